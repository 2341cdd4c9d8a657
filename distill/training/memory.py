"""How much memory a training will need, told before it begins; and what is said when there was too little."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosfly.errors import ConfigError
from distill.student.encoding import Encoded
from distill.student.model import Student
from distill.training.loss import answer_loss
from distill.training.settings import TrainConfig

GB = 1e9
PROBES = (64, 192)  # tokens; the fallback of linear attention works in pieces of 64
TABLES = 3  # of logits at a time: as computed, in float32, and their gradient
ADAM_COPIES = 2  # first and second moment


@dataclass(frozen=True)
class Memory:
    """Bytes by what they are for; `available` is what the device has for all of it."""

    weights: float
    gradients: float
    optimizer: float
    activations: float
    logits: float
    pictures: float
    available: float

    @property
    def needed(self) -> float:
        return self.weights + self.gradients + self.optimizer + self.activations + self.logits + self.pictures

    def __str__(self) -> str:
        parts = ("weights", "gradients", "optimizer", "activations", "logits", "pictures")
        told = ", ".join(f"{name} {getattr(self, name) / GB:.2f}" for name in parts)
        return f"{self.needed / GB:.2f} GB of {self.available / GB:.1f} ({told})"


def saved_bytes_per_token(student: Student, cfg: TrainConfig) -> float:
    """Measure what a forward pass keeps for its backward pass, a token: two short texts are run, and what is saved is counted.

    What is saved depends on the layers, on peft and on which kernels are there, and grows evenly with the tokens. With gradient
    checkpointing it is what stays; what one layer makes anew comes on top of it, once.
    """
    import torch

    found: list[int] = []
    student.model.train()
    own = {p.untyped_storage().data_ptr() for p in student.model.parameters()}
    for length in PROBES:
        storages: dict[int, Any] = {}  # held: of one that is let go on the way the next would take the place

        def count(tensor: Any, storages: dict[int, Any] = storages) -> Any:
            if (place := tensor.untyped_storage().data_ptr()) not in own:
                storages.setdefault(place, tensor.untyped_storage())
            return tensor

        half = np.full(length // 2, student.end_token_id, np.int64)
        row = Encoded("probe", half, half, None, np.zeros((0, 3), np.int64), 1.0)
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            answer_loss(student, [row], torch.zeros((0, 1)), cfg.logit_chunk)
        found.append(sum(storage.nbytes() for storage in storages.values()))
    return (found[1] - found[0]) / (PROBES[1] - PROBES[0])


def estimate(student: Student, cfg: TrainConfig, longest: int, picture_bytes: float) -> Memory:
    """Estimate the peak of a training step.

    Args:
        longest: tokens of the longest sample. picture_bytes: of the features of the pictures of one sample.
    """
    parameters = list(student.model.parameters())
    learning = sum(p.numel() * p.element_size() for p in parameters if p.requires_grad)
    config = student.core.config.text_config
    rows = cfg.batch_size
    return Memory(
        weights=sum(p.numel() * p.element_size() for p in parameters),
        gradients=learning,
        optimizer=ADAM_COPIES * learning,
        activations=saved_bytes_per_token(student, cfg) * longest * rows,
        logits=float(TABLES * cfg.logit_chunk * config.vocab_size * 4),
        pictures=rows * picture_bytes,
        available=available_bytes(student.device),
    )


def available_bytes(device: str) -> float:
    """Give the memory of the device: the accelerator's, or the machine's."""
    import torch

    if device == "cuda":
        return float(torch.cuda.get_device_properties(torch.cuda.current_device()).total_memory)
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def used_gb(device: str) -> float:
    """Give the most memory used so far: of the accelerator, or of this process."""
    import torch

    if device == "cuda":
        return torch.cuda.max_memory_allocated() / GB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GB


@contextlib.contextmanager
def memory_errors(cfg: TrainConfig) -> Iterator[None]:
    """Say what helps where the memory was too small, on an accelerator or a CPU."""
    import torch

    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        is_full = isinstance(error, torch.OutOfMemoryError | MemoryError) or "DefaultCPUAllocator" in str(error)
        if not is_full:
            raise
        smaller = f"--set distill.train.batch_size={max(1, cfg.batch_size // 2)}"
        less = "--set distill.train.gradient_checkpointing=true"
        raise ConfigError(
            "the memory is full",
            where="distill.train.batch_size",
            got=f"{cfg.batch_size}: {str(error)[:120]}",
            fix=f"run the same command again with {smaller if cfg.batch_size > 1 else less}, which goes on from the last checkpoint"
            + (f"; or with {less}" if cfg.batch_size > 1 and not cfg.gradient_checkpointing else ""),
        ) from error
