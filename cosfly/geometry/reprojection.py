"""Reprojection of one frame into another: it checks depths, instances, poses and intrinsics against each other.

Points of one depth image are moved into the other camera. There a static surface has the depth that both poses imply,
and the same instance. Colours are not compared, because light, weather, zoom and renderers change them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.runtime.compiled import njit

COLUMNS, GRID_ROWS = 64, 36  # the points are the middles of this grid's cells
NEAR_M, FAR_M = 0.3, 999.0  # range of depths; the sky is farther
LEAST_SEEN = 150  # points; a share of fewer is not reported
LEAST_PLANES = 30  # points; the depth error of fewer is not reported
LEAST_SHIFTED = 12  # points of an object; fewer are not reported
FIRM, MOVED, RENAMED = 1, 2, 3  # states of a point, see `_reproject`
SHARED_ID = 65534  # instance id of several objects: docs/files.md
MOVING = np.zeros(256, np.bool_)  # kinds of objects that may be elsewhere in the next frame
MOVING[[12, 13, 14, 15, 16, 17, 18, 19, 21]] = True  # people, riders, vehicles, dynamic objects (CARLA 0.9.16)
# Kinds of surfaces that people and cars stand on, and water. Maps have several in one plane (two roads at their
# crossing), where a renderer's rounding decides the id pixel by pixel, so only their kind is compared.
FLAT = np.zeros(256, np.bool_)
FLAT[[1, 2, 10, 23, 24, 25, 27]] = True
# The depth of an inclined surface changes within a pixel: by 0.05 m for half a pixel of 45 degrees at 50 m and 500 px.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1


@dataclass(frozen=True)
class View:
    """A frame."""

    depth: np.ndarray  # (h, w) float32, m
    instance: np.ndarray  # (h, w, 3) uint8 as in `instance.png`, or (0, 0, 3) without instances
    rotation: np.ndarray  # (3, 3) world_from_camera
    position_m: np.ndarray  # (3,) world


@dataclass(frozen=True)
class Agreement:
    """Numbers of points of one frame by what the other frame shows at their place."""

    seen: int  # within the other picture; of these:
    agree: int  # at the same depth
    hidden: int  # behind a nearer surface
    through: int  # in front of all surfaces, so their own surface is missing
    same: int  # of `agree`: with the same instance, or on flat ground with the same kind
    planes: int  # of `agree`: on planes, where the depth error is exact
    error: float  # median depth error of `planes`, as a share of the depth; NaN: too few
    error_flat: float  # of those on flat ground
    error_standing: float  # of all others
    shifted: int  # of one instance, most of which is farther away in the other frame; 0: there is none
    renamed: int  # of one instance, most of which has the same depth but another id in the other frame; 0: none
    seen_back: int  # `seen` of the other frame's points in this one
    through_back: int

    @property
    def gone(self) -> float:
        """Return the larger share of points of one frame that are missing in the other frame, 0 to 1.

        In a static world it is 0: a point that is not visible in the other frame is hidden by something nearer.
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
    """Return the largest number of points of one instance in a state, of instances with fewer FIRM points."""
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
        counts (5,): seen, agree, hidden, through and same. Depth errors (k,), and whether each is off flat ground (k,).
        Ids (m,) and states (m,) of the points well inside one instance: FIRM has the same depth and id in b; for MOVED,
        b is farther away; RENAMED has another id in b.
    """
    height, width = depth_a.shape
    height_b, width_b = depth_b.shape
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
            depth_m = float(depth_a[v, u])
            own = _code(inst_a, v, u) if has_ids else 0
            if not (depth_m > 0.0 and depth_m < FAR_M) or moving[own & 255]:
                continue
            u_b, v_b, z = _reprojected(u, v, depth_m, intrinsics, others, turn, shift)
            if not (u_b > 1.5 and v_b > 1.5 and u_b < width_b - 2.5 and v_b < height_b - 2.5):
                continue
            is_flat = flat[own & 255]
            off_m, farther_m, is_through, is_same, is_free, is_whole, is_one = _around(
                depth_b, inst_b, int(v_b), int(u_b), z, own, has_ids, moving, flat
            )
            if not is_free:
                continue
            counts[0] += 1
            agrees = off_m <= TOLERANCE_SHARE * z + TOLERANCE_M
            state = 0
            if agrees and is_whole:
                state = FIRM
            elif agrees and is_one and not is_flat:
                state = RENAMED
            # Farther on all sides: a nearer point may be another side of the same instance, which hides this one.
            elif not agrees and has_ids and (is_through or (is_whole and farther_m > 0.0)):
                state = MOVED
            if state > 0:
                ids[num_ids], states[num_ids] = own >> 8, state
                num_ids += 1
            if agrees:
                counts[1] += 1
                counts[4] += is_same
                error = _error_on_plane(depth_b, u_b, v_b, z)
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
    """Compare the nine pixels around a place with a point at depth z, m, of the instance `own`.

    Returns:
        off_m: the least difference in depth. farther_m: how much farther than the point the nearest pixel is.
        is_through: the point is clearly nearer than all pixels. is_same: one pixel shows its instance, or its kind of
        flat ground. is_free: no pixel shows a moving kind. is_whole: all pixels show its instance. is_one: all pixels
        show one instance.
    """
    off_m, farther_m, is_through, is_same, is_free, is_whole, is_one = (
        1e9,
        1e9,
        True,
        not has_ids,
        True,
        has_ids,
        has_ids,
    )
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            difference_m = float(depth[y, x]) - z
            off_m, farther_m = min(off_m, abs(difference_m)), min(farther_m, difference_m)
            is_through &= difference_m > 0.05 * z + 0.3
            if has_ids:
                code = _code(instance, y, x)
                kind = code & 255
                is_free &= not moving[kind]
                is_same |= code == own or (kind == own & 255 and flat[kind])
                is_whole &= code == own
                is_one &= code == _code(instance, row, column)
    return off_m, farther_m, is_through, is_same, is_free, is_whole, is_one


@njit(cache=True, nogil=True)
def _error_on_plane(depth, u, v, z):  # type: ignore[no-untyped-def]
    """Return the error of the depth at a place, px, against z, as a share of z; NaN if its four pixels are not a plane.

    On a plane 1 / depth is linear in the picture, so its interpolation between four pixels is exact.
    """
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    a, b = u - 0.5 - x, v - 0.5 - y
    d00, d01, d10, d11 = float(depth[y, x]), float(depth[y, x + 1]), float(depth[y + 1, x]), float(depth[y + 1, x + 1])
    if min(d00, d01, d10, d11) <= 0.0:  # invalid
        return np.nan
    q00, q01, q10, q11 = 1.0 / d00, 1.0 / d01, 1.0 / d10, 1.0 / d11
    if not abs(q00 + q11 - q01 - q10) < 1e-5 / z:
        return np.nan
    q = (1 - b) * ((1 - a) * q00 + a * q01) + b * ((1 - a) * q10 + a * q11)
    return abs(1.0 / q - z) / z
