"""`cosfly doctor`: check what works on this machine, and how to fix what does not."""

import importlib.metadata
import importlib.util
import platform
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.limits import memory_bytes, num_cpus

OPTIONAL_PACKAGES = {  # name: the purpose, and the packages to install
    "torch": ("students", "-e '.[distill]'"),
    "transformers": ("students", "-e '.[distill]'"),
    "peft": ("students", "-e '.[distill]'"),
    "bert_score": ("evaluation of students", "-e '.[distill]'"),
    "datasets": ("opening the release as a user would", "datasets"),
    "vllm": ("a teacher in this process", "-e '.[vllm]'"),
    "pyrender": ("the second renderer", "-e '.[pyrender]'"),
    "ompl": ("the sampling planners of plan compare", "-e '.[ompl]'"),
    "carla": ("CARLA's maps and pictures", "-e '.[carla]'"),
    "unrealcv": ("UnrealCV's maps and pictures", "-e '.[unrealcv]' && pip install --no-deps unrealcv"),
    "gymnasium": ("the environments of cosfly.envs", "-e '.[envs]'"),
    "ray": ("workers on a Ray cluster", "-e '.[ray]'"),
}
FRAMES_PER_GIB = 200  # a 1280x720 frame takes about 5 MB, nearly all of it float32 depth
LEAST_FREE_GIB = 5


class Check(NamedTuple):
    """One line of the table."""

    name: str
    state: Literal["ok", "missing", "optional"]  # `missing` prevents `cosfly run`; `optional` does not
    detail: str


def examine(folder: Path) -> Iterator[Check]:
    """Check this machine, whose runs are written below `folder`, and yield the results."""
    memory_gib = memory_bytes() / 2**30
    yield Check("python", "ok", f"{platform.python_version()} on {platform.platform()}")
    yield Check("machine", "ok", f"{num_cpus()} cores, {memory_gib:.0f} GiB memory")
    yield _check_disk(folder)
    yield _check_gl()
    for name, (purpose, install) in OPTIONAL_PACKAGES.items():
        if importlib.util.find_spec(name) is None:
            yield Check(name, "optional", f"not installed; for {purpose}: pip install {install}")
        else:
            yield Check(name, "ok", importlib.metadata.version(name.replace("_", "-")))


def _check_disk(folder: Path) -> Check:
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free_gib = shutil.disk_usage(existing).free / 2**30
    num_frames = int(free_gib * FRAMES_PER_GIB)
    detail = f"{free_gib:.1f} GiB free at {existing.resolve()}, room for about {num_frames:,} frames of 1280x720"
    if free_gib > LEAST_FREE_GIB:
        return Check("disk", "ok", detail)
    return Check("disk", "missing", f"{detail}; free some space, or name another disk with --out")


def _check_gl() -> Check:
    from cosfly.formats.boxes import make_box_map
    from cosfly.render.stage import open_renderer

    try:
        renderer = open_renderer("gl", make_box_map([], [], [], []), 16, 16)
    except EnvironmentMissing as error:
        return Check("GL (renderer)", "missing", str(error))
    renderer.close()
    return Check("GL (renderer)", "ok", renderer.device)
