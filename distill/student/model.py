"""The student: a vision-language model of Qwen3.5's structure (3.5, 3.6, 3.8), its tokenizer and its image processor.

The processor is put together here from the tokenizer and the Pillow image processor: the ready-made one needs
torchvision and, without it, silently shrinks to the tokenizer. Only `student_folder` reaches for a network, for a
repository's name.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError, shown
from cosfly.runtime.json_io import read_json
from distill.student.kernels import fuse_norms, look_at_equal_sizes_at_once, use_kernels_for

INSTALL = 'pip install "cosfly[distill]"'
MODEL_TYPE = "qwen3_5"
END_OF_TURN = "<|im_end|>"
IMAGE_TOKEN = "<|image_pad|>"
# What the chat templates of Qwen3.5, 3.6 and 3.8 write, and a student must know as one token each.
NEEDED_TOKENS = ("<|im_start|>", END_OF_TURN, "<|vision_start|>", "<|vision_end|>", IMAGE_TOKEN)
HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
MODEL_FILES = ["*.json", "*.safetensors", "*.jinja", "*.txt"]  # of a repository; none of them is code
Device = Literal["auto", "cpu", "cuda"]
Dtype = Literal["auto", "float32", "bfloat16"]


def require(*packages: str) -> None:
    """Check that optional packages can be imported."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise EnvironmentMissing("a package that students need is not installed", got=package, fix=INSTALL)


def quiet_transformers() -> None:
    """Keep the library's own bars, hints and talk of its next version off the terminal, where ours stand."""
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"transformers\.")
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    transformers_logging.set_verbosity_error()


@dataclass
class Processor:
    """What makes numbers of texts and pictures; without the model, so worker processes can have it."""

    tokenizer: Any
    image_processor: Any

    @cached_property
    def end_token_id(self) -> int:
        return int(self.tokenizer.convert_tokens_to_ids(END_OF_TURN))

    @cached_property
    def image_token_id(self) -> int:
        return int(self.tokenizer.convert_tokens_to_ids(IMAGE_TOKEN))

    @cached_property
    def chat_tokens(self) -> tuple[str, ...]:
        """What texts may not hold: tokens that are no text, but turns, pictures, thoughts and calls."""
        return tuple(sorted({token.content for token in self.tokenizer.added_tokens_decoder.values()}))

    @property
    def pad_token_id(self) -> int:
        found = self.tokenizer.pad_token_id
        return self.end_token_id if found is None else int(found)


@dataclass
class Student(Processor):
    """A loaded student. `model` is a transformers model, or a peft model round one; `dtype` is what it computes in,
    where weights that are trained may have more."""

    model: Any
    device: str
    dtype: Any

    @property
    def core(self) -> Any:
        """The transformers model itself, with the layers of an adapter in it where there is one."""
        return self.model.get_base_model() if hasattr(self.model, "get_base_model") else self.model

    @property
    def tower(self) -> Any:
        """The vision tower."""
        return self.core.model.visual

    def embedded(self, ids: Any, features: Any) -> Any:
        """Return what the language model reads of tokens (b, n), with features of the pictures (image tokens, width) in
        them."""
        found = self.core.get_input_embeddings()(ids).to(self.dtype)
        if not len(features):
            return found
        return found.masked_scatter((ids == self.image_token_id)[..., None], features.to(self.dtype))

    def computing(self) -> contextlib.AbstractContextManager:
        """Compute in `dtype`, whatever the weights are kept in; in float32 there is nothing to convert."""
        import torch

        if self.dtype == torch.float32:
            return contextlib.nullcontext()
        return torch.autocast(self.device, self.dtype)


def is_hub_name(name: str) -> bool:
    """Return whether a student is named as a repository of a hub, and not as a folder."""
    return HUB_NAME.fullmatch(name) is not None and not name.startswith(".") and not Path(name).is_dir()


def student_folder(name: str) -> Path:
    """Return the folder of a student: a folder as it is; of a repository's name, as `Qwen/Qwen3.5-2B`, the copy in the
    hub's cache.
    """
    if not is_hub_name(name):
        return Path(name)
    require("torch", "transformers", "peft")
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(name, allow_patterns=MODEL_FILES))
    except (OSError, ValueError, RuntimeError) as error:  # no network, no such repository, no permission
        words = "the student is neither a folder nor a repository that can be loaded"
        fix = "correct the name, or download the model elsewhere and pass its folder"
        raise InputError(words, where=name, got=str(error)[:300], fix=fix) from error


def weight_files(folder: Path) -> dict[str, Path]:
    """Return the files that decide what a model folder computes, for the inputs of a stage: name -> path."""
    config = read_json(folder / "config.json", what="student model (a folder with config.json)")
    found = config.get("model_type") if isinstance(config, dict) else None
    if found != MODEL_TYPE:
        where, expected = f"{folder / 'config.json'}: model_type", f"{MODEL_TYPE!r}, the type of Qwen3.5, 3.6 and 3.8"
        raise InputError("the model type is not supported", where=where, got=shown(found), expected=expected)
    weights = sorted(folder.glob("*.safetensors"))
    if not weights:
        raise InputError(
            "the folder has no weights", where=folder, expected="*.safetensors", fix="download the whole model folder"
        )
    settings = ("config.json", "tokenizer.json", "tokenizer_config.json", "preprocessor_config.json", CHAT_FORMAT_FILE)
    files = [folder / name for name in (*settings, "chat_template.jinja")]
    return {f"model/{path.name}": path for path in (*files, *weights) if path.is_file()}


def pick_device(wanted: Device) -> str:
    """Return the device to use: `cuda` if there is one, unless told otherwise."""
    require("torch")
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise EnvironmentMissing("torch finds no accelerator", got="device=cuda", fix="set device=auto or device=cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


def compute_dtype(wanted: Dtype, device: str) -> Any:
    """Return torch's name of what to compute in: bfloat16 on an accelerator and float32 on a CPU, unless told
    otherwise."""
    import torch

    if wanted == "auto":
        return torch.bfloat16 if device == "cuda" else torch.float32
    return getattr(torch, wanted)


def load_student(
    folder: Path,
    *,
    device: Device = "auto",
    dtype: Dtype = "auto",
    max_pixels: int,
    adapter: Path | None = None,
    is_trained: bool = False,
) -> Student:
    """Load a model folder, with an adapter if one is given.

    Args:
        dtype: what it computes in; auto is bfloat16 on an accelerator and float32 on a CPU.
        max_pixels: images with more pixels are scaled down, sides to multiples of the patch.
        is_trained: keep the weights in float32 in any case, for an optimizer.
    """
    require("torch", "transformers", "peft")
    weight_files(folder)
    quiet_transformers()
    import torch
    from peft import PeftModel
    from safetensors import SafetensorError
    from transformers import AutoModelForImageTextToText

    device_name = pick_device(device)
    computed = compute_dtype(dtype, device_name)
    use_kernels_for(computed, device_name)
    tokenizer, image_processor = load_processor(folder, max_pixels)
    model: Any
    try:
        model = AutoModelForImageTextToText.from_pretrained(
            folder, dtype=torch.float32 if is_trained else computed, local_files_only=True, use_safetensors=True
        )
        if adapter is not None:
            if not (adapter / "adapter_model.safetensors").is_file():
                raise InputError("the folder is not an adapter", where=adapter, expected="adapter_model.safetensors")
            model = PeftModel.from_pretrained(model, adapter)
    except (OSError, RuntimeError, ValueError, SafetensorError) as error:
        raise InputError("the student cannot be loaded", where=adapter or folder, got=str(error)[:300]) from error
    student = Student(tokenizer, image_processor, model, device_name, computed)
    check_tokens_fit(student, folder)
    try:
        model.to(device_name)
    except torch.OutOfMemoryError as error:
        raise EnvironmentMissing(
            "the weights do not fit into the memory of the accelerator", where=folder, got=str(error)[:99]
        ) from error
    if device_name == "cuda":
        fuse_norms(student.core)
    look_at_equal_sizes_at_once(student.core)
    return student


def check_tokens_fit(student: Student, folder: Path) -> None:
    """Check that tokenizer and weights are of one model."""
    known, most = len(student.tokenizer), student.core.get_input_embeddings().weight.shape[0]
    if known > most:
        raise InputError(
            "the tokenizer has more tokens than the model", where=folder, got=known, expected=f"at most {most}"
        )
    found, wanted = student.image_token_id, student.core.config.image_token_id
    if found != wanted:
        words = f"the tokenizer and the model have different ids for {IMAGE_TOKEN}"
        raise InputError(words, where=folder, got=found, expected=f"{wanted} (image_token_id in config.json)")


def load_processor(folder: Path, max_pixels: int) -> tuple[Any, Any]:
    """Load the tokenizer and the image processor of a model folder."""
    require("transformers")
    from transformers import AutoTokenizer
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    try:
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        image_processor = Qwen2VLImageProcessorPil.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError) as error:
        raise InputError("the processor of the student cannot be loaded", where=folder, got=str(error)[:300]) from error
    if not tokenizer.chat_template:
        raise InputError("the tokenizer has no chat template", where=folder, expected="chat_template.jinja")
    if missing := set(NEEDED_TOKENS) - tokenizer.get_vocab().keys():
        raise InputError(
            "the tokenizer lacks tokens for chats with pictures", where=folder, expected=", ".join(missing)
        )
    side_px = image_processor.patch_size * image_processor.merge_size
    if max_pixels < side_px**2:
        raise ConfigError(
            "the value is too small for one patch",
            where="max_pixels",
            got=max_pixels,
            expected=f"at least {side_px**2}",
        )
    own = image_processor.size  # areas in pixels, in spite of the names
    largest = min(int(own["longest_edge"]), max_pixels)
    image_processor.size = {"shortest_edge": min(int(own["shortest_edge"]), largest), "longest_edge": largest}
    return tokenizer, image_processor
