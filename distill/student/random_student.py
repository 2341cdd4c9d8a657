"""Students of random weights in Qwen3.5's structure, from 0.3 million parameters up, with a tokenizer trained on the
training set: for a try on a laptop, and for experiments with a student that knows nothing before."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field

from cosfly.formats.captions import FIELDS, TOKENS
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.seeding import rng_for
from distill.student.model import quiet_transformers, require
from distill.student.saving import writing_errors

END_OF_TURN, IMAGE_TOKEN = "<|im_end|>", "<|image_pad|>"
TINY, RANDOM = "tiny", "random"  # values of `--student` beside folders and names of repositories
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
    "frame position velocity visibility true false drone target world depth camera yaw pitch roll five frames"
    " JSON object",
    " ".join(FIELDS),
)
HEAD_WIDTH = 16  # of the attention heads of small students; wide ones have Qwen3.5's
WIDE_HEAD_WIDTH = 128
WIDE = 512


class RandomStudent(Config):
    """Size of a student of random weights. The vision tower has half its width and half its number of layers."""

    width: int = Field(64, ge=64, multiple_of=64, description="width of the language model")
    layers: int = Field(
        4, ge=4, multiple_of=4, description="layers of the language model; three of four have linear attention"
    )

    @property
    def vocabulary(self) -> int:
        """Number of tokens of the tokenizer, without special tokens."""
        return max(800, 8 * self.width)


def random_student_settings(name: str, given: RandomStudent) -> RandomStudent | None:
    """Return the size of a student of random weights: of `tiny`, or the given one of `random`; None for other names."""
    return {TINY: RandomStudent(), RANDOM: given}.get(name)


def make_tiny_student(folder: Path, seed: int = 0) -> Path:
    """Write a student of about 0.3 million parameters that overfits a handful of captions within minutes on a CPU."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("the folder is not empty", where=folder, fix="choose another --out")
    return make_random_student(folder, RandomStudent(), seed)


def make_random_student(folder: Path, cfg: RandomStudent, seed: int, texts: Iterable[str] = ()) -> Path:
    """Write a randomly initialised student: three layers of linear attention to one of full attention, a vision tower.

    Args:
        texts: what its byte-level tokenizer is trained on, beside a few lines of our own.
    Returns:
        `folder`, with config.json, model.safetensors, tokenizer and preprocessor files.
    """
    require("torch", "transformers")
    import torch
    from transformers import Qwen3_5ForConditionalGeneration
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    quiet_transformers()
    tokenizer = _tokenizer((*_TOKENIZER_TEXT, " ".join(TOKENS), *texts), cfg.vocabulary)
    sizes: Any = {"patch_size": 16, "merge_size": 2, "temporal_patch_size": 2}
    areas: Any = {"shortest_edge": 32 * 32, "longest_edge": 1280 * 1280}  # in pixels
    image_processor = Qwen2VLImageProcessorPil(**sizes, image_mean=[0.5] * 3, image_std=[0.5] * 3, size=areas)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng_for(seed, "distill.tiny_student", "weights").integers(2**31)))
        model = Qwen3_5ForConditionalGeneration(model_config(cfg, tokenizer))
        # Final norm and tied embeddings stay frozen under LoRA and bound the logits by |hidden| |embedding|, which is
        # sqrt(width), hence the loss by 0.29 nats in the smallest; twice the length lets it be sure of an answer.
        with torch.no_grad():
            model.model.language_model.embed_tokens.weight.mul_(2.0)
    with atomic_folder(folder) as partial, writing_errors(partial):
        model.save_pretrained(partial)
        tokenizer.save_pretrained(partial)
        image_processor.save_pretrained(partial)
    return folder


def _tokenizer(lines: Iterable[str], vocabulary: int) -> Any:
    from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers
    from transformers.models.qwen3_5.tokenization_qwen3_5 import PRETOKENIZE_REGEX, Qwen3_5Tokenizer

    bpe = Tokenizer(models.BPE())
    bpe.normalizer = normalizers.NFC()
    bpe.decoder = decoders.ByteLevel()
    words = pre_tokenizers.Split(Regex(PRETOKENIZE_REGEX), "isolated")
    letters = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    bpe.pre_tokenizer = pre_tokenizers.Sequence([words, letters])
    given: Any = {"initial_alphabet": sorted(letters.alphabet()), "show_progress": False}
    trainer = trainers.BpeTrainer(vocab_size=vocabulary, **given)
    bpe.train_from_iterator(lines, trainer)
    state: dict[str, Any] = json.loads(bpe.to_str())["model"]
    own: Any = {"vocab": state["vocab"], "merges": [tuple(merge) for merge in state["merges"]]}
    ends: Any = {"eos_token": END_OF_TURN, "pad_token": _SPECIAL_TOKENS[0]}
    tokenizer = Qwen3_5Tokenizer(**own, **ends, model_max_length=32768)
    tokenizer.add_special_tokens({"extra_special_tokens": list(_SPECIAL_TOKENS[1:])})
    tokenizer.chat_template = _CHAT_TEMPLATE
    return tokenizer


def model_config(cfg: RandomStudent, tokenizer: Any) -> Any:
    """Return the library's configuration of a student: heads and rotary sections as wide as its width allows."""
    from transformers import Qwen3_5Config

    ids = {token: tokenizer.convert_tokens_to_ids(token) for token in _SPECIAL_TOKENS}
    head = WIDE_HEAD_WIDTH if cfg.width >= WIDE else HEAD_WIDTH
    heads = max(2, cfg.width // head)
    section = head // 16  # of half of the rotary half of a head: a quarter each for height and width, the rest for time
    rope = {"rope_type": "default", "rope_theta": 1e4, "partial_rotary_factor": 0.5, "mrope_interleaved": True}
    rope["mrope_section"] = [head // 4 - 2 * section, section, section]
    text = {
        "vocab_size": len(tokenizer),
        "hidden_size": cfg.width,
        "intermediate_size": 2 * cfg.width,
        "num_hidden_layers": cfg.layers,
        "num_attention_heads": heads,
        "num_key_value_heads": heads // 2,
        "head_dim": head,
        "linear_key_head_dim": head,
        "linear_value_head_dim": head,
        "linear_num_key_heads": heads // 2,
        "linear_num_value_heads": heads,
        "layer_types": (["linear_attention"] * 3 + ["full_attention"]) * (cfg.layers // 4),
        "tie_word_embeddings": True,
        "initializer_range": cfg.width**-0.5,  # the usual 0.02 is for wide models
        "rope_parameters": rope,
        "eos_token_id": ids[END_OF_TURN],
        "pad_token_id": ids["<|endoftext|>"],
    }
    vision = {
        "depth": cfg.layers // 2,
        "hidden_size": cfg.width // 2,
        "intermediate_size": cfg.width,
        "num_heads": max(2, cfg.width // 128),
        "out_hidden_size": cfg.width,
        "num_position_embeddings": 64,
    }
    kinds = ("image", "video", "vision_start", "vision_end")
    marks = {f"{kind}_token_id": ids[f"<|{kind}_pad|>" if kind in kinds[:2] else f"<|{kind}|>"] for kind in kinds}
    return Qwen3_5Config(text_config=text, vision_config=vision, tie_word_embeddings=True, **marks)
