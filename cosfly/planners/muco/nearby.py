"""A cache of MuCO between iterations: for each waypoint, the few boxes that can matter while it stays near a place.

A waypoint moves half a metre an iteration, so the boxes around it and between it and its target are the same for
several. Results do not depend on the cache: a waypoint that has left its place, or has too many boxes around it, is
looked up in the index.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.geometry.kernels import collect_hits, distance_to_box, nearest_box, segment_hits_box, squared_gap
from cosfly.runtime.compiled import njit

MARGIN_M = 1.5  # three steps of the default cap; more would remember more boxes, less would look up more often
MOVED_M = 0.9  # looked up again beyond this, so that the trial steps of the next iteration stay within MARGIN_M
ROOM = 32  # boxes cached for a waypoint; a longer list is not cached


class Nearby(NamedTuple):
    """Cached boxes of n waypoints.

    anchors: (n, 3) m, where the boxes were looked up; infinite where nothing is cached. around, on_view: (n, ROOM)
    boxes within reach of the waypoint, and across the view of its target. num_around, num_on_view: (n,) how many, -1
    for more than ROOM.
    """

    anchors: np.ndarray
    around: np.ndarray
    num_around: np.ndarray
    on_view: np.ndarray
    num_on_view: np.ndarray


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
    """Look up the boxes of waypoints that have moved since they were looked up, in place.

    Args:
        points, targets: (n, 3) m. reach_m, spread_m: greatest distance and growth of boxes in queries.
    """
    found = np.empty(ROOM + 1, dtype=np.int64)
    for i in range(len(points)):
        p, x = points[i], targets[i]
        dx, dy, dz = p[0] - nearby.anchors[i, 0], p[1] - nearby.anchors[i, 1], p[2] - nearby.anchors[i, 2]
        if dx * dx + dy * dy + dz * dz <= MOVED_M * MOVED_M:
            continue
        nearby.anchors[i, 0], nearby.anchors[i, 1], nearby.anchors[i, 2] = p[0], p[1], p[2]
        # A segment without length, grown: every box nearer than that on each axis of its own frame.
        grown = reach_m + MARGIN_M
        count = collect_hits(index, p[0], p[1], p[2], p[0], p[1], p[2], grown, found)
        nearby.num_around[i] = count if count <= ROOM else -1
        _keep(found, min(count, ROOM), nearby.around, i)
        count = collect_hits(index, x[0], x[1], x[2], p[0], p[1], p[2], spread_m + MARGIN_M, found)
        nearby.num_on_view[i] = count if count <= ROOM else -1
        _keep(found, min(count, ROOM), nearby.on_view, i)


@njit(cache=True)
def _keep(found, count, boxes, i):
    for k in range(count):  # the shape check of a slice assignment takes the compiler seconds
        boxes[i, k] = found[k]


@njit(cache=True, inline="always")
def known(anchors, numbers, i, x, y, z):
    """Return the number of cached boxes for a place of waypoint i, -1 where the index must be queried.

    numbers: num_around or num_on_view. Arrays are passed one by one: see loss.py on the cost of tuples.
    """
    dx, dy, dz = x - anchors[i, 0], y - anchors[i, 1], z - anchors[i, 2]
    return numbers[i] if dx * dx + dy * dy + dz * dz <= MARGIN_M * MARGIN_M else -1


@njit(cache=True)
def nearest_among(rows, boxes, i, count, x, y, z, reach_m):
    """Return what `nearest_box` does, of boxes[i, :count] only."""
    best, best_box = reach_m, -1
    for k in range(count):
        box = boxes[i, k]
        gap = squared_gap(rows, box, x, y, z)
        if gap > 0.0 and (best <= 0.0 or gap >= best * best):
            continue
        distance = distance_to_box(rows, box, x, y, z)
        if distance < best:
            best, best_box = distance, box
    return best, best_box


@njit(cache=True)
def nearest_of(nearby, i, index, x, y, z, reach_m):
    """Return what `nearest_box` does for a place of waypoint i, from the cache where possible."""
    count = known(nearby.anchors, nearby.num_around, i, x, y, z)
    if count < 0:
        return nearest_box(index, x, y, z, reach_m)
    return nearest_among(index.rows, nearby.around, i, count, x, y, z, reach_m)


@njit(cache=True)
def hits_among(rows, boxes, i, count, ax, ay, az, bx, by, bz, inflate_m, out):
    """Return what `collect_hits` does, of boxes[i, :count] only."""
    found = 0
    for k in range(count):
        if segment_hits_box(rows, boxes[i, k], ax, ay, az, bx, by, bz, inflate_m):
            out[found] = boxes[i, k]
            found += 1
    return found
