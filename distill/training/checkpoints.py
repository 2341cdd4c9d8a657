"""Checkpoints of a training: the weights that learn, the optimizer's state, the progress; and the log up to them."""

import shutil
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_folder, read_lines, write_bytes
from cosfly.runtime.json_io import FileFormat, parse_json, read_model, write_model
from distill.student.model import Student
from distill.student.saving import save_tensors

WEIGHTS, MOMENTS, STATE = "weights.safetensors", "optimizer.safetensors", "state.json"
CHECKPOINT_FORMAT = FileFormat("cosfly.checkpoint", "3.0", "checkpoint")


class Progress(BaseModel):
    """How far a training is."""

    step: int = 0
    best_step: int = 0  # of the best validation, 0 before the first
    best_loss: float | None = None
    stale: int = 0  # number of validations since the best one
    has_ended: bool = False
    samples: str = ""  # digest of the samples that are used, on which the order of the steps depends


def learning_weights(student: Student) -> dict[str, Any]:
    """Return the weights that learn, by name: the matrices of an adapter, or those of the model."""
    return {name: p for name, p in student.model.named_parameters() if p.requires_grad}


def checkpoint_path(folder: Path, step: int) -> Path:
    """Return the folder of a checkpoint, named so that they sort by step."""
    return folder / f"step_{step:08d}"


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint."""
    return max(folder.glob("step_*"), default=None)


def save_checkpoint(folder: Path, student: Student, optimizer: Any, progress: Progress) -> None:
    """Write a checkpoint, whole or not at all."""
    weights = learning_weights(student)
    moments = {
        f"{name}/{key}": value
        for name, parameter in weights.items()
        for key, value in optimizer.state.get(parameter, {}).items()
    }
    with atomic_folder(checkpoint_path(folder, progress.step)) as partial:
        save_tensors(partial / WEIGHTS, weights)
        save_tensors(partial / MOMENTS, moments)
        write_model(partial / STATE, progress, CHECKPOINT_FORMAT)


def drop_old_checkpoints(folder: Path, progress: Progress, keep: int) -> None:
    """Remove all but the newest `keep` checkpoints and the best one; what a kill left of an older one goes too."""
    for path in sorted(folder.glob("step_*"))[:-keep]:
        if path != checkpoint_path(folder, progress.best_step):
            shutil.rmtree(path)


def load_checkpoint(folder: Path, student: Student, optimizer: Any = None) -> Progress:
    """Load the weights of a checkpoint into the student, and the optimizer's state if an optimizer is given."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    weights = learning_weights(student)
    try:
        stored_weights = load_file(folder / WEIGHTS)
        stored_moments = load_file(folder / MOMENTS) if optimizer is not None else {}
        if stored_weights.keys() != weights.keys():
            raise ValueError("the weights are those of another student")
    except (SafetensorError, OSError, ValueError) as error:
        fix = f"remove {folder}, then run the same command again to resume from the previous checkpoint"
        raise InputError("the checkpoint is damaged", where=folder, got=str(error)[:200], fix=fix) from error
    with torch.no_grad():
        for name, parameter in weights.items():
            parameter.copy_(stored_weights[name])
    if optimizer is not None:
        moments: dict[str, dict[str, Any]] = {}
        for key, value in stored_moments.items():
            name, _, moment = key.rpartition("/")
            moments.setdefault(name, {})[moment] = value
        state = {i: moments[name] for i, name in enumerate(weights) if name in moments}  # in the optimizer's order
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return read_model(folder / STATE, Progress, CHECKPOINT_FORMAT)


def cut_log(path: Path, num_steps: int) -> None:
    """Keep the lines of the first `num_steps` steps: what came after the checkpoint is done again."""
    lines = [line for line in read_lines(path, what="log") if line.endswith(b"\n")] if path.exists() else []
    write_bytes(path, b"".join(line for line in lines if parse_json(line)["step"] <= num_steps))
