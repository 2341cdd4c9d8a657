"""The planners side by side on the same walks: `cosfly plan compare` (app:three_axis_eval).

The paper's axes, as its table's figures have them: visibility is the mean; path efficiency is the shortest mean length
of a planner without collisions over the planner's own; smoothness is 1 / (1 + jerk RMS); safety is (1 - collision
fraction) * clamp(least clearance / 5 m); each from the planner's means over all walks. "Blocked" is what is not
visible, of all rays. Any two or more planners can be compared: the first is the one that the others are held against.
Only walks that all of them fly are compared; the others are counted by the planner that failed.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, field_validator

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, read_paths
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.planners.contract import ALL_PLANNERS, PLANNERS, PlanConfig, known_planner, title_of
from cosfly.planners.overview import draw_pedestrians
from cosfly.planners.stage import check_ids, draw_styles_of, plan_trajectory, warm_up
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

# Figures of one flight, in the order of the tables: name, title, digits.
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
AXES = ("visibility", "path_efficiency", "smoothness", "safety")
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of walks, for the intervals of axis differences


# --- figures ----------------------------------------------------------------------------------------------------------


def trajectory_figures(trace: DroneTrace) -> dict[str, float]:
    """Return the figures of FIGURES of one flight."""
    figures = {name: float(trace.metrics[name]) for name, _, _ in FIGURES if name in trace.metrics}
    figures["blocked_fraction"] = round(1.0 - figures["five_ray_mean"], 4)
    figures["collision_fraction"] = round(float((trace.clearances_m < 0).mean()), 4)
    return {name: figures[name] for name, _, _ in FIGURES}


def mean_figures(flights: list[dict[str, float]]) -> dict[str, float]:
    """Average figures over flights."""
    return {name: round(float(np.mean([flight[name] for flight in flights])), 4) for name, _, _ in FIGURES}


def axis_scores(means: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the four axis scores and their mean for each planner (tab:appendix_h_four_axis_scores).

    Args:
        means: planner -> mean figures.
    """
    free = [figures["length_m"] for figures in means.values() if figures["collision_fraction"] == 0]
    shortest_m = min(free or [figures["length_m"] for figures in means.values()])
    scores = {}
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
    """Return the first planner's axis scores less each other's, with the 95 % interval over walks drawn with
    replacement (Efron 1979).

    Args:
        figures: planner -> figures of the same walks in the same order.
    """
    first, *others = figures
    tables = {planner: np.array([list(row.values()) for row in rows]) for planner, rows in figures.items()}
    names, num = [name for name, _, _ in FIGURES], len(tables[first])
    draws = [np.arange(num), *rng.integers(num, size=(NUM_RESAMPLES, num))]
    scores = [
        axis_scores({k: dict(zip(names, table[draw].mean(axis=0), strict=True)) for k, table in tables.items()})
        for draw in draws
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
    """Return difference and relative difference in percent for each figure; none where the second's is 0."""
    table: dict[str, dict[str, float | None]] = {}
    for name, _, _ in FIGURES:
        change = first[name] - second[name]
        relative = round(100.0 * change / second[name], 3) if second[name] else None
        table[name] = {"delta": round(change, 4), "relative_percent": relative}
    return table


def win_rates(first: list[dict[str, float]], second: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Count on how many walks the first planner is strictly better (tab:appendix_h_tastar_muco_win_rates)."""
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


def summarize(flights: dict[str, list[DroneTrace]], rng: np.random.Generator) -> dict:
    """Compare flights of the same walks.

    Args:
        flights: planner -> traces, the same walks in the same order, at least one. rng: draws walks for intervals.
    Returns:
        The tables of `compare.json`. `deltas`, `axis_differences` and `win_rates` are by the other planner: the first's
        less its own, the first's wins.
    """
    first, *others = flights
    figures = {planner: [trajectory_figures(trace) for trace in traces] for planner, traces in flights.items()}
    means = {planner: mean_figures(rows) for planner, rows in figures.items()}
    ids = [trace.path_id for trace in flights[first]]
    return {
        "means": means,
        "deltas": {other: deltas(means[first], means[other]) for other in others},
        "axes": axis_scores(means),
        "axis_differences": axis_differences(figures, rng),
        "win_rates": {other: win_rates(figures[first], figures[other]) for other in others},
        "scenarios": [
            {"id": path_id, **{planner: rows[i] for planner, rows in figures.items()}} for i, path_id in enumerate(ids)
        ],
    }


class CompareConfig(PlanConfig):
    """Settings of a comparison: those of step 4, whose `planner` counts for nothing here, and who takes part."""

    planners: tuple[str, ...] = Field(tuple(PLANNERS), description="who is compared, against the first")

    @field_validator("planners")
    @classmethod
    def _are_known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("a planner is named twice")
        known = tuple(known_planner(name) for name in names)  # first, so that a wrong name is what one hears of
        if len(known) < 2:
            raise ValueError(f"a comparison needs at least 2 planners; name another of {', '.join(ALL_PLANNERS)}")
        return known


# --- stage ------------------------------------------------------------------------------------------------------------


def make_worker(cfg: CompareConfig, simplified_map: Path, seed: int, keeps_all: bool = False) -> Work:
    """Load and index the map once; give the function that plans one walk with each of the planners.

    keeps_all: a walk that one of them does not fly is kept, with the others' flights.
    """
    from cosfly.geometry.kernels import obstacle_index
    from cosfly.planners.reacquire import screens_of

    box_map = read_boxes(simplified_map)
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    settings = {name: cfg.model_copy(update={"planner": name}) for name in cfg.planners}
    for planner in settings.values():
        warm_up(planner)

    def work(item: Item) -> Outcome:
        (walk, styles), flights = item.payload, dict[str, dict]()
        errors: dict[str, NoPathError] = {}
        times_ms: dict[str, float] = {}
        for name, planner in settings.items():
            begin_s = time.perf_counter()
            try:
                flights[name] = plan_trajectory(walk, obstacles, planner, seed, screens, styles).as_json()
            except NoPathError as error:
                errors[name] = error
            times_ms[name] = round(1000.0 * (time.perf_counter() - begin_s), 2)
        if len(errors) == len(settings):
            raise errors[cfg.planners[0]]
        missing = f"no_{next(iter(errors))}_flight" if errors and not keeps_all else None
        result = {"flights": flights, "errors": {k: str(e) for k, e in errors.items()}, "times_ms": times_ms}
        return Outcome(result, missing)

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
    """Reads a simplified map and `path.json`, writes `compare.json`, each planner's flights and a picture; gives
    the first.

    A walk that a planner cannot fly is dropped with that planner's name, one that none can is a failure.

    Raises:
        InputError: a file is not what it must be.
        NothingKept: there is no walk that all fly.
    """

    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_compare", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product = out / "compare.json"
    if stage.is_complete:
        return product
    box_map, walks = read_boxes(simplified_map), read_paths(paths)
    check_ids(walks, paths)
    items = [Item(w.path_id, (w, styles)) for w, styles in zip(walks, draw_styles_of(walks, cfg, seed), strict=True)]
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally, expected="a walk that all planners fly")
    shared = {record.id: result_of(record, TrajectoriesOfPath) for record in finished.kept}
    traces = [found.traces(walk_id) for walk_id, found in shared.items()]
    flights = {name: [flown[name] for flown in traces] for name in cfg.planners}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    named = {name: ALL_PLANNERS[name] for name in flights}
    summary = {
        "planners": named,
        **summarize(flights, rng_for(seed, "plan_compare", "intervals")),
        "left_out": _left_out(finished.records),
    }
    write_json(product, {**FORMAT.header, **header, **summary})
    outputs = [product]
    for name, own in flights.items():
        outputs.append(out / f"drone_trace_{name}.json")
        write_traces(outputs[-1], own, {**header, "planner": name})
    by_id = {walk.path_id: walk for walk in walks}
    flown: list[PedestrianTrajectory] = [by_id[walk_id] for walk_id in shared]
    outputs.append(out / "compare_overlay.png")
    write_bytes(outputs[-1], draw_overlay(box_map, flown, flights))
    stage.finish(outputs, finished.tally, timings=timings(shared.values(), cfg.planners))
    return product


class TrajectoriesOfPath(BaseModel):
    """What the journal holds of a walk, by planner."""

    flights: dict[str, dict[str, Any]]
    errors: dict[str, str]
    times_ms: dict[str, float]

    def traces(self, walk_id: str) -> dict[str, DroneTrace]:
        """Return the flights by planner; raises InputError where one is not what a flight must be."""
        return {name: DroneTrace.from_json(f, f"items.jsonl: {walk_id}: {name}") for name, f in self.flights.items()}


def _left_out(records: Iterable[ItemRecord]) -> list[dict[str, str]]:
    """Walks that are not compared, with the planners that failed and their reasons."""
    rows = []
    for record in records:
        if isinstance(record, Failed):
            rows.append({"id": record.id, "planner": "all", "message": record.message})
        elif isinstance(record, Dropped):
            rows += [
                {"id": record.id, "planner": k, "message": v}
                for k, v in result_of(record, TrajectoriesOfPath).errors.items()
            ]
    return rows


def timings(shared: Collection[TrajectoriesOfPath], planners: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return planning times over the compared walks: they differ from run to run, so they stand in the manifest
    alone."""
    table = {}
    for name in planners:
        times_ms = np.array([found.times_ms.get(name, 0.0) for found in shared])
        p50, p95 = np.percentile(times_ms, (50, 95))
        figures = {"mean_ms": times_ms.mean(), "p50_ms": p50, "p95_ms": p95, "max_ms": times_ms.max()}
        table[name] = {figure: round(float(value), 1) for figure, value in figures.items()}
    return table


# --- pictures ---------------------------------------------------------------------------------------------------------

# RGB: the paper's blue and orange, then others that differ in brightness too.
PALETTE = (
    (30, 100, 210), (235, 120, 20), (20, 150, 90), (150, 60, 170), (120, 90, 60), (20, 170, 190), (200, 40, 60),
    (110, 110, 110),
)  # fmt: skip
LEGEND_PX = 160  # of one planner


def color_of(planner: str) -> tuple[int, int, int]:
    """Return a planner's color, the same in every comparison."""
    return PALETTE[list(ALL_PLANNERS).index(planner) % len(PALETTE)]


def _legend(picture: np.ndarray, planners: Collection[str], y: float) -> None:
    x = float(picture.shape[1] - LEGEND_PX * len(planners))
    for planner in planners:
        draw_line(picture, np.array([[x, y - 5], [x + 34, y - 5]]), color_of(planner), 3)
        x = draw_text(picture, title_of(planner), x + 42, y) + 18


# --- from above -------------------------------------------------------------------------------------------------------


def draw_overlay(box_map: BoxMap, walks: list[PedestrianTrajectory], flights: dict[str, list[DroneTrace]]) -> bytes:
    """Draw walks (dark) and the flights of each planner over the map; PNG bytes."""
    picture, view = draw_pedestrians(box_map, walks, [trace for traces in flights.values() for trace in traces])
    for planner, traces in flights.items():
        for trace in traces:
            line = view.pixels(trace.positions_m)
            draw_line(picture, line, color_of(planner), 2, halo=5)
            draw_dot(picture, line[0], 5, color_of(planner))
    caption = add_caption(picture, f"{box_map.name}: {len(walks)} walks (dark); dots are starts")
    _legend(caption, flights, 25)
    return png_bytes(caption)


# --- tables -----------------------------------------------------------------------------------------------------------


def text_tables(product: Path) -> list[TextTable]:
    """Read `compare.json` and its manifest as tables of text: figures, axes, and the first planner's wins."""
    found, times = read_object(product, what="comparison"), read_manifest(product.parent).facts["timings"]
    first, *others = planners = list(found["means"])
    titles, less = [title_of(planner) for planner in planners], [f"less {title_of(other)}" for other in others]
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
    criteria = next(iter(rates.values()))
    wins = [
        [name.replace("_", " "), *(f"{rates[o][name]['count']} of {rates[o][name]['of']}" for o in others)]
        for name in criteria
    ]
    columns = ["figure", *titles, *(column for title in less for column in (title, "%"))]
    return [
        TextTable("Means over the walks that all fly", columns, figures),
        TextTable("Axis scores, higher is better; differences with 95 % intervals", ["axis", *titles, *less], axes),
        TextTable(f"{title_of(first)}, walk by walk", ["criterion", *(f"to {title_of(o)}" for o in others)], wins),
    ]
