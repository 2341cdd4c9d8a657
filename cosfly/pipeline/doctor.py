"""`cosfly doctor`: check what works on this machine, and how to fix what does not."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from cosfly.runtime.errors import EnvironmentMissing

OPTIONAL_PACKAGES = {  # name -> what needs it, and what to install
    "torch": ("students", "cosfly[distill]"),
    "transformers": ("students", "cosfly[distill]"),
    "peft": ("students", "cosfly[distill]"),
    "bert_score": ("evaluation of students", "cosfly[distill]"),
    "datasets": ("opening the release as a user would", "datasets"),
    "vllm": ("a teacher in this process", "cosfly[vllm]"),
    "pyrender": ("the second renderer", "cosfly[pyrender]"),
    "ompl": ("the sampling planners of plan benchmark", "cosfly[ompl]"),
    "carla": ("CARLA's maps and pictures", "cosfly[carla]"),
    "unrealcv": ("UnrealCV's maps and pictures", "cosfly[unrealcv]; then --no-deps unrealcv"),
}
GPU_QUERY = ("--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")


class Check(NamedTuple):
    """One line of the table. state: `missing` stops the main job; `optional` does not."""

    name: str
    state: Literal["ok", "missing", "optional"]
    detail: str


def examine(folder: Path) -> Iterator[Check]:
    """Yield the checks of this machine; runs will be written to `folder`."""
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    yield Check("python", "ok", f"{platform.python_version()} on {platform.platform()}")
    yield Check("machine", "ok", f"{len(os.sched_getaffinity(0))} cores, {memory_gib:.0f} GiB memory")
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free / 2**30
    # A 1280x720 frame takes about 5 MB, nearly all of it float32 depth.
    detail = f"{free:.1f} GiB free at {place.resolve()}, room for about {int(free * 200):,} frames of 1280x720"
    fix = "" if free > 5 else "; free some space, or name another disk with --out"
    yield Check("disk", "missing" if fix else "ok", detail + fix)
    yield _gl()
    yield _gpu()
    for name, (purpose, install) in OPTIONAL_PACKAGES.items():
        if importlib.util.find_spec(name) is None:
            yield Check(name, "optional", f'not installed; for {purpose}: pip install "{install}"')
        else:
            yield Check(name, "ok", importlib.metadata.version(name.replace("_", "-")))


def _gl() -> Check:
    from cosfly.formats.boxes import make_box_map
    from cosfly.render.stage import open_renderer

    try:
        renderer = open_renderer("gl", make_box_map([], [], [], []), 16, 16)
    except EnvironmentMissing as error:
        return Check("GL (renderer)", "missing", str(error))
    renderer.close()
    return Check("GL (renderer)", "ok", renderer.device)


def _gpu() -> Check:
    try:
        done = subprocess.run(["nvidia-smi", *GPU_QUERY], capture_output=True, text=True, timeout=20, check=False)
    except FileNotFoundError:
        return Check("GPU", "optional", "no nvidia-smi: frames are rendered and students trained on the CPU")
    except subprocess.TimeoutExpired:
        return Check("GPU", "optional", "nvidia-smi does not answer")
    if done.returncode != 0:
        return Check("GPU", "optional", f"nvidia-smi failed: {done.stdout.strip() or done.stderr.strip()}"[:120])
    return Check("GPU", "ok", "; ".join(done.stdout.strip().splitlines()))
