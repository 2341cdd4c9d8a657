"""A step of fixed tensors recorded on an accelerator: its kernels played again without the host's telling each."""

from __future__ import annotations

import logging
from collections.abc import Callable

from distill.student.model import Student

log = logging.getLogger(__name__)

Play = Callable[[], None]
Record = Callable[[Callable[[], None]], Play | None]


def recorder_for(student: Student) -> Record | None:
    """Give what records the steps of a student; None where nothing can be recorded, as on a CPU."""
    return record_graph if student.device == "cuda" else None


def record_graph(step: Callable[[], None]) -> Play | None:
    """Record a step as a CUDA graph. Recording computes nothing: only what is given does, and it moves the very tensors that the step named.

    Args:
        step: has run once with tensors of these sizes. It may neither ask for a value nor wait, and what it keeps it writes in place; a
            tensor that it makes anew stays where it is, and each time it is played gets new values.
    Returns:
        What plays it; None where it cannot be recorded, which is logged: it is then computed plainly.
    Raises:
        OutOfMemoryError: of torch, the memory is full.
    """
    import torch

    graph = torch.cuda.CUDAGraph()
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads read pictures meanwhile
            step()
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        log.warning(
            "a step of decoding cannot be recorded and is computed plainly: %s", str(error).splitlines()[0][:160]
        )
        return None
    return graph.replay
