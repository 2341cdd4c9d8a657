"""What a run will take: time and disk by stage, from its settings and the figures of `cosfly run showcase`."""

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
from cosfly.render.weather import dark_flights

UNITS = {
    "maps": "map", "simplify": "map", "pedestrians": "walks", "plan": "walks", "render": "frames", "inspect": "frames",
    "caption": "windows", "release": "frames",
}  # fmt: skip
BY_PIXELS = ("render", "inspect", "release")  # what costs as much as its pictures have pixels
BASIS = "`cosfly run showcase` on a 2-core machine (docs/first-runs.md)"
# Seconds and MB of a unit of each stage; of BY_PIXELS of a million pixels. Of `cosfly run showcase`: seconds of
# docs/first-runs.md (2 cores, AMD EPYC, idle): 3 walks, 858 frames of 0.9216 Mpx, 804 windows of teacher `rules`.
RATES = {
    "maps": (0.2, 1.1), "simplify": (5.6, 1.2), "pedestrians": (4.6 / 3, 0.3 / 3), "plan": (2.3 / 3, 0.4 / 3),
    "render": (51.2 / 790.7, 4383 / 790.7), "inspect": (8.3 / 790.7, 0.7 / 790.7), "caption": (4.0 / 804, 7.4 / 804),
    "release": (7.8 / 790.7, 1842 / 790.7),
}  # fmt: skip
# Frames of a walk over those of the straight way between its ends (50 to 100 m at 1.2 m/s, two frames a second: 143).
DETOUR = 1.14


@dataclass(frozen=True)
class StageEstimate:
    """One stage of a run. seconds: None where its teacher decides; is_done: it costs nothing any more."""

    name: str
    count: int
    seconds: float | None
    bytes: float
    is_done: bool

    @property
    def stage(self) -> str:
        """Its name without that of a town."""
        return self.name.rpartition("/")[2]


# --- how much there is to do ------------------------------------------------------------------------------------------


def _mpx(cfg: RunConfig) -> float:
    return cfg.render.width_px * cfg.render.height_px / 1e6


def _straight_frames(cfg: RunConfig) -> float:
    """Frames over the mean straight way between a walk's ends."""
    walk = cfg.pedestrians
    steps = (walk.min_distance_m + walk.max_distance_m) / 2 / walk.cruise_speed_mps / walk.dt_s
    return steps / cfg.render.frame_stride


def _is_complete(folder: Path) -> bool:
    return (folder / "manifest.json").exists()


def _walks_of(run: Path) -> int:
    return len(read_paths(run / "pedestrians/path.json")) if _is_complete(run / "pedestrians") else 0


def _frames_of(cfg: RunConfig, run: Path) -> list[int]:
    """Frames of each flight that will be drawn, where the plan is finished; else none."""
    if not _is_complete(run / "plan"):
        return []
    traces = read_traces(run / "plan/drone_trace.json")
    return [-(-len(trace.time_s) // cfg.render.frame_stride) for trace in traces if trace.drop_reason is None] * len(
        cfg.render.tracks
    )


def num_windows(cfg: RunConfig, frames: list[int]) -> int:
    """Windows of flights of so many frames (`caption.window`)."""
    window = cfg.caption.window
    whole = (count - window.num_frames + 1 - window.future_frames for count in frames)
    return sum(math.ceil(max(0, count) / window.stride) for count in whole)


def _amounts(cfg: RunConfig, out: Path) -> dict[str, int]:
    """Count what a run is of."""
    walks, tracks = cfg.pedestrians.num_paths, len(cfg.render.tracks)
    each = round(DETOUR * _straight_frames(cfg))
    made = _walks_of(out)
    frames = (_frames_of(cfg, out) if made == walks else []) or [each] * (walks * tracks)
    return {"map": 1, "walks": walks, "frames": sum(frames), "windows": num_windows(cfg, frames)}


def estimate(cfg: RunConfig, out: Path) -> list[StageEstimate]:
    """Estimate each stage of a run, of several towns each town's under its name; a finished stage costs nothing.

    Raises:
        CosflyError: what stands in `out` cannot be read.
    """
    if not cfg.towns:
        return list(_stages(cfg, out, STAGES))
    rows: list[StageEstimate] = []
    frames = 0
    for name in cfg.towns:
        town = cfg.of_town(name)
        rows += [replace(row, name=f"{name}/{row.name}") for row in _stages(town, out / name, STAGES[:-1])]
        frames += rows[-3].count  # of render
    return [*rows, _stage("release", frames, cfg, out)]


def _stages(cfg: RunConfig, out: Path, names: tuple[str, ...]) -> Iterator[StageEstimate]:
    counts = _amounts(cfg, out)
    for name in names:
        yield _stage(name, counts[UNITS[name]], cfg, out)


def _stage(name: str, count: int, cfg: RunConfig, out: Path) -> StageEstimate:
    if _is_complete(out / name):
        return StageEstimate(name, count, 0.0, 0.0, True)
    seconds, size_mb = (rate * count * (_mpx(cfg) if name in BY_PIXELS else 1) for rate in RATES[name])
    if name == "caption" and cfg.caption.teacher_kind != "rules":
        return StageEstimate(name, count, None, size_mb * 1e6, False)
    return StageEstimate(name, count, seconds, size_mb * 1e6, False)


# --- in words ---------------------------------------------------------------------------------------------------------


def time_left(rows: list[StageEstimate]) -> str:
    """Return the time of all that is not done, in words; what nobody knows is named."""
    unknown = dict.fromkeys(row.name for row in rows if row.seconds is None)
    text = duration(sum(row.seconds or 0.0 for row in rows))
    return f"{text}, and {', '.join(unknown)}, whose time depends on its teacher" if unknown else text


def free_bytes(out: Path) -> int:
    """Free space where a run will stand."""
    place = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    return shutil.disk_usage(place).free


def remarks(cfg: RunConfig, out: Path, rows: list[StageEstimate]) -> list[str]:
    """Return what the figures rest on, what they come to in all, and what stands in the way of the run."""
    needed = sum(row.bytes for row in rows)
    disk = f"{in_words(needed)} of disk, {in_words(free_bytes(out))} are free"
    lines = [f"figures: {BASIS}", f"in all about {time_left(rows)}; {disk}", *caveats(cfg)]
    if any(row.seconds is None for row in rows):
        lines.append("cosfly caption --plan says what the teacher will take")
    if needed > free_bytes(out):
        lines.append("there is not enough space for it: choose another --out, or fewer walks or pixels")
    return lines


def caveats(cfg: RunConfig) -> list[str]:
    """Return which settings hold for some flights alone, and which flights nobody will see anything on; maps are read
    where a flight is by night.
    """
    lines = cfg.plan.remarks()
    for name, town in ({name: cfg.of_town(name) for name in cfg.towns} or {cfg.name: cfg}).items():
        num = town.pedestrians.num_paths
        if dark := dark_flights(town.render, num, partial(load_map, town.maps, seed=town.seed)):
            listed = ", ".join(map(walk_id, dark[:4])) + ", ..." * (len(dark) > 4)
            lines.append(
                f"{name}: {len(dark)} of {num} flights are dark ({listed}): by night, on a map without street lamps, "
                "roads and pavements; nobody will see the person there. Take another time of day (render.tod_name, "
                "render.tod_pool), another render.weather_seed, or a map with streets"
            )
    return lines


def in_words(num_bytes: float) -> str:
    """Return a size in words."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.1f} MB"
