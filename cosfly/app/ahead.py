"""Compiled code of a run, compiled once by a spare process while the stages before run: two workers that need it would both compile it.

`python -m cosfly.app.ahead PLANNER` is that process. It writes numba's cache and a mark for each stage that is ready, and ends when its
input closes: whatever becomes of the process that started it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import numpy as np

from cosfly.work.compiled import cache_folder
from cosfly.work.store import sha256_bytes

log = logging.getLogger(__name__)

STAGES = ("plan", "render", "inspect")  # in the order of their need
# Several times what it takes on a machine with nothing else to do; then the stage compiles for itself.
WAIT_MAX_S = 120.0
LOOK_AGAIN_S = 0.05


@contextlib.contextmanager
def compiled_ahead(planner: str, todo: Collection[str]) -> Iterator[Callable[[str], None]]:
    """Compile meanwhile; gives the function that waits until what a stage needs is there. Does nothing where that was done before or cannot be done.

    Args:
        todo: the stages that are still to be done.
    """
    folder, missing = cache_folder(), not_compiled(planner, todo)
    if folder is None or not missing:
        yield lambda stage: None
        return
    command = [sys.executable, "-m", "cosfly.app.ahead", planner]
    try:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:  # no room for another process: the stages compile for themselves
        yield lambda stage: None
        return

    def wait(stage: str) -> None:
        if stage not in missing or (folder / _mark(stage, planner)).exists():
            return
        if process.poll() is None:
            log.info("compiling what %s needs, once on this machine, begun with the run: about 30 s in all", stage)
        until_s = time.monotonic() + WAIT_MAX_S
        while process.poll() is None and not (folder / _mark(stage, planner)).exists():
            if time.monotonic() > until_s:
                process.kill()  # or both would compile the same
            time.sleep(LOOK_AGAIN_S)

    try:
        yield wait
    finally:
        process.kill()
        process.communicate()


def not_compiled(planner: str, todo: Collection[str]) -> list[str]:
    """Tell for which of the stages that are still to be done `compiled_ahead` would compile."""
    folder = cache_folder()
    return [] if folder is None else [s for s in STAGES if s in todo and not (folder / _mark(s, planner)).exists()]


def _mark(stage: str, planner: str) -> str:
    """Name the file that says that a stage is compiled: for this checkout, as numba keeps each folder of sources apart."""
    return f"{planner if stage == 'plan' else stage}.{sha256_bytes(__file__.encode())[:16]}.compiled"


def compile_planner(planner: str) -> None:
    from cosfly.planners.contract import PlanConfig
    from cosfly.planners.stage import warm_up

    warm_up(PlanConfig(planner=planner))


def compile_encoders() -> dict[str, bytes]:
    """Compile what writes pictures; gives the files of a small frame, some of it flat and some of it noise."""
    from cosfly.products import frames

    size = (72, 128)
    noise = np.random.default_rng(0).integers(0, 255, (*size, 3)).astype(np.uint8)
    noise[:36] = 128
    depth = np.broadcast_to(np.linspace(5.0, 50.0, size[0])[:, None], size).astype(np.float32)
    return {
        "rgb.png": frames.rgb_bytes(noise),
        "instance.png": frames.instance_bytes(noise[..., 0] & 15, noise[..., 1].astype(np.uint16)),
        "depth.npy": frames.depth_bytes(depth),
    }


def compile_render() -> None:
    """Compile what draws and writes frames."""
    from cosfly.render.camera import spheres_in_view

    spheres = [np.ones(shape, np.float32) for shape in ((1, 3), 1, 1, 1, 3, (3, 3))]
    spheres_in_view(*spheres, np.ones(2), np.ones(2), 1.0)
    compile_encoders()


def compile_inspection() -> None:
    """Compile what looks at pictures: at two frames, each from its files, as the inspection does."""
    from cosfly.inspection.pixels import NUM_IDS, unpack
    from cosfly.inspection.pixels import look_at as look_at_pixels
    from cosfly.products.frames import grid_rows
    from cosfly.space.reprojection import View, compare_views

    files = compile_encoders()
    picture = unpack(files, Path("frame"))
    look_at_pixels(picture, np.zeros(NUM_IDS, dtype=bool), 0.9)
    rows = picture.colours[grid_rows(len(picture.colours))]
    views = [View(picture.depth, picture.instance, rows, np.eye(3), np.array([0.0, 0.0, z])) for z in (0.0, 0.1)]
    compare_views(views[0], views[1], np.array([64.0, 64.0, 64.0, 36.0]))


def main() -> None:
    """Compile what the stages need, and mark each that is ready."""
    planner, folder = sys.argv[1], cache_folder()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    steps: dict[str, Callable[[], object]] = {
        "plan": lambda: compile_planner(planner),
        "render": compile_render,
        "inspect": compile_inspection,
    }
    for stage in STAGES:
        mark = None if folder is None else folder / _mark(stage, planner)
        if mark is not None and not mark.exists():
            steps[stage]()
            mark.touch()


def _end_with_parent() -> None:
    sys.stdin.buffer.read()  # returns when the other end is closed
    os._exit(1)


if __name__ == "__main__":
    main()
