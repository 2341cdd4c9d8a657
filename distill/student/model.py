"""Load a student through transformers' Auto classes: a vision-language model or a language model of any family.

A student is a folder, the name of a repository on a hub, or a GGUF file. Only `student_path` uses the network.
"""

import contextlib
import importlib.util
import inspect
import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cosfly.runtime.errors import CosflyError, EnvironmentMissing, InputError
from cosfly.runtime.io import read_text
from cosfly.runtime.json_io import read_json, read_object
from distill.student import qwen3_5
from distill.student.chat import Processor

log = logging.getLogger(__name__)

INSTALL = 'pip install -e ".[distill]"'
HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
MODEL_FILES = ["*.json", "*.safetensors", "*.jinja", "*.txt", "*.model"]  # of a repository; none of them is code
GGUF = ".gguf"
TEMPLATE = "chat_template.jinja"
Device = Literal["auto", "cpu", "cuda"]
Dtype = Literal["auto", "float32", "bfloat16"]


def require(*packages: str) -> None:
    """Check that optional packages can be imported."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            fix = "pip install gguf" if package == "gguf" else INSTALL
            raise EnvironmentMissing("a package that students need is not installed", got=package, fix=fix)


def quiet_transformers() -> None:
    """Turn off the library's progress bars and hints, which would mix with ours."""
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"transformers\.")
    from transformers import modeling_gguf_pytorch_utils
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    modeling_gguf_pytorch_utils.tqdm = transformers_logging.tqdm  # its own bar does not follow the line above
    transformers_logging.set_verbosity_error()


@dataclass(kw_only=True)
class Student(Processor):
    """A loaded student."""

    model: Any  # a transformers model, or a peft model around it
    device: str
    dtype: Any  # of the computation; weights that are trained may be kept in float32
    stored: Any = None  # type of the weights on disk, if known

    @property
    def core(self) -> Any:
        """The transformers model, which includes the layers of an adapter."""
        return self.model.get_base_model() if hasattr(self.model, "get_base_model") else self.model

    def computing(self) -> contextlib.AbstractContextManager:
        """Compute in `dtype`, whatever the type of the weights; in float32 there is nothing to convert."""
        import torch

        if self.dtype == torch.float32:
            return contextlib.nullcontext()
        return torch.autocast(self.device, self.dtype)


# --- where a student is -----------------------------------------------------------------------------------------------


def is_hub_name(name: str) -> bool:
    """Return whether a student is named as a repository of a hub and not as a folder or a file."""
    return HUB_NAME.fullmatch(name) is not None and not name.startswith(".") and not Path(name).exists()


def student_path(name: str, *, allow_code: bool = False) -> Path:
    """Return the folder or the GGUF file of a student. A repository, such as `Qwen/Qwen3.5-2B`, is downloaded into the
    hub's cache, with its code if `allow_code`."""
    if not is_hub_name(name):
        return Path(name)
    require("torch", "transformers", "peft")
    from huggingface_hub import snapshot_download

    patterns = [*MODEL_FILES, *["*.py"] * allow_code]
    try:
        return Path(snapshot_download(name, allow_patterns=patterns))
    except (OSError, ValueError, RuntimeError) as error:  # no network, no such repository, no permission
        words = "the student is neither a folder nor a repository that can be loaded"
        fix = "correct the name, or download the model elsewhere and pass its folder"
        raise InputError(words, where=name, got=str(error)[:300], fix=fix) from error


def weight_files(path: Path) -> dict[str, Path]:
    """Return the files that decide what a student computes, for the inputs of a stage: name -> path."""
    if path.suffix == GGUF:
        if not path.is_file():
            raise InputError("the file does not exist", where=path)
        return {f"model/{path.name}": path}
    read_json(path / "config.json", what="student model (a folder with config.json, or a GGUF file)")
    if not any(path.glob("*.safetensors")):
        fix = "download the whole model folder"
        raise InputError("the folder has no weights", where=path, expected="*.safetensors", fix=fix)
    files = {file for pattern in MODEL_FILES for file in path.glob(pattern)}
    return {f"model/{file.name}": file for file in sorted(files)}


def pick_device(wanted: Device) -> str:
    """Return the device to use: `cuda` if there is one, unless the settings say otherwise."""
    import torch

    has_cuda = torch.cuda.is_available()
    if wanted == "cuda" and not has_cuda:
        raise EnvironmentMissing("torch finds no accelerator", got="device=cuda", fix="set device=auto or device=cpu")
    if wanted == "auto":
        return "cuda" if has_cuda else "cpu"
    return wanted


def compute_dtype(wanted: Dtype, device: str) -> Any:
    """Return the type of the computation: bfloat16 on an accelerator and float32 on a CPU, unless `wanted`."""
    import torch

    if wanted == "auto":
        return torch.bfloat16 if device == "cuda" else torch.float32
    return getattr(torch, wanted)


# --- loading ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def loading_errors(what: str, where: Path) -> Iterator[None]:
    """Convert what transformers, peft, gguf and safetensors raise about a file into one line."""
    try:
        yield
    except (CosflyError, AttributeError, NameError, MemoryError):
        raise
    except Exception as error:  # tokenizers raises this class itself
        got = " ".join(str(error).split())[:300] or type(error).__name__
        fix = "update transformers, or use another student"
        if "trust_remote_code" in str(error):
            got, fix = "a model with its own code", "set allow_code=true if you trust this code, or use another student"
        elif where.suffix == GGUF:
            fix = "use a file of another quantization, such as Q8_0 or F16"
        raise InputError(f"the {what} cannot be loaded", where=where, got=got, fix=fix) from error


def _picture_processor(config: Any, tokenizer: Any, arguments: dict[str, Any]) -> Any:
    """Put the processor of a family together without its video part, which needs torchvision and is never used."""
    from transformers import AutoImageProcessor
    from transformers.models.auto import processing_auto

    folder = arguments["pretrained_model_name_or_path"]
    images = AutoImageProcessor.from_pretrained(**arguments, backend="pil")
    recorded: dict[str, Any] = {}
    if (folder / "processor_config.json").is_file():
        recorded = read_object(folder / "processor_config.json", what="processor")
    name = recorded.get("processor_class") or processing_auto.PROCESSOR_MAPPING_NAMES.get(config.model_type)
    if name is None:
        raise ValueError(f"transformers has no processor for model_type {config.model_type!r}")
    base: Any = processing_auto.processor_class_from_name(name)
    parts = [part for part in base.get_attributes() if part in ("image_processor", "tokenizer")]

    class PictureProcessor(base):
        @classmethod
        def get_attributes(cls) -> list[str]:
            return parts

    parameters = inspect.signature(base.__init__).parameters
    settings = {key: value for key, value in recorded.items() if key in parameters and "processor" not in key}
    if "video_processor" in parameters:
        settings["video_processor"] = None
    if (file := folder / "chat_template.json").is_file():
        settings.setdefault("chat_template", read_object(file, what="chat template").get("chat_template"))
    PictureProcessor.__name__ = base.__name__
    return PictureProcessor(image_processor=images, tokenizer=tokenizer, **settings)


def load_student(
    path: Path, *,
    device: Device = "auto", dtype: Dtype = "auto", adapter: Path | None = None, is_trained: bool = False,
    template: str = "", allow_code: bool = False,
) -> Student:  # fmt: skip
    """Load a student, with an adapter if one is given.

    Args:
        path: a model folder or a GGUF file.
        dtype: type of the computation; auto is bfloat16 on an accelerator and float32 on a CPU.
        is_trained: keep all weights in float32, for an optimizer.
        template: chat template that replaces that of the student; by default that of the adapter, if it has one.
    """
    require("torch", "transformers", "peft")
    weight_files(path)
    log.info("loading the student %s%s", path, ", a GGUF file: this may take minutes" * (path.suffix == GGUF))
    import torch
    from transformers import AutoConfig, AutoModelForCausalLM, AutoModelForImageTextToText, AutoTokenizer
    from transformers.models.auto.modeling_auto import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING

    quiet_transformers()
    device_name = pick_device(device)
    computed = compute_dtype(dtype, device_name)
    arguments: Any = {"pretrained_model_name_or_path": path, "local_files_only": True, "trust_remote_code": allow_code}
    if path.suffix == GGUF:
        require("gguf")
        arguments |= {"pretrained_model_name_or_path": path.parent, "gguf_file": path.name}
    with loading_errors("configuration of the student", path):
        config = AutoConfig.from_pretrained(**arguments)
    stored = None if path.suffix == GGUF else getattr(config, "dtype", None)
    own_code = getattr(config, "auto_map", None) or {}
    takes_pictures = type(config) in MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING or "AutoModelForImageTextToText" in own_code
    with loading_errors("tokenizer of the student", path):
        tokenizer: Any = AutoTokenizer.from_pretrained(**arguments)
    library = None
    if takes_pictures and hasattr(config, "vision_config"):
        with loading_errors("processor of the student", path):
            library = _picture_processor(config, tokenizer, arguments)
    if not template and adapter is not None and (adapter / TEMPLATE).is_file():
        template = read_text(adapter / TEMPLATE, what="chat template")
    Processor(tokenizer, library, template).check(path)
    is_qwen3_5 = config.model_type == "qwen3_5"  # for which we have faster code
    if is_qwen3_5:
        qwen3_5.choose_kernels(computed, device_name)
    auto_class: Any = AutoModelForImageTextToText if takes_pictures else AutoModelForCausalLM
    weights_dtype = torch.float32 if is_trained else computed
    with loading_errors("student", adapter or path):
        model, info = auto_class.from_pretrained(
            **arguments, config=config, dtype=weights_dtype, use_safetensors=True, output_loading_info=True
        )
        if missing := sorted(info["missing_keys"]):  # the library would fill them with random numbers
            got, fix = f"no {', '.join(missing[:3])} ({len(missing)} missing)", "download the whole model"
            raise InputError("the student has no weights for some of its layers", where=path, got=got, fix=fix)
        if path.suffix == GGUF:  # the weights are plain numbers now, which can be saved
            model.config.__dict__.pop("quantization_config", None)
            model.__dict__.pop("hf_quantizer", None)
        if adapter is not None:
            model = _with_adapter(model, adapter)
    model.to(device_name)
    if is_qwen3_5 and device_name == "cuda":
        qwen3_5.fuse_norms(model)
    log.info("the student is loaded")
    return Student(tokenizer, library, template, model=model, device=device_name, dtype=computed, stored=stored)


def _with_adapter(model: Any, adapter: Path) -> Any:
    """Return a model with an adapter, all of whose tensors must fit: the library leaves a missing one at zero."""
    from peft import PeftModel, load_peft_weights

    if not (adapter / "adapter_model.safetensors").is_file():
        raise InputError("the folder is not an adapter", where=adapter, expected="adapter_model.safetensors")
    model = PeftModel.from_pretrained(model, adapter)
    num_tensors = len(load_peft_weights(str(adapter), device="cpu"))
    num_expected = sum("lora_" in name for name, _ in model.named_parameters())
    if num_tensors != num_expected:
        got, fix = f"{num_tensors} tensors", "pass the base model of this adapter, or the whole adapter"
        words, expected = "the adapter does not fit the model", f"{num_expected} tensors"
        raise InputError(words, where=adapter, got=got, expected=expected, fix=fix)
    return model
