"""`reacquire`: the walker disappears behind a house or a tree, the drone searches and finds again.

It begins low and away, where the map hides the walker for a while (a place is looked for, by chance), and goes on as it was while it
waits; then it climbs and swings behind the walker's last way until it sees. Judged by what came of it, not by the mean of sight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cosfly.planners.contract import PlanConfig, Scenario, Wish
from cosfly.planners.styles.courses import without_jumps
from cosfly.planners.styles.table import HIDING

if TYPE_CHECKING:
    from cosfly.kernels import BoxIndex

TRIES = 48
LOST_LEAST_S, LOST_MOST_S = 1.5, 15.0  # longest time without sight
BEFORE_S, AFTER_S = 2.0, 3.0  # seen at least so long before it is lost, and at the end
SEEN = 0.5  # mean visibility that counts as seen
WAITS_S = 2.0  # before it searches
CLIMBS_M, SEARCHES_FROM_M = (12.0, 26.0), (8.0, 16.0)  # while it searches: height gained, distance in the plane
FREE_SHARE = 0.9  # of the wished places that keep the safety distance; the planner finds ways round the rest


def wish_of_reacquire(
    scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> Wish | None:
    """Look for a flight that loses the walker and finds again; None where the map hides nobody on this walk."""
    from cosfly.kernels import signed_distances, visibility

    targets, ground = scenario.targets_m, scenario.ground_m
    for _ in range(TRIES):
        apart_m, altitude_m = rng.uniform(*HIDING.ground_distance_m), rng.uniform(*HIDING.altitude_m)
        bearing, climb_m, near_m = rng.uniform(-np.pi, np.pi), rng.uniform(*CLIMBS_M), rng.uniform(*SEARCHES_FROM_M)
        waiting = _wish(scenario, cfg, len(targets), bearing, (apart_m, apart_m), (altitude_m, altitude_m))
        lost = first_loss(visibility(obstacles, waiting.places_m(targets, ground), targets), scenario.dt_s)
        if lost is None:
            continue
        begin = lost + round(WAITS_S / scenario.dt_s)
        wish = _wish(scenario, cfg, begin, bearing, (apart_m, near_m), (altitude_m, altitude_m + climb_m))
        places = wish.places_m(targets, ground)
        gaps_m, _ = signed_distances(obstacles, places, cfg.safety_distance_m)
        is_free = gaps_m >= cfg.safety_distance_m
        if is_free.mean() >= FREE_SHARE and finds_again(visibility(obstacles, places, targets), scenario.dt_s):
            return wish
    return None


def _wish(scenario: Scenario, cfg: PlanConfig, begin: int, bearing: float, aparts_m: tuple, altitudes_m: tuple) -> Wish:
    """Stand at a bearing, and from frame `begin` on behind the walker, nearer and higher: (before, after)."""
    after = np.arange(len(scenario.targets_m)) >= begin
    azimuth = scenario.wish.heading_rad + np.where(after, np.pi if bearing >= 0 else -np.pi, bearing)
    apart_m, altitude_m = np.where(after, aparts_m[1], aparts_m[0]), np.where(after, altitudes_m[1], altitudes_m[0])
    wish = without_jumps(np.column_stack([azimuth, apart_m, altitude_m]), scenario, cfg)
    return replace(wish, keeps_sight=np.zeros(len(after), dtype=bool))


def first_loss(seen: np.ndarray, dt_s: float) -> int | None:
    """Give the first frame of a loss that follows a time of sight; None where there is none."""
    before = round(BEFORE_S / dt_s)
    for begin, end in _hidden_runs(seen):
        if begin >= before and (end - begin) * dt_s >= LOST_LEAST_S and seen[begin - before : begin].mean() >= SEEN:
            return begin
    return None


def finds_again(seen: np.ndarray, dt_s: float) -> bool:
    """Tell whether a walker is seen, lost, and seen at the end again; seen: (n,) five-ray visibility."""
    if first_loss(seen, dt_s) is None:
        return False
    longest_s = max(end - begin for begin, end in _hidden_runs(seen)) * dt_s
    return bool(longest_s <= LOST_MOST_S and seen[-round(AFTER_S / dt_s) :].mean() >= SEEN and seen[-1] > 0)


def _hidden_runs(seen: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen == 0, [0]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
