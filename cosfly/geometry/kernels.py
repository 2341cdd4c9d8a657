"""Compiled geometry of many oriented boxes: distance, outward normal, blocked segments, five-ray visibility.

`BoxIndex` sorts boxes into square cells of the xy plane, so that a query tests the few boxes near it. Functions that
take single coordinates are for other compiled code; those that take arrays check their arguments. Nothing here runs in
parallel: the stages distribute items over processes.
"""

from typing import NamedTuple

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.bystanders import Bystander
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.geometry.axes import rotation_matrices
from cosfly.runtime.compiled import njit

CELL_M = 8.0  # about the influence radius of obstacles: a distance query looks at nine cells
MAX_CELLS = 1 << 18  # bounds the memory for a map with a stray box far away

# Kinds that neither collide nor hide a person: surfaces, water, and labels without a body.
NO_OBSTACLE_KINDS = GROUND_KINDS | {KINDS["Water"], KINDS["Sky"]}

# Ends of the five rays relative to the target's hip point, m (subsec:appendix_planner_tastar).
RAY_OFFSETS_M = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.8], [0.0, 0.0, -0.6], [0.3, 0.0, 0.0], [-0.3, 0.0, 0.0]])
RAY_SPREAD_M = 0.8  # the longest of the offsets
CORNER = 3.0**0.5  # times the growth of a rotated box: the largest growth of its axis-aligned bounds

# Columns of BoxIndex.rows; u, v, w are the axes of a box's own frame: x = XU u + XV v + XW w + CENTER_X.
CENTER_X, CENTER_Y, CENTER_Z, HALF_X, HALF_Y, HALF_Z, XU, XV, XW, YU, YV, YW, ZU, ZV, ZW = range(15)
LOW_X, LOW_Y, LOW_Z, HIGH_X, HIGH_Y, HIGH_Z = range(15, 21)
ORIGIN_X, ORIGIN_Y, CELL = range(3)  # indices into BoxIndex.grid


class BoxIndex(NamedTuple):
    """k oriented boxes and the cells that hold them.

    Cell c = ix * shape[1] + iy holds members[starts[c]:starts[c + 1]]. A row has three cache lines.
    """

    rows: np.ndarray  # (k, 21) m: centre, half extents, world_from_box row by row, corners of the axis-aligned bounds
    grid: np.ndarray  # (3,) low corner of cell (0, 0) and cell size, m
    shape: np.ndarray  # (2,) cells along x and y
    starts: np.ndarray  # (cells + 1,)
    members: np.ndarray  # (m,) rows


# --- building ---------------------------------------------------------------------------------------------------------


def index_boxes(
    centers: np.ndarray, half_extents: np.ndarray, rotations: np.ndarray, *, cell_m: float = CELL_M
) -> BoxIndex:
    """Sort boxes into cells.

    Args:
        centers, half_extents: (k, 3) m.
        rotations: (k, 3, 3) world_from_box.
        cell_m: Side of a cell; it is doubled until a vast map has at most MAX_CELLS.
    """
    centers, half_extents, rotations = map(_points, (centers, half_extents, rotations))
    spans = np.einsum("kij,kj->ki", np.abs(rotations), half_extents)
    mins, maxs = centers - spans, centers + spans
    low = mins[:, :2].min(axis=0) if len(centers) else np.zeros(2)
    high = maxs[:, :2].max(axis=0) if len(centers) else np.zeros(2)
    while np.prod(np.floor((high - low) / cell_m) + 1) > MAX_CELLS:
        cell_m *= 2.0
    shape = (np.floor((high - low) / cell_m) + 1).astype(np.int64)
    first = np.floor((mins[:, :2] - low) / cell_m).astype(np.int64).clip(0, shape - 1)
    last = np.floor((maxs[:, :2] - low) / cell_m).astype(np.int64).clip(0, shape - 1)
    starts, members = _fill_cells(first, last, shape)
    rows = np.column_stack([centers, half_extents, rotations.reshape(-1, 9), mins, maxs])
    return BoxIndex(np.ascontiguousarray(rows), np.array([low[0], low[1], cell_m]), shape, starts, members)


def obstacle_index(box_map: BoxMap) -> BoxIndex:
    """Index the boxes of a map that a drone can hit or that can hide a person (all but NO_OBSTACLE_KINDS)."""
    solid = box_map.select(~box_map.is_any_of(NO_OBSTACLE_KINDS))
    return index_boxes(solid.centers, solid.half_extents, rotation_matrices(np.radians(solid.rotations_deg)))


def _fill_cells(first: np.ndarray, last: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and members of BoxIndex, the boxes of a cell in order. first, last: (k, 2) cells of a box."""
    spans = last - first + 1
    counts = spans.prod(axis=1)
    boxes = np.repeat(np.arange(len(first)), counts)  # one entry for each cell of each box
    cell_of_box = np.arange(len(boxes)) - np.repeat(np.cumsum(counts) - counts, counts)  # from 0 for each box
    along_x, along_y = np.divmod(cell_of_box, spans[boxes, 1])
    cells = (first[boxes, 0] + along_x) * shape[1] + first[boxes, 1] + along_y
    starts = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=int(shape.prod())))])
    return starts, boxes[np.argsort(cells, kind="stable")]


# --- one box ----------------------------------------------------------------------------------------------------------
# Single numbers of a row are read, not slices: a slice costs two atomic reference counts, more than the arithmetic.


@njit(cache=True, inline="always")
def in_box_frame(rows, box, x, y, z):
    """Return the coordinates of a world point in a box's frame."""
    return turned(rows, box, x - rows[box, CENTER_X], y - rows[box, CENTER_Y], z - rows[box, CENTER_Z])


@njit(cache=True, inline="always")
def turned(rows, box, dx, dy, dz):
    """Turn a world vector into a box's frame."""
    return (
        rows[box, XU] * dx + rows[box, YU] * dy + rows[box, ZU] * dz,
        rows[box, XV] * dx + rows[box, YV] * dy + rows[box, ZV] * dz,
        rows[box, XW] * dx + rows[box, YW] * dy + rows[box, ZW] * dz,
    )


@njit(cache=True)
def distance_to_box(rows, box, x, y, z):
    """Return the signed distance of a point to a box, m: negative inside (depth below the nearest face)."""
    u, v, w = in_box_frame(rows, box, x, y, z)
    qx, qy, qz = abs(u) - rows[box, HALF_X], abs(v) - rows[box, HALF_Y], abs(w) - rows[box, HALF_Z]
    deepest = max(qx, qy, qz)
    if deepest <= 0.0:
        return deepest
    px, py, pz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    return np.sqrt(px * px + py * py + pz * pz)


@njit(cache=True, inline="always")
def squared_gap(rows, box, x, y, z):
    """Return the squared distance of a point to the axis-aligned bounds of a box, m^2; the box is no nearer."""
    dx = max(rows[box, LOW_X] - x, 0.0, x - rows[box, HIGH_X])
    dy = max(rows[box, LOW_Y] - y, 0.0, y - rows[box, HIGH_Y])
    dz = max(rows[box, LOW_Z] - z, 0.0, z - rows[box, HIGH_Z])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, inline="always")
def distance_if_nearer(rows, box, x, y, z, best):
    """Return the signed distance of a point to a box, m, or `best` if the bounds of the box are no nearer than that."""
    gap = squared_gap(rows, box, x, y, z)
    distance = best
    if gap <= 0.0 or (best > 0.0 and gap < best * best):
        distance = distance_to_box(rows, box, x, y, z)
    return distance


@njit(cache=True)
def normal_of_box(rows, box, x, y, z):
    """Return the unit vector away from a box at a point: from the nearest surface point or, inside, face.

    A tie between faces goes to the first axis, a point in the middle plane to the positive side.
    """
    u, v, w = in_box_frame(rows, box, x, y, z)
    qx, qy, qz = abs(u) - rows[box, HALF_X], abs(v) - rows[box, HALF_Y], abs(w) - rows[box, HALF_Z]
    sx, sy, sz = (1.0 if u >= 0 else -1.0), (1.0 if v >= 0 else -1.0), (1.0 if w >= 0 else -1.0)
    a, b, c = max(qx, 0.0) * sx, max(qy, 0.0) * sy, max(qz, 0.0) * sz
    length = np.sqrt(a * a + b * b + c * c)
    if length > 0.0:
        a, b, c = a / length, b / length, c / length
    elif qx >= qy and qx >= qz:
        a, b, c = sx, 0.0, 0.0
    elif qy >= qz:
        a, b, c = 0.0, sy, 0.0
    else:
        a, b, c = 0.0, 0.0, sz
    return (
        rows[box, XU] * a + rows[box, XV] * b + rows[box, XW] * c,
        rows[box, YU] * a + rows[box, YV] * b + rows[box, YW] * c,
        rows[box, ZU] * a + rows[box, ZV] * b + rows[box, ZW] * c,
    )


@njit(cache=True, inline="always")
def clip(origin, direction, half, enter, leave):
    """Clip the part [enter, leave] of a segment to one slab; enter > leave means nothing is left."""
    if abs(direction) < 1e-12:
        return (enter, leave) if abs(origin) <= half else (1.0, 0.0)
    near, far = (-half - origin) / direction, (half - origin) / direction
    return max(enter, min(near, far)), min(leave, max(near, far))


@njit(cache=True, inline="always")
def touches(rows, box, a, b, c, u, v, w, inflate_m):
    """Return whether a segment from (a, b, c) to (u, v, w) in a box's frame touches the box grown by `inflate_m`.

    Source: Slab method, Kay and Kajiya 1986.
    """
    enter, leave = clip(a, u - a, rows[box, HALF_X] + inflate_m, 0.0, 1.0)
    enter, leave = clip(b, v - b, rows[box, HALF_Y] + inflate_m, enter, leave)
    enter, leave = clip(c, w - c, rows[box, HALF_Z] + inflate_m, enter, leave)
    return enter <= leave


@njit(cache=True)
def segment_hits_box(rows, box, ax, ay, az, bx, by, bz, inflate_m):
    """Return whether a segment touches a box grown by `inflate_m` on every side."""
    if min(ax, bx) > rows[box, HIGH_X] + inflate_m or max(ax, bx) < rows[box, LOW_X] - inflate_m:
        return False
    if min(ay, by) > rows[box, HIGH_Y] + inflate_m or max(ay, by) < rows[box, LOW_Y] - inflate_m:
        return False
    if min(az, bz) > rows[box, HIGH_Z] + inflate_m or max(az, bz) < rows[box, LOW_Z] - inflate_m:
        return False
    a, b, c = in_box_frame(rows, box, ax, ay, az)
    u, v, w = in_box_frame(rows, box, bx, by, bz)
    return touches(rows, box, a, b, c, u, v, w, inflate_m)


@njit(cache=True)
def segment_to_box(rows, box, ax, ay, az, bx, by, bz):
    """Return the least distance of a segment to a box, m, 0 where it touches, and the share of its way where that is.

    Along a line the squared distance is convex, and a parabola between the points where it crosses the planes of the
    six faces: its slope is linear there, and zero where the distance is least. So the slope is computed at these points
    and at both ends; `low` and `high` become the last share with a falling and the first with a rising distance.
    """
    u, v, w = in_box_frame(rows, box, ax, ay, az)
    p, q, r = turned(rows, box, bx - ax, by - ay, bz - az)
    starts = (u, v, w)
    ways = (p, q, r)
    low, low_slope = 0.0, -np.inf
    high, high_slope = 1.0, np.inf
    for candidate in range(8):  # 0 to 5: the faces, two on each axis; 6 and 7: the ends
        share = float(candidate - 6)
        if candidate < 6:
            axis = candidate // 2
            if abs(ways[axis]) < 1e-12:
                continue
            side = 1 - 2 * (candidate % 2)
            share = (side * rows[box, HALF_X + axis] - starts[axis]) / ways[axis]
            if not 0.0 < share < 1.0:
                continue
        slope = 0.0
        for axis in range(3):
            x = starts[axis] + share * ways[axis]
            half = rows[box, HALF_X + axis]
            slope += (x - min(max(x, -half), half)) * ways[axis]
        if slope <= 0.0 and share >= low:
            low, low_slope = share, slope
        if slope >= 0.0 and share <= high:
            high, high_slope = share, slope
    if high <= low or low_slope == -np.inf or high_slope == np.inf:
        share = low if low_slope > -np.inf else high
    else:
        share = low - low_slope * (high - low) / max(high_slope - low_slope, 1e-300)
    squared = 0.0
    for axis in range(3):
        squared += max(abs(starts[axis] + share * ways[axis]) - rows[box, HALF_X + axis], 0.0) ** 2
    return np.sqrt(squared), share


# --- many boxes, one query --------------------------------------------------------------------------------------------


@njit(cache=True)
def nearest_box(index, x, y, z, reach_m):
    """Return (signed distance, box) of the nearest box, or (reach_m, -1) if none is nearer than `reach_m`.

    Rings of cells are searched outwards until no unseen box can be nearer.
    """
    best, best_box = reach_m, -1
    if len(index.rows) == 0:
        return best, best_box
    num_x, num_y = index.shape[0], index.shape[1]
    # The grid is convex: from outside, the distance from its nearest point is a lower bound.
    gx = min(max((x - index.grid[ORIGIN_X]) / index.grid[CELL], 0.0), float(num_x))
    gy = min(max((y - index.grid[ORIGIN_Y]) / index.grid[CELL], 0.0), float(num_y))
    cx, cy = min(int(gx), num_x - 1), min(int(gy), num_y - 1)
    border_m = min(gx - cx, cx + 1 - gx, gy - cy, cy + 1 - gy) * index.grid[CELL]
    for ring in range(max(cx, num_x - 1 - cx, cy, num_y - 1 - cy) + 1):
        if ring > 0 and (ring - 1) * index.grid[CELL] + border_m >= best:
            break
        for ix in range(max(cx - ring, 0), min(cx + ring, num_x - 1) + 1):
            # A column inside the ring has two cells of it, a column at its edge all.
            step = 1 if ring == 0 or abs(ix - cx) == ring else 2 * ring
            for iy in range(cy - ring, cy + ring + 1, step):
                if iy < 0 or iy >= num_y:
                    continue
                cell = ix * num_y + iy
                for place in range(index.starts[cell], index.starts[cell + 1]):
                    box = index.members[place]
                    distance = distance_if_nearer(index.rows, box, x, y, z, best)
                    if distance < best:
                        best, best_box = distance, box
    return best, best_box


@njit(cache=True)
def collect_hits(index, ax, ay, az, bx, by, bz, inflate_m, out):
    """Write the boxes that a segment touches, grown by `inflate_m`, to `out` and return their number.

    The search stops when `out` is full, so an `out` of length 1 tests whether there is any.
    """
    num_hits = 0
    if len(index.rows) == 0 or len(out) == 0:
        return num_hits
    num_x, num_y = index.shape[0], index.shape[1]
    ox, oy, cell = index.grid[ORIGIN_X], index.grid[ORIGIN_Y], index.grid[CELL]
    reach = CORNER * inflate_m
    first_x = max(int(np.floor((min(ax, bx) - reach - ox) / cell)), 0)
    last_x = min(int(np.floor((max(ax, bx) + reach - ox) / cell)), num_x - 1)
    dx = bx - ax
    for ix in range(first_x, last_x + 1):
        t0, t1 = 0.0, 1.0  # the part of the segment within reach of this column of cells
        if abs(dx) > 1e-12:
            t0, t1 = (ox + ix * cell - reach - ax) / dx, (ox + (ix + 1) * cell + reach - ax) / dx
            if t0 > t1:
                t0, t1 = t1, t0
            t0, t1 = max(t0 - 1e-9, 0.0), min(t1 + 1e-9, 1.0)
        y0, y1 = ay + t0 * (by - ay), ay + t1 * (by - ay)
        first_y = max(int(np.floor((min(y0, y1) - reach - oy) / cell)), 0)
        last_y = min(int(np.floor((max(y0, y1) + reach - oy) / cell)), num_y - 1)
        for iy in range(first_y, last_y + 1):
            for place in range(index.starts[ix * num_y + iy], index.starts[ix * num_y + iy + 1]):
                box = index.members[place]
                is_listed = False
                for k in range(num_hits):
                    is_listed = is_listed or out[k] == box
                if not is_listed and segment_hits_box(index.rows, box, ax, ay, az, bx, by, bz, inflate_m):
                    out[num_hits] = box
                    num_hits += 1
                    if num_hits == len(out):
                        return num_hits
    return num_hits


@njit(cache=True)
def free_rays(index, boxes, num_boxes, x, y, z, target):
    """Return the fraction of the five rays from a point to a target that none of `boxes[:num_boxes]` touches."""
    free = 0
    for ray in range(5):
        tx = target[0] + RAY_OFFSETS_M[ray, 0]
        ty = target[1] + RAY_OFFSETS_M[ray, 1]
        tz = target[2] + RAY_OFFSETS_M[ray, 2]
        is_blocked = False
        for k in range(num_boxes):
            if segment_hits_box(index.rows, boxes[k], tx, ty, tz, x, y, z, 0.0):
                is_blocked = True
                break
        if not is_blocked:
            free += 1
    return free / 5.0


# --- arrays -----------------------------------------------------------------------------------------------------------


def signed_distances(index: BoxIndex, points: np.ndarray, reach_m: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distance to the nearest box for many points.

    Args:
        points: (n, 3) m.
        reach_m: Boxes farther away are ignored.
    Returns:
        (n,) m, at most reach_m, and (n,) the nearest box, -1 where there is none in reach (k == 0 too).
    """
    return _signed_distances(index, _points(points), float(reach_m))


@njit(cache=True)
def _signed_distances(index, points, reach_m):
    distances = np.empty(len(points))
    boxes = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        distances[i], boxes[i] = nearest_box(index, points[i, 0], points[i, 1], points[i, 2], reach_m)
    return distances, boxes


def normals(index: BoxIndex, points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the unit vectors away from boxes (k,) at points (k, 3), (k, 3), as `normal_of_box` does."""
    return _normals(index, _points(points), np.ascontiguousarray(boxes, dtype=np.int64))


@njit(cache=True)
def _normals(index, points, boxes):
    units = np.empty((len(points), 3))
    for i in range(len(points)):
        units[i] = normal_of_box(index.rows, boxes[i], points[i, 0], points[i, 1], points[i, 2])
    return units


def segments_hit(index: BoxIndex, starts: np.ndarray, ends: np.ndarray, inflate_m: float = 0.0) -> np.ndarray:
    """Return which segments touch any box grown by `inflate_m` on every side.

    Args:
        starts, ends: (n, 3) m.
    Returns:
        (n,) bool. Touching a face counts, lying inside too. k == 0 gives all False.
    """
    return _segments_hit(index, _points(starts), _points(ends), float(inflate_m))


@njit(cache=True)
def _segments_hit(index, starts, ends, inflate_m):
    hits = np.zeros(len(starts), dtype=np.bool_)
    first_hit = np.empty(1, dtype=np.int64)
    for i in range(len(starts)):
        a, b = starts[i], ends[i]
        hits[i] = collect_hits(index, a[0], a[1], a[2], b[0], b[1], b[2], inflate_m, first_hit) > 0
    return hits


def swept_distances(index: BoxIndex, points: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the least distance to boxes on the segment from each point to the next; at the last point, its own.

    Args:
        points: (n, 3) m.
        reach_m: Boxes farther away are ignored.
    Returns:
        (n,) m, at most reach_m, negative only where an end of the segment is inside a box, 0 where it passes through
        one; (n,) the share of the segment where that is; (n,) the box, -1 where none is in reach.
    """
    return _swept_distances(index, _points(points), float(reach_m))


@njit(cache=True)
def _swept_distances(index, points, reach_m):
    num = len(points)
    distances, boxes = _signed_distances(index, points, reach_m)
    point_distances = distances.copy()
    shares = np.zeros(num)
    near = np.empty(len(index.rows), dtype=np.int64)
    for i in range(num - 1):
        a, b = points[i], points[i + 1]
        if distances[i + 1] < distances[i]:
            distances[i], shares[i], boxes[i] = distances[i + 1], 1.0, boxes[i + 1]
        length = np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        # Distance changes by at most a metre per metre.
        if distances[i] <= 0.0 or point_distances[i] + point_distances[i + 1] - length >= 2.0 * distances[i]:
            continue
        for k in range(collect_hits(index, a[0], a[1], a[2], b[0], b[1], b[2], distances[i], near)):
            distance, share = segment_to_box(index.rows, near[k], a[0], a[1], a[2], b[0], b[1], b[2])
            if distance < distances[i]:
                distances[i], shares[i], boxes[i] = distance, share, near[k]
    return distances, shares, boxes


def visibility(index: BoxIndex, drones: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the five-ray visibility of each target from each drone.

    A box that contains an end of a ray blocks it: a person inside a solid box is hidden, as in the renderer. Flat
    ground is not in the index (`obstacle_index`), so it does not hide people who stand on it.

    Args:
        drones, targets: (n, 3) m; a target is a hip point.
    Returns:
        (n,) the fraction of unblocked rays, 0, 0.2 ... 1. k == 0 gives all 1.
    """
    return _visibility(index, _points(drones), _points(targets))


@njit(cache=True)
def _visibility(index, drones, targets):
    fractions = np.empty(len(drones))
    boxes = np.empty(len(index.rows), dtype=np.int64)
    for i in range(len(drones)):
        drone, target = drones[i], targets[i]
        count = collect_hits(index, target[0], target[1], target[2], drone[0], drone[1], drone[2], RAY_SPREAD_M, boxes)
        fractions[i] = free_rays(index, boxes, count, drone[0], drone[1], drone[2], target)
    return fractions


def _points(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


def distances_to_boxes_m(points_m: np.ndarray, bystander: Bystander) -> np.ndarray:
    """Return the distance of a point, (n, 3), from the box of a bystander at each time, (n,) m, 0 inside."""
    offset = points_m - bystander.centers_m
    cos, sin = np.cos(bystander.headings_rad), np.sin(bystander.headings_rad)
    local = np.stack([offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin, offset[:, 2]])
    return np.linalg.norm(np.maximum(np.abs(local) - np.array(PERSON_HALF_EXTENTS_M)[:, None], 0.0), axis=0)
