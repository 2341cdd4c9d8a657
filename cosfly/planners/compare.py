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
from cosfly.formats.episodes import Figure
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.planners.contract import ALL_PLANNERS, PLANNERS, PlanConfig, known_planner, planner_notes, title_of
from cosfly.planners.overview import draw_compared
from cosfly.planners.stage import load_obstacles, make_items, plan_trajectory, read_inputs, warm_up
from cosfly.runtime.config import Distinct
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, read_object, write_json
from cosfly.runtime.pool import ItemOutcomes, Watch, run_items
from cosfly.runtime.run_dir import Dropped, Failed, Resume, StageFolder, read_manifest, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.tables import TextTable, cells

FORMAT = FileFormat("cosfly.plan_compare", "2.2")
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
NO_TRAJECTORY = {"five_ray_mean": 0.0, "blocked_fraction": 1.0, "collision_fraction": 1.0, "clearance_min_m": 0.0}
AXES = ("visibility", "path_efficiency", "smoothness", "safety")
AXES_AND_MEAN = (*AXES, "mean")
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of pedestrian trajectories, for intervals (Efron 1979)

Means = dict[str, dict[str, float]]  # planner -> mean figures or scores
FiniteMeans = dict[str, dict[str, float | None]]


# --- figures ----------------------------------------------------------------------------------------------------------


def trajectory_figures(trace: DroneTrace) -> dict[str, float]:
    """Return the figures of FIGURES of one drone trajectory."""
    blocked_fraction = round(1.0 - trace.metrics["five_ray_mean"], 4)
    collision_fraction = round(float((trace.clearances_m < 0).mean()), 4)
    figures = trace.metrics | {"blocked_fraction": blocked_fraction, "collision_fraction": collision_fraction}
    return {name: float(figures[name]) for name in NAMES}


def mean_figures(tables: dict[str, np.ndarray], sample: np.ndarray | slice = slice(None)) -> Means:
    """Average tables (n, figures) over sampled rows; NaN is ignored, and the mean of a column of NaN is infinite."""
    mean_rows = {}
    for planner, table in tables.items():
        rows = table[sample]
        counts = (~np.isnan(rows)).sum(axis=0)
        means = np.where(counts > 0, np.nansum(rows, axis=0) / np.maximum(counts, 1), np.inf)
        mean_rows[planner] = dict(zip(NAMES, means.tolist(), strict=True))
    return mean_rows


def shortest_mean_m(means: Means) -> float:
    """Return the shortest mean length of planners without collisions, or of all where every planner collides."""
    free = [figures["length_m"] for figures in means.values() if figures["collision_fraction"] == 0]
    return min(free or [figures["length_m"] for figures in means.values()])


def axis_scores(means: Means) -> Means:
    """Return the four axis scores and their mean for each planner (tab:appendix_h_four_axis_scores)."""
    shortest_m = shortest_mean_m(means)
    scores = {}
    for planner, figures in means.items():
        clear = float(np.clip(figures["clearance_min_m"] / CLEARANCE_SCALE_M, 0.0, 1.0))
        efficiency = shortest_m / figures["length_m"] if figures["length_m"] > 0 else 1.0
        smoothness = 1.0 / (1.0 + figures["jerk_rms_mps3"])
        safety = (1.0 - figures["collision_fraction"]) * clear
        axes = [figures["five_ray_mean"], efficiency, smoothness, safety]
        rounded = [round(value, 4) for value in (*axes, sum(axes) / len(axes))]
        scores[planner] = dict(zip(AXES_AND_MEAN, rounded, strict=True))
    return scores


def drawn_scores(tables: dict[str, np.ndarray], rng: np.random.Generator) -> list[Means]:
    """Return the axis scores of all rows of tables (n, figures), then those of rows drawn with replacement."""
    num = len(next(iter(tables.values())))
    samples = [np.arange(num), *rng.integers(num, size=(NUM_RESAMPLES, num))]
    return [axis_scores(mean_figures(tables, sample)) for sample in samples]


def interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of drawn values."""
    low, high = np.percentile(np.nan_to_num(np.asarray(values, dtype=np.float64)), INTERVAL_PERCENT)
    return round(float(low), 4), round(float(high), 4)


def deltas(first: dict[str, float], second: dict[str, float]) -> dict[str, dict[str, float | None]]:
    """Return difference and relative difference in percent for each figure; None where the second's is 0."""
    table: dict[str, dict[str, float | None]] = {}
    for name in NAMES:
        change = first[name] - second[name]
        relative = round(100.0 * change / second[name], 3) if second[name] else None
        table[name] = {"delta": round(change, 4), "relative_percent": relative}
    return table


def win_rates(pairs: Sequence[tuple[dict[str, float], dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Count how often the first planner is strictly better (tab:appendix_h_tastar_muco_win_rates)."""
    wins = {
        "visibility_higher": [a["five_ray_mean"] > b["five_ray_mean"] for a, b in pairs],
        "path_shorter": [a["length_m"] < b["length_m"] for a, b in pairs],
        "jerk_lower": [a["jerk_rms_mps3"] < b["jerk_rms_mps3"] for a, b in pairs],
        "clearance_larger": [a["clearance_min_m"] > b["clearance_min_m"] for a, b in pairs],
        "both_collision_free": [a["collision_fraction"] == b["collision_fraction"] == 0 for a, b in pairs],
    }
    return {name: {"count": sum(w), "of": len(w), "rate": round(sum(w) / len(w), 4)} for name, w in wins.items()}


def summarize(planned: dict[str, PlannedItem], planners: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
    """Compare planners on the same pedestrian trajectories.

    Args:
        planned: id of a pedestrian trajectory -> the planners' trajectories. rng: draws scenarios for the intervals.
    Returns:
        The tables of the product. `deltas`, `axis_differences` and `win_rates` are by the other planner: the first
        planner's figures minus its own, and the first planner's wins, where both found trajectories.
    """
    first, *others = planners
    found = {path_id: item.read_traces(path_id) for path_id, item in planned.items()}
    scenarios: list[dict[str, Any]] = [
        {"id": path_id, **{name: trajectory_figures(traces[name]) if name in traces else None for name in planners}}
        for path_id, traces in found.items()
    ]
    tables = {name: np.array([_table_row(scenario[name]) for scenario in scenarios]) for name in planners}
    means = mean_figures(tables)
    measured, *resampled = drawn_scores(tables, rng)

    def difference(other: str, axis: str) -> dict[str, float]:
        low, high = interval([scores[first][axis] - scores[other][axis] for scores in resampled])
        return {"difference": round(measured[first][axis] - measured[other][axis], 4), "low": low, "high": high}

    pairs = {other: [(row[first], row[other]) for row in scenarios if row[first] and row[other]] for other in others}
    return {
        "scenarios": scenarios,
        "infeasible": {path_id: item.errors for path_id, item in planned.items() if item.errors},
        "means": {name: finite(row) for name, row in means.items()},
        "shortest_mean_m": round(shortest_mean_m(means), 4),
        "axes": measured,
        "intervals": {
            name: {axis: interval([scores[name][axis] for scores in resampled]) for axis in AXES_AND_MEAN}
            for name in planners
        },
        "deltas": {other: deltas(means[first], means[other]) for other in others if pairs[other]},
        "axis_differences": {other: {axis: difference(other, axis) for axis in AXES_AND_MEAN} for other in others},
        "win_rates": {other: win_rates(pairs[other]) for other in others if pairs[other]},
    }


def _table_row(figures: dict[str, float] | None) -> list[float]:
    """Return the figures of one trajectory in the order of NAMES; NaN where a missing trajectory has none."""
    return [(figures or NO_TRAJECTORY).get(name, np.nan) for name in NAMES]


def finite(figures: dict[str, float]) -> dict[str, float | None]:
    """Return rounded figures, None for those that are not finite."""
    return {name: round(float(value), 4) if np.isfinite(value) else None for name, value in figures.items()}


# --- stage ------------------------------------------------------------------------------------------------------------


class CompareConfig(PlanConfig):
    """Settings of a comparison: those of step 4, of which `planner` is ignored, and the planners to compare."""

    planners: Distinct[tuple[str, ...]] = Field(tuple(PLANNERS), description="planners to compare with the first one")

    @field_validator("planners")
    @classmethod
    def _are_known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            known_planner(name)
        if len(names) < 2:
            raise ValueError(f"a comparison needs at least two planners; add one of {', '.join(ALL_PLANNERS)}")
        return names


class PlannedItem(BaseModel):
    """Journal entry of one pedestrian trajectory, by planner."""

    traces: dict[str, dict[str, Any]]
    errors: dict[str, str]
    times_ms: dict[str, float]

    def read_traces(self, path_id: str) -> dict[str, DroneTrace]:
        """Return the traces by planner; raise InputError if one is invalid."""
        return {name: DroneTrace.from_json(t, f"items.jsonl: {path_id}: {name}") for name, t in self.traces.items()}


def make_worker(cfg: CompareConfig, simplified_map: Path, seed: int, keeps_all: bool) -> Work:
    """Load the map once; return the function that plans for one pedestrian trajectory with each planner.

    keeps_all: Keep an item if only some planners failed.
    """
    obstacles, screens = load_obstacles(simplified_map)
    settings = {name: cfg.model_copy(update={"planner": name}) for name in cfg.planners}
    for planner_cfg in settings.values():
        warm_up(planner_cfg)

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        planned = PlannedItem(traces={}, errors={}, times_ms={})
        errors = list[NoPathError]()
        for name, planner_cfg in settings.items():
            begin_s = time.perf_counter()
            try:
                trace = plan_trajectory(pedestrian, obstacles, planner_cfg, seed, screens, styles)
                planned.traces[name] = trace.as_json()
            except NoPathError as error:
                errors.append(error)
                planned.errors[name] = str(error)
            planned.times_ms[name] = round(1000.0 * (time.perf_counter() - begin_s), 2)
        if not planned.traces:
            raise errors[0]
        dropped = f"no_{next(iter(planned.errors))}_trajectory" if errors and not keeps_all else None
        return Outcome(planned.model_dump(), dropped)

    return work


def plan_all(
    stage: StageFolder, cfg: CompareConfig, simplified_map: Path, paths: Path, seed: int, *, most: int | None = None,
    keeps_all: bool = False, **pool: Any,
) -> tuple[BoxMap, list[PedestrianTrajectory], ItemOutcomes, dict[str, PlannedItem], dict[str, Any]]:  # fmt: skip
    """Plan for each pedestrian trajectory, or the first `most`, with each planner.

    Returns:
        Map, pedestrian trajectories, work items, the kept ones by id, and the head of the product.
    """
    box_map, pedestrians = read_inputs(simplified_map, paths)
    items = make_items(pedestrians[:most], cfg, seed)
    done = run_items(stage, items, make_worker, (cfg, simplified_map, seed, keeps_all), **pool)
    if not done.tally.kept:
        followers = "at least one planner" if keeps_all else "every planner"
        raise stage.nothing_kept(done.tally, expected=f"a pedestrian trajectory that {followers} can follow")
    planned = {record.id: result_of(record, PlannedItem) for record in done.kept}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    return box_map, pedestrians, done, planned, header


def run(
    cfg: CompareConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(), resume: Resume = "if-same",
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `compare.json`, each planner's traces and a picture.

    A pedestrian trajectory that a planner cannot follow is dropped with that planner's name; one that no planner can
    follow is a failure. Return the path of `compare.json`.
    """
    product = out / "compare.json"
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_compare", config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return product
    box_map, pedestrians, done, planned, header = plan_all(
        stage, cfg, simplified_map, paths, seed, workers=workers, watch=watch
    )
    summary = {
        "planners": {name: ALL_PLANNERS[name] for name in cfg.planners},
        "notes": planner_notes(cfg.planners, cfg),
        **summarize(planned, cfg.planners, rng_for(seed, "plan_compare", "intervals")),
        "skipped": _skipped(done),
    }
    write_json(product, {**FORMAT.header, **header, **summary})
    found = [item.read_traces(path_id) for path_id, item in planned.items()]
    traces = {name: [path_traces[name] for path_traces in found] for name in cfg.planners}
    outputs = [product, *(out / f"drone_trace_{name}.json" for name in traces), out / "compare_overlay.png"]
    for path, (name, planner_traces) in zip(outputs[1:], traces.items(), strict=False):
        write_traces(path, planner_traces, {**header, "planner": name})
    compared = [pedestrian for pedestrian in pedestrians if pedestrian.path_id in planned]
    write_bytes(outputs[-1], draw_compared(box_map, compared, traces))
    stage.finish(outputs, done.tally, timings=timings(planned.values(), cfg.planners))
    return product


def _skipped(done: ItemOutcomes) -> Iterable[dict[str, str]]:
    """Return the pedestrian trajectories that are not compared, with the planners that failed and their reasons."""
    rows = []
    for record in done.records:
        if isinstance(record, Failed):
            rows.append({"id": record.id, "planner": "all", "message": record.message})
        elif isinstance(record, Dropped):
            errors = result_of(record, PlannedItem).errors
            rows += [{"id": record.id, "planner": planner, "message": message} for planner, message in errors.items()]
    return rows


def timings(items: Collection[PlannedItem], planners: Sequence[str]) -> Means:
    """Return planning times, which are written to the manifest only because they differ from run to run."""
    table = {}
    for name in planners:
        times_ms = np.array([item.times_ms.get(name, 0.0) for item in items])
        p50, p95 = np.percentile(times_ms, (50, 95))
        figures = {"mean_ms": times_ms.mean(), "p50_ms": p50, "p95_ms": p95, "max_ms": times_ms.max()}
        table[name] = {figure: round(float(value), 1) for figure, value in figures.items()}
    return table


def text_tables(product: Path) -> list[TextTable]:
    """Read `compare.json` and its manifest as text tables: figures, axes, and the first planner's wins."""
    comparison = read_object(product, what="comparison")
    times = read_manifest(product.parent).facts["timings"]
    first, *others = planners = list(comparison["means"])
    titles = [title_of(planner) for planner in planners]
    minus = [f"minus {title_of(other)}" for other in others]
    figures = []
    for name, words, digits in FIGURES:
        row = [words, *cells((comparison["means"][planner][name] for planner in planners), digits)]
        for other in others:
            change = comparison["deltas"][other][name]
            relative = change["relative_percent"]
            row += [f"{change['delta']:+.{digits}f}", "n/a" if relative is None else f"{relative:+.1f}"]
        figures.append(row)
    means_ms = cells((times[planner]["mean_ms"] for planner in planners), 1)
    figures.append(["planning time (ms)", *means_ms, *[""] * 2 * len(others)])
    axes = []
    for name in AXES_AND_MEAN:
        found = [comparison["axis_differences"][other][name] for other in others]
        differences = [Figure(value=one["difference"], low=one["low"], high=one["high"], count=0) for one in found]
        scores = cells(comparison["axes"][p][name] for p in planners)
        axes.append([name.replace("_", " "), *scores, *(one.shown("+.3f") for one in differences)])
    rates = comparison["win_rates"]
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
