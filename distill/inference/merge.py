"""An adapter's updates put into the weights of its base: a model folder for transformers, vLLM and any server.

The base's files are gone through one tensor after the other, so a model of any size fits, and what the adapter leaves
alone (the vision tower, layers that transformers does not load) comes out byte for byte as it was.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.config import Config
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import atomic_folder, storage_errors
from cosfly.runtime.json_io import read_json, read_object, validated, write_json
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from distill.student.checkpoint import read_adapter_facts, save_tensors
from distill.student.model import require, student_folder, weight_files

STAGE = "distill.merge"
PREFIX = "base_model.model."  # of the names that peft gives
# Files of a model folder that are neither weights nor code: what the model is, what its processor and its chats are.
COPIED = ("*.json", "*.jinja", "*.txt", "*.model", "LICENSE*")


class LoraSettings(BaseModel):
    """Of `adapter_config.json`, what decides how an update is computed."""

    peft_type: Literal["LORA"]
    r: int = Field(ge=1)
    lora_alpha: float = Field(gt=0, allow_inf_nan=False)
    use_rslora: bool = False
    # What else a LoRA may be, and none of ours is; each is refused unless it is off.
    use_dora: Literal[False] = False
    use_qalora: Literal[False] = False
    lora_bias: Literal[False] = False
    fan_in_fan_out: Literal[False] = False
    bias: Literal["none"] = "none"
    alpha_pattern: dict[str, float] = Field({}, max_length=0)
    rank_pattern: dict[str, int] = Field({}, max_length=0)
    modules_to_save: list[str] | None = Field(None, max_length=0)

    @property
    def scale(self) -> float:
        return self.lora_alpha / (math.sqrt(self.r) if self.use_rslora else self.r)


def run(model: Path, adapter: Path, out: Path, *, resume: Resume = "if-same") -> Path:
    """Read a base model's folder and an adapter that was trained on it; write `model/`.

    Returns:
        The folder `model/`, which transformers and vLLM load.
    Raises:
        InputError: the adapter is of another base, or of a kind that is not merged here.
        StorageError: the disk is full. EnvironmentMissing: torch or safetensors is missing.
    """
    require("torch", "safetensors")
    model = student_folder(str(model))
    inputs = {**weight_files(model), **adapter_files(adapter)}
    read_adapter_facts(adapter, model)
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=0, resume=resume)
    merged = out / "model"
    if stage.is_complete:
        return merged
    updates = Updates(adapter)
    with atomic_folder(merged) as partial:
        _copy_settings(model, adapter, partial)
        shards, num_bytes = sorted(model.glob("*.safetensors")), 0
        with progress_bar(STAGE, total=len(shards)) as advance:
            for shard in shards:
                num_bytes += _merge_shard(shard, partial / shard.name, updates)
                advance(1)
        _mend_index(partial, num_bytes)
        if left := updates.unused():
            fix = "pass the base model that the adapter was trained on as --model"
            raise InputError(
                "the base model lacks a layer that the adapter changes", where=adapter, got=left[0], fix=fix
            )
    outputs = [path for path in merged.iterdir() if path.is_file()]
    tally = Tally(input=len(updates.names), kept=len(updates.names))
    stage.finish(outputs, tally)
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


class Updates:
    """The updates of an adapter by the name of the tensor that they are added to."""

    def __init__(self, adapter: Path) -> None:
        path = adapter / "adapter_config.json"
        value = read_json(path, what="adapter")
        self._scale = validated(LoraSettings, value, path).scale
        _, tensors = _read_tensors(adapter / "adapter_model.safetensors")
        self._pairs: dict[str, list[Any]] = {}
        for name, tensor in tensors.items():
            layer, _, part = name.removeprefix(PREFIX).rpartition(".lora_")
            if part not in ("A.weight", "B.weight") or not name.startswith(PREFIX):
                raise InputError("the file has a tensor that is not of a LoRA adapter", where=adapter, got=name)
            self._pairs.setdefault(f"{layer}.weight", [None, None])["AB".index(part[0])] = tensor
        for name, (down, up) in self._pairs.items():
            whole = down is not None and up is not None and down.ndim == up.ndim == 2
            if not whole or down.shape[0] != up.shape[1]:
                raise InputError(
                    "an update of the adapter is incomplete",
                    where=adapter,
                    got=name,
                    expected="lora_A (r, n) and lora_B (m, r)",
                )
        self.names = sorted(self._pairs)
        self._used: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._pairs

    def add_to(self, name: str, weight: Any) -> Any:
        """Return a weight (m, n) with its update, in float32."""
        down, up = self._pairs[name]
        if weight.shape != (found := (up.shape[0], down.shape[1])):
            words = "the update and its layer have different shapes"
            raise InputError(words, where=name, got=found, expected=str(tuple(weight.shape)))
        self._used.add(name)
        return weight.float() + self._scale * (up.float() @ down.float())

    def unused(self) -> list[str]:
        return [name for name in self.names if name not in self._used]


def _copy_settings(model: Path, adapter: Path, out: Path) -> None:
    """Copy what is no weights: from the base all, from the adapter what it was taught."""
    files = {path for pattern in COPIED for path in model.glob(pattern) if path.is_file()}
    for path in sorted(files, key=lambda path: path.name):
        shutil.copyfile(path, out / path.name)  # a hub's cache holds links, of which the content counts
    if (adapter / CHAT_FORMAT_FILE).is_file():
        shutil.copyfile(adapter / CHAT_FORMAT_FILE, out / CHAT_FORMAT_FILE)


def _read_tensors(path: Path) -> tuple[dict[str, str] | None, dict[str, Any]]:
    """Read a file of weights: what it says of itself, and its tensors by name."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise InputError("the file of weights is damaged", where=path, got=str(error)[:200]) from error


def _merge_shard(shard: Path, out: Path, updates: Updates) -> int:
    """Write one file of weights with the updates in it; gives the bytes of its tensors."""
    import torch

    metadata, tensors = _read_tensors(shard)
    for name in tensors:
        if name in updates:
            merged = updates.add_to(name, tensors[name])
            tensors[name] = merged.to(tensors[name].dtype)
            if not torch.isfinite(tensors[name]).all():
                raise InputError(
                    "a merged weight is not finite",
                    where=shard,
                    got=name,
                    fix="check in the training log that the loss is finite",
                )
    with storage_errors(out):
        save_tensors(out, tensors, metadata)
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def _mend_index(folder: Path, num_bytes: int) -> None:
    """Say in the index of several files how many bytes their tensors have now."""
    path = folder / "model.safetensors.index.json"
    if path.is_file():
        index = read_object(path, what="index of weights")
        metadata = index.get("metadata") or {}
        if not isinstance(metadata, dict):
            raise InputError("the field is not an object", where=f"{path}: metadata", got=shown(metadata))
        write_json(path, index | {"metadata": {**metadata, "total_size": num_bytes}})
