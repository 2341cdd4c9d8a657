"""The style `reacquire`: the target disappears behind a house or a tree, the drone searches and finds it again.

The drone starts low and away, at a place found at random from which the map hides the target for a while, and goes on
for a moment; then it climbs and moves behind the target's last heading until it sees the target. The trajectory is
judged by this outcome, not by its mean visibility.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cosfly.planners.contract import PlanConfig, Scenario, TrackingReference
from cosfly.planners.reference_trajectory import positions_of, without_jumps
from cosfly.planners.styles import REACQUIRE, Style

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

TRIES = 120
LOST_LEAST_S, LOST_MOST_S = 1.5, 15.0  # of the longest time without line of sight
BEFORE_S, AFTER_S = 2.0, 3.0  # seen at least this long before the loss, and at the end
SEEN = 0.5  # mean visibility that counts as seen
WAITS_S = 4.0  # before it searches
DEEP_LOSS_S = 5.0  # required of the drawn course, so that small moves of the planner keep the target hidden
LATE_SHARE = 0.5  # of the tries that follow the path of the target
FREE_SHARE = 1.0  # of the reference positions that keep the safety distance


def reacquire_reference(
    scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> TrackingReference | None:
    """Return a reference that loses the target and finds it again; None where the map does not hide the target."""
    from cosfly.geometry.kernels import signed_distances, visibility

    targets, ground, dt_s, style = scenario.targets_m, scenario.ground_m, scenario.dt_s, cfg.style(REACQUIRE)
    for _ in range(TRIES):
        course = _watching(style, scenario, rng)
        searches_m = style.ground_distance_end_m or style.ground_distance_m
        climb_m, near_m = rng.uniform(*style.climb_m), rng.uniform(*searches_m)
        seen = visibility(screens, positions_of(course, targets, ground), targets)
        lost = first_loss(seen, dt_s, DEEP_LOSS_S)
        if lost is None:
            continue
        searching = np.arange(len(course)) >= lost + round(WAITS_S / dt_s)
        course[searching, 0] = scenario.reference.heading_rad[searching] + np.pi
        course[searching, 1:] = near_m, course[lost, 2] + climb_m
        reference = without_jumps(course, scenario, cfg)
        places = reference.places_m(targets, ground)
        gaps_m, _ = signed_distances(obstacles, places, cfg.safety_distance_m)
        is_free = gaps_m >= cfg.safety_distance_m
        if is_free.mean() >= FREE_SHARE and finds_again(visibility(screens, places, targets), dt_s):
            return replace(reference, keeps_sight=np.zeros(len(course), dtype=bool))
    return None


def _watching(style: Style, scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Draw a course, (n, 3), before the loss: at a bearing from the target, or behind it along its path."""
    targets, heading_rad = scenario.targets_m, scenario.reference.heading_rad
    apart_m, altitude_m = rng.uniform(*style.ground_distance_m), rng.uniform(*style.altitude_m)
    bearing, is_late = rng.uniform(-np.pi, np.pi), rng.random() < LATE_SHARE
    azimuth, aparts_m = heading_rad + bearing, np.full(len(targets), apart_m)
    if is_late:
        along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(targets[:, :2], axis=0).T))])
        start = -apart_m * np.array([np.cos(heading_rad[0]), np.sin(heading_rad[0])])
        away = np.stack([np.interp(along_m - apart_m, along_m, targets[:, k]) for k in (0, 1)], axis=1)
        away += np.clip(1.0 - along_m / apart_m, 0.0, 1.0)[:, None] * start - targets[:, :2]
        azimuth, aparts_m = np.arctan2(away[:, 1], away[:, 0]), np.hypot(away[:, 0], away[:, 1])
    return np.column_stack([azimuth, aparts_m, np.full(len(targets), altitude_m)])


def first_loss(seen: np.ndarray, dt_s: float, least_s: float = LOST_LEAST_S) -> int | None:
    """Return the first frame of a loss of at least `least_s` after visible frames; None where there is none."""
    before = max(1, round(BEFORE_S / dt_s))
    for begin, end in _hidden_runs(seen):
        if begin >= before and (end - begin) * dt_s >= least_s and seen[begin - before : begin].mean() >= SEEN:
            return begin
    return None


def finds_again(seen: np.ndarray, dt_s: float) -> bool:
    """Return whether the target is visible, lost, and visible at the end; seen: (n,) five-ray visibility."""
    if first_loss(seen, dt_s) is None:
        return False
    longest_s = max(end - begin for begin, end in _hidden_runs(seen)) * dt_s
    return bool(longest_s <= LOST_MOST_S and seen[-max(1, round(AFTER_S / dt_s)) :].mean() >= SEEN and seen[-1] > 0)


def _hidden_runs(seen: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen == 0, [0]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
