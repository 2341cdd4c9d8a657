"""Five-ray visibility of one target from many points: boxes sorted by direction once, so that a query tests few."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.geometry import kernels
from cosfly.geometry.kernels import HALF_X, HALF_Y, HALF_Z, HIGH_X, HIGH_Y, HIGH_Z, LOW_X, LOW_Y, in_box_frame, touches
from cosfly.runtime.compiled import int64, njit

NUM_SECTORS = 128  # of the horizon round a target

# Feet of the five rays (RAY_OFFSETS_M): the lowest relative to the hip, and how far to the side.
FOOT_LOW_M, FOOT_SIDE_M = -0.6, 0.3
ALL_BLOCKED = 0b11111
ROUNDING = 1e-6


class Horizon(NamedTuple):
    """The m boxes near one target that can hide it, and by sector of directions (s = NUM_SECTORS)."""

    boxes: np.ndarray  # (m,)
    near: np.ndarray  # (m,) distance in the plane, less the spread of the rays, m
    slopes: np.ndarray  # (m,) a ray that rises more per horizontal metre passes above the box
    counts: np.ndarray  # (s,) number of boxes that reach into the sector
    lists: np.ndarray  # (s, m) those boxes
    steepest: np.ndarray  # (s,) largest of their slopes


@njit(cache=True)
def make_horizon(index, target, reach_m, least_slope):
    """Sort the boxes around a target by direction, so that `look` tests the few that can hide it.

    The horizon is valid for points within `reach_m` in the plane that rise at least `least_slope` per horizontal metre
    above the lowest foot of the rays; boxes that cannot hide the target from there are ignored. A ray that starts at
    height `low` or above and ends at height p_z and horizontal distance d has height low + (p_z - low) t at the share t
    of its length. It reaches a box at horizontal distance r at t = (r - FOOT_SIDE_M) / d or later.
    """
    boxes, near, slopes, spans = _boxes_round(index, target, reach_m, least_slope)
    counts = np.zeros(NUM_SECTORS, dtype=np.int64)
    lists = np.empty((NUM_SECTORS, len(boxes)), dtype=np.int64)
    steepest = np.full(NUM_SECTORS, -np.inf)
    for k in range(len(boxes)):
        first = int(np.floor(spans[k, 0] / (2.0 * np.pi) * NUM_SECTORS))
        last = int(np.floor(spans[k, 1] / (2.0 * np.pi) * NUM_SECTORS))
        for step in range(min(last - first + 1, NUM_SECTORS)):
            sector = (first + step) % NUM_SECTORS
            lists[sector, counts[sector]] = k
            counts[sector] += 1
            steepest[sector] = max(steepest[sector], slopes[k])
    return Horizon(boxes, near, slopes, counts, lists, steepest)


@njit(cache=True)
def _boxes_round(index, target, reach_m, least_slope):
    """Return the boxes in reach that are steep enough: number, distance, slope, and first and last azimuth (2,)."""
    boxes = np.empty(len(index.rows), dtype=np.int64)
    near, slopes, spans = np.empty(len(boxes)), np.empty(len(boxes)), np.empty((len(boxes), 2))
    num = 0
    if len(index.rows) == 0:
        return boxes, near, slopes, spans
    cell = index.grid[kernels.CELL]
    num_x = index.shape[0]
    num_y = index.shape[1]
    first_x = min(max(int(np.floor((target[0] - reach_m - index.grid[kernels.ORIGIN_X]) / cell)), 0), num_x)
    last_x = min(int(np.floor((target[0] + reach_m - index.grid[kernels.ORIGIN_X]) / cell)), num_x - 1)
    first_y = min(max(int(np.floor((target[1] - reach_m - index.grid[kernels.ORIGIN_Y]) / cell)), 0), num_y)
    last_y = min(int(np.floor((target[1] + reach_m - index.grid[kernels.ORIGIN_Y]) / cell)), num_y - 1)
    is_visited = np.zeros(len(index.rows), dtype=np.bool_)
    low = target[2] + FOOT_LOW_M
    for ix in range(first_x, last_x + 1):
        for iy in range(first_y, last_y + 1):
            for place in range(index.starts[ix * num_y + iy], index.starts[ix * num_y + iy + 1]):
                box = index.members[place]
                if is_visited[box]:
                    continue
                is_visited[box] = True
                rows = index.rows[box]
                dx = max(rows[LOW_X] - target[0], 0.0, target[0] - rows[HIGH_X])
                dy = max(rows[LOW_Y] - target[1], 0.0, target[1] - rows[HIGH_Y])
                distance = np.sqrt(dx * dx + dy * dy)
                if distance > reach_m + FOOT_SIDE_M or rows[HIGH_Z] < low:
                    continue
                boxes[num], near[num] = box, max(distance - FOOT_SIDE_M, 0.0)
                slopes[num] = (rows[HIGH_Z] - low) / near[num] if near[num] > 1e-6 else np.inf
                if slopes[num] < least_slope - ROUNDING:
                    continue
                spans[num, 0], spans[num, 1] = _span(rows, target, distance)
                num += 1
    return boxes[:num], near[:num], slopes[:num], spans[:num]


@njit(cache=True)
def _span(rows, target, distance_m):
    """Return the azimuths under which rays to a target may touch a box: those of its bounds, and the feet's spread."""
    if distance_m < 1.0:
        return 0.0, 2.0 * np.pi
    middle = np.arctan2(0.5 * (rows[LOW_Y] + rows[HIGH_Y]) - target[1], 0.5 * (rows[LOW_X] + rows[HIGH_X]) - target[0])
    left, right = 0.0, 0.0
    for corner in range(4):
        x, y = rows[LOW_X + 3 * (corner % 2)], rows[LOW_Y + 3 * (corner // 2)]
        turn = np.arctan2(y - target[1], x - target[0]) - middle
        turn -= 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
        left, right = min(left, turn), max(right, turn)
    spread = np.arcsin(FOOT_SIDE_M / distance_m) + 1e-9
    return middle + left - spread, middle + right + spread


@njit(cache=True, inline="always")
def look(index, horizon, target, x, y, z):
    """Return the five-ray visibility of the horizon's target from a point above it, as `kernels.visibility` does."""
    dx, dy = x - target[0], y - target[1]
    away, rise = np.sqrt(dx * dx + dy * dy), z - target[2] - FOOT_LOW_M
    sector = int(np.floor(np.arctan2(dy, dx) / (2.0 * np.pi) * NUM_SECTORS)) % NUM_SECTORS
    # In products, so that straight above needs no division; a box round the target itself is infinitely steep.
    if horizon.counts[sector] == 0 or rise > horizon.steepest[sector] * away + 1e-9:
        return 1.0
    blocked = int64(0)
    for place in range(horizon.counts[sector]):
        k = horizon.lists[sector, place]
        if horizon.near[k] <= away + 1e-9 and not rise > horizon.slopes[k] * away + 1e-9:
            blocked = _blocked_rays(index.rows, horizon.boxes[k], x, y, z, target, blocked)
            if blocked == ALL_BLOCKED:
                break
    num_free = int64(5)
    for ray in range(5):
        num_free -= (blocked >> ray) & 1
    return num_free / 5.0


@njit(cache=True)
def _blocked_rays(rows, box, x, y, z, target, blocked):
    """Add to the bits of `blocked` the rays to a target that touch a box."""
    tx, ty, tz, feet = target[0], target[1], target[2], kernels.RAY_OFFSETS_M
    if min(x, tx - FOOT_SIDE_M) > rows[box, HIGH_X] or max(x, tx + FOOT_SIDE_M) < rows[box, LOW_X]:
        return blocked
    if min(y, ty) > rows[box, HIGH_Y] or max(y, ty) < rows[box, LOW_Y] or tz + FOOT_LOW_M > rows[box, HIGH_Z]:
        return blocked
    u, v, w = in_box_frame(rows, box, x, y, z)
    hip_u, hip_v, hip_w = in_box_frame(rows, box, tx, ty, tz)
    # Every ray is within RAY_SPREAD_M of the middle one: far outside the box none is blocked (step 0), deep inside all
    # are (step 1). One loop, because the compiler takes seconds for each test that is written out.
    least = min(rows[box, HALF_X], rows[box, HALF_Y], rows[box, HALF_Z])
    for step in range(7):
        grown, a, b, c = 0.0, 0.0, 0.0, 0.0
        if step == 0:
            grown = kernels.RAY_SPREAD_M
        elif step == 1:
            if least < kernels.RAY_SPREAD_M:
                continue
            grown = -kernels.RAY_SPREAD_M
        elif (blocked >> (step - 2)) & 1:
            continue
        else:
            a, b, c = kernels.turned(rows, box, feet[step - 2, 0], feet[step - 2, 1], feet[step - 2, 2])
        hits = touches(rows, box, hip_u + a, hip_v + b, hip_w + c, u, v, w, grown)
        if step == 0 and not hits:
            return blocked
        if step == 1 and hits:
            return int64(ALL_BLOCKED)
        if step > 1 and hits:
            blocked |= 1 << (step - 2)
    return blocked
