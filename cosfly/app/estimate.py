"""What a run will take: time, disk and tokens by stage, from its settings and the figures of finished runs.

A figure's basis is told with it: runs that stand beside the run, or else the quickstart of docs/first-runs.md.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from caption.run.progress import duration
from cosfly.app.runs import STAGES, StageLook, find, look
from cosfly.app.settings import RunConfig, manner_of_work
from cosfly.errors import CosflyError
from cosfly.maps.stage import load_map
from cosfly.products.captions import read_captions
from cosfly.products.traces import read_traces
from cosfly.products.walks import read_paths, walk_id
from cosfly.render.weather import dark_flights
from cosfly.work.config import load
from cosfly.work.ray_engine import ALL_ROOM
from cosfly.work.stage_folder import Failed, StageFolder, flattened

UNITS = {
    "maps": "map", "simplify": "map", "pedestrians": "walks", "plan": "walks", "render": "frames", "inspect": "frames",
    "caption": "windows", "release": "frames",
}  # fmt: skip
BY_PIXELS = ("render", "inspect", "release")  # what costs as much as its pictures have pixels
MOST_RUNS = 3  # looked at, the newest
UNKNOWN_TOKENS = "not known before asking: cosfly caption --plan"


@dataclass(frozen=True)
class Rate:
    """What one unit of a stage costs; of BY_PIXELS one of a million pixels. seconds: of the stage on its workers."""

    seconds: float
    bytes: float
    basis: str


@dataclass
class Rates:
    """Costs by stage, and how long a walk is. tokens: prompt and completion of a window, by kind of teacher."""

    stages: dict[str, Rate]
    frames_a_metre: float  # of the way between a walk's ends, as the crow flies, at 1 m/s and one frame a second
    tokens: dict[str, tuple[float, float]] = field(default_factory=dict)


def _rate(seconds: float, size_mb: float, units: float) -> Rate:
    return Rate(seconds / units, size_mb * 1e6 / units, "the quickstart on a 2-core machine (docs/first-runs.md)")


# Of `cosfly run quickstart`: seconds of docs/first-runs.md (2 cores, AMD EPYC, idle), sizes of `du` today: 3 walks, 858
# frames of 0.9216 Mpx, 804 windows. Ends of a walk are 50 to 100 m apart; at 1.2 m/s and two frames a second 143 frames
# are 1.14 times the straight way.
SHIPPED = Rates(
    {
        "maps": _rate(0.2, 1.1, 1), "simplify": _rate(5.6, 1.2, 1), "pedestrians": _rate(4.6, 0.3, 3),
        "plan": _rate(2.3, 0.4, 3), "render": _rate(51.2, 4383, 858 * 0.9216), "inspect": _rate(8.3, 0.7, 858 * 0.9216),
        "caption": _rate(4.0, 7.4, 804), "release": _rate(7.8, 1842, 858 * 0.9216),
    },
    1.14,
    {"rules": (0.0, 0.0)},
)  # fmt: skip


@dataclass(frozen=True)
class StageEstimate:
    """One stage of a run. tokens: in and out, None where nobody knows; is_done: it costs nothing any more."""

    name: str
    count: int
    seconds: float | None
    bytes: float
    tokens: tuple[float, float] | None
    is_done: bool
    basis: str

    @property
    def stage(self) -> str:
        """Its name without that of a town."""
        return self.name.rpartition("/")[2]


# --- figures of finished runs -----------------------------------------------------------------------------------------


def rates_near(out: Path) -> Rates:
    """Gather the figures of the run itself and of the newest runs beside it; what they lack comes from SHIPPED."""
    rates = replace(SHIPPED, stages=dict(SHIPPED.stages), tokens=dict(SHIPPED.tokens))
    try:
        found = list(find(out.parent, depth=1)) if out.parent.is_dir() else []
    except (CosflyError, OSError):
        found = []
    found = sorted(found, key=lambda run: (run / "run.yaml").stat().st_mtime)[-MOST_RUNS:]
    for run in found:  # the newest last: it counts
        _learn(rates, run)
    return rates


def _learn(rates: Rates, run: Path) -> None:
    try:
        seen = look(run)
    except CosflyError:  # of another version
        return
    if seen.cfg.towns:
        return
    num_walks, frames = _walks_of(run), _frames_of(seen.cfg, run)
    if not num_walks or not frames:
        return
    counts = {"map": 1, "walks": num_walks, "frames": sum(frames), "windows": num_windows(seen.cfg, frames)}
    workers = manner_of_work(seen.cfg)["workers"]
    for stage in seen.stages:
        if stage.state != "complete" or stage.seconds is None or not counts[UNITS[stage.name]]:
            continue
        units = counts[UNITS[stage.name]] * (_mpx(seen.cfg) if stage.name in BY_PIXELS else 1)
        seconds = max(stage.seconds, _seconds_of_items(run / stage.name, stage, workers))
        told = "all" if workers == ALL_ROOM else workers
        rates.stages[stage.name] = Rate(seconds / units, stage.size_bytes / units, f"{run}, {told} workers")
        if stage.name == "caption" and seen.cfg.caption.teacher_kind != "rules":
            rates.tokens[seen.cfg.caption.teacher_kind] = _tokens_of(run / "caption/captions.jsonl")
    rates.frames_a_metre = sum(frames) / (len(seen.cfg.render.tracks) * num_walks * _straight_frames(seen.cfg))


def _seconds_of_items(folder: Path, stage: StageLook, workers: int) -> float:
    """The manifest of a run that went on later tells the last part of its time; the items tell all of it."""
    records = StageFolder(folder, stage.name, False).items()
    return sum(record.seconds for record in records if not isinstance(record, Failed)) / max(1, workers)


def _tokens_of(captions: Path) -> tuple[float, float]:
    usages = [caption.usage for caption in read_captions(captions)]
    count = max(1, len(usages))
    return sum(u.prompt_tokens for u in usages) / count, sum(u.completion_tokens for u in usages) / count


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


def _amounts(cfg: RunConfig, out: Path, rates: Rates) -> dict[str, int]:
    """Count what a run is of."""
    walks, tracks = cfg.pedestrians.num_paths, len(cfg.render.tracks)
    each = round(rates.frames_a_metre * _straight_frames(cfg))
    made = _walks_of(out)
    frames = (_frames_of(cfg, out) if made == walks else []) or [each] * (walks * tracks)
    return {"map": 1, "walks": walks, "frames": sum(frames), "windows": num_windows(cfg, frames)}


def other_settings(cfg: RunConfig, out: Path) -> list[str]:
    """Name the settings of stages that the work in a run folder was made with otherwise, by their dotted paths."""
    if not (out / "run.yaml").is_file():
        return []
    sections = {"seed", "towns", "roi", *STAGES}
    found, wanted = (
        flattened(one.model_dump(mode="json", include=sections)) for one in (load(RunConfig, out / "run.yaml"), cfg)
    )
    return sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))


def estimate(cfg: RunConfig, out: Path, rates: Rates) -> list[StageEstimate]:
    """Estimate each stage of a run, of several towns each town's under its name; a finished stage costs nothing.

    Raises:
        CosflyError: what stands in `out` cannot be read.
    """
    if not cfg.towns:
        return list(_stages(cfg, out, rates, STAGES))
    rows: list[StageEstimate] = []
    frames = 0
    for name in cfg.towns:
        town = cfg.of_town(name)
        rows += [replace(row, name=f"{name}/{row.name}") for row in _stages(town, out / name, rates, STAGES[:-1])]
        frames += rows[-3].count  # of render
    return [*rows, _stage("release", frames, cfg, out, rates)]


def _stages(cfg: RunConfig, out: Path, rates: Rates, names: tuple[str, ...]) -> Iterator[StageEstimate]:
    counts = _amounts(cfg, out, rates)
    changed = {name.partition(".")[0] for name in other_settings(cfg, out)}
    fresh = 0 if changed - set(names) else min((names.index(name) for name in changed), default=len(names))
    for place, name in enumerate(names):
        yield _stage(name, counts[UNITS[name]], cfg, out, rates, place < fresh)


def _stage(name: str, count: int, cfg: RunConfig, out: Path, rates: Rates, stands: bool = True) -> StageEstimate:
    """Estimate a stage; `stands`: what is finished of it was made with these settings."""
    rate, is_done, tokens = rates.stages[name], stands and _is_complete(out / name), (0.0, 0.0)
    units = count * (_mpx(cfg) if name in BY_PIXELS else 1)
    seconds: float | None = rate.seconds * units
    known: tuple[float, float] | None = tokens
    if name == "caption":
        per_window = rates.tokens.get(cfg.caption.teacher_kind)
        known = None if per_window is None else (per_window[0] * count, per_window[1] * count)
        seconds = None if per_window is None else seconds
    if is_done:
        return StageEstimate(name, count, 0.0, 0.0, tokens, True, rate.basis)
    return StageEstimate(name, count, seconds, rate.bytes * units, known, False, rate.basis)


# --- in words ---------------------------------------------------------------------------------------------------------


def time_left(rows: list[StageEstimate]) -> str:
    """Give the time of all that is not done, in words; what nobody knows is named."""
    unknown = dict.fromkeys(row.name for row in rows if row.seconds is None)
    text = duration(sum(row.seconds or 0.0 for row in rows))
    return f"{text}, and {', '.join(unknown)}, whose time depends on its teacher" if unknown else text


def free_bytes(out: Path) -> int:
    """Free space where a run will stand."""
    place = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    return shutil.disk_usage(place).free


def space(rows: list[StageEstimate], out: Path) -> str:
    """Give the disk space of all that is not done, and what is free, in words."""
    return f"{in_words(sum(row.bytes for row in rows))} of disk, {in_words(free_bytes(out))} are free"


def remarks(cfg: RunConfig, out: Path, rows: list[StageEstimate]) -> list[str]:
    """Say what the figures rest on, what they come to in all, and what stands in the way of the run."""
    lines = []
    for basis in dict.fromkeys(row.basis for row in rows):
        names = dict.fromkeys(row.stage for row in rows if row.basis == basis)
        lines.append(f"figures of {', '.join(names)}: {basis}")
    lines.append(f"in all about {time_left(rows)}; {space(rows, out)}")
    lines += caveats(cfg)
    if any(row.tokens is None for row in rows):
        lines.append(f"tokens are {UNKNOWN_TOKENS}")
    if others := other_settings(cfg, out):
        listed = f"{', '.join(others[:6])}{' ...' if len(others) > 6 else ''}"
        lines.append(
            f"{out} was made with other settings ({listed}): its finished stages refuse them; choose another --out"
        )
    if sum(row.bytes for row in rows) > free_bytes(out):
        lines.append("there is not enough space for it: choose another --out, or fewer walks or pixels")
    return lines


def caveats(cfg: RunConfig) -> list[str]:
    """Say which settings hold for some flights alone, and which flights nobody will see anything on; maps are read
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
    """Give a size in words."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.1f} MB"
