"""The paper's comparison of planners on the same scenarios: `cosfly plan benchmark` (app:three_axis_eval).

Figures and axes are those of compare.py. Here no scenario is skipped: a scenario for which a planner finds no
trajectory counts as one with visibility 0, all positions in collision and clearance 0. Lengths and dynamics are means
over the trajectories found; a planner that finds none gets the worst value.

The paper prints the 14-way score (tab:appendix_h_extended_ranking) without its weights. Its rows determine them: with
each criterion normalised from the worst planner, 0, to the best, 1, all fourteen scores are 0.35 visibility + 0.30
collision + 0.35 clearance within 0.0001; path length, acceleration and jerk have no weight.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.planners import compare
from cosfly.planners.compare import AXES, FIGURES, INTERVAL_PERCENT, NAMES, NUM_RESAMPLES, CompareConfig, PlannedItem
from cosfly.planners.contract import ALL_PLANNERS, planner_notes, title_of
from cosfly.planners.stage import make_items, read_inputs
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.viz.tables import TextTable

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.plan_benchmark", "1.0", "benchmark of planners")
NO_TRAJECTORY = {"five_ray_mean": 0.0, "blocked_fraction": 1.0, "collision_fraction": 1.0, "clearance_min_m": 0.0}
GROUPS = {
    "our own": ("foresight",),
    "target-aware": ("track_astar", "muco"),
    "A* family": ("astar", "weighted_astar", "theta_star", "visibility_astar"),
    "sampling, spline": ("rrt_star", "prm", "bspline_prm"),
    "gradient, optimization": ("elastic_band", "minimum_jerk", "potential_field", "chomp", "trajopt"),
}
GROUP_OF = {planner: group for group, members in GROUPS.items() for planner in members}
PAIR = GROUPS["target-aware"]
# Criteria of the weighted score: figure, whether more is better, weight (the paper's, see above).
CRITERIA = {
    "visibility": ("five_ray_mean", True, 0.35),
    "collision": ("collision_fraction", False, 0.30),
    "clearance": ("clearance_min_m", True, 0.35),
}
INSTALL = 'pip install "cosfly[ompl]"'


class PaperRow(NamedTuple):
    """The paper's figures of a planner: mean of the four axes (seven planners only), weighted score, visibility,
    clearance, and the number of 20 scenarios without collision."""

    axes_mean: float | None
    weighted: float
    visibility: float
    clearance_m: float
    num_free: int


_PRINTED = {
    "track_astar": (0.782, 1.0, 0.9787, 4.0291, 20), "muco": (0.699, 0.7861, 0.8941, 2.7543, 20),
    "rrt_star": (0.573, 0.4123, 0.6164, 1.5066, 20), "prm": (0.578, 0.4319, 0.6009, 1.7984, 20),
    "bspline_prm": (0.596, 0.4161, 0.6077, 1.6059, 20), "elastic_band": (0.596, 0.3, 0.5639, 0.8981, 20),
    "minimum_jerk": (0.558, 0.2776, 0.6235, 1.1371, 19), "astar": (None, 0.389, 0.6151, 1.3078, 20),
    "weighted_astar": (None, 0.401, 0.6189, 1.3871, 20), "theta_star": (None, 0.4012, 0.6234, 1.3548, 20),
    "visibility_astar": (None, 0.4141, 0.6246, 1.46, 20), "potential_field": (None, 0.1325, 0.6345, 1.5505, 19),
    "chomp": (None, 0.2249, 0.5995, 1.2535, 19), "trajopt": (None, 0.4129, 0.6159, 1.5161, 20),
}  # fmt: skip
PAPER = {planner: PaperRow(*row) for planner, row in _PRINTED.items()}
PAPER_SHORTEST_M = 85.73  # to which the paper normalises path efficiency
PAPER_GROUPS = dict(zip(list(GROUPS)[1:], (0.9364, 0.6205, 0.6083, 0.6075), strict=True))  # visibility

Means = dict[str, dict[str, float]]  # planner -> mean figures


class BenchmarkConfig(CompareConfig):
    """Settings of a benchmark: those of a comparison, and the number of scenarios."""

    planners: tuple[str, ...] = Field(tuple(ALL_PLANNERS), description="planners to run")
    scenarios: int = Field(20, ge=1, description="largest number of pedestrian trajectories, from the first one on")


# --- stage ------------------------------------------------------------------------------------------------------------


def run(
    cfg: BenchmarkConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Read a simplified map and `path.json`; write `benchmark.json`, its tables and the figures.

    A pedestrian trajectory that no planner can follow, such as one through a house, is a failure and no scenario.
    Planning times are written to `items.jsonl` and the manifest, the only files that differ between equal runs.

    Returns:
        The path of `benchmark.json`.
    Raises:
        InputError: If an input file is invalid.
        NothingKept: If no planner finds any trajectory.
    """
    cfg = _without_missing(cfg)
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_benchmark", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product, page = out / "benchmark.json", out / "benchmark.md"
    if stage.is_complete:
        return product
    box_map, pedestrians = read_inputs(simplified_map, paths)
    items = make_items(pedestrians[: cfg.scenarios], cfg, seed)
    done = run_items(stage, items, compare.make_worker, (cfg, simplified_map, seed, True), workers=workers, watch=watch)
    if not done.tally.kept:
        raise stage.nothing_kept(done.tally, expected="a pedestrian trajectory that a planner follows")
    planned = {record.id: result_of(record, PlannedItem) for record in done.kept}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    found = header | summarize(planned, cfg.planners, rng_for(seed, "plan_benchmark", "intervals"))
    found["notes"] = planner_notes(cfg.planners, cfg)
    write_json(product, {**FORMAT.header, **found})
    write_bytes(page, markdown(found).encode())
    pictures = _pictures(found, planned, box_map)
    for name, picture in pictures.items():
        write_bytes(out / name, picture)
    outputs = [product, page, *(out / name for name in pictures)]
    stage.finish(outputs, done.tally, timings=compare.timings(planned.values(), cfg.planners))
    return product


def _without_missing(cfg: BenchmarkConfig) -> BenchmarkConfig:
    """Remove the planners whose package is not installed, with a warning."""
    sampling = [name for name in cfg.planners if ALL_PLANNERS[name].startswith("cosfly.planners.reference.sampling")]
    if not sampling or importlib.util.find_spec("ompl") is not None:
        return cfg
    if len(sampling) == len(cfg.planners):
        raise EnvironmentMissing("OMPL is not installed", expected="a planner that does not need it", fix=INSTALL)
    log.warning("OMPL is not installed; skipped: %s; %s", ", ".join(sampling), INSTALL)
    return cfg.model_copy(update={"planners": tuple(name for name in cfg.planners if name not in sampling)})


def _pictures(found: dict[str, Any], planned: dict[str, PlannedItem], box_map: BoxMap) -> dict[str, bytes]:
    """Draw the figures; none, with a warning, where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        log.warning("matplotlib is not installed; no figures are drawn; %s", INSTALL)
        return {}
    from cosfly.planners.benchmark_figures import draw

    return draw(found, planned, box_map)


# --- figures ----------------------------------------------------------------------------------------------------------


def summarize(planned: dict[str, PlannedItem], planners: tuple[str, ...], rng: np.random.Generator) -> dict[str, Any]:
    """Return the tables of `benchmark.json`.

    Args:
        planned: id of a pedestrian trajectory -> the planners' trajectories. rng: draws scenarios for the intervals.
    """
    traces = [item.read_traces(path_id) for path_id, item in planned.items()]
    figures = {p: [compare.trajectory_figures(t[p]) if p in t else None for t in traces] for p in planners}
    tables = {p: np.array([_row(one) for one in rows]) for p, rows in figures.items()}
    means = _means(tables, np.arange(len(planned)))
    samples = rng.integers(len(planned), size=(NUM_RESAMPLES, len(planned)))
    axes, axes_drawn = compare.axis_scores(means), [compare.axis_scores(_means(tables, sample)) for sample in samples]
    return {
        "scenarios": list(planned),
        "infeasible": {path_id: item.errors for path_id, item in planned.items() if item.errors},
        "figures": figures,
        "means": {p: {name: _number(value) for name, value in row.items()} for p, row in means.items()},
        "shortest_mean_m": round(compare.shortest_mean_m(means), 4),
        "axes": {
            p: {"scores": row, "intervals": {axis: _interval([drawn[p][axis] for drawn in axes_drawn]) for axis in row}}
            for p, row in axes.items()
        },
        "deltas": _deltas(means),
        "ranking": _ranking(means),
        "groups": _groups(means),
    }


def _deltas(means: Means) -> dict[str, dict[str, float | None]]:
    """Return TA*+Smooth minus MuCO; empty where one of them did not run or found no trajectory."""
    if not all(p in means and np.isfinite(list(means[p].values())).all() for p in PAIR):
        return {}
    return compare.deltas(*(means[p] for p in PAIR))


def _row(figures: dict[str, float] | None) -> list[float]:
    """Return figures in the order of NAMES, NaN where a missing trajectory has none."""
    return [figures[name] if figures else NO_TRAJECTORY.get(name, np.nan) for name in NAMES]


def _means(tables: dict[str, np.ndarray], sample: np.ndarray) -> Means:
    """Average over sampled scenarios; infinite where a planner found none of their trajectories."""
    found = {}
    for planner, table in tables.items():
        rows = table[sample]
        counts = (~np.isnan(rows)).sum(axis=0)
        means = np.where(counts > 0, np.nansum(rows, axis=0) / np.maximum(counts, 1), np.inf)
        found[planner] = dict(zip(NAMES, means.tolist(), strict=True))
    return found


def _normalized(means: Means) -> np.ndarray:
    """Return (planners, criteria) from 0, the worst, to 1, the best; all 1 where there is no difference."""
    columns = []
    for figure, more_is_better, _ in CRITERIA.values():
        values = np.array([row[figure] for row in means.values()])
        known = np.isfinite(values)
        low, span = values[known].min(), np.ptp(values[known])
        share = (values - low) / span if span > 0 else np.full(len(values), float(more_is_better))
        columns.append(np.where(known, share if more_is_better else 1.0 - share, 0.0))
    return np.stack(columns, axis=1)


def _ranking(means: Means) -> dict[str, dict[str, Any]]:
    normalized, planners = _normalized(means), list(means)
    scores = (normalized @ [weight for *_, weight in CRITERIA.values()]).round(4)
    return {
        planners[k]: {
            "rank": rank,
            "score": float(scores[k]),
            "normalized": dict(zip(CRITERIA, np.round(normalized[k], 4).tolist(), strict=True)),
        }
        for rank, k in enumerate(np.argsort(-scores, kind="stable").tolist(), 1)
    }


def _groups(means: Means) -> dict[str, dict[str, Any]]:
    """Return the mean figures of each group of planners."""
    rows = {}
    for group, all_members in GROUPS.items():
        if members := [planner for planner in all_members if planner in means]:
            figures = {name: _number(float(np.mean([means[p][name] for p in members]))) for name in NAMES}
            rows[group] = {"num_planners": len(members), "figures": figures}
    return rows


def _interval(values: list[float]) -> tuple[float, float]:
    low, high = np.percentile(np.nan_to_num(np.asarray(values, dtype=np.float64)), INTERVAL_PERCENT)
    return round(float(low), 4), round(float(high), 4)


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


# --- tables of text ---------------------------------------------------------------------------------------------------


def markdown(found: dict[str, Any]) -> str:
    """Return the tables of the paper, with its figures next to ours, as a page of text."""
    parts = [f"# Planners on {len(found['scenarios'])} scenarios of {found['map']}, seed {found['seed']}"]
    parts += [f"{title_of(planner)}: {note}." for planner, note in found["notes"].items()]
    for table in text_tables(found):
        if table.rows:
            parts.append("## " + table.title.replace("*", "\\*") + f"\n\n{table.markdown()}")
    return "\n\n".join(parts)


def _cells(values: Iterable[float | None], digits: int = 3) -> list[str]:
    return ["-" if value is None else f"{value:.{digits}f}" for value in values]


def _printed(planner: str, *names: str) -> list[str]:
    """Return the paper's figures of a planner."""
    digits = {"num_free": 0, "clearance_m": 2}
    row = PAPER.get(planner)
    return [cell for name in names for cell in _cells([getattr(row, name, None)], digits.get(name, 3))]


def text_tables(found: dict[str, Any]) -> Iterator[TextTable]:
    """Yield the tables of `benchmark.json` as text: axes, deltas, weighted score, feasibility, groups."""
    means, rows = found["means"], []
    for p, row in sorted(found["axes"].items(), key=lambda entry: -entry[1]["scores"]["mean"]):
        spread = " to ".join(_cells(row["intervals"]["mean"]))
        ours = _cells(means[p][name] for name in ("collision_fraction", "clearance_min_m"))
        scores = _cells(row["scores"][axis] for axis in (*AXES, "mean"))
        rows.append([title_of(p), *scores, spread, *_printed(p, "axes_mean"), *ours])
    columns = ["visibility", "efficiency", "smoothness", "safety", "mean", "95 %", "paper", "collision", "clearance"]
    shortest = f"{found['shortest_mean_m']:.2f} m (paper: {PAPER_SHORTEST_M} m)"
    yield TextTable(f"Four axes; efficiency to the shortest mean, {shortest}", ["planner", *columns], rows)

    rows = []
    for name, words, digits in FIGURES if found["deltas"] else ():
        delta = found["deltas"][name]
        values = _cells([*(means[p][name] for p in PAIR), delta["delta"]], digits)
        rows.append([words, *values, *_cells([delta["relative_percent"]], 1)])
    yield TextTable(" minus ".join(map(title_of, PAIR)), ["figure", *map(title_of, PAIR), "delta", "%"], rows)

    rows = []
    for p, place in found["ranking"].items():
        scores = _cells([place["score"], *place["normalized"].values()])
        rows.append([f"{place['rank']} {title_of(p)}", *scores, *_printed(p, "weighted")])
    words = ", ".join(f"{weight:g} {name}" for name, (*_, weight) in CRITERIA.items())
    title = f"Weighted score: {words}; each from the worst, 0, to the best, 1"
    yield TextTable(title, ["planner", "score", *CRITERIA, "paper"], rows)

    rows = []
    for p, figures in found["figures"].items():
        fractions = [one["collision_fraction"] for one in figures if one]
        ours = _cells(means[p][name] for name in ("collision_fraction", "five_ray_mean", "clearance_min_m"))
        counts = [f"{count} of {len(figures)}" for count in (len(fractions), fractions.count(0.0))]
        rows.append([title_of(p), GROUP_OF[p], *counts, *ours, *_printed(p, "num_free", "visibility", "clearance_m")])
    columns = ["found", "free of collisions", "collision", "visibility", "clearance"]
    printed = ["paper: free of 20", "paper: visibility", "paper: clearance"]
    title = "Feasibility; a missing trajectory collides and sees nothing"
    yield TextTable(title, ["planner", "group", *columns, *printed], rows)

    rows = []
    names = ("five_ray_mean", "blocked_fraction", "collision_fraction", "clearance_min_m", "length_m")
    for group, own in found["groups"].items():
        cells = [*(own["figures"][name] for name in names), PAPER_GROUPS.get(group)]
        rows.append([group, str(own["num_planners"]), *_cells(cells)])
    columns = ["visibility", "blocked", "collision", "clearance", "length", "paper: visibility"]
    yield TextTable("Groups; clearance and length in m", ["group", "planners", *columns], rows)
