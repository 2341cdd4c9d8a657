"""Reprojection of one frame into another: it checks depths, instances, poses and intrinsics against each other.

Points of one depth image are moved into the other camera. There a static surface has the depth that both poses imply,
and the same instance. Colours are not compared, because light, weather, zoom and renderers change them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.runtime.compiled import njit

COLUMNS, GRID_ROWS = 64, 36  # the points are the middles of this grid's cells
NEAR_M, FAR_M = 0.3, 999.0  # range of depths; the sky is farther
LEAST_SEEN = 150  # points; a share of fewer is not reported
LEAST_PLANES = 30  # points; the depth error of fewer is not reported
SEEN, AGREE, MISSING, SAME = range(4)  # indices of the counts of `_reproject`; names as in `Agreement`
# Kinds of objects that may be elsewhere in the next frame, (256,) bool by kind.
MOVING = np.isin(np.arange(256), [KINDS[kind] for kind in (
    "Pedestrians", "Rider", "Car", "Truck", "Bus", "Train", "Motorcycle", "Bicycle", "Dynamic",
)])  # fmt: skip
# Kinds of surfaces that people and cars stand on, and water. Maps have several in one plane (two roads at their
# crossing), where a renderer's rounding decides the id pixel by pixel, so only their kind is compared.
FLAT = np.isin(np.arange(256), [*GROUND_KINDS, KINDS["Water"]])
# The depth of an inclined surface changes within a pixel: by 0.05 m for half a pixel of 45 degrees at 50 m and 500 px.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1
MISSING_SHARE, MISSING_M = 0.05, 0.3  # a surface this much farther than a point proves it missing: over the tolerance
BORDER_LOW_PX, BORDER_HIGH_PX = 1.5, 2.5  # keep the nine pixels around a place, and the four of its plane, inside


@dataclass(frozen=True)
class View:
    """What one frame shows, and from where."""

    depth: np.ndarray  # (h, w) float32, m
    instance: np.ndarray  # (h, w, 3) uint8 as in `instance.png`, or (0, 0, 3) without instances
    rotation: np.ndarray  # (3, 3) world_from_camera
    position_m: np.ndarray  # (3,) world


@dataclass(frozen=True)
class Agreement:
    """Numbers of points of one frame by what the other frame shows at their place."""

    seen: int  # within the other picture; of these:
    agree: int  # at the same depth
    same: int  # of `agree`: with the same instance, or on flat ground with the same kind
    error: float  # median depth error of those of `agree` on planes, where it is exact, as a share; NaN: too few
    error_flat: float  # of those on flat ground
    error_off_flat: float  # of all others
    # Larger share of points of one frame that are in front of all surfaces of the other, so that their own surface is
    # missing there. In a static world it is 0: a point that is not visible is hidden by something nearer.
    missing_share: float


def compare_views(a: View, b: View, intrinsics_a: np.ndarray, intrinsics_b: np.ndarray | None = None) -> Agreement:
    """Reproject the grid's points of frame a into frame b and back.

    intrinsics_a: (4,) fx, fy, cx, cy of both frames. intrinsics_b: of frame b, if the camera has zoomed.
    """
    k_a = intrinsics_a.astype(np.float64)
    k_b = k_a if intrinsics_b is None else intrinsics_b.astype(np.float64)
    turn = b.rotation.T @ a.rotation  # b_from_a
    shift = b.rotation.T @ (a.position_m - b.position_m)
    counts, errors, is_off_flat = _reproject(
        a.depth, a.instance, b.depth, b.instance, k_a, k_b, turn, shift, MOVING, FLAT
    )
    counts_back, *_ = _reproject(
        b.depth, b.instance, a.depth, a.instance, k_b, k_a, turn.T, -turn.T @ shift, MOVING, FLAT
    )
    missing_shares = [c[MISSING] / c[SEEN] for c in (counts, counts_back) if c[SEEN] >= LEAST_SEEN]
    return Agreement(
        seen=int(counts[SEEN]), agree=int(counts[AGREE]), same=int(counts[SAME]), error=_error_of(errors),
        error_flat=_error_of(errors[~is_off_flat]), error_off_flat=_error_of(errors[is_off_flat]),
        missing_share=float(max(missing_shares, default=0.0)),
    )  # fmt: skip


def _error_of(errors: np.ndarray) -> float:
    return median_of(errors) if len(errors) >= LEAST_PLANES else np.nan


def median_of(values: np.ndarray) -> float:
    """Return the median, with NaN as the greatest number; for few it takes a quarter of the time of `np.median`."""
    middle = len(values) // 2
    ordered = np.partition(values, (middle - 1, middle))
    return float(ordered[middle] if len(values) % 2 else (ordered[middle - 1] + ordered[middle]) / 2.0)


@njit(cache=True, nogil=True)
def _reproject(  # type: ignore[no-untyped-def]
    depth_a, inst_a, depth_b, inst_b, intrinsics_a, intrinsics_b, turn, shift, moving, flat
):
    """Reproject the points of frame a into frame b.

    Args:
        turn, shift: (3, 3) and (3,) m, b_from_a of the cameras. moving, flat: MOVING and FLAT.

    Returns:
        Counts (4,), see SEEN. Depth errors (k,), and whether each is off flat ground (k,).
    """
    height, width = depth_a.shape
    height_b, width_b = depth_b.shape
    has_ids = inst_a.shape[0] > 0 and inst_b.shape[0] > 0
    counts = np.zeros(4, np.int64)
    errors = np.empty(COLUMNS * GRID_ROWS)
    is_off_flat = np.zeros(COLUMNS * GRID_ROWS, np.bool_)
    num_errors = 0
    for j in range(GRID_ROWS):
        v = int((j + 0.5) * height / GRID_ROWS)
        for i in range(COLUMNS):
            u = int((i + 0.5) * width / COLUMNS)
            depth_m = float(depth_a[v, u])
            own = _code(inst_a, v, u) if has_ids else 0
            if not (depth_m > 0.0 and depth_m < FAR_M) or moving[own & 255]:
                continue
            u_b, v_b, z = _reprojected(u, v, depth_m, intrinsics_a, intrinsics_b, turn, shift)
            if not (u_b > BORDER_LOW_PX and v_b > BORDER_LOW_PX):  # also where they are NaN
                continue
            if not (u_b < width_b - BORDER_HIGH_PX and v_b < height_b - BORDER_HIGH_PX):
                continue
            least_error_m, is_missing, is_same, all_static = _around(
                depth_b, inst_b, int(v_b), int(u_b), z, own, has_ids, moving, flat
            )
            if not all_static:
                continue
            counts[SEEN] += 1
            if least_error_m <= TOLERANCE_SHARE * z + TOLERANCE_M:
                counts[AGREE] += 1
                counts[SAME] += is_same
                error = _error_on_plane(depth_b, u_b, v_b, z)
                if not np.isnan(error):
                    errors[num_errors] = error
                    is_off_flat[num_errors] = has_ids and not flat[own & 255]
                    num_errors += 1
            elif is_missing:
                counts[MISSING] += 1
    return counts, errors[:num_errors], is_off_flat[:num_errors]


@njit(cache=True, nogil=True)
def _reprojected(u, v, d, intrinsics_a, intrinsics_b, turn, shift):  # type: ignore[no-untyped-def]
    """Return the reprojection of pixel (u, v) at depth d into the other picture, px, and its depth, m; or NaN."""
    x = (u + 0.5 - intrinsics_a[2]) / intrinsics_a[0] * d
    y = (v + 0.5 - intrinsics_a[3]) / intrinsics_a[1] * d
    z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
    if z < NEAR_M:
        return np.nan, np.nan, z
    across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]
    down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]
    return intrinsics_b[0] * across / z + intrinsics_b[2], intrinsics_b[1] * down / z + intrinsics_b[3], z


@njit(cache=True, nogil=True)
def _code(instance, y, x):  # type: ignore[no-untyped-def]
    """Return a pixel of `instance.png` as one number, the kind lowest."""
    return np.int64(instance[y, x, 0]) | np.int64(instance[y, x, 1]) << 8 | np.int64(instance[y, x, 2]) << 16


@njit(cache=True, nogil=True)
def _around(depth, instance, row, column, z, own, has_ids, moving, flat):  # type: ignore[no-untyped-def]
    """Compare the nine pixels around a place with a point at depth z, m, of the instance `own`.

    Returns:
        least_error_m: the least difference in depth. is_missing: the point is clearly nearer than all pixels. is_same:
        one pixel shows its instance, or its kind of flat ground. all_static: no pixel shows a moving kind.
    """
    least_error_m = 1e9
    is_missing, is_same, all_static = True, not has_ids, True
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            difference_m = float(depth[y, x]) - z
            least_error_m = min(least_error_m, abs(difference_m))
            is_missing &= difference_m > MISSING_SHARE * z + MISSING_M
            if has_ids:
                code = _code(instance, y, x)
                kind = code & 255
                all_static &= not moving[kind]
                is_same |= code == own or (kind == own & 255 and flat[kind])
    return least_error_m, is_missing, is_same, all_static


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
