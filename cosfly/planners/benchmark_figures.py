"""The figures of a benchmark, drawn with matplotlib (extra `ompl`): axes, deltas, trajectories in 3D.

Each target-aware planner has its own color; generic planners are gray.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import CORNER_SIGNS, rotation_matrices
from cosfly.geometry.kernels import NO_OBSTACLE_KINDS
from cosfly.planners.benchmark import PAIR, PAPER
from cosfly.planners.compare import AXES, FIGURES, PlannedItem, color_of
from cosfly.planners.contract import PLANNERS, title_of

GRAY = "#9a9a9a"
# Scenarios shown in 3D; boxes are drawn within this margin of the trajectories and from this height on.
NUM_SHOWN, ROOM_M, LEAST_M = 4, 10.0, 5.0
FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def draw(found: dict[str, Any], planned: dict[str, PlannedItem], box_map: BoxMap) -> dict[str, bytes]:
    """Return the figures, file name -> PNG; those of TA*+Smooth against MuCO only where both found trajectories."""
    primary = [p for p in found["axes"] if p not in PAPER or PAPER[p].axes_mean is not None]  # the paper's seven, ours
    pictures = {"axes_radar.png": _radar(found, primary or list(found["axes"]))}
    pictures |= {"axes_bars.png": _bars(found), "axes_pairs.png": _pairs(found)}
    if found["deltas"]:
        pictures |= {"deltas.png": _deltas(found), "trajectories_3d.png": _trajectories(found, planned, box_map)}
    return pictures


def _color(planner: str) -> Any:
    return np.array(color_of(planner)) / 255.0 if planner in PLANNERS else GRAY


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _radar(found: dict[str, Any], planners: list[str]) -> bytes:
    """Draw the four axes as polygons (fig:appendix_h_alg3d_measured)."""
    figure = _figure(8.0, 9.0)
    axes, angles = figure.add_subplot(projection="polar"), np.arange(len(AXES)) * 2.0 * np.pi / len(AXES)
    for planner in planners:
        scores = found["axes"][planner]["scores"]
        style = {"edgecolor": _color(planner), "lw": 2.0, "label": f"{title_of(planner)}: mean {scores['mean']:.3f}"}
        axes.fill(angles, [scores[name] for name in AXES], facecolor="none", **style)
    axes.set_xticks(angles, [name.replace("_", " ") for name in AXES])
    axes.set_ylim(0.0, 1.0)
    figure.legend(loc="outside lower center", ncols=3)
    return _png(figure)


def _bars(found: dict[str, Any]) -> bytes:
    figure = _figure(13.0, 5.5)
    axes, names = figure.add_subplot(), (*AXES, "mean")
    places, width = np.arange(len(found["axes"])), 0.8 / len(names)
    shades = ("#3a6ea5", "#8fb8de", "#7fb069", "#e6aa68", "#303030")
    for k, (name, shade) in enumerate(zip(names, shades, strict=True)):
        values = np.array([row["scores"][name] for row in found["axes"].values()])
        spans = np.array([row["intervals"][name] for row in found["axes"].values()])
        whiskers = np.clip([values - spans[:, 0], spans[:, 1] - values], 0.0, None)
        style = {"yerr": whiskers, "error_kw": {"lw": 0.8}, "color": shade, "label": name.replace("_", " ")}
        axes.bar(places + (k - 2) * width, values, width, **style)
    printed = {k: PAPER[p].axes_mean for k, p in enumerate(found["axes"]) if p in PAPER}
    shown = [(k + 2 * width, value) for k, value in printed.items() if value is not None]
    if shown:
        axes.plot(*zip(*shown, strict=True), "D", color="#d1495b", ms=5, label="mean in the paper")
    axes.set_xticks(places, [title_of(planner) for planner in found["axes"]], rotation=35, ha="right")
    axes.set_title("Four axes, with 95 % bootstrap intervals over scenarios")
    figure.legend(loc="outside right upper")
    return _png(figure)


def _pairs(found: dict[str, Any]) -> bytes:
    figure = _figure(13.5, 8.0)
    pairs = [(one, other) for k, one in enumerate(AXES) for other in AXES[k + 1 :]]
    for place, (one, other) in enumerate(pairs, 1):
        axes = figure.add_subplot(2, 3, place)
        for planner, row in found["axes"].items():
            style = {"ms": 8, "label": title_of(planner)} if planner in PLANNERS else {"ms": 5}
            axes.plot(row["scores"][one], row["scores"][other], "o", color=_color(planner), **style)
        axes.set(xlabel=one.replace("_", " "), ylabel=other.replace("_", " "))
        axes.margins(0.2)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(PLANNERS))
    figure.suptitle("The axes in pairs; gray: generic planners")
    return _png(figure)


def _deltas(found: dict[str, Any]) -> bytes:
    """Draw relative changes with their sign set so that TA*+Smooth is better on the right."""
    more_is_better = {"five_ray_mean", "clearance_min_m", "smoothness_score"}
    shown = {"blocked_fraction", "length_m", "accel_rms_mps2", "jerk_rms_mps3"} | more_is_better
    figure, rows = _figure(9.0, 4.5), []
    for name, title, _ in reversed(FIGURES):
        base = found["means"]["muco"][name]
        if name in shown and base:
            sign = 100.0 / base * (1.0 if name in more_is_better else -1.0)
            words = title if name in more_is_better else f"less {title}"
            rows.append((words, sign * (found["deltas"][name]["delta"] or 0.0)))
    axes = figure.add_subplot()
    for place, (_, change) in enumerate(rows):
        axes.barh(place, change, color=_color("track_astar") if change >= 0 else _color("muco"))
        axes.annotate(f"{change:+.1f} %", (max(change, 0.0), place), xytext=(6, -4), textcoords="offset points")
    axes.axvline(0.0, color="black", lw=0.8)
    axes.set_yticks(range(len(rows)), [words for words, _ in rows])
    axes.margins(x=0.15)
    axes.set_xlabel("relative to MuCO, %; to the right TA* + Smooth is better")
    axes.set_title("TA* + Smooth against MuCO")
    return _png(figure)


def _trajectories(found: dict[str, Any], planned: dict[str, PlannedItem], box_map: BoxMap) -> bytes:
    """Draw the scenarios in which the visibility of TA*+Smooth exceeds that of MuCO most."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    def gain(path_id: str) -> float:
        one, other = (found["figures"][planner][found["scenarios"].index(path_id)] or {} for planner in PAIR)
        return one.get("five_ray_mean", 0.0) - other.get("five_ray_mean", 0.0)

    figure = _figure(14.0, 11.0)
    for place, path_id in enumerate(sorted(planned, key=gain, reverse=True)[:NUM_SHOWN], 1):
        traces = planned[path_id].read_traces(path_id)
        points = np.concatenate([trace.positions_m for trace in traces.values()])
        targets = next(iter(traces.values())).targets_m
        low, high = np.minimum(points.min(axis=0), targets.min(axis=0)), points.max(axis=0)
        axes = figure.add_subplot(2, 2, place, projection="3d")
        near = (np.abs(box_map.centers - (low + high) / 2) <= (high - low) / 2 + ROOM_M)[:, :2].all(axis=1)
        near &= ~box_map.is_any_of(NO_OBSTACLE_KINDS) & (box_map.half_extents[:, 2] >= LEAST_M / 2.0)
        turns = rotation_matrices(np.radians(box_map.rotations_deg[near]))
        corners = np.einsum("kij,ksj->ksi", turns, CORNER_SIGNS * box_map.half_extents[near][:, None])
        faces = (corners + box_map.centers[near][:, None])[:, FACES, :].reshape(-1, 4, 3)
        axes.add_collection3d(Poly3DCollection(faces, facecolor="#b9b9b9", edgecolor="#909090", lw=0.2, alpha=0.12))
        for planner, trace in reversed(traces.items()):
            style = {"lw": 2.2, "label": title_of(planner)} if planner in PLANNERS else {"lw": 0.8}
            axes.plot(*trace.positions_m.T, color=_color(planner), **style)
        axes.plot(*targets.T, "--", color="black", lw=1.5, label="pedestrian")
        low[2] = targets[:, 2].min() - TARGET_HEIGHT_M
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.15)
        axes.locator_params(nbins=5)
        axes.set_title(f"{path_id}: visibility {gain(path_id):+.3f}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle("Largest gains in visibility of TA* + Smooth over MuCO; gray: generic planners")
    return _png(figure)
