"""Planners side by side on the same pedestrian trajectories: `cosfly plan compare` (app:three_axis_eval).

The paper's axes, as its table's figures define them: visibility is the mean; path efficiency is the shortest mean
length of a planner without collisions over the planner's own; smoothness is 1 / (1 + jerk RMS); safety is (1 -
collision fraction) * clamp(least clearance / 5 m); each from the planner's means over all pedestrian trajectories.
"Blocked" is the share of rays that are not free. The first planner is compared with each of the others.

Where a planner finds no trajectory, its visibility and clearance count as 0 and all positions as collisions. Lengths
and dynamics are means over the trajectories found; a planner that finds none gets the worst value.

The paper prints the 14-way score (tab:appendix_h_extended_ranking) without its weights. Its rows determine them: with
each criterion normalised from the worst planner, 0, to the best, 1, all fourteen scores are 0.35 visibility + 0.30
collision + 0.35 clearance within 0.0001; path length, acceleration and jerk have no weight.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, Field, field_validator

from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.planners.contract import ALL_PLANNERS, NOTES, PLANNERS, PlanConfig, known_planner, title_of
from cosfly.planners.overview import draw_compared
from cosfly.planners.stage import load_obstacles, make_items, plan_trajectory, read_inputs, warm_up
from cosfly.runtime.config import Distinct
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, read_object, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import StageFolder, read_manifest, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.tables import TextTable, cells

FORMAT = FileFormat("cosfly.plan_compare", "3.0")
CLEARANCE_SCALE_M = 5.0  # a clearance of this or more is full safety


class FigureColumn(NamedTuple):
    """A figure of one trajectory, as a column of tables."""

    name: str
    title: str
    digits: int


class Criterion(NamedTuple):
    """A part of the weighted score."""

    figure: str
    more_is_better: bool
    weight: float


SIGHT_AND_SAFETY = (
    FigureColumn("five_ray_mean", "visibility", 3),
    FigureColumn("blocked_rays", "blocked rays", 3),
    FigureColumn("collision_fraction", "collision", 3),
    FigureColumn("clearance_min_m", "clearance, m", 2),
)
FLIGHT = (
    FigureColumn("length_m", "length, m", 1),
    FigureColumn("duration_s", "time, s", 1),
    FigureColumn("target_distance_mean_m", "distance, m", 1),
    FigureColumn("altitude_mean_m", "altitude, m", 1),
    FigureColumn("accel_rms_mps2", "accel., m/s2", 3),
    FigureColumn("jerk_rms_mps3", "jerk, m/s3", 3),
    FigureColumn("smoothness_score", "S", 3),
)
FIGURES = (*SIGHT_AND_SAFETY, *FLIGHT)
NAMES = [column.name for column in FIGURES]
NO_TRAJECTORY = {"five_ray_mean": 0.0, "blocked_rays": 1.0, "collision_fraction": 1.0, "clearance_min_m": 0.0}
PAPER_DELTAS = {"five_ray_mean", "blocked_rays", "clearance_min_m", "length_m", "accel_rms_mps2", "jerk_rms_mps3"}
AXES = ("visibility", "path_efficiency", "smoothness", "safety")
AXES_AND_MEAN = (*AXES, "mean")
GROUPS = {
    "our own": ("foresight",),
    "target-aware": ("track_astar", "muco"),
    "A* family": ("astar", "weighted_astar", "theta_star", "visibility_astar"),
    "sampling, spline": ("rrt_star", "prm", "bspline_prm"),
    "gradient, optimization": ("elastic_band", "minimum_jerk", "potential_field", "chomp", "trajopt"),
}
GROUP_OF = {planner: group for group, members in GROUPS.items() for planner in members}
CRITERIA = {  # with the paper's weights, see above
    "visibility": Criterion("five_ray_mean", True, 0.35),
    "collision": Criterion("collision_fraction", False, 0.30),
    "clearance": Criterion("clearance_min_m", True, 0.35),
}

Means = dict[str, dict[str, float]]  # planner -> mean figures or scores


# --- figures ----------------------------------------------------------------------------------------------------------


def trajectory_figures(trace: DroneTrace) -> dict[str, float]:
    """Return the figures of FIGURES of one drone trajectory."""
    blocked_rays = round(1.0 - trace.metrics["five_ray_mean"], 4)
    collision_fraction = round(float((trace.clearances_m < 0).mean()), 4)
    figures = trace.metrics | {"blocked_rays": blocked_rays, "collision_fraction": collision_fraction}
    return {name: float(figures[name]) for name in NAMES}


def mean_figures(tables: dict[str, np.ndarray]) -> Means:
    """Average the rows of tables (n, figures); NaN is ignored, and the mean of a column of NaN is infinite."""
    mean_rows = {}
    for planner, table in tables.items():
        counts = (~np.isnan(table)).sum(axis=0)
        means = np.where(counts > 0, np.nansum(table, axis=0) / np.maximum(counts, 1), np.inf)
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
    return {
        name: {"count": sum(is_won), "of": len(is_won), "rate": round(sum(is_won) / len(is_won), 4)}
        for name, is_won in wins.items()
    }


def summarize(planned: dict[str, PlannedItem], planners: Sequence[str]) -> dict[str, Any]:
    """Compare planners on the same pedestrian trajectories.

    Args:
        planned: id of a pedestrian trajectory -> the planners' trajectories.
    Returns:
        The tables of the product. `deltas` and `win_rates` are by the other planner: the first planner's figures minus
        its own, and the first planner's wins, where both found trajectories.
    """
    first, *others = planners
    scenarios = list[dict[str, Any]]()
    for path_id, item in planned.items():
        traces = item.read_traces(path_id)
        figures = {name: trajectory_figures(traces[name]) if name in traces else None for name in planners}
        scenarios.append({"id": path_id, **figures})
    means = mean_figures({name: np.array([_table_row(row[name]) for row in scenarios]) for name in planners})
    pairs = {other: [(row[first], row[other]) for row in scenarios if row[first] and row[other]] for other in others}
    return {
        "scenarios": scenarios,
        "infeasible": {path_id: item.errors for path_id, item in planned.items() if item.errors},
        "means": {name: finite(row) for name, row in means.items()},
        "shortest_mean_m": round(shortest_mean_m(means), 4),
        "axes": axis_scores(means),
        "ranking": ranking(means),
        "groups": _groups(means),
        "deltas": {other: deltas(means[first], means[other]) for other in others if pairs[other]},
        "win_rates": {other: win_rates(pairs[other]) for other in others if pairs[other]},
    }


def ranking(means: Means) -> dict[str, dict[str, Any]]:
    """Return rank, weighted score and criteria from 0, the worst, to 1, the best; 1 where there is no difference."""
    columns = []
    for figure, more_is_better, _ in CRITERIA.values():
        values = np.array([row[figure] for row in means.values()])
        span = np.ptp(values)
        share = (values - values.min()) / span if span > 0 else np.full(len(values), float(more_is_better))
        columns.append(share if more_is_better else 1.0 - share)
    normalized = np.stack(columns, axis=1)
    planners = list(means)
    scores = (normalized @ [criterion.weight for criterion in CRITERIA.values()]).round(4)
    return {
        planners[k]: {
            "rank": rank,
            "score": float(scores[k]),
            "normalized": dict(zip(CRITERIA, np.round(normalized[k], 4).tolist(), strict=True)),
        }
        for rank, k in enumerate(np.argsort(-scores, kind="stable").tolist(), 1)
    }


def _groups(means: Means) -> dict[str, dict[str, Any]]:
    """Return the number of planners of each group, and the means of their mean figures."""
    groups = {}
    for group, members in GROUPS.items():
        rows = [list(means[planner].values()) for planner in members if planner in means]
        if rows:
            figures = dict(zip(NAMES, np.mean(rows, axis=0), strict=True))
            groups[group] = {"num_planners": len(rows), "figures": finite(figures)}
    return groups


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


def make_worker(cfg: CompareConfig, simplified_map: Path, seed: int) -> Work:
    """Load the map once; return the function that plans for one pedestrian trajectory with each planner."""
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
        return Outcome(planned.model_dump())

    return work


def run(
    cfg: CompareConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(),
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `compare.json`, each planner's traces and a picture.

    A pedestrian trajectory that no planner can follow, such as one through a house, is a failure and is not compared.
    Planning times are written to `items.jsonl` and the manifest, the only files that differ between equal runs. Return
    the path of `compare.json`.
    """
    product = out / "compare.json"
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_compare", config=cfg, inputs=inputs, seed=seed)
    if stage.is_complete:
        return product
    box_map, pedestrians = read_inputs(simplified_map, paths)
    items = make_items(pedestrians, cfg, seed)
    done = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    if not done.tally.kept:
        raise stage.nothing_kept(done.tally, expected="a pedestrian trajectory that at least one planner can follow")
    planned = {record.id: result_of(record, PlannedItem) for record in done.kept}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    facts = {
        "planners": {name: ALL_PLANNERS[name] for name in cfg.planners},
        "notes": {name: NOTES[name] for name in cfg.planners if name in NOTES},
    }
    write_json(product, {**FORMAT.header, **header, **facts, **summarize(planned, cfg.planners)})
    traces: dict[str, list[DroneTrace]] = {name: [] for name in cfg.planners}
    for path_id, item in planned.items():
        for name, trace in item.read_traces(path_id).items():
            traces[name].append(trace)
    trace_paths = {name: out / f"drone_trace_{name}.json" for name in traces}
    for name, path in trace_paths.items():
        write_traces(path, traces[name], {**header, "planner": name})
    compared = [pedestrian for pedestrian in pedestrians if pedestrian.path_id in planned]
    overlay = out / "compare_overlay.png"
    write_bytes(overlay, draw_compared(box_map, compared, traces))
    outputs = [product, *trace_paths.values(), overlay]
    stage.finish(outputs, done.tally, timings=timings(planned.values(), cfg.planners))
    return product


def timings(items: Collection[PlannedItem], planners: Sequence[str]) -> Means:
    """Return planning times, which are written to the manifest only because they differ from run to run."""
    table = {}
    for name in planners:
        times_ms = np.array([item.times_ms.get(name, 0.0) for item in items])
        p50, p95 = np.percentile(times_ms, (50, 95))
        figures = {"mean_ms": times_ms.mean(), "p50_ms": p50, "p95_ms": p95, "max_ms": times_ms.max()}
        table[name] = {figure: round(float(value), 1) for figure, value in figures.items()}
    return table


# --- tables -----------------------------------------------------------------------------------------------------------


def text_tables(product: Path) -> Iterator[TextTable]:
    """Read `compare.json` and its manifest as text tables: figures, the paper's axes, score and groups, and deltas."""
    comparison = read_object(product, what="comparison")
    means, scenarios = comparison["means"], comparison["scenarios"]
    times = read_manifest(product.parent).facts["timings"]
    first = title_of(next(iter(means)))

    rows = {}
    for planner, figures in means.items():
        collisions = [scenario[planner]["collision_fraction"] for scenario in scenarios if scenario[planner]]
        counts = [f"{count} of {len(scenarios)}" for count in (len(collisions), collisions.count(0.0))]
        rows[title_of(planner)] = [*counts, *_figure_cells(figures, SIGHT_AND_SAFETY)]
    title = "Sight and safety; a missing trajectory counts as a collision without visibility"
    yield _table(title, ["found", "free of collisions", *_titles(SIGHT_AND_SAFETY)], rows)

    rows = {
        title_of(planner): [*_figure_cells(figures, FLIGHT), *cells([times[planner]["mean_ms"]], 1)]
        for planner, figures in means.items()
    }
    title = (
        "Flight, means over the trajectories found: distance to the target, RMS of acceleration and jerk, smoothness S"
    )
    yield _table(title, [*_titles(FLIGHT), "planning, ms"], rows)

    by_mean = sorted(comparison["axes"].items(), key=lambda planner_scores: -planner_scores[1]["mean"])
    rows = {title_of(planner): cells(scores[axis] for axis in AXES_AND_MEAN) for planner, scores in by_mean}
    title = f"Axis scores; efficiency relative to the shortest mean, {comparison['shortest_mean_m']:.2f} m"
    yield _table(title, [axis.replace("_", " ") for axis in AXES_AND_MEAN], rows)

    rows = {
        f"{row['rank']} {title_of(planner)}": [
            GROUP_OF.get(planner, "-"), *cells([row["score"], *row["normalized"].values()])
        ]
        for planner, row in comparison["ranking"].items()
    }  # fmt: skip
    weights = ", ".join(f"{criterion.weight:g} {name}" for name, criterion in CRITERIA.items())
    title = f"Weighted score: {weights}; each is scaled from 0 (worst planner) to 1 (best planner)"
    yield _table(title, ["group", "score", *CRITERIA], rows)

    columns = [*SIGHT_AND_SAFETY, FLIGHT[0]]
    rows = {
        group: [str(row["num_planners"]), *_figure_cells(row["figures"], columns)]
        for group, row in comparison["groups"].items()
    }
    yield _table("Means of groups of planners", ["planners", *_titles(columns)], rows, head="group")

    columns = [column for column in FIGURES if column.name in PAPER_DELTAS]
    rows = {
        title_of(other): cells((changes[column.name]["relative_percent"] for column in columns), 1)
        for other, changes in comparison["deltas"].items()
    }
    yield _table(f"{first} minus another planner, %", _titles(columns), rows)

    rates = comparison["win_rates"]
    rows = {title_of(other): [f"{w['count']} of {w['of']}" for w in wins.values()] for other, wins in rates.items()}
    names = [name.replace("_", " ") for name in next(iter(rates.values()), ())]
    yield _table(f"{first} better than another planner", names, rows)


def _table(title: str, columns: list[str], rows: dict[str, list[str]], head: str = "planner") -> TextTable:
    return TextTable(title, [head, *columns], [[name, *row] for name, row in rows.items()])


def _titles(figures: Sequence[FigureColumn]) -> list[str]:
    return [column.title for column in figures]


def _figure_cells(row: dict[str, float | None], figures: Sequence[FigureColumn]) -> list[str]:
    return [text for column in figures for text in cells([row[column.name]], column.digits)]
