"""Adapters and whole models on disk: tensors in safetensors, the rest in JSON, nothing that a file could run."""

import contextlib
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_file, storage_errors, write_bytes
from cosfly.runtime.json_io import FileFormat, read_model, write_model
from distill.student.model import GGUF, TEMPLATE, Student, weight_files

ADAPTER_FACTS, ADAPTER_FORMAT = "cosfly_adapter.json", FileFormat("cosfly.adapter", "1.0", "adapter")
COPIED = ("*.json", "*.jinja", "*.txt", "*.model", "LICENSE*")  # files of a model folder without weights and code


class AdapterFacts(BaseModel):
    """`cosfly_adapter.json` of an adapter: digests of the weight files of its base."""

    base_sha256: dict[str, str]


@contextlib.contextmanager
def writing_errors(path: Path) -> Iterator[None]:
    """Convert the error of a full or read-only disk, in whichever class a library raises it."""
    with storage_errors(path):
        try:
            yield
        except Exception as error:  # safetensors and tokenizers give the number of the system's error in their text
            match = re.search(r"os error (\d+)", str(error))
            if match is None:
                raise
            raise OSError(int(match[1]), os.strerror(int(match[1])), str(path)) from error


def save_tensors(path: Path, tensors: Mapping[str, Any]) -> None:
    """Write tensors by name."""
    from safetensors.torch import save_file

    with writing_errors(path):
        save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, path)


def write_student(student: Student, folder: Path, base: Path, base_name: str = "") -> None:
    """Write an adapter that peft loads, or a whole model that transformers and vLLM load.

    Args:
        base: its folder, whose other files a whole model gets as they are, or the GGUF file that it was read from.
        base_name: name of the base in an adapter, in place of its path on this machine, which peft writes.
    """
    adapters = getattr(student.model, "peft_config", {})
    for config in adapters.values():
        config.base_model_name_or_path = base_name
    if base.is_dir() and not adapters:
        for path in sorted({path for pattern in COPIED for path in base.glob(pattern)}):
            if path.is_file() and "safetensors" not in path.name:
                shutil.copyfile(path, folder / path.name)  # the content, because a hub's cache has links
    options = {"save_embedding_layers": False} if adapters else {}  # peft would look for the base on the hub
    with writing_errors(folder):
        student.model.save_pretrained(folder, **options)
        if not base.is_dir() and not adapters:
            student.tokenizer.save_pretrained(folder)
    if student.template:
        write_bytes(folder / TEMPLATE, student.template.encode())
    if adapters:
        (folder / "README.md").unlink(missing_ok=True)
        write_model(folder / ADAPTER_FACTS, AdapterFacts(base_sha256=base_digests(base)), ADAPTER_FORMAT)


def base_digests(model: Path) -> dict[str, str]:
    """Return the digests of the weight files that an adapter belongs to."""
    suffixes = (".safetensors", GGUF)
    return {path.name: sha256_file(path) for path in weight_files(model).values() if path.suffix in suffixes}


def check_adapter(adapter: Path, model: Path) -> dict[str, Path]:
    """Check that a folder has an adapter of a model; return its files, for the inputs of a stage."""
    path = adapter / ADAPTER_FACTS
    if not path.is_file() or not (adapter / CHAT_FORMAT_FILE).is_file():
        expected = f"{ADAPTER_FACTS} and {CHAT_FORMAT_FILE} of a finished cosfly distill train"
        fix = "pass the folder adapter/ of a training; the folder model/ of a training is a whole model"
        raise InputError("the folder is not an adapter", where=adapter, expected=expected, fix=fix)
    recorded, digests = read_model(path, AdapterFacts, ADAPTER_FORMAT).base_sha256, base_digests(model)
    if recorded != digests:
        got, expected, fix = str(digests)[:120], str(recorded)[:120], "pass the base model of this adapter"
        raise InputError("the adapter was trained on another model", where=path, got=got, expected=expected, fix=fix)
    return {f"adapter/{file.name}": file for file in sorted(adapter.iterdir()) if file.is_file()}
