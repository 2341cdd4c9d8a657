"""One frame seen from another: points of a depth image carried through both poses into the next picture, and what is
found there.

What stands still has the depth that the poses give it from both places, and the same instance. So depth, masks, poses,
intrinsics and times bear witness against each other, whatever a file says of them. Colours say nothing: light, weather,
zoom and renderers change them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.runtime.compiled import njit

COLUMNS, GRID_ROWS = 64, 36  # points are taken at the middle of so many cells
NEAR_M, FAR_M = 0.3, 999.0  # beyond stands the sky
LEAST_SEEN = 150  # points, for a share of them to mean something
LEAST_PLANES = 30  # points, for their depth to say something
LEAST_SHIFTED = 12  # points of a thing
SHARED_ID = 65534  # of several things: docs/files.md
MOVING = np.zeros(256, np.bool_)  # kinds of pixels that may be elsewhere in the next frame
MOVING[[12, 13, 14, 15, 16, 17, 18, 19, 21]] = True  # people, riders, vehicles, what is dynamic (CARLA 0.9.16)
# Kinds of surfaces that people and cars stand on, and water. Maps lay them on each other in one plane (two roads at
# their crossing), where a renderer's rounding decides pixel by pixel whose id shows: of these the kind alone tells what
# is seen.
FLAT = np.zeros(256, np.bool_)
FLAT[[1, 2, 10, 23, 24, 25, 27]] = True
# Depth of a surface that is seen slantwise changes within a pixel; half a pixel of a 45 degree slope at 50 m and 500 px
# is 0.05 m.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1


@dataclass(frozen=True)
class View:
    """A frame. depth (h, w) float32 m; instance (h, w, 3) uint8 as in `instance.png`, or (0, 0, 3) where there is none;
    rotation:
    world_from_camera (3, 3); position_m (3,).
    """

    depth: np.ndarray
    instance: np.ndarray
    rotation: np.ndarray
    position_m: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """What became of the points. seen: those that lie in the other picture; of them have the depth that stands there
    (agree), lie behind it (hidden), or before it, where nothing is (through). same: of those that agree, the same
    instance, of flat ground the same kind. planes: of those that agree, on planes there; error: median of these, as a
    share of the depth; error_flat, error_standing: of those of them that are ground and that are not; NaN: too few.
    shifted: points of one thing that is farther there, as most of it is; renamed: of one that has its depth there and
    another id, as most of it has; 0 where there is none. seen_back, through_back: the same of the other's points in the
    first.
    """

    seen: int
    agree: int
    hidden: int
    through: int
    same: int
    planes: int
    error: float
    error_flat: float
    error_standing: float
    shifted: int
    renamed: int
    seen_back: int
    through_back: int

    @property
    def gone(self) -> float:
        """Share of what one of the two shows and the other looks through, 0 to 1. However far apart frames are, of one
        world it is 0: what is not there any more, from there, is hidden by what is nearer, and that by something else
        from here.
        """
        both = ((self.through, self.seen), (self.through_back, self.seen_back))
        return max((through / seen for through, seen in both if seen >= LEAST_SEEN), default=0.0)


def compare_views(
    one: View, other: View, intrinsics: np.ndarray, others_intrinsics: np.ndarray | None = None
) -> Agreement:
    """Carry the grid's points of one frame into another.

    Args:
        intrinsics: (4,) fx, fy, cx, cy of both. others_intrinsics: those of the other, where the camera zoomed between
            them.
    """
    intrinsics = intrinsics.astype(np.float64)
    others = intrinsics if others_intrinsics is None else others_intrinsics.astype(np.float64)
    turn, shift = other.rotation.T @ one.rotation, other.rotation.T @ (one.position_m - other.position_m)
    counts, errors, standing, firm, moved, renamed = _carry(
        one.depth, one.instance, other.depth, other.instance, intrinsics, others, turn, shift, MOVING, FLAT
    )
    back = _carry(
        other.depth, other.instance, one.depth, one.instance, others, intrinsics, turn.T, -turn.T @ shift, MOVING, FLAT
    )[0]
    seen, agree, hidden, through, same = counts.tolist()
    return Agreement(
        seen, agree, hidden, through, same, len(errors), _error_of(errors), _error_of(errors[~standing]),
        _error_of(errors[standing]), _most_of_one(firm, moved), _most_of_one(firm, renamed),
        int(back[0]), int(back[3]),
    )  # fmt: skip


def _error_of(errors: np.ndarray) -> float:
    return median_of(errors) if len(errors) >= LEAST_PLANES else np.nan


def median_of(values: np.ndarray) -> float:
    """Return what `np.median` does of numbers, in a quarter of its time for few."""
    middle = len(values) // 2
    found = np.partition(values, (middle - 1, middle))
    return float(found[middle] if len(values) % 2 else (found[middle - 1] + found[middle]) / 2.0)


def _most_of_one(firm: np.ndarray, odd: np.ndarray) -> int:
    """Return the points of the thing most of whose points are odd. firm, odd: ids at points well inside one thing."""
    if len(odd) < LEAST_SHIFTED:
        return 0
    counts = np.bincount(odd, minlength=SHARED_ID + 1)
    counts[counts <= np.bincount(firm, minlength=len(counts))[: len(counts)]] = 0
    counts[[0, SHARED_ID]] = 0  # ids of nothing and of many things
    most = int(counts.max())
    return most if most >= LEAST_SHIFTED else 0


@njit(cache=True, nogil=True)
def _carry(depth_a, inst_a, depth_b, inst_b, intrinsics, others, turn, shift, moving, flat):  # type: ignore
    """Counts (5,), errors (k,) and which of them are of no flat ground; of points among nothing but their own thing its
    id, of those with its depth and of those that are farther; of points with its depth among nothing but one other
    thing their own id."""
    height, width = depth_a.shape
    others_height, others_width = depth_b.shape
    has_ids = inst_a.shape[0] > 0 and inst_b.shape[0] > 0
    counts = np.zeros(5, np.int64)
    errors, num_errors = np.empty(COLUMNS * GRID_ROWS), 0
    standing = np.zeros(COLUMNS * GRID_ROWS, np.bool_)
    firm, num_firm = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    moved, num_moved = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    renamed, num_renamed = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    for j in range(GRID_ROWS):
        v = int((j + 0.5) * height / GRID_ROWS)
        for i in range(COLUMNS):
            u = int((i + 0.5) * width / COLUMNS)
            d = float(depth_a[v, u])
            if not (d > 0.0 and d < FAR_M) or (has_ids and moving[inst_a[v, u, 0]]):
                continue
            s, t, z = _carried_point(u, v, d, intrinsics, others, turn, shift)
            if not (s > 1.5 and t > 1.5 and s < others_width - 2.5 and t < others_height - 2.5):
                continue
            column, row = int(s), int(t)
            best, least, is_through, is_same, is_free, is_whole, is_one = _around(
                depth_b, inst_b, row, column, z, inst_a, v, u, has_ids, moving, flat
            )
            if not is_free:
                continue
            counts[0] += 1
            is_there = best <= TOLERANCE_SHARE * z + TOLERANCE_M
            own = np.int64(inst_a[v, u, 1]) | np.int64(inst_a[v, u, 2]) << 8 if has_ids else np.int64(0)
            if is_there and is_whole:
                firm[num_firm] = own
                num_firm += 1
            elif is_there and is_one and not flat[inst_a[v, u, 0]]:
                renamed[num_renamed] = own
                num_renamed += 1
            # Farther all round: what is nearer may be another side of the thing, that hides this one.
            elif not is_there and has_ids and (is_through or (is_whole and least > 0.0)):
                moved[num_moved] = own
                num_moved += 1
            if is_there:
                counts[1] += 1
                counts[4] += is_same
                error = _error_on_plane(depth_b, s, t, z)
                if not np.isnan(error):
                    errors[num_errors] = error
                    standing[num_errors] = has_ids and not flat[inst_a[v, u, 0]]
                    num_errors += 1
            elif is_through:
                counts[3] += 1
            else:
                counts[2] += 1
    return counts, errors[:num_errors], standing[:num_errors], firm[:num_firm], moved[:num_moved], renamed[:num_renamed]


@njit(cache=True, nogil=True)
def _carried_point(u, v, d, intrinsics, others, turn, shift):  # type: ignore[no-untyped-def]
    """Where the middle of pixel (u, v) at depth d comes out in the other picture, px, and its depth, m; or NaN."""
    x, y = (u + 0.5 - intrinsics[2]) / intrinsics[0] * d, (v + 0.5 - intrinsics[3]) / intrinsics[1] * d
    z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
    if z < NEAR_M:
        return np.nan, np.nan, z
    across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]
    down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]
    return others[0] * across / z + others[2], others[1] * down / z + others[3], z


@njit(cache=True, nogil=True)
def _around(depth, instance, row, column, z, inst_a, v, u, has_ids, moving, flat):  # type: ignore[no-untyped-def]
    """What nine pixels say of a point at depth z, of the thing at (v, u) of `inst_a`: least distance in depth, least
    depth beyond it; is it nearer than all; does one show its thing, or a surface that may show in its place; does none
    show who moves; do all show its thing; do all show one."""
    best, least, is_through, is_same, is_free, is_whole, is_one = 1e9, 1e9, True, not has_ids, True, has_ids, has_ids
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            off = float(depth[y, x]) - z
            best, least = min(best, abs(off)), min(least, off)
            if off <= 0.05 * z + 0.3:
                is_through = False
            if has_ids:
                is_free &= not moving[instance[y, x, 0]]
                is_kind = instance[y, x, 0] == inst_a[v, u, 0]
                is_own = is_kind and instance[y, x, 1] == inst_a[v, u, 1] and instance[y, x, 2] == inst_a[v, u, 2]
                is_same |= is_own or (is_kind and flat[inst_a[v, u, 0]])
                is_whole &= is_own
                is_one &= (
                    instance[y, x, 0] == instance[row, column, 0]
                    and instance[y, x, 1] == instance[row, column, 1]
                    and instance[y, x, 2] == instance[row, column, 2]
                )
    return best, least, is_through, is_same, is_free, is_whole, is_one


@njit(cache=True, nogil=True)
def _error_on_plane(depth, s, t, z):  # type: ignore[no-untyped-def]
    """How far the depth between four pixels is from z, as a share of it; NaN where they are not of one plane.

    Of a plane 1 / depth is linear in the picture, so that between four pixels it is exact.
    """
    x, y = int(np.floor(s - 0.5)), int(np.floor(t - 0.5))
    a, b = s - 0.5 - x, t - 0.5 - y
    d00, d01, d10, d11 = float(depth[y, x]), float(depth[y, x + 1]), float(depth[y + 1, x]), float(depth[y + 1, x + 1])
    if min(d00, d01, d10, d11) <= 0.0:  # invalid
        return np.nan
    q00, q01, q10, q11 = 1.0 / d00, 1.0 / d01, 1.0 / d10, 1.0 / d11
    if not abs(q00 + q11 - q01 - q10) < 1e-5 / z:
        return np.nan
    q = (1 - b) * ((1 - a) * q00 + a * q01) + b * ((1 - a) * q10 + a * q11)
    return abs(1.0 / q - z) / z
