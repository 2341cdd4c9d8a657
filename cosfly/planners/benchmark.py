"""The paper's comparison of planners on the same scenarios: `cosfly plan benchmark` (app:three_axis_eval).

Figures and axes are those of compare.py. Here nothing is left out: a scenario that a planner does not fly counts as one
where the walker is never seen (visibility 0), every place collides and no box is kept away from (clearance 0); lengths
and dynamics, of which there are none, are means over what is flown, and of one that flies nothing as bad as can be.

The 14-way score of the paper (tab:appendix_h_extended_ranking) is printed without its weights. Its rows give them away:
with each criterion normalised from the worst planner, 0, to the best, 1, all fourteen scores are 0.35 visibility + 0.30
collision + 0.35 clearance within 0.0001, and path length, acceleration and jerk count for nothing.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, Field

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.planners import compare
from cosfly.planners.compare import AXES, FIGURES, INTERVAL_PERCENT, NUM_RESAMPLES, CompareConfig
from cosfly.planners.contract import ALL_PLANNERS, title_of
from cosfly.planners.stage import check_ids, draw_styles_of
from cosfly.runtime.errors import EnvironmentMissing, InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, read_model, write_model
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item
from cosfly.viz.tables import TextTable

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.plan_benchmark", "1.0", "benchmark of planners")
NAMES = [name for name, _, _ in FIGURES]
INFEASIBLE = {"five_ray_mean": 0.0, "blocked_fraction": 1.0, "collision_fraction": 1.0, "clearance_min_m": 0.0}
GROUPS = {
    "our own": ("foresight",),
    "target-aware": ("track_astar", "muco"),
    "A* family": ("astar", "weighted_astar", "theta_star", "visibility_astar"),
    "sampling, spline": ("rrt_star", "prm", "bspline_prm"),
    "gradient, optimization": ("elastic_band", "minimum_jerk", "potential_field", "chomp", "trajopt"),
}
GROUP_OF = {planner: group for group, members in GROUPS.items() for planner in members}
# Criteria of the weighted score: its figure, and whether more is better.
CRITERIA = {
    "visibility": ("five_ray_mean", True),
    "collision": ("collision_fraction", False),
    "clearance": ("clearance_min_m", True),
}
WEIGHTS = {"visibility": 0.35, "collision": 0.30, "clearance": 0.35}  # the paper's, see above
INSTALL = 'pip install "cosfly[ompl]"'


class PaperRow(NamedTuple):
    """What the paper prints of a planner: mean of the four axes (of seven planners), weighted score, visibility,
    clearance, and scenarios of 20 without collision.
    """

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


Flown = dict[str, compare.TrajectoriesOfPath]  # by the id of the walk


class BenchmarkConfig(CompareConfig):
    """Settings of a benchmark: those of a comparison, and how many scenarios."""

    planners: tuple[str, ...] = Field(tuple(ALL_PLANNERS), description="who takes part")
    scenarios: int = Field(20, ge=1, description="walks from the beginning of the file, at most")


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
    """Reads a simplified map and `path.json`, writes `benchmark.json`, its tables and the figures; returns the first.

    A walk that no planner flies, as one through a house, is a failure and no scenario. Planning times stand in
    `items.jsonl` and in the manifest, the only files that differ when all is done again.

    Raises:
        InputError: a file is not what it must be.
        NothingKept: no walk is flown by anybody.
    """
    cfg = _without_missing(cfg)
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_benchmark", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product, page = out / "benchmark.json", out / "benchmark.md"
    if stage.is_complete:
        return product
    box_map, walks = read_boxes(simplified_map), read_paths(paths)
    check_ids(walks, paths)
    walks = walks[: cfg.scenarios]
    items = [Item(w.path_id, (w, styles)) for w, styles in zip(walks, draw_styles_of(walks, cfg, seed), strict=True)]
    done = run_items(stage, items, compare.make_worker, (cfg, simplified_map, seed, True), workers=workers, watch=watch)
    if not done.tally.kept:
        raise stage.nothing_kept(done.tally, expected="a walk that a planner flies")
    flown = {record.id: result_of(record, compare.TrajectoriesOfPath) for record in done.kept}
    header = {"map": box_map.name, "num_boxes": len(box_map), "seed": seed, "settings": cfg.all_values()}
    summary = summarize(flown, cfg.planners, rng_for(seed, "plan_benchmark", "intervals"))
    found = Benchmark(**header, **summary)
    write_model(product, found, FORMAT)
    write_bytes(page, markdown(found).encode())
    pictures = _pictures(found, flown, box_map)
    for name, picture in pictures.items():
        write_bytes(out / name, picture)
    stage.finish(
        [product, page, *(out / name for name in pictures)],
        done.tally,
        timings=compare.timings(flown.values(), cfg.planners),
    )
    return product


def _without_missing(cfg: BenchmarkConfig) -> BenchmarkConfig:
    """Leave out the planners whose package is not installed, with one line that says so."""
    sampling = [name for name in cfg.planners if ALL_PLANNERS[name].startswith("cosfly.planners.reference.sampling")]
    if not sampling or importlib.util.find_spec("ompl") is not None:
        return cfg
    if len(sampling) == len(cfg.planners):
        raise EnvironmentMissing("OMPL is not installed", expected="a planner that goes without", fix=INSTALL)
    log.warning("OMPL is not installed; left out: %s; %s", ", ".join(sampling), INSTALL)
    return cfg.model_copy(update={"planners": tuple(name for name in cfg.planners if name not in sampling)})


def _pictures(found: Benchmark, flown: Flown, box_map: BoxMap) -> dict[str, bytes]:
    """Draw the figures; none, with one line that says so, where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        log.warning("matplotlib is not installed; there are no figures; %s", INSTALL)
        return {}
    from cosfly.planners.benchmark_figures import draw

    return draw(found, flown, box_map)


# --- tables -----------------------------------------------------------------------------------------------------------

Interval = tuple[float, float]


class AxisRow(BaseModel):
    """Scores of a planner and 95 % of what other scenarios would give."""

    scores: dict[str, float]
    intervals: dict[str, Interval]


class RankRow(BaseModel):
    """normalized: criterion -> 0 (worst) to 1 (best)."""

    rank: int
    score: float
    normalized: dict[str, float]


class GroupRow(BaseModel):
    """Means over the planners of a group."""

    num_planners: int
    figures: dict[str, float | None]


class Benchmark(BaseModel):
    """`benchmark.json`. figures: planner -> a row for each scenario, null where it flew nothing; means: see above."""

    map: str
    num_boxes: int
    seed: int
    settings: dict[str, Any]
    scenarios: list[str] = Field(min_length=1)
    infeasible: dict[str, dict[str, str]]
    figures: dict[str, list[dict[str, float] | None]]
    means: dict[str, dict[str, float | None]]
    shortest_mean_m: float
    axes: dict[str, AxisRow]
    deltas: dict[str, dict[str, float | None]] = {}
    ranking: dict[str, RankRow]
    groups: dict[str, GroupRow]


def read_benchmark(path: Path) -> Benchmark:
    """Read `benchmark.json` back; raises InputError."""
    return read_model(path, Benchmark, FORMAT)


def summarize(flown: Flown, planners: tuple[str, ...], rng: np.random.Generator) -> dict[str, Any]:
    """Make the tables of `benchmark.json` from the flights. rng: draws scenarios."""
    traces = [found.traces(name) for name, found in flown.items()]
    figures = {p: [compare.trajectory_figures(t[p]) if p in t else None for t in traces] for p in planners}
    tables = {p: np.array([_row(flight) for flight in rows]) for p, rows in figures.items()}
    means = _means(tables, np.arange(len(flown)))
    drawn = [_means(tables, draw) for draw in rng.integers(len(flown), size=(NUM_RESAMPLES, len(flown)))]
    axes, axes_drawn = compare.axis_scores(means), [compare.axis_scores(found) for found in drawn]
    axis_rows = {
        p: AxisRow(scores=row, intervals={axis: _interval([found[p][axis] for found in axes_drawn]) for axis in row})
        for p, row in axes.items()
    }
    free_m = [row["length_m"] for row in means.values() if row["collision_fraction"] == 0]
    return {
        "scenarios": list(flown),
        "infeasible": {name: found.errors for name, found in flown.items() if found.errors},
        "figures": figures,
        "means": {p: {n: _number(value) for n, value in row.items()} for p, row in means.items()},
        "shortest_mean_m": round(min(free_m or [row["length_m"] for row in means.values()]), 4),
        "axes": axis_rows,
        "deltas": _deltas(means),
        "ranking": _ranking(means),
        "groups": _groups(means),
    }


def _deltas(means: dict[str, dict[str, float]]) -> dict[str, dict[str, float | None]]:
    """Return TA*+Smooth less MuCO; nothing where one of them took no part or flew nothing."""
    pair = GROUPS["target-aware"]
    if not all(p in means and np.isfinite(list(means[p].values())).all() for p in pair):
        return {}
    return compare.deltas(*(means[p] for p in pair))


def _row(flight: dict[str, float] | None) -> list[float]:
    """Return the figures of a flight in the order of NAMES, NaN where one that was not flown has none."""
    return [flight[name] if flight else INFEASIBLE.get(name, np.nan) for name in NAMES]


def _means(tables: dict[str, np.ndarray], draw: np.ndarray) -> dict[str, dict[str, float]]:
    """Average over drawn scenarios; infinite where a planner flew none of them."""
    found = {}
    for planner, table in tables.items():
        rows = table[draw]
        counts = (~np.isnan(rows)).sum(axis=0)
        means = np.where(counts > 0, np.nansum(rows, axis=0) / np.maximum(counts, 1), np.inf)
        found[planner] = dict(zip(NAMES, means.tolist(), strict=True))
    return found


def _normalized(means: dict[str, dict[str, float]]) -> np.ndarray:
    """Return (planners, criteria) from 0, the worst, to 1, the best; all 1 where there is no difference."""
    columns = []
    for figure, more_is_better in CRITERIA.values():
        values = np.array([row[figure] for row in means.values()])
        known = np.isfinite(values)
        low, span = values[known].min(), np.ptp(values[known])
        share = (values - low) / span if span > 0 else np.full(len(values), float(more_is_better))
        columns.append(np.where(known, share if more_is_better else 1.0 - share, 0.0))
    return np.stack(columns, axis=1)


def _ranking(means: dict[str, dict[str, float]]) -> dict[str, RankRow]:
    normalized = _normalized(means)
    scores = (normalized @ list(WEIGHTS.values())).round(4)
    planners = list(means)
    order = np.argsort(-scores, kind="stable").tolist()
    return {
        planners[k]: RankRow(
            rank=rank,
            score=scores[k],
            normalized=dict(zip(CRITERIA, np.round(normalized[k], 4).tolist(), strict=True)),
        )
        for rank, k in enumerate(order, 1)
    }


def _groups(means: dict[str, dict[str, float]]) -> dict[str, GroupRow]:
    rows = {}
    for group, all_members in GROUPS.items():
        if members := [planner for planner in all_members if planner in means]:
            figures = {name: _number(float(np.mean([means[p][name] for p in members]))) for name in NAMES}
            rows[group] = GroupRow(num_planners=len(members), figures=figures)
    return rows


def _interval(values: Any) -> Interval:
    low, high = np.percentile(np.nan_to_num(np.asarray(values, dtype=np.float64)), INTERVAL_PERCENT)
    return round(float(low), 4), round(float(high), 4)


def _number(value: float | None) -> float | None:
    return round(value, 4) if value is not None and np.isfinite(value) else None


# --- tables of text ---------------------------------------------------------------------------------------------------


def text_tables(found: Benchmark) -> list[TextTable]:
    """Return the tables of the paper with its figures beside ours."""
    try:
        return [table for table in _tables(found) if table.rows]
    except KeyError as error:
        raise InputError("a table lacks a part", where=FORMAT.what, got=str(error), fix="run it again") from None


def markdown(found: Benchmark) -> str:
    """Return the tables as a page of text."""
    parts = [f"# Planners on {len(found.scenarios)} scenarios of {found.map}, seed {found.seed}"]
    parts += ["## " + table.title.replace("*", "\\*") + f"\n\n{table.markdown()}" for table in text_tables(found)]
    return "\n\n".join(parts)


def _cells(values: Iterable[float | None], digits: int = 3) -> list[str]:
    return ["-" if value is None else f"{value:.{digits}f}" for value in values]


def _printed(planner: str, *names: str) -> list[str]:
    """Return what the paper prints of a planner."""
    digits = {"num_free": 0, "clearance_m": 2}
    row = PAPER.get(planner)
    return [cell for name in names for cell in _cells([getattr(row, name, None)], digits.get(name, 3))]


def _tables(found: Benchmark) -> Iterator[TextTable]:
    num, pair = len(found.scenarios), GROUPS["target-aware"]
    rows = []
    for p, row in sorted(found.axes.items(), key=lambda entry: -entry[1].scores["mean"]):
        scores = _cells(row.scores[axis] for axis in (*AXES, "mean"))
        spread = " to ".join(_cells(row.intervals["mean"]))
        ours = _cells(found.means[p][name] for name in ("collision_fraction", "clearance_min_m"))
        rows.append([title_of(p), *scores, spread, *_printed(p, "axes_mean"), *ours])
    columns = ["visibility", "efficiency", "smoothness", "safety", "mean", "95 %", "paper", "collision", "clearance"]
    title = f"Four axes; efficiency to the shortest mean, {found.shortest_mean_m:.2f} m (paper: {PAPER_SHORTEST_M} m)"
    yield TextTable(title, ["planner", *columns], rows)

    rows = []
    for name, words, digits in FIGURES if found.deltas else ():
        values = [*(found.means[p][name] for p in pair), found.deltas[name]["delta"]]
        rows.append([words, *_cells(values, digits), *_cells([found.deltas[name]["relative_percent"]], 1)])
    columns = ["figure", *map(title_of, pair), "delta", "%"]
    yield TextTable("TA* + Smooth less MuCO", columns, rows)

    rows = []
    for p, place in found.ranking.items():
        normalized = _cells(place.normalized[name] for name in WEIGHTS)
        rows.append([f"{place.rank} {title_of(p)}", *_cells([place.score]), *normalized, *_printed(p, "weighted")])
    words = ", ".join(f"{weight:g} {name}" for name, weight in WEIGHTS.items())
    title = f"Weighted score: {words}; each from the worst, 0, to the best, 1"
    yield TextTable(title, ["planner", "score", *WEIGHTS, "paper"], rows)

    rows = []
    for p, flights in found.figures.items():
        fractions = [flight["collision_fraction"] for flight in flights if flight]
        ours = _cells(found.means[p][name] for name in ("collision_fraction", "five_ray_mean", "clearance_min_m"))
        counts = [f"{count} of {num}" for count in (len(fractions), fractions.count(0.0))]
        rows.append([title_of(p), GROUP_OF[p], *counts, *ours, *_printed(p, "num_free", "visibility", "clearance_m")])
    columns = ["flown", "free of collisions", "collision", "visibility", "clearance"]
    printed = ["paper: free of 20", "paper: visibility", "paper: clearance"]
    title = "Feasibility; what is not flown collides and sees nothing"
    yield TextTable(title, ["planner", "group", *columns, *printed], rows)

    rows = []
    names = ("five_ray_mean", "blocked_fraction", "collision_fraction", "clearance_min_m", "length_m")
    for group, means in found.groups.items():
        figures = [*(means.figures[name] for name in names), PAPER_GROUPS.get(group)]
        rows.append([group, str(means.num_planners), *_cells(figures)])
    columns = ["visibility", "blocked", "collision", "clearance", "length", "paper: visibility"]
    yield TextTable("Groups; clearance and length in m", ["group", "planners", *columns], rows)
