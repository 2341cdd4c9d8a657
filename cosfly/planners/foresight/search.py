"""The cheapest sequence of places that sees the walker: dynamic programming over the key frames of a lattice.

Each key frame is looked from once, before any way is known, so the way is the best of all, and it leaves a place before the walker
is hidden from there. What it costs to fly a metre is the same in one stride as in several: a jump from ring to ring is what smoothing
makes a gentle change of.
"""

from __future__ import annotations

import numpy as np

from cosfly.planners.contract import PlanConfig, Scenario
from cosfly.planners.foresight.lattice import Lattice
from cosfly.planners.sight import FOOT_LOW_M, look, make_horizon
from cosfly.space.kernels import (
    HIGH_X,
    HIGH_Y,
    HIGH_Z,
    LOW_X,
    LOW_Y,
    LOW_Z,
    BoxIndex,
    collect_hits,
    distance_to_box,
    index_boxes,
    squared_gap,
)
from cosfly.work.compiled import njit

WAY_COST = 0.02  # of a metre, where "the walker hidden for one key frame" = 1
NEIGHBOUR_SHARE = 0.3  # of what is seen a key frame before and after: places that see only just do not last
SPEED_SHARE = 0.9  # of the limit: smoothing must be able to catch up
REACH_M = 12.0  # a box farther away than this is not asked after: two places this free have nothing between them


def search_flight(
    scenario: Scenario, lattice: Lattice, obstacles: BoxIndex, cfg: PlanConfig, clearance_m: float
) -> np.ndarray | None:
    """Search the raw flight of one walk.

    Args:
        obstacles: at least the boxes of the map that can be near the lattice or hide the walker.
        clearance_m: that points and the lines between them keep from all boxes.
    Returns:
        (n, 3), straight between key frames; None if no sequence of places is free.
    """
    frames, num_azimuths = lattice.frames, lattice.places_m.shape[2]
    places = lattice.places_m.reshape(len(frames), -1, 3)
    aloft = boxes_aloft(obstacles, scenario.targets_m, lattice)
    gaps, hidden = np.zeros(places.shape[:2]), np.ones(places.shape[:2])
    _survey(places, scenario.targets_m[frames], obstacles, aloft.rows, clearance_m, REACH_M, gaps, hidden)
    before, after = np.roll(hidden, 1, axis=0), np.roll(hidden, -1, axis=0)
    before[0], after[-1] = hidden[0], hidden[-1]
    own = (1.0 - 2.0 * NEIGHBOUR_SHARE) * hidden + NEIGHBOUR_SHARE * (before + after)
    own[~scenario.wish.keeps_sight[frames]] = 0.0
    own += lattice.costs.reshape(own.shape)
    longest_m = SPEED_SHARE * cfg.speed_max_mps * scenario.dt_s * np.diff(frames, prepend=0)
    chosen = _cheapest(
        places, own, gaps, longest_m, aloft, clearance_m, lattice.links, num_azimuths, lattice.max_turn, WAY_COST
    )
    if chosen[0] < 0:
        return None
    path, every = places[np.arange(len(frames)), chosen], np.arange(len(scenario.targets_m))
    return np.stack([np.interp(every, frames, path[:, axis]) for axis in range(3)], axis=1)


def boxes_aloft(obstacles: BoxIndex, targets_m: np.ndarray, lattice: Lattice) -> BoxIndex:
    """Index the boxes that may be within REACH_M of a place: most end far below a drone."""
    rows, aside_m = obstacles.rows, lattice.radius_max_m + REACH_M
    (low_x, low_y), (high_x, high_y) = targets_m[:, :2].min(axis=0) - aside_m, targets_m[:, :2].max(axis=0) + aside_m
    keep = rows[:, HIGH_Z] >= lattice.places_m[:, :, 0, 2].min() - REACH_M
    keep &= (
        (rows[:, HIGH_X] >= low_x)
        & (rows[:, LOW_X] <= high_x)
        & (rows[:, HIGH_Y] >= low_y)
        & (rows[:, LOW_Y] <= high_y)
    )
    rows = rows[keep]
    return index_boxes(rows[:, :3], rows[:, 3:6], rows[:, 6:15].reshape(-1, 3, 3), cell_m=2.0 * REACH_M)


@njit(cache=True)
def _survey(places, targets, index, aloft, clearance_m, reach_m, gaps, hidden):
    """Write the distance of each place to the nearest box, at most `reach_m`, and the hidden share of the walker, both (m, c).

    Places nearer than `clearance_m` keep what stands in `hidden`. aloft: rows of the boxes of `index` within `reach_m` of places.
    """
    near = np.empty(len(aloft), dtype=np.int64)
    for key in range(len(places)):
        target = targets[key]
        away_max, least_slope = 0.0, np.inf
        for c in range(places.shape[1]):
            away = np.sqrt((places[key, c, 0] - target[0]) ** 2 + (places[key, c, 1] - target[1]) ** 2)
            away_max = max(away_max, away)
            least_slope = min(least_slope, (places[key, c, 2] - target[2] - FOOT_LOW_M) / max(away, 1.0))
        horizon, num_near = make_horizon(index, target, away_max, least_slope), 0
        for box in range(len(aloft)):
            if squared_gap(aloft, box, target[0], target[1], aloft[box, LOW_Z]) <= (away_max + reach_m) ** 2:
                near[num_near] = box
                num_near += 1
        for c in range(places.shape[1]):
            x, y, z = places[key, c, 0], places[key, c, 1], places[key, c, 2]
            gap = reach_m
            for k in range(num_near):
                if gap >= clearance_m and squared_gap(aloft, near[k], x, y, z) < gap * gap:
                    gap = min(gap, distance_to_box(aloft, near[k], x, y, z))
            gaps[key, c] = gap
            if gap >= clearance_m:
                hidden[key, c] = 1.0 - look(index, horizon, target, x, y, z)


@njit(cache=True)
def _cheapest(places, own, gaps, longest_m, index, clearance_m, links, num_azimuths, max_turn, way_cost):
    """Give the chosen place of each key frame, (m,), all -1 if no sequence of places is free.

    places: (m, c, 3), c = rings * azimuths. own: (m, c) cost of a place. gaps: (m, c) m. longest_m: (m,) move into each key frame.
    links: (rings, r) rings that may be come from, the first -1 ends the list.
    """
    num_keys, num_places, one = len(places), places.shape[1], np.empty(1, dtype=np.int64)
    cost, came_from = np.full((num_keys, num_places), np.inf), np.full((num_keys, num_places), -1, dtype=np.int64)
    for key in range(num_keys):
        for c in range(num_places):
            if gaps[key, c] < clearance_m:
                continue
            if key == 0:
                cost[key, c] = own[key, c]
                continue
            x, y, z = places[key, c, 0], places[key, c, 1], places[key, c, 2]
            ring, azimuth, best = c // num_azimuths, c % num_azimuths, np.inf
            for trial in range(2 * max_turn + 1):  # 0, -1, 1, -2, 2: the nearest first rules most others out
                turn = (trial + 1) // 2 * (1 - 2 * (trial % 2))
                column = (azimuth + turn) % num_azimuths
                for link in range(links.shape[1]):
                    if links[ring, link] < 0:
                        break
                    b = links[ring, link] * num_azimuths + column
                    if cost[key - 1, b] >= best:
                        continue
                    u, v, w = places[key - 1, b, 0], places[key - 1, b, 1], places[key - 1, b, 2]
                    length = np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)
                    guess = cost[key - 1, b] + way_cost * length
                    if guess >= best or length > longest_m[key]:
                        continue
                    # Distance changes by at most a metre per metre: where both ends are freer than this, so is the line.
                    is_close = gaps[key, c] + gaps[key - 1, b] - length < 2.0 * clearance_m
                    if is_close and collect_hits(index, u, v, w, x, y, z, clearance_m, one) > 0:
                        continue
                    best, came_from[key, c] = guess, b
            cost[key, c] = best + own[key, c]
    chosen = np.full(num_keys, -1, dtype=np.int64)
    last = int(np.argmin(cost[num_keys - 1]))
    if cost[num_keys - 1, last] < np.inf:
        chosen[num_keys - 1] = last
        for key in range(num_keys - 1, 0, -1):
            chosen[key - 1] = came_from[key, chosen[key]]
    return chosen
