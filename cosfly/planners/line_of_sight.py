"""Five-ray visibility of one target from many points.

`kernels.visibility` searches the boxes for each point. A planner tests thousands of points around the same target, so
here the boxes around the target are sorted by direction once, and a point tests only those in its direction.
"""

from typing import NamedTuple

import numpy as np

from cosfly.geometry import kernels
from cosfly.geometry.kernels import HALF_X, HALF_Y, HALF_Z, HIGH_X, HIGH_Y, HIGH_Z, LOW_X, LOW_Y, in_box_frame, touches
from cosfly.runtime.compiled import int64, njit

NUM_SECTORS = 128  # equal sectors of azimuth around a target

# The rays end at RAY_OFFSETS_M from the target's hip: the lowest end, and the largest shift to the side.
LOWEST_END_M = float(kernels.RAY_OFFSETS_M[:, 2].min())
SIDE_END_M = float(kernels.RAY_OFFSETS_M[:, :2].max())
NUM_RAYS = len(kernels.RAY_OFFSETS_M)
ALL_BLOCKED = (1 << NUM_RAYS) - 1  # a bit for each ray
NO_DISTANCE_M = 1e-6  # a nearer box counts as one around the target
SLOPE_ROUNDING = 1e-6
ROUNDING_M = 1e-9


class Horizon(NamedTuple):
    """The m boxes near one target that can hide it, also by the sector in which they lie (s = NUM_SECTORS)."""

    boxes: np.ndarray  # (m,) rows of the boxes in the index
    nearest_m: np.ndarray  # (m,) horizontal distance from the nearest ray end to the box
    slopes: np.ndarray  # (m,) a ray that rises more per horizontal metre passes above the box; inf around the target
    counts: np.ndarray  # (s,) number of boxes in the sector
    lists: np.ndarray  # (s, m) these boxes, as places in `boxes`
    steepest: np.ndarray  # (s,) largest of their slopes


@njit(cache=True)
def make_horizon(index, target, reach_m, least_slope):
    """Sort the boxes around a target by direction.

    The horizon is valid for points at a horizontal distance of at most `reach_m` that rise at least `least_slope` per
    horizontal metre above the lowest ray end. It leaves out boxes that cannot hide the target from these points.

    Why a slope decides: a ray that ends at height `low_m` or above, and comes from a point at height z and horizontal
    distance d, has at least the height low_m + (z - low_m) t at the share t of its length. It reaches a box at
    horizontal distance r at t = (r - SIDE_END_M) / d or later.
    """
    boxes, nearest_m, slopes, spans_rad = _boxes_in_reach(index, target, reach_m, least_slope)
    counts = np.zeros(NUM_SECTORS, dtype=np.int64)
    lists = np.empty((NUM_SECTORS, len(boxes)), dtype=np.int64)
    steepest = np.full(NUM_SECTORS, -np.inf)
    for k in range(len(boxes)):
        first = int(np.floor(spans_rad[k, 0] / (2.0 * np.pi) * NUM_SECTORS))
        last = int(np.floor(spans_rad[k, 1] / (2.0 * np.pi) * NUM_SECTORS))
        for step in range(min(last - first + 1, NUM_SECTORS)):
            sector = (first + step) % NUM_SECTORS
            lists[sector, counts[sector]] = k
            counts[sector] += 1
            steepest[sector] = max(steepest[sector], slopes[k])
    return Horizon(boxes, nearest_m, slopes, counts, lists, steepest)


@njit(cache=True, inline="always")
def five_ray_visibility(index, horizon, target, x, y, z):
    """Return the share of free rays to the target of a horizon from a point above it, as `kernels.visibility` does."""
    dx, dy = x - target[0], y - target[1]
    away_m = np.sqrt(dx * dx + dy * dy)
    rise_m = z - target[2] - LOWEST_END_M
    sector = int(np.floor(np.arctan2(dy, dx) / (2.0 * np.pi) * NUM_SECTORS)) % NUM_SECTORS
    # A slope times a distance instead of a quotient, because a point straight above has the distance 0.
    if horizon.counts[sector] == 0 or rise_m > horizon.steepest[sector] * away_m + ROUNDING_M:
        return 1.0
    blocked = int64(0)
    for place in range(horizon.counts[sector]):
        k = horizon.lists[sector, place]
        is_between = horizon.nearest_m[k] <= away_m + ROUNDING_M
        if is_between and not rise_m > horizon.slopes[k] * away_m + ROUNDING_M:
            blocked = _blocked_rays(index.rows, horizon.boxes[k], x, y, z, target, blocked)
            if blocked == ALL_BLOCKED:
                break
    num_free = int64(NUM_RAYS)
    for ray in range(NUM_RAYS):
        num_free -= (blocked >> ray) & 1
    return num_free / NUM_RAYS


@njit(cache=True)
def _boxes_in_reach(index, target, reach_m, least_slope):
    """Return the boxes of a horizon: row in the index, distance, slope, and first and last azimuth (2,)."""
    boxes = np.empty(len(index.rows), dtype=np.int64)
    nearest_m, slopes, spans_rad = np.empty(len(boxes)), np.empty(len(boxes)), np.empty((len(boxes), 2))
    num = 0
    if len(index.rows) == 0:
        return boxes, nearest_m, slopes, spans_rad
    cell_m = index.grid[kernels.CELL]
    num_x = index.shape[0]
    num_y = index.shape[1]
    first_x = min(max(int(np.floor((target[0] - reach_m - index.grid[kernels.ORIGIN_X]) / cell_m)), 0), num_x)
    last_x = min(int(np.floor((target[0] + reach_m - index.grid[kernels.ORIGIN_X]) / cell_m)), num_x - 1)
    first_y = min(max(int(np.floor((target[1] - reach_m - index.grid[kernels.ORIGIN_Y]) / cell_m)), 0), num_y)
    last_y = min(int(np.floor((target[1] + reach_m - index.grid[kernels.ORIGIN_Y]) / cell_m)), num_y - 1)
    is_visited = np.zeros(len(index.rows), dtype=np.bool_)
    low_m = target[2] + LOWEST_END_M
    for ix in range(first_x, last_x + 1):
        for iy in range(first_y, last_y + 1):
            for place in range(index.starts[ix * num_y + iy], index.starts[ix * num_y + iy + 1]):
                box = index.members[place]
                if is_visited[box]:
                    continue
                is_visited[box] = True
                row = index.rows[box]
                dx = max(row[LOW_X] - target[0], 0.0, target[0] - row[HIGH_X])
                dy = max(row[LOW_Y] - target[1], 0.0, target[1] - row[HIGH_Y])
                away_m = np.sqrt(dx * dx + dy * dy)
                if away_m > reach_m + SIDE_END_M or row[HIGH_Z] < low_m:
                    continue
                boxes[num] = box
                nearest_m[num] = max(away_m - SIDE_END_M, 0.0)
                slopes[num] = (row[HIGH_Z] - low_m) / nearest_m[num] if nearest_m[num] > NO_DISTANCE_M else np.inf
                if slopes[num] < least_slope - SLOPE_ROUNDING:
                    continue
                spans_rad[num, 0], spans_rad[num, 1] = _azimuths_of(row, target, away_m)
                num += 1
    return boxes[:num], nearest_m[:num], slopes[:num], spans_rad[:num]


@njit(cache=True)
def _azimuths_of(row, target, away_m):
    """Return the first and last azimuth, rad, at which a ray may touch a box: the bounds of the box, and SIDE_END_M."""
    if away_m < 1.0:
        return 0.0, 2.0 * np.pi
    middle = np.arctan2(0.5 * (row[LOW_Y] + row[HIGH_Y]) - target[1], 0.5 * (row[LOW_X] + row[HIGH_X]) - target[0])
    left, right = 0.0, 0.0
    for corner in range(4):
        x, y = row[LOW_X + 3 * (corner % 2)], row[LOW_Y + 3 * (corner // 2)]  # the high bounds are 3 columns after
        turn = np.arctan2(y - target[1], x - target[0]) - middle
        turn -= 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
        left, right = min(left, turn), max(right, turn)
    margin = np.arcsin(SIDE_END_M / away_m) + 1e-9
    return middle + left - margin, middle + right + margin


@njit(cache=True)
def _blocked_rays(rows, box, x, y, z, target, blocked):
    """Return `blocked`, one bit per ray, with the bits of the rays that touch a box added."""
    tx, ty, tz, ends_m = target[0], target[1], target[2], kernels.RAY_OFFSETS_M
    if min(x, tx - SIDE_END_M) > rows[box, HIGH_X] or max(x, tx + SIDE_END_M) < rows[box, LOW_X]:
        return blocked
    if min(y, ty) > rows[box, HIGH_Y] or max(y, ty) < rows[box, LOW_Y] or tz + LOWEST_END_M > rows[box, HIGH_Z]:
        return blocked
    u, v, w = in_box_frame(rows, box, x, y, z)
    hip_u, hip_v, hip_w = in_box_frame(rows, box, tx, ty, tz)
    # All rays are within RAY_SPREAD_M of the ray to the hip. Step 0: if that ray misses the box grown by the spread, no
    # ray is blocked. Step 1: if it hits the box shrunk by the spread, all are. Steps 2 to 6 test each ray. It is one
    # loop, because the compiler takes seconds for each call of `touches` that is written out.
    thinnest_m = min(rows[box, HALF_X], rows[box, HALF_Y], rows[box, HALF_Z])
    for step in range(2 + NUM_RAYS):
        ray = step - 2  # negative for the ray to the hip
        grown_m, end_u, end_v, end_w = 0.0, 0.0, 0.0, 0.0
        if step == 0:
            grown_m = kernels.RAY_SPREAD_M
        elif step == 1:
            if thinnest_m < kernels.RAY_SPREAD_M:
                continue
            grown_m = -kernels.RAY_SPREAD_M
        elif (blocked >> ray) & 1:
            continue
        else:
            end_u, end_v, end_w = kernels.turned(rows, box, ends_m[ray, 0], ends_m[ray, 1], ends_m[ray, 2])
        hits = touches(rows, box, hip_u + end_u, hip_v + end_v, hip_w + end_w, u, v, w, grown_m)
        if step == 0 and not hits:
            return blocked
        if step == 1 and hits:
            return int64(ALL_BLOCKED)
        if step > 1 and hits:
            blocked |= 1 << ray
    return blocked
