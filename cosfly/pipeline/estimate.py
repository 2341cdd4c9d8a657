"""The time and disk that a run will take, by stage, from its settings and the figures of `cosfly run showcase`."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from caption.run.progress import duration
from cosfly.formats.pedestrian_paths import read_paths, walk_id
from cosfly.formats.traces import read_traces
from cosfly.maps.stage import load_map
from cosfly.pipeline.runs import STAGES
from cosfly.pipeline.settings import RunConfig
from cosfly.render.weather import dark_trajectories

UNITS = {
    "maps": "map", "simplify": "map", "pedestrians": "pedestrians", "plan": "pedestrians", "render": "frames",
    "inspect": "frames", "caption": "windows", "release": "frames",
}  # fmt: skip
BY_PIXELS = ("render", "inspect", "release")  # their rates are per million pixels
BASIS = "`cosfly run showcase` on a 2-core machine (docs/first-runs.md)"
# Seconds and MB per unit. Of `cosfly run showcase` (docs/first-runs.md; 2 cores, AMD EPYC, idle): 3 pedestrians,
# 858 frames of 0.9216 Mpx, 804 windows of teacher `rules`.
RATES = {
    "maps": (0.2, 1.1), "simplify": (5.6, 1.2), "pedestrians": (4.6 / 3, 0.3 / 3), "plan": (2.3 / 3, 0.4 / 3),
    "render": (51.2 / 790.7, 4383 / 790.7), "inspect": (8.3 / 790.7, 0.7 / 790.7), "caption": (4.0 / 804, 7.4 / 804),
    "release": (7.8 / 790.7, 1842 / 790.7),
}  # fmt: skip
# Frames of a trajectory over those of the straight line between its ends (50 to 100 m at 1.2 m/s, 2 frames/s: 143).
DETOUR = 1.14


@dataclass(frozen=True)
class StageEstimate:
    """One stage of a run, of a town `town/stage`. seconds: None where its teacher decides; 0 where it is done."""

    name: str
    count: int
    seconds: float | None
    bytes: float
    is_done: bool

    @property
    def amount(self) -> str:
        """The number of its units: `858 frames`."""
        return f"{self.count:,} {UNITS[self.name.rpartition('/')[2]]}"


def estimate(cfg: RunConfig, out: Path) -> list[StageEstimate]:
    """Estimate each stage of a run; of several towns, each stage of each town, then the release.

    Raises:
        CosflyError: A product of the run cannot be read.
    """
    if not cfg.towns:
        return list(_stages(cfg, out, STAGES))
    rows: list[StageEstimate] = []
    frames = 0
    for name in cfg.towns:
        own = list(_stages(cfg.of_town(name), out / name, STAGES[:-1]))
        rows += [replace(row, name=f"{name}/{row.name}") for row in own]
        frames += next(row.count for row in own if row.name == "render")
    return [*rows, _stage("release", frames, cfg, out)]


def _stages(cfg: RunConfig, out: Path, names: tuple[str, ...]) -> Iterator[StageEstimate]:
    walk, tracks, stride = cfg.pedestrians, len(cfg.render.tracks), cfg.render.frame_stride
    straight = (walk.min_distance_m + walk.max_distance_m) / 2 / walk.cruise_speed_mps / walk.dt_s / stride
    frames = [round(DETOUR * straight)] * (walk.num_paths * tracks)
    paths, traces = out / "pedestrians/path.json", out / "plan/drone_trace.json"
    if all(_is_complete(path.parent) for path in (paths, traces)) and len(read_paths(paths)) == walk.num_paths:
        kept = (trace for trace in read_traces(traces) if trace.drop_reason is None)
        frames = [math.ceil(len(trace.time_s) / stride) for trace in kept] * tracks or frames
    counts = {"map": 1, "pedestrians": walk.num_paths, "frames": sum(frames), "windows": num_windows(cfg, frames)}
    for name in names:
        yield _stage(name, counts[UNITS[name]], cfg, out)


def _stage(name: str, count: int, cfg: RunConfig, out: Path) -> StageEstimate:
    if _is_complete(out / name):
        return StageEstimate(name, count, 0.0, 0.0, True)
    scale = count * (cfg.render.width_px * cfg.render.height_px / 1e6 if name in BY_PIXELS else 1)
    seconds, size_mb = (rate * scale for rate in RATES[name])
    is_known = name != "caption" or cfg.caption.teacher_kind == "rules"
    return StageEstimate(name, count, seconds if is_known else None, size_mb * 1e6, False)


def _is_complete(folder: Path) -> bool:
    return (folder / "manifest.json").exists()


def num_windows(cfg: RunConfig, frames: list[int]) -> int:
    """Return the number of caption windows of tracks with these numbers of frames."""
    window = cfg.caption.window
    whole = (count - window.num_frames + 1 - window.future_frames for count in frames)
    return sum(math.ceil(max(0, count) / window.stride) for count in whole)


def remarks(cfg: RunConfig, out: Path, rows: list[StageEstimate]) -> list[str]:
    """Return the basis of the figures, their totals, and what prevents the run."""
    needed, time = sum(row.bytes for row in rows), duration(sum(row.seconds or 0.0 for row in rows))
    unknown = [row.name for row in rows if row.seconds is None]
    if unknown:
        time += f", and {', '.join(unknown)}, whose time depends on the teacher"
    place = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free
    lines = [f"figures: {BASIS}", f"in all about {time}; {in_words(needed)} of disk, {in_words(free)} are free"]
    lines += caveats(cfg)
    if unknown:
        lines.append("cosfly caption --plan estimates the teacher's part")
    if needed > free:
        lines.append("the disk is too small: choose another --out, or fewer pedestrians or pixels")
    return lines


def caveats(cfg: RunConfig) -> list[str]:
    """Return which settings apply to some trajectories only, and which trajectories will be too dark to see."""
    lines = cfg.plan.remarks()
    for name, town in ({name: cfg.of_town(name) for name in cfg.towns} or {cfg.name: cfg}).items():
        num = town.pedestrians.num_paths
        if dark := dark_trajectories(town.render, num, partial(load_map, town.maps, seed=town.seed)):
            listed = ", ".join(map(walk_id, dark[:4])) + ", ..." * (len(dark) > 4)
            lines.append(
                f"{name}: {len(dark)} of {num} trajectories are dark ({listed}): they are at night, on a map without "
                "street lamps, roads and pavements, so nobody will see the target. Choose another time of day "
                "(render.tod_name, render.tod_pool), another render.weather_seed, or a map with streets"
            )
    return lines


def in_words(num_bytes: float) -> str:
    """Return a size in MB or GB."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.1f} MB"
