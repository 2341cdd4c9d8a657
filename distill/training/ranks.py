"""The processes of one training, as `torchrun` and `accelerate launch` start them: each has its device and its share of
every step.

One process needs none of this, and gets a group of one that does nothing.
"""

from __future__ import annotations

import contextlib
import datetime
import logging
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from cosfly.runtime.errors import ConfigError, CosflyError, EnvironmentMissing
from distill.student.model import Device, pick_device

log = logging.getLogger(__name__)

T = TypeVar("T")
# For the slowest process: loading weights, counting tokens, answering in validation.
PATIENCE = datetime.timedelta(minutes=30)


@dataclass(frozen=True)
class Ranks:
    """The group of processes, and this one's place in it."""

    rank: int
    size: int
    device: str

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    def total(self, values: list[float]) -> list[float]:
        """Add up numbers over all processes."""
        if self.size == 1:
            return values
        import torch

        tensor = torch.tensor(values, dtype=torch.float64, device=self.device)
        _collective(torch.distributed.all_reduce, tensor)
        return tensor.tolist()

    def add_gradients(self, parameters: list[Any]) -> None:
        """Add up the gradients of all processes, in place."""
        if self.size == 1:
            return
        import torch

        for parameter in parameters:  # a process without a sample of this step has no gradients
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        for bucket in _buckets([parameter.grad for parameter in parameters]):
            flat = torch.cat([gradient.reshape(-1) for gradient in bucket])
            _collective(torch.distributed.all_reduce, flat)
            for gradient, part in zip(bucket, flat.split([g.numel() for g in bucket]), strict=True):
                gradient.copy_(part.view_as(gradient))

    def gathered(self, value: T) -> list[T]:
        """Return every process the values of all, in the order of their ranks."""
        if self.size == 1:
            return [value]
        import torch

        values: list[Any] = [None] * self.size
        _collective(torch.distributed.all_gather_object, values, value)
        return values

    def first_does(self, action: Callable[[], T]) -> T:
        """Let the first process do something and tell all the result; its error is everybody's error."""
        if self.size == 1:
            return action()
        import torch

        box: list[Any] = [None, None]
        if self.is_first:
            try:
                box[0] = action()
            except CosflyError as error:
                box[1] = error
        _collective(torch.distributed.broadcast_object_list, box)
        if box[1] is not None:
            raise box[1]
        return box[0]


BUCKET_NUMBERS = 50_000_000  # of gradients that are added up in one call


def _buckets(gradients: list[Any]) -> Iterator[list[Any]]:
    bucket: list[Any] = []
    count = 0
    for gradient in gradients:
        if bucket and (count + gradient.numel() > BUCKET_NUMBERS or gradient.dtype != bucket[0].dtype):
            yield bucket
            bucket, count = [], 0
        bucket.append(gradient)
        count += gradient.numel()
    if bucket:
        yield bucket


def _collective(call: Callable[..., Any], *arguments: Any) -> None:
    """Do something with all processes."""
    try:
        call(*arguments)
    except RuntimeError as error:  # what torch.distributed raises of a broken connection
        fix = "read the message of that process, then run the same command again to resume from the last checkpoint"
        got = str(error).splitlines()[0][:160]
        raise EnvironmentMissing("another process of this training has ended", got=got, fix=fix) from error


def is_first_process() -> bool:
    """Return whether this process is the one of those that were started together that speaks for all."""
    return _number("RANK", 0) == 0


def _number(name: str, default: int) -> int:
    text = os.environ.get(name, str(default))
    if not text.isdecimal():
        raise ConfigError("the value is not a whole number", where=f"environment variable {name}", got=text[:40])
    return int(text)


@contextlib.contextmanager
def joined(device: Device) -> Iterator[Ranks]:
    """Join the processes that were started together (RANK, WORLD_SIZE, LOCAL_RANK), or be alone."""
    import torch

    name, size = pick_device(device), _number("WORLD_SIZE", 1)
    rank, local = _number("RANK", 0), _number("LOCAL_RANK", 0)
    if name == "cuda":
        if local >= torch.cuda.device_count():
            got, where = f"{torch.cuda.device_count()} accelerators", f"process {local} of this machine"
            fix = "start fewer processes (--nproc-per-node), or set distill.train.device=cpu"
            raise EnvironmentMissing("there are fewer accelerators than processes", where=where, got=got, fix=fix)
        torch.cuda.set_device(local)
    if size == 1:
        yield Ranks(0, 1, name)
        return
    backend = "nccl" if name == "cuda" else "gloo"
    torch.distributed.init_process_group(backend, timeout=PATIENCE)
    if rank:
        logging.getLogger("distill").setLevel(logging.WARNING)  # what all would say, the first says
    ended_well = False
    try:
        yield Ranks(rank, size, name)
        ended_well = True
    finally:
        # After an error nobody waits for anybody: NCCL would, so its connections break with the process. The threads of
        # gloo have to be ended, or the interpreter's end sometimes turns the error into an abort.
        if ended_well or backend == "gloo":
            torch.distributed.destroy_process_group()
