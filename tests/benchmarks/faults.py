"""Kills and stops workers of a stage at random moments, known from the stage's events alone."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosfly.work.chance import rng_for
from cosfly.work.stage_events import LOSSES, read_events

SIGNALS = {"kill": signal.SIGKILL, "stall": signal.SIGSTOP}
SPAN = (0.05, 0.9)  # of an undisturbed run's time: when faults happen
LOOK_AGAIN_S = 0.1  # for a worker, where none is there


@dataclass(frozen=True)
class Faults:
    """How often a worker gets the signal of `kind`, in a run that takes `seconds` undisturbed."""

    kind: str
    number: int
    seconds: float
    seed: int


def is_running_child(pid: int) -> bool:
    """Tell whether a process runs, is not stopped, and is a child of this one, not another of its number."""
    try:
        state, parent, *_ = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    return int(parent) == os.getpid() and state not in "ZXT"


@contextlib.contextmanager
def planted(faults: Faults | None, folder: Path) -> Iterator[list[float]]:
    """Plant faults while the block works in a stage folder; yields the moments (s, from the first worker on)."""
    moments_s: list[float] = []
    if faults is None:
        yield moments_s
        return
    is_over = threading.Event()
    saboteur = threading.Thread(target=_plant, args=(faults, folder, moments_s, is_over), daemon=True)
    saboteur.start()
    try:
        yield moments_s
    finally:
        is_over.set()
        saboteur.join()


def _plant(faults: Faults, folder: Path, moments_s: list[float], is_over: threading.Event) -> None:
    rng = rng_for(faults.seed, "bench", faults.kind)
    planned_s = np.sort(rng.uniform(*SPAN, faults.number)) * faults.seconds
    if not _workers(folder, is_over):
        return
    begin_s = time.monotonic()
    for moment_s in planned_s:
        if is_over.wait(max(0.0, begin_s + moment_s - time.monotonic())):
            return
        pids = _workers(folder, is_over)
        if not pids:
            return
        os.kill(int(rng.choice(pids)), SIGNALS[faults.kind])
        moments_s.append(time.monotonic() - begin_s)


def _workers(folder: Path, is_over: threading.Event) -> list[int]:
    """Wait for running workers; gives their process ids, none when it is over."""
    while not is_over.is_set():
        pids: dict[int, int] = {}
        for event in read_events(folder):
            if event.worker is not None and event.pid is not None:
                pids[event.worker] = 0 if event.event in LOSSES else event.pid
        if running := sorted(pid for pid in pids.values() if pid and is_running_child(pid)):
            return running
        is_over.wait(LOOK_AGAIN_S)
    return []
