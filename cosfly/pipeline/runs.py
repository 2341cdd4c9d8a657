"""Summaries of run directories (stages, items, disk), and estimates of the time and disk of a run, by stage."""

import contextlib
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from cosfly.formats.frames import LEGIBLE_HEIGHT_PX
from cosfly.formats.inspection import undecided
from cosfly.formats.traces import read_traces
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.styles import ROWS
from cosfly.runtime.config import load
from cosfly.runtime.console import duration
from cosfly.runtime.errors import InputError
from cosfly.runtime.run_dir import StageFolder, Tally, read_manifest

STAGES = ("maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release")  # of a run, in order
PAGES = ("viewer.html", "contact_sheet.png", "inspect/report.html", "caption/report.html", "release/dataset/README.md")


@dataclass(frozen=True)
class StageSummary:
    name: str  # `stage`, or `town/stage` in a run with towns
    folder: Path
    state: Literal["complete", "begun", "to do"]
    tally: Tally | None = None  # outcomes of its items so far; None before it began
    seconds: float | None = None  # None before it is complete
    num_items: int | None = None  # of a stage that has begun; None if it is not known

    @property
    def items(self) -> str:
        """Its outcomes in words: `8 kept of 8 so far, of 10`."""
        if self.tally is None or self.state == "complete":
            return str(self.tally or "")
        return f"{self.tally} so far" + (f", of {self.num_items}" if self.num_items else "")

    @property
    def size_bytes(self) -> int:
        """The disk space of its files; links are not followed."""
        total = 0
        for folder, _, names in os.walk(self.folder):
            for name in names:
                with contextlib.suppress(OSError):  # a running stage may remove the file meanwhile
                    total += os.lstat(os.path.join(folder, name)).st_size
        return total


@dataclass(frozen=True)
class RunSummary:
    cfg: RunConfig
    stages: list[StageSummary]

    @property
    def is_complete(self) -> bool:
        return all(stage.state == "complete" for stage in self.stages)

    @property
    def progress(self) -> str:
        """The number of complete stages: `3 of 8`."""
        return f"{sum(stage.state == 'complete' for stage in self.stages)} of {len(self.stages)}"

    def waiting(self) -> dict[Path, int]:
        """Return, for each inspection with tracks that wait for a manual decision, its folder and their number."""
        waiting = {}
        for stage in self.stages:
            if stage.folder.name == "inspect" and stage.state == "complete":
                waiting[stage.folder] = len(undecided(stage.folder / "inspect.json"))
        return {folder: count for folder, count in waiting.items() if count}


def summarize(run: Path) -> RunSummary:
    if not (run / "run.yaml").is_file():
        what = "the folder is not a run directory"
        expected = "a directory that `cosfly run` wrote"
        pages = " or ".join(str(page) for page in (run / "report.html", run / "map.png") if page.exists())
        fix = "pass the --out of a `cosfly run`" + (f", or open {pages}" if pages else "")
        raise InputError(what, where=run, got="no run.yaml in it", expected=expected, fix=fix)
    cfg = load(RunConfig, run / "run.yaml")
    names = list(STAGES)
    if cfg.towns:  # one release is made of all towns
        names = [*(f"{town}/{name}" for town in cfg.towns for name in STAGES[:-1]), "release"]
    stages = [_stage(name, run / name) for name in names]
    for index, stage in enumerate(stages):
        if stage.state == "begun":
            town, _, name = stage.name.rpartition("/")
            town_cfg = cfg.all_towns()[town] if town else cfg
            num_items = _num_items(town_cfg, len(num_frames(town_cfg, run / town))).get(name)
            stages[index] = replace(stage, num_items=num_items)
    return RunSummary(cfg, stages)


def _num_items(cfg: RunConfig, num_trajectories: int) -> dict[str, int]:
    """Return the number of items of the stages in which it is known before they end."""
    num_paths, num_tracks = cfg.pedestrians.num_paths, num_trajectories * len(cfg.render.tracks)
    return {"pedestrians": num_paths, "plan": num_paths, "render": num_tracks, "inspect": num_tracks}


def _stage(name: str, folder: Path) -> StageSummary:
    if (folder / "manifest.json").exists():
        manifest = read_manifest(folder)
        return StageSummary(name, folder, "complete", manifest.counts, manifest.seconds)
    if not (folder / "stage.json").exists():
        return StageSummary(name, folder, "to do")
    outcomes = {record.id: record for record in StageFolder(folder, name, False).items()}
    tally = Tally(input=len(outcomes))
    for record in outcomes.values():
        tally.count(record)
    return StageSummary(name, folder, "begun", tally)


# --- estimates --------------------------------------------------------------------------------------------------------

# Measured in `cosfly run showcase` (docs/benchmarks.md; 2 cores, AMD EPYC, idle): 3 pedestrians, 858 frames of
# 0.9216 Mpx, 804 windows by `rules`. Rates of frames are per million pixels; their disk space is that of `diverse`.
BASIS = "`cosfly run showcase` on a 2-core machine (docs/benchmarks.md), disk space of frames on `diverse`"


class Rate(NamedTuple):
    """The time and disk space of a stage for each of its units."""

    unit: str  # frames: of a million pixels
    seconds: float
    megabytes: float


RATES = {
    "maps": Rate("map", 0.2, 1.1),
    "simplify": Rate("map", 1.4, 1.2),
    "pedestrians": Rate("pedestrians", 4.6 / 3, 0.3 / 3),
    "plan": Rate("pedestrians", 2.3 / 3, 0.4 / 3),
    "render": Rate("frames", 51.2 / 790.7, 2.3),
    "inspect": Rate("frames", 26.8 / 790.7, 0.7 / 790.7),
    "caption": Rate("windows", 4.0 / 804, 7.4 / 804),
    "release": Rate("frames", 25.4 / 790.7, 2.3),
}
START_S = 2.0  # of a stage and its workers, which `showcase` hides: inspect and release of `quickstart` take 2 to 4 s
WALK_MPS = 1.0  # progress along the straight line from start to goal; 0.75 to 1.19 was measured on eight maps
PERSON_M, PERSON_DEPTH_M = 1.75, 0.45  # height of a person, and extent in the plane
SMALL_SHARE = 0.2  # of the time


@dataclass(frozen=True)
class StageEstimate:
    name: str
    count: int  # of its units
    seconds: float | None  # None if they depend on the teacher; 0 if the stage is complete
    bytes: float  # 0 if the stage is complete
    is_done: bool

    @property
    def amount(self) -> str:
        """The number of its units: `858 frames`."""
        return f"{self.count:,} {RATES[self.name.rpartition('/')[2]].unit}"


def estimate(cfg: RunConfig, out: Path) -> list[StageEstimate]:
    """Estimate each stage of a run; with several towns, each stage of each town, and then the release."""
    if not cfg.towns:
        frames = num_frames(cfg, out)
        return [*_estimates(cfg, out, frames), _release(cfg, out, [frames])]
    rows: list[StageEstimate] = []
    town_frames: list[list[int]] = []
    for name, town in cfg.all_towns().items():
        frames = num_frames(town, out / name)
        town_frames.append(frames)
        rows += [replace(row, name=f"{name}/{row.name}") for row in _estimates(town, out / name, frames)]
    return [*rows, _release(cfg, out, town_frames)]


def num_frames(cfg: RunConfig, out: Path) -> list[int]:
    """Return the number of frames of each trajectory, of the finished plan or from the distances of the settings."""
    if _is_complete(out / "plan"):
        traces = read_traces(out / "plan/drone_trace.json")
        num_points = [len(trace.time_s) for trace in traces if trace.drop_reason is None]
    else:
        walking = cfg.pedestrians
        duration_s = 0.5 * (walking.min_distance_m + walking.max_distance_m) / WALK_MPS
        num_points = [round(duration_s / walking.dt_s)] * walking.num_paths
    return [math.ceil(count / cfg.render.frame_stride) for count in num_points]


def _estimates(cfg: RunConfig, out: Path, frames: list[int]) -> Iterator[StageEstimate]:
    window = cfg.caption.window
    # Number of frames of each trajectory at which a whole window can begin.
    num_starts = [max(0, count - window.num_frames + 1 - window.future_frames) for count in frames]
    num_tracks = len(cfg.render.tracks)
    counts = {
        "map": 1,
        "pedestrians": cfg.pedestrians.num_paths,
        "frames": sum(frames) * num_tracks,
        "windows": sum(math.ceil(count / window.stride) for count in num_starts) * num_tracks,
    }
    num_items = _num_items(cfg, len(frames))
    for name in STAGES[:-1]:
        stage = _stage(name, out / name)
        num_done = stage.tally.input if stage.tally and stage.state == "begun" else 0
        share_done = num_done / num_items.get(name, math.inf)
        yield _estimate(name, round(counts[RATES[name].unit] * (1.0 - min(share_done, 1.0))), cfg, out)


def _release(cfg: RunConfig, out: Path, town_frames: list[list[int]]) -> StageEstimate:
    """Estimate the release of all towns, which has the selected frames."""
    most = math.inf if cfg.release.selection == "all" else cfg.release.num_frames
    num_tracks = len(set(cfg.release.tracks) & set(cfg.render.tracks))
    count = sum(min(count, most) for frames in town_frames for count in frames) * num_tracks
    return _estimate("release", int(count), cfg, out)


def _estimate(name: str, count: int, cfg: RunConfig, out: Path) -> StageEstimate:
    if _is_complete(out / name):
        return StageEstimate(name, count, 0.0, 0.0, True)
    rate = RATES[name]
    num_units: float = count
    if rate.unit == "frames":
        num_units *= cfg.render.width_px * cfg.render.height_px / 1e6
    is_known = name != "caption" or cfg.caption.teacher_kind == "rules"
    seconds = START_S + rate.seconds * num_units if is_known else None
    return StageEstimate(name, count, seconds, rate.megabytes * num_units * 1e6, False)


def _is_complete(folder: Path) -> bool:
    return (folder / "manifest.json").exists()


def remarks(cfg: RunConfig, out: Path, rows: list[StageEstimate]) -> list[str]:
    """Return lines for the user: the basis of the estimates, their totals, and reasons why the run may fail."""
    needed = sum(row.bytes for row in rows)
    time = duration(sum(row.seconds or 0.0 for row in rows))
    unknown = [row.name for row in rows if row.seconds is None]
    if unknown:
        time += f", and {', '.join(unknown)}, whose time depends on the teacher"
    existing = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    lines = [
        f"estimates are based on {BASIS}",
        f"total: about {time}; {in_words(needed)} of disk space ({in_words(free)} are free)",
        *caveats(cfg),
    ]
    if unknown:
        lines.append("run cosfly caption --limit 10: its report has the tokens and cost of a caption")
    if needed > free:
        lines.append("the disk is too small: choose another --out, fewer pedestrians or smaller pictures")
    return lines


def caveats(cfg: RunConfig) -> list[str]:
    """Return remarks on settings that apply to some trajectories only, and on targets too small to see.

    Too small: lower than LEGIBLE_HEIGHT_PX in the styles of SMALL_SHARE of the time or more. Distances, altitudes and
    fields of view are the middles of their ranges.
    """
    plan, render = cfg.plan, cfg.render
    fov_deg = sum(render.fovs_deg) / len(render.fovs_deg)
    focal_px = render.width_px / 2.0 / math.tan(math.radians(fov_deg / 2.0))
    small: dict[str, float] = {}  # words -> share of the time
    for name, share in plan.styles.items():
        apart_m, up_m = plan.behind_distance_m, plan.altitude_preferred_m
        if name in ROWS:
            row = plan.style(name)
            apart_m = float(np.mean([row.ground_distance_m, row.ground_distance_end_m or row.ground_distance_m]))
            up_m = float(np.mean([row.altitude_m, row.altitude_end_m or row.altitude_m]))
        height_px = focal_px * (PERSON_M * apart_m + PERSON_DEPTH_M * up_m) / math.hypot(apart_m, up_m) ** 2
        if share > 0 and height_px < LEGIBLE_HEIGHT_PX:
            small[f"{name} {height_px:.0f} px"] = share
    remarks = plan.remarks()
    if sum(small.values()) >= SMALL_SHARE * sum(plan.styles.values()):
        remarks.append(
            f"the target is lower than {LEGIBLE_HEIGHT_PX:g} px in pictures ({', '.join(small)}), so it can hardly be "
            "recognized. Choose larger pictures (render.width_px), a narrower field of view (render.fovs_deg), or "
            "smaller distances (plan.behind_distance_m, plan.altitude_preferred_m, plan.style_ranges)"
        )
    return remarks


def in_words(num_bytes: float) -> str:
    """Return a size in MB or GB."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.1f} MB"
