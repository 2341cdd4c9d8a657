"""Load a student through transformers' Auto classes: a vision-language model or a language model of any family.

A student is a folder, the name of a repository on a hub, or a GGUF file. Only `student_path` uses the network.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import logging
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.errors import EnvironmentMissing, InputError, shown
from cosfly.runtime.io import read_text
from cosfly.runtime.json_io import read_json, read_object
from distill.student.chat import Processor

log = logging.getLogger(__name__)

INSTALL = 'pip install "cosfly[distill]"'
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
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    transformers_logging.set_verbosity_error()


@dataclass(kw_only=True)
class Student(Processor):
    """A loaded student. `model` is a transformers model or a peft model around it; `dtype` is the type of the
    computation, while weights that are trained may be kept in float32."""

    model: Any
    device: str
    dtype: Any

    @property
    def core(self) -> Any:
        """The transformers model, which includes the layers of an adapter."""
        return self.model.get_base_model() if hasattr(self.model, "get_base_model") else self.model

    @property
    def processor(self) -> Processor:
        """The student without its model, for worker processes."""
        return Processor(self.tokenizer, self.library, self.picture_token_id, self.template)

    @property
    def width(self) -> int:
        """Width of the language model."""
        return int(self.core.config.get_text_config().hidden_size)

    @property
    def has_image_features(self) -> bool:
        """Whether pictures can be encoded apart from the language model, so that each is encoded once."""
        return hasattr(self.core.base_model, "get_image_features")

    def vision_modules(self) -> list[Any]:
        """Return the parts of the model that are not its language model and not its output head."""
        decoder = {id(module) for module in self.core.get_decoder().modules()} if self.has_pictures else set()
        head = self.core.get_output_embeddings()
        children = self.core.base_model.children() if self.has_pictures else ()
        return [child for child in children if id(child) not in decoder and child is not head]

    def language_layers(self) -> tuple[str, list[str]]:
        """Return the name of the language model inside `core`, and the names of its linear layers below it."""
        import torch

        decoder, head = self.core.get_decoder(), self.core.get_output_embeddings()
        prefix = next(name for name, module in self.core.named_modules() if module is decoder)
        linear = (torch.nn.Linear,)
        return prefix, [n for n, m in decoder.named_modules() if isinstance(m, linear) and m is not head]

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
    """Return the folder or the GGUF file of a student.

    Args:
        name: a folder, a GGUF file, a folder with one GGUF file and no configuration, or a repository such as
            `Qwen/Qwen3.5-2B`, which is downloaded into the hub's cache.
        allow_code: download the code of the repository too.
    """
    if is_hub_name(name):
        require("torch", "transformers", "peft")
        from huggingface_hub import snapshot_download

        patterns = [*MODEL_FILES, *["*.py"] * allow_code]
        try:
            path = Path(snapshot_download(name, allow_patterns=patterns))
        except (OSError, ValueError, RuntimeError) as error:  # no network, no such repository, no permission
            words = "the student is neither a folder nor a repository that can be loaded"
            fix = "correct the name, or download the model elsewhere and pass its folder"
            raise InputError(words, where=name, got=str(error)[:300], fix=fix) from error
    else:
        path = Path(name)
    found = sorted(path.glob(f"*{GGUF}")) if path.is_dir() and not (path / "config.json").is_file() else []
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise InputError("the folder has several GGUF files", where=path, got=names, fix="pass one of these files")
    return found[0] if found else path


def weight_files(path: Path) -> dict[str, Path]:
    """Return the files that decide what a student computes, for the inputs of a stage: name -> path."""
    if path.suffix == GGUF:
        if not path.is_file():
            raise InputError("the file does not exist", where=path)
        return {f"model/{path.name}": path}
    read_json(path / "config.json", what="student model (a folder with config.json, or a GGUF file)")
    weights = sorted(path.glob("*.safetensors"))
    if not weights:
        fix = "download the whole model folder"
        raise InputError("the folder has no weights", where=path, expected="*.safetensors", fix=fix)
    settings = ("config.json", "tokenizer.json", "tokenizer.model", "tokenizer_config.json", CHAT_FORMAT_FILE)
    pictures = ("preprocessor_config.json", "processor_config.json")
    files = [path / name for name in (*settings, *pictures, TEMPLATE, "chat_template.json")]
    return {f"model/{file.name}": file for file in (*files, *weights) if file.is_file()}


def pick_device(wanted: Device) -> str:
    """Return the device to use: `cuda` if there is one, unless the settings say otherwise."""
    require("torch")
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise EnvironmentMissing("torch finds no accelerator", got="device=cuda", fix="set device=auto or device=cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


def compute_dtype(wanted: Dtype, device: str) -> Any:
    """Return the type of the computation: bfloat16 on an accelerator and float32 on a CPU, unless `wanted`."""
    import torch

    if wanted == "auto":
        return torch.bfloat16 if device == "cuda" else torch.float32
    return getattr(torch, wanted)


# --- loading ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def loading_errors(what: str, where: Path) -> Any:
    """Turn what transformers, gguf and safetensors raise about a bad file into one line."""
    from safetensors import SafetensorError

    try:
        yield
    except (ImportError, LookupError, OSError, RuntimeError, TypeError, ValueError, SafetensorError) as error:
        words = " ".join(str(error).split())[:300] or type(error).__name__
        fix = "use a file of another quantization, such as Q8_0 or F16" if where.suffix == GGUF else None
        raise InputError(f"the {what} cannot be loaded", where=where, got=words, fix=fix) from error


def _arguments(path: Path, allow_code: bool) -> dict[str, Any]:
    """Return what transformers' `from_pretrained` is given for a student."""
    common = {"local_files_only": True, "trust_remote_code": allow_code}
    if path.suffix != GGUF:
        return {"pretrained_model_name_or_path": path, **common}
    require("gguf")
    return {"pretrained_model_name_or_path": path.parent, "gguf_file": path.name, **common}


def load_config(path: Path, *, allow_code: bool = False) -> Any:
    """Load the configuration of a student, and check that transformers knows its family without code of its own."""
    require("torch", "transformers")
    from transformers import AutoConfig
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    if path.suffix != GGUF:
        value = read_object(path / "config.json", what="student model")
        kind = value.get("model_type")
        if kind not in CONFIG_MAPPING and "auto_map" in value and not allow_code:
            words = "the student needs code from its own repository, which is not run"
            fix = "use a family that transformers has, or allow it with allow_code=true if you trust the code"
            raise InputError(words, where=path, got=f"model_type {shown(kind)}", fix=fix)
        if kind not in CONFIG_MAPPING and "auto_map" not in value:
            fix = "update transformers, or use another student"
            raise InputError("transformers does not know the model type", where=path, got=shown(kind), fix=fix)
    with loading_errors("configuration of the student", path):
        return AutoConfig.from_pretrained(**_arguments(path, allow_code))


def model_class(config: Any, path: Path) -> Any:
    """Return the Auto class of a student: with a vision part for image, text to text, otherwise for text alone."""
    from transformers import AutoModelForCausalLM, AutoModelForImageTextToText
    from transformers.models.auto.modeling_auto import (
        MODEL_FOR_CAUSAL_LM_MAPPING,
        MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING,
    )

    auto_map = getattr(config, "auto_map", None) or {}
    pairs = (
        (AutoModelForImageTextToText, MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING),
        (AutoModelForCausalLM, MODEL_FOR_CAUSAL_LM_MAPPING),
    )
    for auto_class, mapping in pairs:
        if type(config) in mapping or auto_class.__name__ in auto_map:
            return auto_class
    words = "the model is neither a language model nor a vision-language model"
    raise InputError(words, where=path, got=f"model_type {config.model_type!r}", fix="use another student")


def load_processor(
    path: Path, *, adapter: Path | None = None, template: str = "", allow_code: bool = False
) -> Processor:
    """Load the tokenizer of a student and, if it has a vision part, its processor.

    Args:
        adapter: folder whose chat template takes precedence: the one of its training.
        template: text of a chat template that takes precedence over all.
    """
    config = load_config(path, allow_code=allow_code)
    auto_class = model_class(config, path)
    from transformers import AutoTokenizer

    quiet_transformers()
    arguments = _arguments(path, allow_code)
    with loading_errors("tokenizer of the student", path):
        tokenizer: Any = AutoTokenizer.from_pretrained(**arguments)
    library = None
    if auto_class.__name__ == "AutoModelForImageTextToText" and hasattr(config, "vision_config"):
        with loading_errors("processor of the student", path):
            library = _picture_processor(config, tokenizer, arguments)
    taught = adapter / TEMPLATE if adapter is not None else None
    if not template and taught is not None and taught.is_file():
        template = read_text(taught, what="chat template")
    token = getattr(config, "image_token_id", None) or getattr(config, "image_token_index", None)
    processor = Processor(tokenizer, library, token, template)
    processor.check(path)
    return processor


def _picture_processor(config: Any, tokenizer: Any, arguments: dict[str, Any]) -> Any:
    """Put the processor of a family together without its video part, which needs torchvision and is never used."""
    from transformers import AutoImageProcessor
    from transformers.models.auto import processing_auto

    folder = arguments["pretrained_model_name_or_path"]
    images = AutoImageProcessor.from_pretrained(**arguments, backend="pil")
    own: dict[str, Any] = {}
    if (folder / "processor_config.json").is_file():
        own = read_object(folder / "processor_config.json", what="processor")
    name = own.get("processor_class") or processing_auto.PROCESSOR_MAPPING_NAMES.get(config.model_type)
    if name is None:
        raise ValueError(f"transformers has no processor for model_type {config.model_type!r}")
    base: Any = processing_auto.processor_class_from_name(name)
    used = [part for part in base.get_attributes() if part in ("image_processor", "tokenizer")]

    class PictureProcessor(base):
        @classmethod
        def get_attributes(cls) -> list[str]:
            return used

    known = inspect.signature(base.__init__).parameters
    settings = {key: value for key, value in own.items() if key in known and "processor" not in key}
    if "video_processor" in known:
        settings["video_processor"] = None
    if (file := folder / "chat_template.json").is_file():
        settings.setdefault("chat_template", read_object(file, what="chat template").get("chat_template"))
    PictureProcessor.__name__ = base.__name__
    return PictureProcessor(image_processor=images, tokenizer=tokenizer, **settings)


def load_student(
    path: Path,
    *,
    device: Device = "auto",
    dtype: Dtype = "auto",
    adapter: Path | None = None,
    is_trained: bool = False,
    template: str = "",
    allow_code: bool = False,
) -> Student:
    """Load a student, with an adapter if one is given.

    Args:
        path: a model folder or a GGUF file.
        dtype: type of the computation; auto is bfloat16 on an accelerator and float32 on a CPU.
        is_trained: keep all weights in float32, for an optimizer.
        template: chat template that replaces that of the student.
    """
    require("torch", "transformers", "peft")
    weight_files(path)
    import torch
    from peft import PeftModel

    device_name = pick_device(device)
    computed = compute_dtype(dtype, device_name)
    processor = load_processor(path, adapter=adapter, template=template, allow_code=allow_code)
    config = load_config(path, allow_code=allow_code)
    family = importlib.import_module(FAST_FAMILIES[config.model_type]) if config.model_type in FAST_FAMILIES else None
    if family is not None:
        family.choose_kernels(computed, device_name)
    model: Any
    with loading_errors("student", adapter or path):
        model = model_class(config, path).from_pretrained(
            **_arguments(path, allow_code), dtype=torch.float32 if is_trained else computed, use_safetensors=True
        )
        if path.suffix == GGUF:
            model.config.__dict__.pop("quantization_config", None)  # the weights are plain numbers now
        if adapter is not None:
            if not (adapter / "adapter_model.safetensors").is_file():
                raise InputError("the folder is not an adapter", where=adapter, expected="adapter_model.safetensors")
            model = PeftModel.from_pretrained(model, adapter)
            check_adapter(model, adapter)
    parts = processor.tokenizer, processor.library, processor.picture_token_id, processor.template
    student = Student(*parts, model=model, device=device_name, dtype=computed)
    known, most = len(student.tokenizer), student.core.get_input_embeddings().weight.shape[0]
    if known > most:
        words = "the tokenizer has more tokens than the model"
        raise InputError(words, where=path, got=known, expected=f"at most {most}")
    try:
        model.to(device_name)
    except torch.OutOfMemoryError as error:
        words = "the weights do not fit into the memory of the accelerator"
        raise EnvironmentMissing(words, where=path, got=str(error)[:99]) from error
    if family is not None and device_name == "cuda":
        family.fuse_norms(student.core)
    return student


def adapter_tensors(adapter: Path) -> list[str]:
    """Return the names of the tensors of an adapter."""
    from safetensors import safe_open

    with loading_errors("adapter", adapter), safe_open(adapter / "adapter_model.safetensors", framework="pt") as file:
        return list(file.keys())


def check_adapter(model: Any, adapter: Path) -> None:
    """Check that each tensor of an adapter has its layer in the model, because peft ignores those without one."""
    found = len(adapter_tensors(adapter))
    wanted = sum("lora_" in name for name, _ in model.named_parameters())
    if found != wanted:
        words, fix = "the base model lacks a layer that the adapter changes", "pass the base model of this adapter"
        raise InputError(words, where=adapter, got=f"{found} tensors", expected=f"{wanted}", fix=fix)


FAST_FAMILIES = {"qwen3_5": "distill.student.qwen3_5"}  # families with faster code of ours
