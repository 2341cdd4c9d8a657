"""The planners' compiled code, compiled by a spare process while the stages before run: at first use it takes longer than they do.

`python -m cosfly.planners.ahead PLANNER` is that process. It writes numba's cache and nothing else, and ends when its input closes:
whatever becomes of the process that started it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

from cosfly.compiled import cache_folder
from cosfly.store import sha256_bytes

log = logging.getLogger(__name__)

WAIT_MAX_S = 120.0  # five times what it takes on a machine with nothing else to do; then the stage compiles for itself


@contextlib.contextmanager
def compiled_ahead(planner: str, *, needed: bool = True) -> Iterator[Callable[[], None]]:
    """Compile meanwhile; gives the function that waits for the end of it. Does nothing where it was done before or cannot be done.

    Args:
        needed: whether anything is still to be planned.
    """
    folder = cache_folder()
    if not needed or folder is None or (folder / _mark(planner)).exists():
        yield lambda: None
        return
    command = [sys.executable, "-m", "cosfly.planners.ahead", planner]
    try:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:  # no room for another process: the stage compiles for itself
        yield lambda: None
        return

    def wait() -> None:
        if process.poll() is None:
            log.info("compiling the planner, once on this machine: about 30 s, begun with the run")
        try:
            process.wait(WAIT_MAX_S)
        except subprocess.TimeoutExpired:
            process.kill()  # or both would compile the same

    try:
        yield wait
    finally:
        process.kill()
        process.communicate()


def _mark(planner: str) -> str:
    """Name the file that says that a planner is compiled: for this checkout, as numba keeps each folder of sources apart."""
    return f"{planner}.{sha256_bytes(__file__.encode())[:16]}.compiled"


def main() -> None:
    """Compile what one planner needs, and mark it as done."""
    planner, folder = sys.argv[1], cache_folder()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from cosfly.planners.contract import PlanConfig
    from cosfly.planners.stage import warm_up

    warm_up(PlanConfig(planner=planner))
    if folder is not None:
        (folder / _mark(planner)).touch()


def _end_with_parent() -> None:
    sys.stdin.buffer.read()  # returns when the other end is closed
    os._exit(1)


if __name__ == "__main__":
    main()
