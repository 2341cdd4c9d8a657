"""Processes that a test starts: waiting for what they do, and seeing that they are gone."""

import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cosfly.runtime.pool import Watch

# A stopped worker is lost after 4 s, long before its item has taken too long: a busy machine does not exchange the two.
QUICK = Watch(item_limit_s=6.0, heartbeat_s=0.1, check_s=0.4, probe_s=0.3, failed_checks=10)


@contextmanager
def full_disk(num_bytes: int) -> Iterator[None]:
    """Limit the size of files: the system cuts the write that exceeds it, as on a full disk."""
    limits, kept = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # a module imported now would be cut in __pycache__
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        sys.dont_write_bytecode = kept


def wait_until(holds: Callable[[], object], patience_s: float = 60.0) -> None:
    until_s = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < until_s, "it never came to that"
        time.sleep(0.02)


def ran(*words: object, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a program that has to succeed."""
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, **how)
    assert done.returncode == 0, f"{done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def children_of(pid: int) -> list[int]:
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(place.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(place.parent.name))
        except OSError:  # it has ended meanwhile
            continue
    return found
