"""A server's process that this one starts: it and all that it started end with this one, however that ends.

Between the two stands a guard, a process of its own, whose input is a pipe from here: where that ends, so has who held
it.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO

from cosfly.work.stage_events import process_stat
from cosfly.work.worker import LEFT_TO_THE_PARENT, adopt_orphans, end_with_parent, signals_held_back

PATIENCE_S = 15.0  # for a server that is asked to end
LOOK_S = 0.2


def guarded(words: Sequence[str], log_file: Path, environment: Mapping[str, str]) -> subprocess.Popen:
    """Start a server behind a guard; where the guard's input is closed, as `with` does, both end.

    The guard ends with the server's status, with 128 + N where that was signal N.
    """
    guard = [sys.executable, "-m", "cosfly.work.server_process", *words]
    with log_file.open("ab") as log:
        # A session of its own: Ctrl-C is not for it.
        return subprocess.Popen(
            guard, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
        )


def start_process(words: Sequence[str], log: IO[bytes] | None = None) -> subprocess.Popen:
    """Start a process that is killed with this one, and writes to a log. In a session of its own: Ctrl-C is not for
    it."""
    with signals_held_back():
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            start_new_session=True, preexec_fn=partial(_begin, os.getpid()),
        )  # fmt: skip


def _begin(parent_pid: int) -> None:
    end_with_parent(parent_pid)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)


def end_server(server: subprocess.Popen, patience_s: float) -> None:
    """End a server and all that it started, wherever they went; what does not within this time is killed."""
    if sys.platform != "linux":  # nothing tells what else it started
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGTERM if patience_s else signal.SIGKILL)
    until_s, is_asked = time.monotonic() + patience_s, False
    while left := _descendants():
        is_late = time.monotonic() >= until_s
        for pid in left if is_late or not is_asked else ():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL if is_late else signal.SIGTERM)
        is_asked = True
        server.poll()
        time.sleep(0.02)


def _descendants() -> list[int]:
    """Give the processes below this one, without those that have ended."""
    children = defaultdict[int, list[int]](list)
    for path in Path("/proc").glob("[0-9]*"):
        if (stat := process_stat(int(path.name))) and stat[0] != b"Z":
            children[int(stat[1])].append(int(path.name))
    found = [os.getpid()]
    for pid in found:
        found += children[pid]
    return found[1:]


def main(words: Sequence[str]) -> int:
    """Run a server until it ends, or the input does."""
    adopt_orphans()
    server = start_process(words)
    while server.poll() is None and not select.select([sys.stdin], [], [], LOOK_S)[0]:
        pass
    code = server.poll()
    end_server(server, PATIENCE_S)
    return 0 if code is None else code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
