"""The student: a Qwen3.5 vision-language model from a local folder, its tokenizer and its image processor.

The processor is put together here from the tokenizer and the Pillow image processor, because the ready-made one needs
torchvision and, without it, silently shrinks to the tokenizer. Nothing is ever downloaded.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from cosfly.chance import rng_for
from cosfly.errors import ConfigError, EnvironmentMissing, InputError
from cosfly.products.captions import ACTIONS, FIELDS
from cosfly.reading.documents import read_json
from cosfly.store import atomic_folder

INSTALL = 'pip install "cosfly[distill]"'
MODEL_TYPE = "qwen3_5"
END_OF_TURN = "<|im_end|>"
IMAGE_TOKEN = "<|image_pad|>"
Device = Literal["auto", "cpu", "cuda"]


def require(*packages: str) -> None:
    """Check that optional packages can be imported.

    Raises:
        EnvironmentMissing: names the first missing one and the install line.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise EnvironmentMissing("a package that students need is not installed", got=package, fix=INSTALL)


def quiet_transformers() -> None:
    """Keep the library's own bars and hints off the terminal, where ours stand."""
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    transformers_logging.set_verbosity_error()


@dataclass
class Student:
    """A loaded student. `model` is a transformers model, or a peft model round one."""

    model: Any
    tokenizer: Any
    image_processor: Any
    device: str

    @cached_property
    def end_token_id(self) -> int:
        return int(self.tokenizer.convert_tokens_to_ids(END_OF_TURN))

    @cached_property
    def image_token_id(self) -> int:
        return int(self.tokenizer.convert_tokens_to_ids(IMAGE_TOKEN))

    @property
    def pad_token_id(self) -> int:
        found = self.tokenizer.pad_token_id
        return self.end_token_id if found is None else int(found)


def weight_files(folder: Path) -> dict[str, Path]:
    """Give the files that decide what a model folder computes, for the inputs of a stage: name -> path.

    Raises:
        InputError: it is not a folder of a Qwen3.5 model with safetensors weights.
    """
    config = read_json(folder / "config.json", what="student model (a folder with config.json)")
    found = config.get("model_type") if isinstance(config, dict) else None
    if found != MODEL_TYPE:
        raise InputError(
            "not a student that cosfly knows",
            where=f"{folder / 'config.json'}: model_type",
            got=repr(found),
            expected=f"{MODEL_TYPE!r}, for instance Qwen3.5-2B, or a folder made by cosfly distill tiny-student",
        )
    weights = sorted(folder.glob("*.safetensors"))
    if not weights:
        raise InputError("no weights", where=folder, expected="*.safetensors", fix="download the whole model folder")
    settings = ("config.json", "tokenizer.json", "tokenizer_config.json", "preprocessor_config.json")
    files = [path for name in (*settings, "chat_template.jinja") if (path := folder / name).is_file()]
    return {f"model/{path.name}": path for path in (*files, *weights)}


def pick_device(wanted: Device) -> str:
    """Give the device to use: `cuda` if there is one, unless told otherwise.

    Raises:
        EnvironmentMissing: cuda was asked for and is not there.
    """
    require("torch")
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise EnvironmentMissing("no accelerator is visible to torch", got="device=cuda", fix="set device=auto or cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


def load_student(folder: Path, *, device: Device = "auto", max_pixels: int, adapter: Path | None = None) -> Student:
    """Load a model folder, bfloat16 on an accelerator and float32 on a CPU, with an adapter if one is given.

    Args:
        max_pixels: images with more pixels are scaled down, sides to multiples of the patch.
    Raises:
        InputError: the folder does not hold a whole Qwen3.5 model, or the adapter does not fit it.
        EnvironmentMissing: torch, transformers or peft is missing.
    """
    require("torch", "transformers", "peft")
    weight_files(folder)
    quiet_transformers()
    import torch
    from peft import PeftModel
    from safetensors import SafetensorError
    from transformers import AutoModelForImageTextToText

    device_name = pick_device(device)
    dtype = torch.bfloat16 if device_name == "cuda" else torch.float32
    tokenizer, image_processor = load_processor(folder, max_pixels)
    model: Any
    try:
        model = AutoModelForImageTextToText.from_pretrained(
            folder, dtype=dtype, local_files_only=True, use_safetensors=True
        )
        if adapter is not None:
            if not (adapter / "adapter_model.safetensors").is_file():
                raise InputError(
                    "not an adapter",
                    where=adapter,
                    expected="adapter_model.safetensors",
                    fix="run cosfly distill train",
                )
            model = PeftModel.from_pretrained(model, adapter)
    except (OSError, RuntimeError, ValueError, SafetensorError) as error:
        raise InputError("the student does not load", where=adapter or folder, got=str(error)[:300]) from error
    return Student(model.to(device_name), tokenizer, image_processor, device_name)


def load_processor(folder: Path, max_pixels: int) -> tuple[Any, Any]:
    """Load the tokenizer and the image processor of a model folder.

    Raises:
        InputError: one of them is missing or has no chat template.
    """
    require("transformers")
    from transformers import AutoTokenizer
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    try:
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        image_processor = Qwen2VLImageProcessorPil.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError) as error:
        raise InputError("the student's processor does not load", where=folder, got=str(error)[:300]) from error
    if not tokenizer.chat_template:
        raise InputError("the tokenizer has no chat template", where=folder, expected="chat_template.jinja")
    known = tokenizer.get_vocab()
    for token in (END_OF_TURN, IMAGE_TOKEN):
        if token not in known:
            raise InputError("the tokenizer lacks a token", where=folder, expected=token)
    smallest = min(int(image_processor.size["shortest_edge"]), max_pixels)  # areas in pixels, in spite of the names
    side_px = image_processor.patch_size * image_processor.merge_size
    if max_pixels < side_px**2:
        raise ConfigError("too small for one patch", where="max_pixels", got=max_pixels, expected=f">= {side_px**2}")
    image_processor.size = {"shortest_edge": smallest, "longest_edge": max_pixels}
    return tokenizer, image_processor


# --- a student without weights ----------------------------------------------------------------------------------------

_CHAT_TEMPLATE = (
    "{%- for m in messages %}{{ '<|im_start|>' + m.role + '\n' }}"
    "{%- if m.content is string %}{{ m.content }}"
    "{%- else %}{%- for c in m.content %}"
    "{%- if c.type == 'image' %}{{ '<|vision_start|><|image_pad|><|vision_end|>' }}{%- else %}{{ c.text }}{%- endif %}"
    "{%- endfor %}{%- endif %}{{ '<|im_end|>\n' }}{%- endfor %}"
    "{%- if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{%- endif %}"
)
_SPECIAL_TOKENS = (
    "<|endoftext|>", "<|im_start|>", END_OF_TURN, "<|vision_start|>", "<|vision_end|>", IMAGE_TOKEN, "<|video_pad|>",
)  # fmt: skip
# Enough text for a small vocabulary whose longer pieces are words of drone captions.
_TOKENIZER_TEXT = (
    '{"critical_components":"the pedestrian is visible in the image at a distance of metres ahead of the drone",',
    '"reasoning_trace":"the target turns left so the drone should turn left to keep it in the centre of the view",',
    '{"critical_components":"目标行人在画面中央，无人机保持距离，左侧有建筑物","reasoning_trace":"行人向右转弯，因此无人机应右转跟随",',
    "frame position velocity visibility true false drone target world depth camera yaw pitch roll five frames JSON object",
)


def make_tiny_student(folder: Path, seed: int = 0) -> Path:
    """Write a randomly initialised Qwen3.5 student of about 0.3 million parameters, so that all of distillation runs anywhere.

    It has the architecture of the real ones (three linear-attention layers to one of full attention, a vision tower, a
    byte-level tokenizer trained on a few lines), knows nothing, and overfits a handful of captions within minutes on a CPU.

    Returns:
        `folder`, with config.json, model.safetensors, tokenizer and preprocessor files.
    Raises:
        InputError: the folder exists and is not empty.
        EnvironmentMissing: torch or transformers is missing.
    """
    require("torch", "transformers")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("the folder is not empty", where=folder, fix="choose another --out")
    import torch
    from transformers import Qwen3_5ForConditionalGeneration
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    quiet_transformers()
    tokenizer = _tiny_tokenizer((*_TOKENIZER_TEXT, " ".join(FIELDS), " ".join(ACTIONS)))
    image_processor = Qwen2VLImageProcessorPil(
        patch_size=16,
        merge_size=2,
        temporal_patch_size=2,
        image_mean=[0.5] * 3,
        image_std=[0.5] * 3,
        size={"shortest_edge": 32 * 32, "longest_edge": 1280 * 1280},  # areas in pixels
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng_for(seed, "distill.tiny_student", "weights").integers(2**31)))
        model = Qwen3_5ForConditionalGeneration(_tiny_config(tokenizer))
        # Final norm and tied embeddings stay frozen under LoRA and bound the logits by |hidden| |embedding| = 8 * 1, hence the
        # loss by about 0.29 nats; twice the length lets a student be sure of an answer.
        with torch.no_grad():
            model.model.language_model.embed_tokens.weight.mul_(2.0)
    with atomic_folder(folder) as partial:
        model.save_pretrained(partial)
        tokenizer.save_pretrained(partial)
        image_processor.save_pretrained(partial)
    return folder


def _tiny_tokenizer(lines: Iterable[str]) -> Any:
    from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers
    from transformers.models.qwen3_5.tokenization_qwen3_5 import PRETOKENIZE_REGEX, Qwen3_5Tokenizer

    bpe = Tokenizer(models.BPE())
    bpe.normalizer = normalizers.NFC()
    bpe.decoder = decoders.ByteLevel()
    bpe.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(PRETOKENIZE_REGEX), "isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    trainer = trainers.BpeTrainer(
        vocab_size=800, initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()), show_progress=False
    )
    bpe.train_from_iterator(lines, trainer)
    state: dict[str, Any] = json.loads(bpe.to_str())["model"]
    tokenizer = Qwen3_5Tokenizer(
        vocab=state["vocab"],
        merges=[tuple(merge) for merge in state["merges"]],  # type: ignore[misc]  # pairs, as the library wants them
        eos_token=END_OF_TURN,
        pad_token=_SPECIAL_TOKENS[0],
        model_max_length=32768,
    )
    tokenizer.add_special_tokens({"extra_special_tokens": list(_SPECIAL_TOKENS[1:])})
    tokenizer.chat_template = _CHAT_TEMPLATE
    return tokenizer


def _tiny_config(tokenizer: Any) -> Any:
    from transformers import Qwen3_5Config

    ids = {token: tokenizer.convert_tokens_to_ids(token) for token in _SPECIAL_TOKENS}
    rope = {
        "rope_type": "default",
        "rope_theta": 1e4,
        "partial_rotary_factor": 0.5,
        "mrope_section": [2, 1, 1],
        "mrope_interleaved": True,
    }
    text = {
        "vocab_size": len(tokenizer),
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 16,
        "linear_key_head_dim": 16,
        "linear_value_head_dim": 16,
        "linear_num_key_heads": 2,
        "linear_num_value_heads": 4,
        "layer_types": ["linear_attention"] * 3 + ["full_attention"],
        "tie_word_embeddings": True,
        "initializer_range": 0.125,  # 1 / sqrt(hidden size); the usual 0.02 is for wide models
        "rope_parameters": rope,
        "eos_token_id": ids[END_OF_TURN],
        "pad_token_id": ids["<|endoftext|>"],
    }
    vision = {
        "depth": 2,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_heads": 2,
        "out_hidden_size": 64,
        "num_position_embeddings": 64,
    }
    return Qwen3_5Config(
        text_config=text,
        vision_config=vision,
        image_token_id=ids[IMAGE_TOKEN],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
        tie_word_embeddings=True,
    )
