"""Where a flight begins its life: at the wished places where that works, else the best of a coarse search round the walker.

The wished places (the paper: 20 m behind the walker and as high) end up inside towers and behind corners. Pushing
each waypoint out of a tower on its own would put neighbours on opposite sides of it; the search here chooses places that can be
reached from each other: dynamic programming over time, places on rings round the target, edges that keep their distance to boxes.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from cosfly.planners.contract import PlanConfig, Wish
from cosfly.planners.muco.loss import GREATEST, PREFERRED, Problem
from cosfly.space.kernels import RAY_SPREAD_M, BoxIndex, collect_hits, free_rays, nearest_box
from cosfly.work.compiled import njit

# Places tried round the target: NUM_AZIMUTHS on each ring. The first ring is the normal one, the second steeper (into canyons);
# the others climb over what blocks the way and are tried only where the first two do not suffice.
STEEP_RADIUS, STEEP_CLIMB_M = 0.6, 6.0
NUM_CLIMBS = 5
NUM_AZIMUTHS = 18
MAX_TURN = 3  # azimuths between one key frame and the next: 60 degrees, 21 m on the normal ring in 3 s
BETWEEN_KEYS_S = 3.0

# Costs of the search, in units of "the target fully hidden for one key frame" = 1.
TURN_COST = 0.5  # looking from the side opposite to the wished one
TURN_COST_OF_STYLES = 8.0  # where the bearing is what the flight is for: 64 degrees are as dear as the hidden target
CLIMB_COST = 0.6  # each preferred altitude more
STEEP_COST = 0.1  # a ring other than the normal one
MOVE_COST, MOVE_SCALE_MPS = 0.25, 3.0  # (speed / scale)^2


def search_start(
    problem: Problem, wish: Wish, index: BoxIndex, cfg: PlanConfig, *, climbing: bool, clearance_m: float
) -> np.ndarray | None:
    """Find a free trajectory that sees the target well, by dynamic programming over key frames.

    Args:
        climbing: also try places higher than the normal and the steep ring.
    Returns:
        (n, 3), straight between key frames, every point and segment `clearance_m` from all boxes; None if there is none.
    """
    targets_m = problem.targets
    stride = max(1, round(BETWEEN_KEYS_S / problem.dt_s))
    keys = np.unique(np.append(np.arange(0, len(targets_m), stride), len(targets_m) - 1))
    # Between key frames the flight is straight while the ground may rise and fall: a key frame keeps the bounds of all around it.
    around = 2 * stride + 1
    preferred_m = maximum_filter1d(problem.altitudes[:, PREFERRED], around, mode="nearest")[keys]
    greatest_m = minimum_filter1d(problem.altitudes[:, GREATEST], around, mode="nearest")[keys]
    rings = _rings(wish.ground_distance_m[keys], preferred_m, greatest_m, climbing)
    azimuths = np.arange(NUM_AZIMUTHS) * (2.0 * np.pi / NUM_AZIMUTHS)
    angles = problem.views_rad[keys, None, None] + np.pi + azimuths[None, None, :]
    offsets = rings[:, :, 0, None]
    x = targets_m[keys, 0, None, None] + offsets * np.cos(angles)
    y = targets_m[keys, 1, None, None] + offsets * np.sin(angles)
    z = np.broadcast_to(rings[:, :, 1, None], x.shape)
    places = np.stack([x, y, z], axis=-1).reshape(len(keys), -1, 3)
    turns = np.minimum(azimuths, 2.0 * np.pi - azimuths) / np.pi
    climbs = np.maximum(rings[0, :, 1] - preferred_m[0], 0.0)[:, None] / 20.0
    turn_cost = TURN_COST if wish.any_bearing else TURN_COST_OF_STYLES
    extra = turn_cost * turns[None] ** 2 + CLIMB_COST * climbs + STEEP_COST * (np.arange(rings.shape[1]) > 0)[:, None]
    sight = wish.keeps_sight[keys]
    chosen = _search(places, targets_m[keys], keys * problem.dt_s, extra, sight, index, clearance_m, cfg.speed_max_mps)
    if chosen[0] < 0:
        return None
    path = places[np.arange(len(keys)), chosen]
    frames = np.arange(len(targets_m))
    return np.stack([np.interp(frames, keys, path[:, axis]) for axis in range(3)], axis=1)


def _rings(distances_m: np.ndarray, preferred_m: np.ndarray, greatest_m: np.ndarray, climbing: bool) -> np.ndarray:
    """Give (m, r, 2): horizontal distance and z of the rings of each key frame, the normal one first."""
    all_rings = []
    columns = (distances_m.tolist(), preferred_m.tolist(), greatest_m.tolist())
    for distance_m, preferred, greatest in zip(*columns, strict=True):
        rings = [(distance_m, preferred), (STEEP_RADIUS * distance_m, min(preferred + STEEP_CLIMB_M, greatest))]
        climbs = np.geomspace(8.0, max(greatest - preferred, 8.0), NUM_CLIMBS if climbing else 0)
        all_rings.append(rings + [(distance_m + 0.2 * climb, min(preferred + climb, greatest)) for climb in climbs])
    return np.array(all_rings)


@njit(cache=True)
def _search(places, targets, times, extra, sight, index, clearance_m, speed_max_mps):
    """Give the chosen place of each key frame, (m,), all -1 if no sequence of places is free.

    places: (m, c, 3), c = rings * azimuths. targets: (m, 3). times: (m,) s. extra: (rings, azimuths) cost of a place whatever
    is seen from it. sight: (m,) bool, whether what is seen counts.
    """
    num_keys, num_places, num_azimuths = len(places), places.shape[1], extra.shape[1]
    blockers, one = np.empty(len(index.rows), dtype=np.int64), np.empty(1, dtype=np.int64)
    cost, came_from = np.full((num_keys, num_places), np.inf), np.full((num_keys, num_places), -1, dtype=np.int64)
    own, guesses = np.empty(num_places), np.empty(num_places)
    for key in range(num_keys):
        for c in range(num_places):
            p, x = places[key, c], targets[key]
            gap, _ = nearest_box(index, p[0], p[1], p[2], clearance_m)
            own[c] = np.inf
            if gap >= clearance_m:
                seen = 1.0
                if sight[key]:
                    count = collect_hits(index, x[0], x[1], x[2], p[0], p[1], p[2], RAY_SPREAD_M, blockers)
                    seen = free_rays(index, blockers, count, p[0], p[1], p[2], x)
                own[c] = extra[c // num_azimuths, c % num_azimuths] + 1.0 - seen
        if key == 0:
            for c in range(num_places):
                cost[0, c] = own[c]
            continue
        seconds = times[key] - times[key - 1]
        for c in range(num_places):
            if own[c] == np.inf:
                continue
            p = places[key, c]
            for b in range(num_places):
                turn = abs(c % num_azimuths - b % num_azimuths)
                guesses[b] = np.inf
                if cost[key - 1, b] == np.inf or min(turn, num_azimuths - turn) > MAX_TURN:
                    continue
                q = places[key - 1, b]
                speed = np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2) / seconds
                if speed <= 0.9 * speed_max_mps:
                    guesses[b] = cost[key - 1, b] + MOVE_COST * (speed / MOVE_SCALE_MPS) ** 2
            while True:  # the cheapest way whose segment is free; most often the first one tried is
                b = int(np.argmin(guesses))
                if guesses[b] == np.inf:
                    break
                q = places[key - 1, b]
                if collect_hits(index, q[0], q[1], q[2], p[0], p[1], p[2], clearance_m, one) == 0:
                    cost[key, c], came_from[key, c] = guesses[b] + own[c], b
                    break
                guesses[b] = np.inf
    chosen = np.full(num_keys, -1, dtype=np.int64)
    last = int(np.argmin(cost[num_keys - 1]))
    if cost[num_keys - 1, last] < np.inf:
        chosen[num_keys - 1] = last
        for key in range(num_keys - 1, 0, -1):
            chosen[key - 1] = came_from[key, chosen[key]]
    return chosen
