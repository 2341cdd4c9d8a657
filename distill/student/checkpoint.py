"""What training leaves on disk: checkpoints to continue from, adapters that say what they belong to, and whole models.

Tensors stand in safetensors, the rest in JSON: nothing that a file could run.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_folder, read_checksums, read_lines, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import (
    FileFormat,
    parse_json,
    read_json,
    read_model,
    read_object,
    validated,
    write_json,
    write_model,
)
from distill.student.model import GGUF, TEMPLATE, Student, weight_files

log = logging.getLogger(__name__)

ADAPTER_FACTS = "cosfly_adapter.json"
WEIGHTS, MOMENTS, STATE = "weights.safetensors", "optimizer.safetensors", "state.json"
CHECKPOINT_FORMAT = FileFormat("cosfly.checkpoint", "2.0", "checkpoint")


class Progress(BaseModel):
    """How far a training is: what its checkpoint says beside the weights.

    best_step: of the best validation, 0 before the first; stale: validations since then. unreadable: samples that were
    left out.
    """

    step: int = 0
    best_step: int = 0
    best_score: tuple[float, float] | None = None  # the larger, the better
    stale: int = 0
    has_ended: bool = False
    unreadable: dict[str, str] = {}


def learning_weights(student: Student) -> dict[str, Any]:
    """Return what learns, by name: the matrices of an adapter, or the weights."""
    return {name: p for name, p in student.model.named_parameters() if p.requires_grad}


def save_checkpoint(folder: Path, student: Student, optimizer: Any, progress: Progress) -> None:
    """Write weights, optimizer state and progress into `folder`, whole or not at all."""
    weights = learning_weights(student)
    moments = {
        f"{name}/{key}": value
        for name, parameter in weights.items()
        for key, value in optimizer.state.get(parameter, {}).items()
    }
    with atomic_folder(folder) as partial:
        save_tensors(partial / WEIGHTS, weights)
        save_tensors(partial / MOMENTS, moments)
        write_model(partial / STATE, progress, CHECKPOINT_FORMAT)
        files = [path for path in sorted(partial.rglob("*")) if path.is_file()]
        write_checksums(partial, {str(path.relative_to(partial)): sha256_file(path) for path in files})


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Let what the system says of the disk while a library writes be an OSError, as elsewhere."""
    try:
        yield
    except Exception as error:  # of safetensors, and of tokenizers without a class: the number stands in their words
        found = re.search(r"os error (\d+)", str(error))
        if found is None:
            raise
        raise OSError(int(found[1]), os.strerror(int(found[1])), str(path)) from error


def save_tensors(path: Path, tensors: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
    """Write tensors by name."""
    from safetensors.torch import save_file

    with disk_errors(path):
        save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, path, metadata)


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest undamaged checkpoint; a damaged one is reported and passed over."""
    for path in sorted(folder.glob("step_*"), reverse=True):
        damaged = _damage_of(path)
        if damaged is None:
            return path
        log.warning("%s: this checkpoint is damaged and skipped (%s)", path, damaged)
    return None


def check_whole(checkpoint: Path) -> None:
    """Check that a checkpoint that is needed stands and is whole."""
    damaged = _damage_of(checkpoint)
    if damaged is not None:
        fix = "train again in another --out, or use the last weights with --set distill.train.keep=last"
        raise InputError("the checkpoint of the best validation is damaged", where=checkpoint, got=damaged, fix=fix)


def _damage_of(checkpoint: Path) -> str | None:
    """Return what is damaged of a checkpoint; None: it is whole."""
    try:
        digests = read_checksums(checkpoint).items()
        return next((name for name, digest in digests if sha256_file(checkpoint / name) != digest), None)
    except InputError as error:
        return str(error)


def read_progress(folder: Path) -> Progress:
    """Read how far a checkpoint is."""
    return read_model(folder / STATE, Progress, CHECKPOINT_FORMAT, tree=folder)


def load_checkpoint(folder: Path, student: Student, optimizer: Any = None) -> Progress:
    """Put a checkpoint's weights, and the optimizer's state where one is given, into place."""
    import torch
    from safetensors.torch import load_file

    weights, found = learning_weights(student), load_file(folder / WEIGHTS)  # its checksums were compared
    shapes, wanted = ({n: tuple(t.shape) for n, t in tensors.items()} for tensors in (found, weights))
    if shapes != wanted:
        name = next(n for n in shapes | wanted if shapes.get(n) != wanted.get(n))
        got, expected = f"{name}: {shapes.get(name)}", wanted.get(name)
        raise InputError("the checkpoint belongs to another student", where=folder, got=got, expected=f"{expected}")
    with torch.no_grad():
        for name, parameter in weights.items():
            parameter.copy_(found[name])
    if optimizer is not None:
        moments: dict[str, dict[str, Any]] = {}
        for key, value in load_file(folder / MOMENTS).items():
            name, _, moment = key.rpartition("/")
            moments.setdefault(name, {})[moment] = value
        order = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        names = {id(parameter): name for name, parameter in weights.items()}
        state = {i: moments[names[id(p)]] for i, p in enumerate(order) if names[id(p)] in moments}
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return read_progress(folder)


def drop_old_checkpoints(folder: Path, keep: int, best_step: int) -> None:
    """Remove all but the newest checkpoints and the best."""
    best = checkpoint_path(folder, best_step)
    for path in sorted(folder.glob("step_*"))[:-keep]:
        if path != best:
            # A kill in the middle leaves no half of one.
            leaving = path.with_name(f".{path.name}.{os.getpid()}.partial")
            os.replace(path, leaving)
            shutil.rmtree(leaving)


def checkpoint_path(folder: Path, step: int) -> Path:
    """Return the folder of a checkpoint, named so that they sort by step."""
    return folder / f"step_{step:08d}"


def cut_log(path: Path, num_steps: int) -> None:
    """Keep the lines of the first `num_steps` steps: what came after the checkpoint is done again."""
    lines = read_lines(path, what="log") if path.exists() else ()
    write_bytes(path, b"".join(line for line in lines if _is_of_steps(line, num_steps)))


def _is_of_steps(line: bytes, num_steps: int) -> bool:
    """Return whether a line of the log is of the first steps; one that a kill cut short is of none."""
    try:
        record = parse_json(line) if line.endswith(b"\n") else None
    except ValueError:
        return False
    step = record.get("step") if isinstance(record, dict) else None
    return isinstance(step, int) and step <= num_steps


def adapter_facts(student: Student, max_pixels: int, model: Path) -> dict[str, Any]:
    """Return what an adapter was trained on and how, for those who load it."""
    import peft
    import torch
    import transformers

    parameters = list(student.model.parameters())
    return {
        "schema": "cosfly.adapter",
        "schema_version": "1.0",
        "base_sha256": base_digests(model),
        "max_pixels": max_pixels,
        "trainable_parameters": sum(p.numel() for p in parameters if p.requires_grad),
        "parameters": sum(p.numel() for p in parameters),
        "device": student.device,
        "versions": {"torch": torch.__version__, "transformers": transformers.__version__, "peft": peft.__version__},
    }


def write_adapter_folder(student: Student, folder: Path, base_name: str) -> None:
    """Write an adapter that peft loads.

    Args:
        base_name: what its base is called; peft writes where it stands on this machine, also into a card.
    """
    with disk_errors(folder):
        student.model.save_pretrained(folder)
    if student.template:
        write_bytes(folder / TEMPLATE, student.template.encode())
    (folder / "README.md").unlink(missing_ok=True)
    path = folder / "adapter_config.json"
    write_json(path, read_object(path, what="adapter") | {"base_model_name_or_path": base_name})


COPIED = ("*.json", "*.jinja", "*.txt", "*.model", "LICENSE*")  # files of a model folder without weights and code


def write_model_folder(student: Student, folder: Path, base: Path) -> None:
    """Write a whole model that transformers and vLLM load: its weights, and the other files of its base as they are.

    Args:
        student: a model without an adapter next to its weights.
        base: its folder, or the GGUF file that it was read from.
    """
    if base.is_dir():
        for path in sorted({path for pattern in COPIED for path in base.glob(pattern)}):
            if path.is_file() and "safetensors" not in path.name:
                shutil.copyfile(path, folder / path.name)  # a hub's cache holds links, of which the content counts
    with disk_errors(folder):
        student.model.save_pretrained(folder)
        if not base.is_dir():
            student.tokenizer.save_pretrained(folder)
    if student.template:
        write_bytes(folder / TEMPLATE, student.template.encode())


def base_digests(model: Path) -> dict[str, str]:
    """Return the digests of the weight files that an adapter belongs to."""
    suffixes = (".safetensors", GGUF)
    return {path.name: sha256_file(path) for path in weight_files(model).values() if path.suffix in suffixes}


class AdapterFacts(BaseModel):
    """Of what stands beside an adapter, what those who load it need."""

    base_sha256: dict[str, str]
    max_pixels: int


def read_adapter_facts(adapter: Path, model: Path) -> AdapterFacts:
    """Read what stands beside an adapter, and check that it belongs to the model."""
    path, fix = adapter / ADAPTER_FACTS, "if the training was interrupted, run the same cosfly distill train again"
    facts = validated(AdapterFacts, read_json(path, what="adapter", fix=fix), path)
    if facts.base_sha256 != (found := base_digests(model)):
        got, expected = json.dumps(found)[:120], json.dumps(facts.base_sha256)[:120]
        fix = "pass the base model of this adapter"
        raise InputError("the adapter was trained on another model", where=path, got=got, expected=expected, fix=fix)
    return facts
