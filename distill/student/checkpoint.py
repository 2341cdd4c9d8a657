"""What training leaves on disk: checkpoints to continue from, and adapters that say what they belong to.

Only safetensors and `torch.load(weights_only=True)`: nothing that a file could run.
"""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosfly.errors import InputError
from cosfly.reading.documents import parse_json, read_json, read_object, validation_errors
from cosfly.reading.files import read_lines, sha256_file
from cosfly.store import atomic_folder, read_checksums, write_bytes, write_checksums, write_json
from distill.student.model import Student, weight_files

log = logging.getLogger(__name__)

ADAPTER_FACTS = "cosfly_adapter.json"


def save_checkpoint(folder: Path, student: Student, optimizer: Any, step: int) -> None:
    """Write adapter, optimizer state and step into `folder`, whole or not at all."""
    import torch

    with atomic_folder(folder) as partial:
        student.model.save_pretrained(partial / "adapter")  # safetensors
        torch.save(optimizer.state_dict(), partial / "optimizer.pt")
        write_json(partial / "state.json", {"schema": "cosfly.checkpoint", "schema_version": "1.0", "step": step})
        files = [path for path in sorted(partial.rglob("*")) if path.is_file()]
        write_checksums(partial, {str(path.relative_to(partial)): sha256_file(path) for path in files})


def newest_checkpoint(folder: Path) -> Path | None:
    """Give the newest undamaged checkpoint; a damaged one is reported and passed over."""
    for path in sorted(folder.glob("step_*"), reverse=True):
        try:
            damaged = [name for name, digest in read_checksums(path).items() if sha256_file(path / name) != digest]
        except InputError as error:
            damaged = [str(error)]
        if not damaged:
            return path
        log.warning("%s: a damaged checkpoint is passed over (%s)", path, damaged[0])
    return None


def load_checkpoint(folder: Path, student: Student, optimizer: Any) -> int:
    """Put a checkpoint's adapter and optimizer state into place and give its step."""
    import torch
    from peft import set_peft_model_state_dict
    from safetensors.torch import load_file

    set_peft_model_state_dict(student.model, load_file(folder / "adapter" / "adapter_model.safetensors"))
    optimizer.load_state_dict(torch.load(folder / "optimizer.pt", weights_only=True, map_location=student.device))
    return int(read_object(folder / "state.json", what="checkpoint")["step"])  # its checksums were compared


def drop_old_checkpoints(folder: Path, keep: int) -> None:
    """Remove all but the newest checkpoints."""
    for path in sorted(folder.glob("step_*"))[:-keep]:
        shutil.rmtree(path)


def cut_log(path: Path, num_steps: int) -> None:
    """Keep the lines of the first `num_steps` steps: what came after the checkpoint is done again."""
    kept = []
    if path.exists():
        for line in read_lines(path, what="log"):
            step = _step_of(line)
            if step is not None and step <= num_steps:
                kept.append(line)
    write_bytes(path, b"".join(kept))


def _step_of(line: bytes) -> int | None:
    """Read the step of a line of the log; None where a kill cut it short, or it is no line of a log."""
    try:
        record = parse_json(line) if line.endswith(b"\n") else None
    except ValueError:
        return None
    step = record.get("step") if isinstance(record, dict) else None
    return step if isinstance(step, int) else None


# --- adapters -----------------------------------------------------------------------------------------------------------


def adapter_facts(student: Student, max_pixels: int, model: Path) -> dict[str, Any]:
    """Say what an adapter was trained on and how, for those who load it."""
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


def base_digests(model: Path) -> dict[str, str]:
    """Give the digests of the weight files that an adapter belongs to."""
    return {path.name: sha256_file(path) for path in weight_files(model).values() if path.suffix == ".safetensors"}


class AdapterFacts(BaseModel):
    """Of what stands beside an adapter, what those who load it need."""

    base_sha256: dict[str, str]
    max_pixels: int


def read_adapter_facts(adapter: Path, model: Path) -> AdapterFacts:
    """Read what stands beside an adapter, and check that it belongs to the model.

    Raises:
        InputError: it was trained on other weights, or is malformed.
    """
    path = adapter / ADAPTER_FACTS
    value = read_json(path, what="adapter")
    with validation_errors(path):
        facts = AdapterFacts.model_validate(value)
    found = base_digests(model)
    if facts.base_sha256 != found:
        raise InputError(
            "the adapter was trained on another model",
            where=path,
            got=json.dumps(found)[:120],
            expected=json.dumps(facts.base_sha256)[:120],
            fix="give the model folder that it was trained on",
        )
    return facts
