"""Reprojection of one frame into another: points of a depth image are moved by both poses and compared there.

A static surface has the depth that the poses imply from both positions, and the same instance. So depth, masks, poses,
intrinsics and times check each other. Colours are not used: light, weather, zoom and renderers change them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.runtime.compiled import njit

COLUMNS, GRID_ROWS = 64, 36  # points are taken at the middle of so many cells
NEAR_M, FAR_M = 0.3, 999.0  # beyond is the sky
LEAST_SEEN = 150  # points; a share of fewer is not reported
LEAST_PLANES = 30  # points; the depth error of fewer is not reported
LEAST_SHIFTED = 12  # points of a thing
FIRM, MOVED, RENAMED = 1, 2, 3
SHARED_ID = 65534  # of several things: docs/files.md
MOVING = np.zeros(256, np.bool_)  # kinds of pixels that may be elsewhere in the next frame
MOVING[[12, 13, 14, 15, 16, 17, 18, 19, 21]] = True  # people, riders, vehicles, dynamic objects (CARLA 0.9.16)
# Kinds of surfaces that people and cars stand on, and water. Maps have several in one plane (two roads at their
# crossing), where a renderer's rounding decides the id pixel by pixel, so only their kind is compared.
FLAT = np.zeros(256, np.bool_)
FLAT[[1, 2, 10, 23, 24, 25, 27]] = True
# The depth of an inclined surface changes within a pixel: by 0.05 m for half a pixel of 45 degrees at 50 m and 500 px.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1


@dataclass(frozen=True)
class View:
    """A frame. depth (h, w) float32 m; instance (h, w, 3) uint8 as in `instance.png`, or (0, 0, 3) where there is none;
    rotation: world_from_camera (3, 3); position_m (3,)."""

    depth: np.ndarray
    instance: np.ndarray
    rotation: np.ndarray
    position_m: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """Counts of reprojected points. seen: points within the other picture; of these, agree: with its depth, hidden:
    behind it, through: in front of it, where nothing is. same: of those that agree, with the same instance, on flat
    ground the same kind. planes: of those that agree, on planes; error: their median depth error, as a share of the
    depth; error_flat, error_standing: of those on ground and of the others; NaN: too few.
    shifted: points of one instance most of which is farther there; renamed: of one most of which has its depth there
    and another id; 0: none. seen_back, through_back: the same of the other frame's points in this one.
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
        """Return the share of points of one frame that are missing in the other frame, 0 to 1.

        In a static world it is 0 for any two frames: a point that is not visible there is hidden by something nearer.
        """
        counts = ((self.through, self.seen), (self.through_back, self.seen_back))
        return max((through / seen for through, seen in counts if seen >= LEAST_SEEN), default=0.0)


def compare_views(
    one: View, other: View, intrinsics: np.ndarray, others_intrinsics: np.ndarray | None = None
) -> Agreement:
    """Reproject the grid's points of one frame into another and back.

    intrinsics: (4,) fx, fy, cx, cy of both frames. others_intrinsics: Of the other frame, if the camera has zoomed.
    """
    intrinsics = intrinsics.astype(np.float64)
    others = intrinsics if others_intrinsics is None else others_intrinsics.astype(np.float64)
    turn = other.rotation.T @ one.rotation
    shift = other.rotation.T @ (one.position_m - other.position_m)
    counts, errors, standing, ids, states = _reproject(
        one.depth, one.instance, other.depth, other.instance, intrinsics, others, turn, shift, MOVING, FLAT
    )
    back = _reproject(
        other.depth, other.instance, one.depth, one.instance, others, intrinsics, turn.T, -turn.T @ shift, MOVING, FLAT
    )[0]
    seen, agree, hidden, through, same = counts.tolist()
    return Agreement(
        seen, agree, hidden, through, same, len(errors), _error_of(errors), _error_of(errors[~standing]),
        _error_of(errors[standing]), _most_of_one(ids, states, MOVED), _most_of_one(ids, states, RENAMED),
        int(back[0]), int(back[3]),
    )  # fmt: skip


def _error_of(errors: np.ndarray) -> float:
    return median_of(errors) if len(errors) >= LEAST_PLANES else np.nan


def median_of(values: np.ndarray) -> float:
    """Return the median; for few numbers it takes a quarter of the time of `np.median`."""
    middle = len(values) // 2
    ordered = np.partition(values, (middle - 1, middle))
    return float(ordered[middle] if len(values) % 2 else (ordered[middle - 1] + ordered[middle]) / 2.0)


def _most_of_one(ids: np.ndarray, states: np.ndarray, state: int) -> int:
    """Return the largest number of points in a state among instances with more points in that state than FIRM."""
    ids_in_state = ids[states == state]
    if len(ids_in_state) < LEAST_SHIFTED:
        return 0
    counts = np.bincount(ids_in_state, minlength=SHARED_ID + 1)
    counts[counts <= np.bincount(ids[states == FIRM], minlength=len(counts))[: len(counts)]] = 0
    counts[[0, SHARED_ID]] = 0  # the ids of no instance and of several instances
    most = int(counts.max())
    return most if most >= LEAST_SHIFTED else 0


@njit(cache=True, nogil=True)
def _reproject(depth_a, inst_a, depth_b, inst_b, intrinsics, others, turn, shift, moving, flat):  # type: ignore
    """Reproject the points of frame a into frame b.

    Returns:
        counts (5,); depth errors (k,) and whether each is off flat ground (k,); ids (m,) and states (m,) of points well
        inside one instance. FIRM: the same depth and id in b; MOVED: b is farther there; RENAMED: another id in b.
    """
    height, width = depth_a.shape
    others_height, others_width = depth_b.shape
    has_ids = inst_a.shape[0] > 0 and inst_b.shape[0] > 0
    counts = np.zeros(5, np.int64)
    errors = np.empty(COLUMNS * GRID_ROWS)
    standing = np.zeros(COLUMNS * GRID_ROWS, np.bool_)
    ids, states = np.empty(COLUMNS * GRID_ROWS, np.int64), np.empty(COLUMNS * GRID_ROWS, np.uint8)
    num_errors, num_ids = 0, 0
    for j in range(GRID_ROWS):
        v = int((j + 0.5) * height / GRID_ROWS)
        for i in range(COLUMNS):
            u = int((i + 0.5) * width / COLUMNS)
            d = float(depth_a[v, u])
            own = _code(inst_a, v, u) if has_ids else 0
            if not (d > 0.0 and d < FAR_M) or moving[own & 255]:
                continue
            s, t, z = _reprojected(u, v, d, intrinsics, others, turn, shift)
            if not (s > 1.5 and t > 1.5 and s < others_width - 2.5 and t < others_height - 2.5):
                continue
            column, row, is_flat = int(s), int(t), flat[own & 255]
            best, least, is_through, is_same, is_free, is_whole, is_one = _around(
                depth_b, inst_b, row, column, z, own, has_ids, moving, flat
            )
            if not is_free:
                continue
            counts[0] += 1
            is_there = best <= TOLERANCE_SHARE * z + TOLERANCE_M
            state = 0
            if is_there and is_whole:
                state = FIRM
            elif is_there and is_one and not is_flat:
                state = RENAMED
            # Farther on all sides: a nearer point may be another side of the same instance, which hides this one.
            elif not is_there and has_ids and (is_through or (is_whole and least > 0.0)):
                state = MOVED
            if state > 0:
                ids[num_ids], states[num_ids] = own >> 8, state
                num_ids += 1
            if is_there:
                counts[1] += 1
                counts[4] += is_same
                error = _error_on_plane(depth_b, s, t, z)
                if not np.isnan(error):
                    errors[num_errors] = error
                    standing[num_errors] = has_ids and not is_flat
                    num_errors += 1
            elif is_through:
                counts[3] += 1
            else:
                counts[2] += 1
    return counts, errors[:num_errors], standing[:num_errors], ids[:num_ids], states[:num_ids]


@njit(cache=True, nogil=True)
def _reprojected(u, v, d, intrinsics, others, turn, shift):  # type: ignore[no-untyped-def]
    """Return the reprojection of pixel (u, v) at depth d into the other picture, px, and its depth, m; or NaN."""
    x, y = (u + 0.5 - intrinsics[2]) / intrinsics[0] * d, (v + 0.5 - intrinsics[3]) / intrinsics[1] * d
    z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
    if z < NEAR_M:
        return np.nan, np.nan, z
    across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]
    down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]
    return others[0] * across / z + others[2], others[1] * down / z + others[3], z


@njit(cache=True, nogil=True)
def _code(instance, y, x):  # type: ignore[no-untyped-def]
    """Return a pixel of `instance.png` as one number, the kind lowest."""
    return np.int64(instance[y, x, 0]) | np.int64(instance[y, x, 1]) << 8 | np.int64(instance[y, x, 2]) << 16


@njit(cache=True, nogil=True)
def _around(depth, instance, row, column, z, own, has_ids, moving, flat):  # type: ignore[no-untyped-def]
    """Compare nine pixels with a point at depth z, of the instance `own`. Return the least distance in depth, the
    least depth beyond it, and whether the point is nearer than all, one shows its instance (or kind of flat ground),
    none shows a moving kind, all show its instance, and all show one instance."""
    best, least, is_through, is_same, is_free, is_whole, is_one = 1e9, 1e9, True, not has_ids, True, has_ids, has_ids
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            off = float(depth[y, x]) - z
            best, least = min(best, abs(off)), min(least, off)
            is_through &= off > 0.05 * z + 0.3
            if has_ids:
                code = _code(instance, y, x)
                kind = code & 255
                is_free &= not moving[kind]
                is_same |= code == own or (kind == own & 255 and flat[kind])
                is_whole &= code == own
                is_one &= code == _code(instance, row, column)
    return best, least, is_through, is_same, is_free, is_whole, is_one


@njit(cache=True, nogil=True)
def _error_on_plane(depth, s, t, z):  # type: ignore[no-untyped-def]
    """Return the error of the depth between four pixels against z, as a share of it; NaN where they are not one plane.

    On a plane 1 / depth is linear in the picture, so that between four pixels it is exact.
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
