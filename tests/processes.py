"""Processes that a test starts: waiting for what they do, and seeing that they are gone."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path


def wait_until(holds: Callable[[], object], patience_s: float = 60.0) -> None:
    """Wait until this holds; fails when it never does."""
    until_s = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < until_s, "it never came to that"
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """See in /proc whether a process runs; one that has ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def children_of(pid: int) -> list[int]:
    """List the processes that a process has started, from /proc."""
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(place.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(place.parent.name))
        except OSError:  # it has ended meanwhile
            continue
    return found
