"""The cache of MuCO between iterations: for each waypoint, the few boxes that can matter while it stays nearby.

A waypoint moves half a metre in an iteration, so the boxes around it and on the view of its target are the same for
several iterations. Results do not depend on the cache: for a waypoint that has moved away, or has too many boxes around
it, the index is queried.
"""

from typing import NamedTuple

import numpy as np

from cosfly.geometry.kernels import collect_hits, distance_if_nearer, nearest_box, segment_hits_box
from cosfly.runtime.compiled import njit

MARGIN_M = 1.5  # validity of an entry, three steps of the default cap; more caches more boxes, less queries more often
MOVED_M = 0.9  # an entry is updated beyond this, so that the trial steps of the next iteration stay within MARGIN_M
ROOM = 32  # boxes in one entry; a longer list is not cached


class Nearby(NamedTuple):
    """Cached boxes of n waypoints."""

    anchors: np.ndarray  # (n, 3) the waypoint when its boxes were queried, m; infinite if nothing is cached
    around: np.ndarray  # (n, ROOM) boxes within reach of the waypoint
    num_around: np.ndarray  # (n,) their number, -1 for more than ROOM
    on_view: np.ndarray  # (n, ROOM) boxes between the waypoint and its target
    num_on_view: np.ndarray  # (n,) their number, -1 for more than ROOM


@njit(cache=True)
def nothing_nearby(num_points):
    """Return an empty cache: every query goes to the index."""
    return Nearby(
        np.full((num_points, 3), np.inf), np.zeros((num_points, ROOM), dtype=np.int64),
        np.zeros(num_points, dtype=np.int64), np.zeros((num_points, ROOM), dtype=np.int64),
        np.zeros(num_points, dtype=np.int64),
    )  # fmt: skip


@njit(cache=True)
def remember(nearby, index, points, targets, reach_m, spread_m):
    """Update the entries of waypoints that have moved more than MOVED_M, in place.

    Args:
        points, targets: (n, 3) m. reach_m: greatest distance of boxes around a waypoint in later queries. spread_m:
            greatest growth of boxes on the view in later queries.
    """
    hits = np.empty(ROOM + 1, dtype=np.int64)
    for i in range(len(points)):
        p, target = points[i], targets[i]
        dx, dy, dz = p[0] - nearby.anchors[i, 0], p[1] - nearby.anchors[i, 1], p[2] - nearby.anchors[i, 2]
        if dx * dx + dy * dy + dz * dz <= MOVED_M * MOVED_M:
            continue
        nearby.anchors[i, 0], nearby.anchors[i, 1], nearby.anchors[i, 2] = p[0], p[1], p[2]
        # A segment of length 0 touches a grown box if it is nearer than the growth on each axis of the box's frame.
        reach_grown_m = reach_m + MARGIN_M
        count = collect_hits(index, p[0], p[1], p[2], p[0], p[1], p[2], reach_grown_m, hits)
        nearby.num_around[i] = count if count <= ROOM else -1
        _copy_row(hits, min(count, ROOM), nearby.around, i)
        spread_grown_m = spread_m + MARGIN_M
        count = collect_hits(index, target[0], target[1], target[2], p[0], p[1], p[2], spread_grown_m, hits)
        nearby.num_on_view[i] = count if count <= ROOM else -1
        _copy_row(hits, min(count, ROOM), nearby.on_view, i)


@njit(cache=True)
def _copy_row(hits, count, boxes, i):
    for k in range(count):  # the shape check of a slice assignment takes the compiler seconds
        boxes[i, k] = hits[k]


@njit(cache=True, inline="always")
def num_cached(anchors, numbers, i, x, y, z):
    """Return the number of cached boxes for waypoint i at (x, y, z), -1 where the index must be queried.

    numbers: num_around or num_on_view. Arrays are passed one by one: loss.py explains the cost of tuples.
    """
    dx, dy, dz = x - anchors[i, 0], y - anchors[i, 1], z - anchors[i, 2]
    return numbers[i] if dx * dx + dy * dy + dz * dz <= MARGIN_M * MARGIN_M else -1


@njit(cache=True)
def nearest_among(rows, boxes, i, count, x, y, z, reach_m):
    """Return the result of `nearest_box` among boxes[i, :count] only."""
    best, best_box = reach_m, -1
    for k in range(count):
        box = boxes[i, k]
        distance = distance_if_nearer(rows, box, x, y, z, best)
        if distance < best:
            best, best_box = distance, box
    return best, best_box


@njit(cache=True)
def nearest_of(nearby, i, index, x, y, z, reach_m):
    """Return the result of `nearest_box` for waypoint i at (x, y, z), from the cache where possible."""
    count = num_cached(nearby.anchors, nearby.num_around, i, x, y, z)
    if count < 0:
        return nearest_box(index, x, y, z, reach_m)
    return nearest_among(index.rows, nearby.around, i, count, x, y, z, reach_m)


@njit(cache=True)
def hits_among(rows, boxes, i, count, ax, ay, az, bx, by, bz, inflate_m, out):
    """Return the result of `collect_hits` among boxes[i, :count] only."""
    num_hits = 0
    for k in range(count):
        if segment_hits_box(rows, boxes[i, k], ax, ay, az, bx, by, bz, inflate_m):
            out[num_hits] = boxes[i, k]
            num_hits += 1
    return num_hits
