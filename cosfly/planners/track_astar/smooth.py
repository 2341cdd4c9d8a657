"""The smoothing of TA*+Smooth: shortcuts, then an elastic band, then a verdict (subsec:appendix_planner_tastar).

Only positions change; each keeps its frame and its target. A candidate is valid if the point keeps the safety distance, its
altitude and the speed limit, hits nothing on the way to its neighbours, and sees at most `visibility_loss_point` less than the
raw flight at that frame (five rays: a fifth is the least that can be lost, so nothing is).

The paper leaves open which waypoints are "flagged as visibility anchors". Were it all that see fully, almost none could move;
here it is those that see fully beside one that does not: the edges of an occlusion, which hold the path round it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cosfly.space.kernels import (
    RAY_SPREAD_M,
    BoxIndex,
    collect_hits,
    free_rays,
    nearest_box,
    signed_distances,
    visibility,
)
from cosfly.work.compiled import njit

if TYPE_CHECKING:
    from cosfly.planners.contract import PlanConfig, Scenario, TrackAStarConfig

ROUNDING_M = 1e-9
GAP, STEP = range(2)  # places in `limits`: least distance to boxes, longest step, m
LOW, HIGH = range(2)  # columns of `heights`, (n, 2): least and greatest z of each waypoint


def smooth_flight(
    raw: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, safety_m: float
) -> tuple[np.ndarray, dict]:
    """Smooth a raw flight; give it back as it is if the result is not accepted.

    Args:
        raw: (n, 3). safety_m: the distance that it keeps.
    Returns:
        (n, 3), and facts: shortcuts, elastic iterations, anchors, `smoothing`: `accepted` or the criterion that failed.
    """
    settings, wish = cfg.track_astar, scenario.wish
    raw = np.ascontiguousarray(raw, dtype=np.float64)
    targets = np.ascontiguousarray(scenario.targets_m, dtype=np.float64)
    seen = visibility(obstacles, raw, targets)
    floors = seen - settings.visibility_loss_point
    limits = np.array([safety_m, cfg.speed_max_mps * scenario.dt_s])
    heights = scenario.ground_m[:, None] + np.stack([wish.altitude_min_m, wish.altitude_max_m], axis=1)
    anchors = anchor_flags(seen, settings.anchor_visibility)
    points = raw.copy()
    num_shortcuts = shortcut(points, targets, floors, heights, obstacles, limits, settings.shortcut_frames)
    num_iterations = relax(
        points, targets, floors, heights, anchors, obstacles, limits,
        settings.elastic_iterations, settings.elastic_step, settings.elastic_step_min,
    )  # fmt: skip
    verdict = judge(points, seen, targets, obstacles, settings, safety_m)
    facts = {
        "shortcuts": int(num_shortcuts), "elastic_iterations": int(num_iterations), "anchors": int(anchors.sum()),
        "raw_visibility": round(float(seen.mean()), 4), "smoothing": verdict,
    }  # fmt: skip
    return (points if verdict == "accepted" else raw), facts


def anchor_flags(seen: np.ndarray, threshold: float) -> np.ndarray:
    """Flag frames that see more than `threshold` beside one that does not, (n,) bool."""
    full = seen > threshold
    beside = np.zeros(len(seen), dtype=bool)
    beside[1:] |= ~full[:-1]
    beside[:-1] |= ~full[1:]
    return full & beside


def judge(
    points: np.ndarray, seen_raw: np.ndarray, targets: np.ndarray, obstacles: BoxIndex, cfg: TrackAStarConfig, safety_m: float
) -> str:  # fmt: skip
    """Apply the three criteria to a smoothed flight; give `accepted`, or the name of the first that fails."""
    seen = visibility(obstacles, points, targets)
    if seen_raw.mean() - seen.mean() > cfg.visibility_loss_mean:
        return "mean_visibility"
    if (seen_raw - seen)[seen <= cfg.anchor_visibility].max(initial=0.0) > cfg.visibility_loss_frame:
        return "frame_visibility"
    if signed_distances(obstacles, points, safety_m)[0].min() < safety_m - ROUNDING_M:
        return "clearance"
    return "accepted"


# --- compiled ---------------------------------------------------------------------------------------------------------


@njit(cache=True)
def candidate_is_valid(x, y, z, target, floor, low, high, index, limits, blockers):
    """Tell whether a waypoint keeps distance, altitude (low to high) and sight. limits: (2,) m, places above."""
    if z < low - ROUNDING_M or z > high + ROUNDING_M:
        return False
    gap, _ = nearest_box(index, x, y, z, limits[GAP])
    if gap < limits[GAP]:
        return False
    if floor <= 0.0:
        return True
    count = collect_hits(index, target[0], target[1], target[2], x, y, z, RAY_SPREAD_M, blockers)
    return count == 0 or free_rays(index, blockers, count, x, y, z, target) >= floor


@njit(cache=True)
def step_is_valid(ax, ay, az, bx, by, bz, index, limits, one):
    """Tell whether a step between two valid waypoints is short enough and hits nothing."""
    length = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    if length > limits[STEP] + ROUNDING_M:
        return False
    # Both ends keep the safety distance: a step shorter than twice that reaches no box.
    return length < 2.0 * limits[GAP] or collect_hits(index, ax, ay, az, bx, by, bz, 0.0, one) == 0


@njit(cache=True)
def shortcut(points, targets, floors, heights, index, limits, frames_max):
    """Replace runs of up to `frames_max` waypoints by straight lines, in place, the longest that is valid first.

    Args:
        points, targets: (n, 3). floors: (n,) least visibility. heights: (n, 2), columns above.
    Returns:
        number of lines drawn.
    """
    blockers, one = np.empty(len(index.rows), dtype=np.int64), np.empty(1, dtype=np.int64)
    first, drawn, last = 0, 0, len(points) - 1
    while first < last - 1:
        step = 1
        for span in range(min(frames_max, last - first), 1, -1):
            if _line_is_valid(points, targets, floors, heights, first, span, index, limits, blockers, one):
                start, end = points[first].copy(), points[first + span].copy()
                for k in range(1, span):
                    points[first + k] = start + (end - start) * (k / span)
                step = span
                drawn += 1
                break
        first += step
    return drawn


@njit(cache=True)
def _line_is_valid(points, targets, floors, heights, first, span, index, limits, blockers, one):
    ax, ay, az = points[first, 0], points[first, 1], points[first, 2]
    dx, dy, dz = points[first + span, 0] - ax, points[first + span, 1] - ay, points[first + span, 2] - az
    px, py, pz = ax, ay, az
    for k in range(1, span + 1):
        x, y, z = ax + dx * (k / span), ay + dy * (k / span), az + dz * (k / span)
        i = first + k
        low, high = heights[i, LOW], heights[i, HIGH]
        if k < span and not candidate_is_valid(x, y, z, targets[i], floors[i], low, high, index, limits, blockers):
            return False
        if not step_is_valid(px, py, pz, x, y, z, index, limits, one):
            return False
        px, py, pz = x, y, z
    return True


@njit(cache=True)
def relax(points, targets, floors, heights, anchors, index, limits, iterations, step_first, step_least):
    """Draw each interior waypoint that is no anchor towards the middle of its neighbours, in place.

    A step that is not valid is halved down to `step_least`, then left out. Stops when no waypoint has moved.

    Returns:
        number of iterations.
    """
    blockers, one = np.empty(len(index.rows), dtype=np.int64), np.empty(1, dtype=np.int64)
    for iteration in range(iterations):
        moved = False
        for i in range(1, len(points) - 1):
            dx = 0.5 * (points[i - 1, 0] + points[i + 1, 0]) - points[i, 0]
            dy = 0.5 * (points[i - 1, 1] + points[i + 1, 1]) - points[i, 1]
            dz = 0.5 * (points[i - 1, 2] + points[i + 1, 2]) - points[i, 2]
            if anchors[i] or dx * dx + dy * dy + dz * dz < 1e-10:  # a hundredth of a millimetre
                continue
            step = step_first
            while step >= step_least:
                x, y, z = points[i, 0] + step * dx, points[i, 1] + step * dy, points[i, 2] + step * dz
                if (
                    candidate_is_valid(
                        x, y, z, targets[i], floors[i], heights[i, LOW], heights[i, HIGH], index, limits, blockers
                    )
                    and step_is_valid(points[i - 1, 0], points[i - 1, 1], points[i - 1, 2], x, y, z, index, limits, one)
                    and step_is_valid(x, y, z, points[i + 1, 0], points[i + 1, 1], points[i + 1, 2], index, limits, one)
                ):
                    points[i, 0], points[i, 1], points[i, 2] = x, y, z
                    moved = True
                    break
                step *= 0.5
        if not moved:
            return iteration + 1
    return iterations
