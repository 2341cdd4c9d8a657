"""The paper's comparison of planners on the same scenarios: `cosfly plan benchmark` (app:three_axis_eval).

Figures are numbers, and axes are scores, as in compare.py. Here no scenario is skipped: a scenario for which a planner
finds no trajectory counts as one with visibility 0, all positions in collision and clearance 0. Lengths and dynamics
are means over the trajectories found; a planner that finds none gets the worst value.

The paper prints the 14-way score (tab:appendix_h_extended_ranking) without its weights. Its rows determine them: with
each criterion normalised from the worst planner, 0, to the best, 1, all fourteen scores are 0.35 visibility + 0.30
collision + 0.35 clearance within 0.0001; path length, acceleration and jerk have no weight.
"""

from __future__ import annotations

import importlib.util
import io
import itertools
import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import CORNER_SIGNS, rotation_matrices
from cosfly.planners import compare
from cosfly.planners.compare import AXES, AXES_AND_MEAN, FIGURES, NAMES, CompareConfig, FiniteMeans, PlannedItem
from cosfly.planners.contract import ALL_PLANNERS, PLANNERS, planner_notes, title_of
from cosfly.planners.overview import color_of
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import Watch
from cosfly.runtime.run_dir import Resume, StageFolder
from cosfly.runtime.seeding import rng_for
from cosfly.viz.tables import TextTable, cells

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.plan_benchmark", "2.0", "benchmark of planners")
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
INSTALL = 'pip install -e ".[ompl]"'  # this extra holds both OMPL and matplotlib


class PaperRow(NamedTuple):
    """The paper's figures of a planner."""

    axes_mean: float | None  # mean of the four axes, printed for seven planners only
    weighted: float  # weighted score
    visibility: float
    clearance_m: float
    num_free: int  # scenarios of 20 without collision


# The fields of a PaperRow: axes_mean, weighted, visibility, clearance_m, num_free.
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


class BenchmarkConfig(CompareConfig):
    """Settings of a benchmark: those of a comparison, and the number of scenarios."""

    planners: tuple[str, ...] = Field(tuple(ALL_PLANNERS), description="planners to run")
    scenarios: int = Field(20, ge=1, description="largest number of pedestrian trajectories, in the order of the file")


# --- stage ------------------------------------------------------------------------------------------------------------


def run(
    cfg: BenchmarkConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(), resume: Resume = "if-same",
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `benchmark.json`, its tables and the pictures.

    A pedestrian trajectory that no planner can follow, such as one through a house, is a failure and no scenario.
    Planning times are written to `items.jsonl` and the manifest, the only files that differ between equal runs. Return
    the path of `benchmark.json`.
    """
    cfg = _without_missing(cfg)
    product = out / "benchmark.json"
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_benchmark", config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return product
    box_map, _, done, planned, header = compare.plan_all(
        stage, cfg, simplified_map, paths, seed, most=cfg.scenarios, keeps_all=True, workers=workers, watch=watch
    )
    benchmark = header | summarize(planned, cfg.planners, rng_for(seed, "plan_benchmark", "intervals"))
    benchmark["notes"] = planner_notes(cfg.planners, cfg)
    write_json(product, {**FORMAT.header, **benchmark})
    pages = {"benchmark.md": markdown(benchmark).encode()} | draw_pictures(benchmark, planned, box_map)
    for name, data in pages.items():
        write_bytes(out / name, data)
    outputs = [product, *(out / name for name in pages)]
    stage.finish(outputs, done.tally, timings=compare.timings(planned.values(), cfg.planners))
    return product


def _without_missing(cfg: BenchmarkConfig) -> BenchmarkConfig:
    """Remove the planners whose package is not installed, with a warning."""
    sampling = [name for name in cfg.planners if ALL_PLANNERS[name].startswith("cosfly.planners.reference.sampling")]
    if not sampling or importlib.util.find_spec("ompl") is not None:
        return cfg
    if len(sampling) == len(cfg.planners):
        fix = f"choose a planner that works without OMPL, or install OMPL: {INSTALL}"
        raise EnvironmentMissing("OMPL is not installed, and all chosen planners need it", fix=fix)
    log.warning(
        "OMPL is not installed, so these planners are skipped: %s; to install it: %s", ", ".join(sampling), INSTALL
    )
    return cfg.model_copy(update={"planners": tuple(name for name in cfg.planners if name not in sampling)})


# --- tables -----------------------------------------------------------------------------------------------------------


def summarize(planned: dict[str, PlannedItem], planners: tuple[str, ...], rng: np.random.Generator) -> dict[str, Any]:
    """Return the tables of `benchmark.json`: those of a comparison, and the paper's ranking and groups.

    `deltas` are those of the paper's pair, TA*+Smooth minus MuCO; none if one of them found no trajectory.
    """
    tables = compare.summarize(planned, planners, rng)
    means = tables["means"]
    both_found = all(name in means and None not in means[name].values() for name in PAIR)
    deltas = compare.deltas(*(means[name] for name in PAIR)) if both_found else {}
    return tables | {"deltas": deltas, "ranking": _ranking(means), "groups": _groups(means)}


def _groups(means: FiniteMeans) -> dict[str, dict[str, Any]]:
    """Return the number of planners of each group, and the means of their mean figures."""
    groups = {}
    for group, members in GROUPS.items():
        rows = [list(means[planner].values()) for planner in members if planner in means]
        if rows:
            figures = dict(zip(NAMES, np.array(rows, dtype=np.float64).mean(axis=0), strict=True))
            groups[group] = {"num_planners": len(rows), "figures": compare.finite(figures)}
    return groups


def _ranking(means: FiniteMeans) -> dict[str, dict[str, Any]]:
    """Return rank, weighted score and criteria from 0, the worst, to 1, the best; 1 where there is no difference."""
    columns = []
    for figure, more_is_better, _ in CRITERIA.values():
        values = np.array([row[figure] for row in means.values()], dtype=np.float64)
        is_finite = np.isfinite(values)
        low = values[is_finite].min()
        span = np.ptp(values[is_finite])
        share = (values - low) / span if span > 0 else np.full(len(values), float(more_is_better))
        columns.append(np.where(is_finite, share if more_is_better else 1.0 - share, 0.0))
    normalized = np.stack(columns, axis=1)
    planners = list(means)
    scores = (normalized @ [weight for *_, weight in CRITERIA.values()]).round(4)
    return {
        planners[k]: {
            "rank": rank,
            "score": float(scores[k]),
            "normalized": dict(zip(CRITERIA, np.round(normalized[k], 4).tolist(), strict=True)),
        }
        for rank, k in enumerate(np.argsort(-scores, kind="stable").tolist(), 1)
    }


def markdown(benchmark: dict[str, Any]) -> str:
    """Return the tables of the paper, with its figures next to ours, as a page of text."""
    parts = [f"# Planners on {len(benchmark['scenarios'])} scenarios of {benchmark['map']}, seed {benchmark['seed']}"]
    parts += [f"{title_of(planner)}: {note}." for planner, note in benchmark["notes"].items()]
    tables = [table for table in text_tables(benchmark) if table.rows]
    return "\n\n".join([*parts, *(f"## {t.title}\n\n".replace("*", "\\*") + t.markdown() for t in tables)])


def _printed(planner: str, *names: str) -> list[str]:
    """Return the paper's figures of a planner."""
    row = PAPER.get(planner)
    digits = {"num_free": 0, "clearance_m": 2}
    return [cell for name in names for cell in cells([getattr(row, name, None)], digits.get(name, 3))]


def text_tables(benchmark: dict[str, Any]) -> Iterator[TextTable]:
    """Yield the tables of `benchmark.json` as text: axes, deltas, weighted score, feasibility, groups."""
    for table in (_axes_table, _deltas_table, _ranking_table, _feasibility_table, _groups_table):
        yield table(benchmark)


def _measured(benchmark: dict[str, Any], planner: str, *names: str) -> list[str]:
    """Return our mean figures of a planner."""
    return cells(benchmark["means"][planner][name] for name in names)


def _axes_table(benchmark: dict[str, Any]) -> TextTable:
    columns = ["visibility", "efficiency", "smoothness", "safety", "mean", "95 %", "paper", "collision", "clearance"]
    shortest = f"{benchmark['shortest_mean_m']:.2f} m (paper: {PAPER_SHORTEST_M} m)"
    by_mean = sorted(benchmark["axes"].items(), key=lambda entry: -entry[1]["mean"])
    return TextTable(f"Four axes; efficiency relative to the shortest mean, {shortest}", ["planner", *columns], [
        [
            title_of(planner), *cells(row[axis] for axis in AXES_AND_MEAN),
            " to ".join(cells(benchmark["intervals"][planner]["mean"])), *_printed(planner, "axes_mean"),
            *_measured(benchmark, planner, "collision_fraction", "clearance_min_m"),
        ]
        for planner, row in by_mean
    ])  # fmt: skip


def _deltas_table(benchmark: dict[str, Any]) -> TextTable:
    deltas = benchmark["deltas"]
    return TextTable(" minus ".join(map(title_of, PAIR)), ["figure", *map(title_of, PAIR), "delta", "%"], [
        [
            words, *cells([*(benchmark["means"][planner][name] for planner in PAIR), deltas[name]["delta"]], digits),
            *cells([deltas[name]["relative_percent"]], 1),
        ]
        for name, words, digits in FIGURES if deltas
    ])  # fmt: skip


def _ranking_table(benchmark: dict[str, Any]) -> TextTable:
    words = ", ".join(f"{weight:g} {name}" for name, (*_, weight) in CRITERIA.items())
    title = f"Weighted score: {words}; each is scaled from 0 (worst planner) to 1 (best planner)"
    return TextTable(title, ["planner", "score", *CRITERIA, "paper"], [
        [
            f"{row['rank']} {title_of(planner)}", *cells([row["score"], *row["normalized"].values()]),
            *_printed(planner, "weighted"),
        ]
        for planner, row in benchmark["ranking"].items()
    ])  # fmt: skip


def _feasibility_table(benchmark: dict[str, Any]) -> TextTable:
    rows = []
    scenarios = benchmark["scenarios"]
    for planner in benchmark["means"]:
        fractions = [scenario[planner]["collision_fraction"] for scenario in scenarios if scenario[planner]]
        counts = [f"{count} of {len(scenarios)}" for count in (len(fractions), fractions.count(0.0))]
        measured = _measured(benchmark, planner, "collision_fraction", "five_ray_mean", "clearance_min_m")
        printed = _printed(planner, "num_free", "visibility", "clearance_m")
        rows.append([title_of(planner), GROUP_OF[planner], *counts, *measured, *printed])
    columns = ["found", "free of collisions", "collision", "visibility", "clearance"]
    columns += ["paper: free, of 20", "paper: visibility", "paper: clearance"]
    title = "Feasibility; a missing trajectory counts as a collision without visibility"
    return TextTable(title, ["planner", "group", *columns], rows)


def _groups_table(benchmark: dict[str, Any]) -> TextTable:
    names = ("five_ray_mean", "blocked_fraction", "collision_fraction", "clearance_min_m", "length_m")
    columns = ["visibility", "blocked", "collision", "clearance", "length", "paper: visibility"]
    return TextTable("Groups; clearance and length in m", ["group", "planners", *columns], [
        [group, str(row["num_planners"]), *cells([*(row["figures"][name] for name in names), PAPER_GROUPS.get(group)])]
        for group, row in benchmark["groups"].items()
    ])  # fmt: skip


# --- pictures ---------------------------------------------------------------------------------------------------------
# Each target-aware planner has its own colour; generic planners are grey. A `plot` is what matplotlib calls axes.

GREY = "#9a9a9a"
# Scenarios shown in 3D. Boxes are drawn within ROOM_M of the trajectories if they are at least LEAST_M high.
NUM_SHOWN = 4
ROOM_M = 10.0
LEAST_M = 5.0
# Corners of each face of a box, numbered as in CORNER_SIGNS.
FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def draw_pictures(benchmark: dict[str, Any], planned: dict[str, PlannedItem], box_map: BoxMap) -> dict[str, bytes]:
    """Return the pictures, file name -> PNG; none, with a warning, where matplotlib is not installed.

    Those of TA*+Smooth against MuCO are drawn only where both found trajectories.
    """
    if importlib.util.find_spec("matplotlib") is None:
        log.warning("matplotlib is not installed, so no figures are drawn; to install it: %s", INSTALL)
        return {}
    from matplotlib.figure import Figure

    drawings: dict[str, tuple[tuple[float, float], Callable[..., None]]] = {  # size, inches; function
        "axes_radar.png": ((8.0, 9.0), _radar), "axes_bars.png": ((13.0, 5.5), _bars),
        "axes_pairs.png": ((13.5, 8.0), _pairs),
    }  # fmt: skip
    if benchmark["deltas"]:
        drawings["deltas.png"] = (9.0, 4.5), _deltas
        drawings["trajectories_3d.png"] = (14.0, 11.0), partial(_trajectories, planned=planned, box_map=box_map)
    pictures = {}
    for name, (size, draw) in drawings.items():
        figure = Figure(figsize=size, dpi=110, layout="constrained")
        draw(figure, benchmark)
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
        pictures[name] = file.getvalue()
    return pictures


def _color(planner: str) -> Any:
    """Return a colour of matplotlib."""
    return np.array(color_of(planner)) / 255.0 if planner in PLANNERS else GREY


def _radar(figure: Any, benchmark: dict[str, Any]) -> None:
    """Draw the four axes of our planners and the paper's seven as polygons (fig:appendix_h_alg3d_measured)."""
    primary = [name for name in benchmark["axes"] if name not in PAPER or PAPER[name].axes_mean is not None]
    plot = figure.add_subplot(projection="polar")
    angles = np.arange(len(AXES)) * 2.0 * np.pi / len(AXES)
    for planner in primary or benchmark["axes"]:
        scores = benchmark["axes"][planner]
        style = {"edgecolor": _color(planner), "lw": 2.0, "label": f"{title_of(planner)}: mean {scores['mean']:.3f}"}
        plot.fill(angles, [scores[name] for name in AXES], facecolor="none", **style)
    plot.set_xticks(angles, [name.replace("_", " ") for name in AXES])
    plot.set_ylim(0.0, 1.0)
    figure.legend(loc="outside lower center", ncols=3)


def _bars(figure: Any, benchmark: dict[str, Any]) -> None:
    """Draw the four axes and their mean as bars with intervals, next to the mean that the paper prints."""
    plot = figure.add_subplot()
    places = np.arange(len(benchmark["axes"]))
    width = 0.8 / len(AXES_AND_MEAN)
    shades = ("#3a6ea5", "#8fb8de", "#7fb069", "#e6aa68", "#303030")
    for k, (name, shade) in enumerate(zip(AXES_AND_MEAN, shades, strict=True)):
        values = np.array([scores[name] for scores in benchmark["axes"].values()])
        spans = np.array([intervals[name] for intervals in benchmark["intervals"].values()])
        whiskers = np.clip([values - spans[:, 0], spans[:, 1] - values], 0.0, None)
        style = {"yerr": whiskers, "error_kw": {"lw": 0.8}, "color": shade, "label": name.replace("_", " ")}
        plot.bar(places + (k - 2) * width, values, width, **style)
    printed = {place: PAPER[name].axes_mean for place, name in enumerate(benchmark["axes"]) if name in PAPER}
    shown = [(place + 2 * width, value) for place, value in printed.items() if value is not None]
    if shown:
        plot.plot(*zip(*shown, strict=True), "D", color="#d1495b", ms=5, label="mean in the paper")
    plot.set_xticks(places, [title_of(planner) for planner in benchmark["axes"]], rotation=35, ha="right")
    plot.set_title("Four axes, with 95 % bootstrap intervals over scenarios")
    figure.legend(loc="outside right upper")


def _pairs(figure: Any, benchmark: dict[str, Any]) -> None:
    """Draw the planners as points in each pair of axes."""
    for place, (x_axis, y_axis) in enumerate(itertools.combinations(AXES, 2), 1):
        plot = figure.add_subplot(2, 3, place)
        for planner, scores in benchmark["axes"].items():
            style = {"ms": 8, "label": title_of(planner)} if planner in PLANNERS else {"ms": 5}
            plot.plot(scores[x_axis], scores[y_axis], "o", color=_color(planner), **style)
        plot.set(xlabel=x_axis.replace("_", " "), ylabel=y_axis.replace("_", " "))
        plot.margins(0.2)
        plot.grid(alpha=0.3)
    figure.legend(*plot.get_legend_handles_labels(), loc="outside lower center", ncols=len(PLANNERS))
    figure.suptitle("Pairs of axes; gray: generic planners")


def _deltas(figure: Any, benchmark: dict[str, Any]) -> None:
    """Draw relative changes with their sign set so that TA*+Smooth is better on the right."""
    more_is_better = {"five_ray_mean", "clearance_min_m", "smoothness_score"}
    shown = {"blocked_fraction", "length_m", "accel_rms_mps2", "jerk_rms_mps3"} | more_is_better
    plot = figure.add_subplot()
    rows = []
    for name, title, _ in reversed(FIGURES):
        base = benchmark["means"]["muco"][name]
        if name in shown and base:
            sign = 100.0 / base * (1.0 if name in more_is_better else -1.0)
            words = title if name in more_is_better else f"less {title}"
            rows.append((words, sign * (benchmark["deltas"][name]["delta"] or 0.0)))
    for place, (_, change) in enumerate(rows):
        plot.barh(place, change, color=_color("track_astar") if change >= 0 else _color("muco"))
        plot.annotate(f"{change:+.1f} %", (max(change, 0.0), place), xytext=(6, -4), textcoords="offset points")
    plot.axvline(0.0, color="black", lw=0.8)
    plot.set_yticks(range(len(rows)), [words for words, _ in rows])
    plot.margins(x=0.15)
    plot.set_xlabel("relative to MuCO, %; to the right TA* + Smooth is better")
    plot.set_title("TA* + Smooth against MuCO")


def _trajectories(figure: Any, benchmark: dict[str, Any], planned: dict[str, PlannedItem], box_map: BoxMap) -> None:
    """Draw the scenarios in which the visibility of TA*+Smooth exceeds that of MuCO most."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    scenarios = {scenario["id"]: scenario for scenario in benchmark["scenarios"]}

    def gain(path_id: str) -> float:
        first, second = (scenarios[path_id][planner] or {} for planner in PAIR)
        return first.get("five_ray_mean", 0.0) - second.get("five_ray_mean", 0.0)

    for place, path_id in enumerate(sorted(planned, key=gain, reverse=True)[:NUM_SHOWN], 1):
        traces = planned[path_id].read_traces(path_id)
        points = np.concatenate([trace.positions_m for trace in traces.values()])
        targets = next(iter(traces.values())).targets_m
        low = np.minimum(points.min(axis=0), targets.min(axis=0))
        high = points.max(axis=0)
        plot = figure.add_subplot(2, 2, place, projection="3d")
        faces = _box_faces(box_map, low, high)
        plot.add_collection3d(Poly3DCollection(faces, facecolor="#b9b9b9", edgecolor="#909090", lw=0.2, alpha=0.12))
        for planner, trace in reversed(traces.items()):
            style = {"lw": 2.2, "label": title_of(planner)} if planner in PLANNERS else {"lw": 0.8}
            plot.plot(*trace.positions_m.T, color=_color(planner), **style)
        plot.plot(*targets.T, "--", color="black", lw=1.5, label="pedestrian")
        low[2] = targets[:, 2].min() - TARGET_HEIGHT_M
        plot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        plot.set_box_aspect(high - low, zoom=1.15)
        plot.locator_params(nbins=5)
        plot.set_title(f"{path_id}: visibility {gain(path_id):+.3f}")
    figure.legend(*plot.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle("Largest gains in visibility of TA* + Smooth over MuCO; gray: generic planners")


def _box_faces(box_map: BoxMap, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the faces of the higher boxes around a box of trajectories, (k, 4, 3) m."""
    from cosfly.geometry.kernels import NO_OBSTACLE_KINDS

    near = (np.abs(box_map.centers - (low + high) / 2) <= (high - low) / 2 + ROOM_M)[:, :2].all(axis=1)
    near &= ~box_map.is_any_of(NO_OBSTACLE_KINDS) & (box_map.half_extents[:, 2] >= LEAST_M / 2.0)
    turns = rotation_matrices(np.radians(box_map.rotations_deg[near]))
    corners = np.einsum("kij,ksj->ksi", turns, CORNER_SIGNS * box_map.half_extents[near][:, None])
    return (corners + box_map.centers[near][:, None])[:, FACES, :].reshape(-1, 4, 3)
