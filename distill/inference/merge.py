"""An adapter merged into its base: a model folder for transformers, vLLM and any server."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.json_io import read_json, validated
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from distill.student.checkpoint import read_adapter_facts, write_model_folder
from distill.student.model import (
    GGUF,
    adapter_tensors,
    load_config,
    load_student,
    loading_errors,
    require,
    student_path,
    weight_files,
)

STAGE = "distill.merge"


class LoraSettings(BaseModel):
    """The part of `adapter_config.json` that says what kind of adapter it is; other kinds are refused."""

    peft_type: Literal["LORA"]
    r: int = Field(ge=1)
    lora_alpha: float = Field(gt=0, allow_inf_nan=False)
    use_dora: Literal[False] = False
    lora_bias: Literal[False] = False
    bias: Literal["none"] = "none"
    rank_pattern: dict[str, int] = Field({}, max_length=0)
    modules_to_save: list[str] | None = Field(None, max_length=0)


def run(model: Path, adapter: Path, out: Path, *, resume: Resume = "if-same") -> Path:
    """Read a base model and an adapter that was trained on it; write `model/`.

    The update is added in float32 and rounded once to the type of the base.

    Returns:
        The folder `model/`, which transformers and vLLM load.
    Raises:
        InputError: the adapter belongs to another base, or is of a kind that is not merged here.
        StorageError: the disk is full. EnvironmentMissing: torch, transformers or peft is missing.
    """
    require("torch", "transformers", "peft")
    model = student_path(str(model))
    inputs = {**weight_files(model), **adapter_files(adapter)}
    read_adapter_facts(adapter, model)
    path = adapter / "adapter_config.json"
    validated(LoraSettings, read_json(path, what="adapter"), path)
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=0, resume=resume)
    merged = out / "model"
    if stage.is_complete:
        return merged
    count = _check_tensors(adapter)
    student = load_student(model, device="cpu", dtype="float32", adapter=adapter)
    with loading_errors("adapter", adapter):
        student.model = student.model.merge_and_unload()
    _check_finite(student.model, adapter)
    dtype = None if model.suffix == GGUF else getattr(load_config(model), "dtype", None)
    if dtype is not None:
        student.model.to(dtype)
    with atomic_folder(merged) as partial:
        write_model_folder(student, partial, model)
        if (adapter / CHAT_FORMAT_FILE).is_file():
            shutil.copyfile(adapter / CHAT_FORMAT_FILE, partial / CHAT_FORMAT_FILE)
    stage.finish([path for path in merged.iterdir() if path.is_file()], Tally(input=count, kept=count))
    return merged


def adapter_files(adapter: Path) -> dict[str, Path]:
    """Return the files of an adapter, for the inputs of a stage: name -> path."""
    names = ("adapter_config.json", "adapter_model.safetensors")
    if not all((adapter / name).is_file() for name in names):
        if (adapter / "config.json").is_file():
            what = "the folder contains a whole model, so there is nothing to merge"
            raise InputError(what, where=adapter, fix="use this folder as the model")
        raise InputError("the folder is not an adapter", where=adapter, expected=" and ".join(names))
    return {f"adapter/{path.name}": path for path in sorted(adapter.iterdir()) if path.is_file()}


def _check_tensors(adapter: Path) -> int:
    """Check that the tensors of an adapter are pairs of LoRA matrices; return the number of pairs."""
    layers: dict[str, set[str]] = {}
    for name in adapter_tensors(adapter):
        layer, _, part = name.rpartition(".lora_")
        if part not in ("A.weight", "B.weight"):
            raise InputError("the file has a tensor that is not of a LoRA adapter", where=adapter, got=name)
        layers.setdefault(layer, set()).add(part)
    if half := [layer for layer, parts in layers.items() if len(parts) < 2]:
        words = "an update of the adapter is incomplete"
        raise InputError(words, where=adapter, got=half[0], expected="lora_A and lora_B")
    return len(layers)


def _check_finite(model: Any, adapter: Path) -> None:
    import torch

    for name, weight in model.named_parameters():
        if not torch.isfinite(weight).all():
            fix = "check in the training log that the loss is finite"
            raise InputError("a merged weight is not finite", where=adapter, got=name, fix=fix)
