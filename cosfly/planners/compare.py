"""Planners side by side on the same pedestrian trajectories: `cosfly plan compare` (app:three_axis_eval).

The paper's axes, as its table's figures define them: visibility is the mean; path efficiency is the shortest mean
length of a planner without collisions over the planner's own; smoothness is 1 / (1 + jerk RMS); safety is (1 -
collision fraction) * clamp(least clearance / 5 m); each from the planner's means over all pedestrian trajectories.
"Blocked" is the share of rays that are not free. The other planners are compared with the first one. Only pedestrian
trajectories that all planners follow are compared; the others are listed with the planner that failed.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, field_validator

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.planners.contract import ALL_PLANNERS, PLANNERS, PlanConfig, known_planner, planner_notes, title_of
from cosfly.planners.overview import draw_pedestrians
from cosfly.planners.stage import load_obstacles, make_items, plan_trajectory, read_inputs, warm_up
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, read_object, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Dropped, Failed, ItemRecord, Resume, StageFolder, read_manifest, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.tables import TextTable
from cosfly.viz.topview import add_caption, draw_dot, draw_line, draw_text, png_bytes

FORMAT = FileFormat("cosfly.plan_compare", "2.1")
CLEARANCE_SCALE_M = 5.0  # a clearance of this or more is full safety

# Figures of one trajectory, in the order of the tables: name, title, digits.
FIGURES = (
    ("five_ray_mean", "average visibility", 3),
    ("blocked_fraction", "blocked visibility fraction", 3),
    ("length_m", "path length (m)", 1),
    ("duration_s", "flight time (s)", 1),
    ("target_distance_mean_m", "target distance (m)", 1),
    ("altitude_mean_m", "altitude (m)", 1),
    ("accel_rms_mps2", "acceleration RMS (m/s2)", 3),
    ("jerk_rms_mps3", "jerk RMS (m/s3)", 3),
    ("smoothness_score", "smoothness score S", 3),
    ("collision_fraction", "collision fraction", 3),
    ("clearance_min_m", "min signed clearance (m)", 2),
)
NAMES = [name for name, _, _ in FIGURES]
AXES = ("visibility", "path_efficiency", "smoothness", "safety")
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of pedestrian trajectories, for intervals (Efron 1979)


# --- figures ----------------------------------------------------------------------------------------------------------


def trajectory_figures(trace: DroneTrace) -> dict[str, float]:
    """Return the figures of FIGURES of one drone trajectory."""
    figures = {name: float(trace.metrics[name]) for name in NAMES if name in trace.metrics}
    figures["blocked_fraction"] = round(1.0 - figures["five_ray_mean"], 4)
    figures["collision_fraction"] = round(float((trace.clearances_m < 0).mean()), 4)
    return {name: figures[name] for name in NAMES}


def shortest_mean_m(means: dict[str, dict[str, float]]) -> float:
    """Return the shortest mean length of planners without collisions, or of all where every planner collides."""
    free = [figures["length_m"] for figures in means.values() if figures["collision_fraction"] == 0]
    return min(free or [figures["length_m"] for figures in means.values()])


def axis_scores(means: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the four axis scores and their mean for each planner (tab:appendix_h_four_axis_scores).

    Args:
        means: planner -> mean figures.
    """
    shortest_m, scores = shortest_mean_m(means), {}
    for planner, figures in means.items():
        clear = float(np.clip(figures["clearance_min_m"] / CLEARANCE_SCALE_M, 0.0, 1.0))
        axes = {
            "visibility": figures["five_ray_mean"],
            "path_efficiency": shortest_m / figures["length_m"] if figures["length_m"] > 0 else 1.0,
            "smoothness": 1.0 / (1.0 + figures["jerk_rms_mps3"]),
            "safety": (1.0 - figures["collision_fraction"]) * clear,
        }
        axes["mean"] = sum(axes.values()) / len(axes)
        scores[planner] = {name: round(value, 4) for name, value in axes.items()}
    return scores


def axis_differences(
    figures: dict[str, list[dict[str, float]]], rng: np.random.Generator
) -> dict[str, dict[str, dict]]:
    """Return the first planner's axis scores minus each other planner's, with bootstrap 95 % intervals.

    Args:
        figures: planner -> figures of the same pedestrian trajectories in the same order.
    """
    first, *others = figures
    tables = {planner: np.array([list(row.values()) for row in rows]) for planner, rows in figures.items()}
    num = len(tables[first])
    samples = [np.arange(num), *rng.integers(num, size=(NUM_RESAMPLES, num))]
    scores = [
        axis_scores({k: dict(zip(NAMES, table[sample].mean(axis=0), strict=True)) for k, table in tables.items()})
        for sample in samples
    ]
    differences: dict[str, dict[str, dict]] = {other: {} for other in others}
    for other in others:
        for axis in (*AXES, "mean"):
            found, *drawn = (score[first][axis] - score[other][axis] for score in scores)
            low, high = np.percentile(drawn, INTERVAL_PERCENT)
            row = {"difference": found, "low": low, "high": high}
            differences[other][axis] = {name: round(float(value), 4) for name, value in row.items()}
    return differences


def deltas(first: dict[str, float], second: dict[str, float]) -> dict[str, dict[str, float | None]]:
    """Return difference and relative difference in percent for each figure; None where the second's is 0."""
    table: dict[str, dict[str, float | None]] = {}
    for name in NAMES:
        change = first[name] - second[name]
        relative = round(100.0 * change / second[name], 3) if second[name] else None
        table[name] = {"delta": round(change, 4), "relative_percent": relative}
    return table


def win_rates(first: list[dict[str, float]], second: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Count how often the first planner is strictly better (tab:appendix_h_tastar_muco_win_rates)."""
    pairs = list(zip(first, second, strict=True))
    wins = {
        "visibility_higher": [a["five_ray_mean"] > b["five_ray_mean"] for a, b in pairs],
        "path_shorter": [a["length_m"] < b["length_m"] for a, b in pairs],
        "jerk_lower": [a["jerk_rms_mps3"] < b["jerk_rms_mps3"] for a, b in pairs],
        "clearance_larger": [a["clearance_min_m"] > b["clearance_min_m"] for a, b in pairs],
        "both_collision_free": [a["collision_fraction"] == b["collision_fraction"] == 0 for a, b in pairs],
    }
    num = len(pairs)
    return {name: {"count": sum(won), "of": num, "rate": round(sum(won) / num, 4)} for name, won in wins.items()}


def summarize(traces: dict[str, list[DroneTrace]], rng: np.random.Generator) -> dict:
    """Compare drone trajectories for the same pedestrian trajectories.

    Args:
        traces: planner -> at least one trace, the same pedestrian trajectories in the same order.
    Returns:
        The tables of `compare.json`. `deltas`, `axis_differences` and `win_rates` are by the other planner: the first
        planner's figures minus its own, and the first planner's wins.
    """
    first, *others = traces
    figures = {planner: [trajectory_figures(trace) for trace in own] for planner, own in traces.items()}
    means = {
        p: {name: round(float(np.mean([row[name] for row in rows])), 4) for name in NAMES}
        for p, rows in figures.items()
    }
    return {
        "means": means,
        "deltas": {other: deltas(means[first], means[other]) for other in others},
        "axes": axis_scores(means),
        "axis_differences": axis_differences(figures, rng),
        "win_rates": {other: win_rates(figures[first], figures[other]) for other in others},
        "scenarios": [
            {"id": trace.path_id, **{planner: rows[i] for planner, rows in figures.items()}}
            for i, trace in enumerate(traces[first])
        ],
    }


class CompareConfig(PlanConfig):
    """Settings of a comparison: those of step 4, of which `planner` is ignored, and the planners to compare."""

    planners: tuple[str, ...] = Field(tuple(PLANNERS), description="planners to compare with the first one")

    @field_validator("planners")
    @classmethod
    def _are_known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("a planner is named twice")
        known = tuple(known_planner(name) for name in names)
        if len(known) < 2:
            raise ValueError(f"a comparison needs at least 2 planners; name another of {', '.join(ALL_PLANNERS)}")
        return known


# --- stage ------------------------------------------------------------------------------------------------------------


def make_worker(cfg: CompareConfig, simplified_map: Path, seed: int, keeps_all: bool = False) -> Work:
    """Load the map once; return the function that plans for one pedestrian trajectory with each planner.

    Args:
        keeps_all: Keep an item although a planner failed.
    """
    obstacles, screens = load_obstacles(simplified_map)
    settings = {name: cfg.model_copy(update={"planner": name}) for name in cfg.planners}
    for own in settings.values():
        warm_up(own)

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        traces: dict[str, dict] = {}
        errors: dict[str, NoPathError] = {}
        times_ms: dict[str, float] = {}
        for name, own in settings.items():
            begin_s = time.perf_counter()
            try:
                traces[name] = plan_trajectory(pedestrian, obstacles, own, seed, screens, styles).as_json()
            except NoPathError as error:
                errors[name] = error
            times_ms[name] = round(1000.0 * (time.perf_counter() - begin_s), 2)
        if len(errors) == len(settings):
            raise errors[cfg.planners[0]]
        dropped = f"no_{next(iter(errors))}_trajectory" if errors and not keeps_all else None
        result = {"traces": traces, "errors": {k: str(e) for k, e in errors.items()}, "times_ms": times_ms}
        return Outcome(result, dropped)

    return work


def run(
    cfg: CompareConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Read a simplified map and `path.json`; write `compare.json`, each planner's traces and a picture.

    A pedestrian trajectory that a planner cannot follow is dropped with that planner's name; one that no planner can
    follow is a failure.

    Returns:
        The path of `compare.json`.
    Raises:
        InputError: If an input file is invalid.
        NothingKept: If there is no pedestrian trajectory that all planners follow.
    """
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_compare", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product = out / "compare.json"
    if stage.is_complete:
        return product
    box_map, pedestrians = read_inputs(simplified_map, paths)
    items = make_items(pedestrians, cfg, seed)
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally, expected="a pedestrian trajectory that all planners follow")
    shared = {record.id: result_of(record, PlannedItem) for record in finished.kept}
    by_path = [planned.read_traces(path_id) for path_id, planned in shared.items()]
    traces = {name: [own[name] for own in by_path] for name in cfg.planners}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    summary = {
        "planners": {name: ALL_PLANNERS[name] for name in traces},
        "notes": planner_notes(cfg.planners, cfg),
        **summarize(traces, rng_for(seed, "plan_compare", "intervals")),
        "skipped": _skipped(finished.records),
    }
    write_json(product, {**FORMAT.header, **header, **summary})
    outputs = [product]
    for name, own in traces.items():
        outputs.append(out / f"drone_trace_{name}.json")
        write_traces(outputs[-1], own, {**header, "planner": name})
    outputs.append(out / "compare_overlay.png")
    compared = [pedestrian for pedestrian in pedestrians if pedestrian.path_id in shared]
    write_bytes(outputs[-1], draw_overlay(box_map, compared, traces))
    stage.finish(outputs, finished.tally, timings=timings(shared.values(), cfg.planners))
    return product


class PlannedItem(BaseModel):
    """Journal entry of one pedestrian trajectory, by planner."""

    traces: dict[str, dict[str, Any]]
    errors: dict[str, str]
    times_ms: dict[str, float]

    def read_traces(self, path_id: str) -> dict[str, DroneTrace]:
        """Return the traces by planner; raise InputError where one is invalid."""
        return {name: DroneTrace.from_json(t, f"items.jsonl: {path_id}: {name}") for name, t in self.traces.items()}


def _skipped(records: Iterable[ItemRecord]) -> list[dict[str, str]]:
    """Return the pedestrian trajectories that are not compared, with the planners that failed and their reasons."""
    rows = []
    for record in records:
        if isinstance(record, Failed):
            rows.append({"id": record.id, "planner": "all", "message": record.message})
        elif isinstance(record, Dropped):
            errors = result_of(record, PlannedItem).errors
            rows += [{"id": record.id, "planner": planner, "message": message} for planner, message in errors.items()]
    return rows


def timings(items: Collection[PlannedItem], planners: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return planning times, which are written to the manifest only because they differ from run to run."""
    table = {}
    for name in planners:
        times_ms = np.array([item.times_ms.get(name, 0.0) for item in items])
        p50, p95 = np.percentile(times_ms, (50, 95))
        figures = {"mean_ms": times_ms.mean(), "p50_ms": p50, "p95_ms": p95, "max_ms": times_ms.max()}
        table[name] = {figure: round(float(value), 1) for figure, value in figures.items()}
    return table


# --- picture ----------------------------------------------------------------------------------------------------------

# RGB: the paper's blue and orange, then others that differ in brightness too.
PALETTE = (
    (30, 100, 210), (235, 120, 20), (20, 150, 90), (150, 60, 170), (120, 90, 60), (20, 170, 190), (200, 40, 60),
    (110, 110, 110),
)  # fmt: skip
LEGEND_PX = 160  # of one planner


def color_of(planner: str) -> tuple[int, int, int]:
    """Return a planner's color, the same in every comparison."""
    return PALETTE[list(ALL_PLANNERS).index(planner) % len(PALETTE)]


def draw_overlay(
    box_map: BoxMap, pedestrians: list[PedestrianTrajectory], traces: dict[str, list[DroneTrace]]
) -> bytes:
    """Draw pedestrian trajectories (dark) and the trajectories of each planner over the map; return PNG bytes."""
    picture, view = draw_pedestrians(box_map, pedestrians, [trace for own in traces.values() for trace in own])
    for planner, own in traces.items():
        for trace in own:
            line = view.pixels(trace.positions_m)
            draw_line(picture, line, color_of(planner), 2, halo=5)
            draw_dot(picture, line[0], 5, color_of(planner))
    picture = add_caption(picture, f"{box_map.name}: {len(pedestrians)} pedestrians (dark); dots are starts")
    x, y = float(picture.shape[1] - LEGEND_PX * len(traces)), 25.0
    for planner in traces:
        draw_line(picture, np.array([[x, y - 5], [x + 34, y - 5]]), color_of(planner), 3)
        x = draw_text(picture, title_of(planner), x + 42, y) + 18
    return png_bytes(picture)


# --- tables -----------------------------------------------------------------------------------------------------------


def text_tables(product: Path) -> list[TextTable]:
    """Read `compare.json` and its manifest as text tables: figures, axes, and the first planner's wins."""
    found, times = read_object(product, what="comparison"), read_manifest(product.parent).facts["timings"]
    first, *others = planners = list(found["means"])
    titles, minus = [title_of(planner) for planner in planners], [f"minus {title_of(other)}" for other in others]
    figures, axes = [], []
    for name, words, digits in FIGURES:
        figures.append([words, *(f"{found['means'][planner][name]:.{digits}f}" for planner in planners)])
        for change in (found["deltas"][other][name] for other in others):
            relative = change["relative_percent"]
            figures[-1] += [f"{change['delta']:+.{digits}f}", "n/a" if relative is None else f"{relative:+.1f}"]
    means_ms = [f"{times[planner]['mean_ms']:.1f}" for planner in planners]
    figures.append(["planning time (ms)", *means_ms, *[""] * 2 * len(others)])
    for name in (*AXES, "mean"):
        rows = [found["axis_differences"][other][name] for other in others]
        apart = [f"{row['difference']:+.3f} ({row['low']:+.3f} to {row['high']:+.3f})" for row in rows]
        axes.append([name.replace("_", " "), *(f"{found['axes'][p][name]:.3f}" for p in planners), *apart])
    rates = found["win_rates"]
    wins = [
        [name.replace("_", " "), *(f"{rates[o][name]['count']} of {rates[o][name]['of']}" for o in others)]
        for name in rates[others[0]]
    ]
    columns = ["figure", *titles, *(column for title in minus for column in (title, "%"))]
    return [
        TextTable("Means over the pedestrian trajectories that all planners follow", columns, figures),
        TextTable("Axis scores, higher is better; differences with 95 % intervals", ["axis", *titles, *minus], axes),
        TextTable(f"{title_of(first)} better", ["criterion", *(f"than {title_of(o)}" for o in others)], wins),
    ]
