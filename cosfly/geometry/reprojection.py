"""Reprojection of one frame into another: it checks depths, instances, poses and intrinsics against each other.

Points of one depth image are moved into the other camera. There a static surface has the depth that both poses imply,
and the same instance. Colours are not compared, because light, weather, zoom and renderers change them.
"""

from dataclasses import dataclass

import numpy as np

from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.runtime.compiled import njit

GRID_COLUMNS, GRID_ROWS = 64, 36  # the points are the middles of this grid's cells
LEAST_DEPTH_M, SKY_FROM_M = 0.3, 999.0  # a renderer's near plane; depths of the sky are greater
LEAST_SEEN = 150  # points; a share of fewer is not reported
LEAST_PLANES = 30  # points; the depth error of fewer is not reported
SEEN, AGREE, MISSING, SAME = range(4)  # indices of the counts of `_reproject`; names as in `Agreement`
# Kinds of objects that may be elsewhere in the next frame, (256,) bool by kind.
_MOVING_KINDS = ("Pedestrians", "Rider", "Car", "Truck", "Bus", "Train", "Motorcycle", "Bicycle", "Dynamic")
MOVING = np.isin(np.arange(256), [KINDS[kind] for kind in _MOVING_KINDS])
# Kinds of surfaces that people and cars stand on, and water. Maps have several in one plane (two roads at their
# crossing), where a renderer's rounding decides the id pixel by pixel, so only their kind is compared.
FLAT = np.isin(np.arange(256), [*GROUND_KINDS, KINDS["Water"]])
# The depth of an inclined surface changes within a pixel: by 0.05 m for half a pixel of 45 degrees at 50 m and 500 px.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1
MISSING_SHARE, MISSING_M = 0.05, 0.3  # a surface this much farther than a point proves it missing: over the tolerance
PLANE_SHARE = 1e-5  # largest deviation of 1 / depth from a plane, as a share; rounding is far below it
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

    Args:
        intrinsics_a: (4,) fx, fy, cx, cy of frame a.
        intrinsics_b: Those of frame b; None: the same.
    """
    k_a = intrinsics_a.astype(np.float64)
    k_b = k_a if intrinsics_b is None else intrinsics_b.astype(np.float64)
    b_from_a = b.rotation.T @ a.rotation
    a_in_b_m = b.rotation.T @ (a.position_m - b.position_m)
    counts, errors, is_off_flat = _reproject(a.depth, a.instance, b.depth, b.instance, k_a, k_b, b_from_a, a_in_b_m)
    b_in_a_m = -b_from_a.T @ a_in_b_m
    counts_back, *_ = _reproject(b.depth, b.instance, a.depth, a.instance, k_b, k_a, b_from_a.T, b_in_a_m)
    missing_shares = [c[MISSING] / c[SEEN] for c in (counts, counts_back) if c[SEEN] >= LEAST_SEEN]
    return Agreement(
        seen=int(counts[SEEN]),
        agree=int(counts[AGREE]),
        same=int(counts[SAME]),
        error=_error_of(errors),
        error_flat=_error_of(errors[~is_off_flat]),
        error_off_flat=_error_of(errors[is_off_flat]),
        missing_share=float(max(missing_shares, default=0.0)),
    )


def _error_of(errors: np.ndarray) -> float:
    """Return the median; NaN of too few errors."""
    return float(np.median(errors)) if len(errors) >= LEAST_PLANES else np.nan


@njit(cache=True, nogil=True)
def _reproject(  # type: ignore[no-untyped-def]
    depth_a, instance_a, depth_b, instance_b, intrinsics_a, intrinsics_b, b_from_a, a_in_b_m
):
    """Reproject the points of frame a into frame b.

    Args:
        b_from_a: (3, 3) rotation of the cameras.
        a_in_b_m: (3,) camera a in the axes of camera b, m.

    Returns:
        Counts (4,), see SEEN. Depth errors (k,), and whether each is off flat ground (k,).
    """
    height, width = depth_a.shape
    height_b, width_b = depth_b.shape
    has_ids = instance_a.shape[0] > 0 and instance_b.shape[0] > 0
    counts = np.zeros(4, np.int64)
    errors = np.empty(GRID_COLUMNS * GRID_ROWS)
    is_off_flat = np.zeros(GRID_COLUMNS * GRID_ROWS, np.bool_)
    num_errors = 0
    for cell in range(GRID_COLUMNS * GRID_ROWS):
        u = int((cell % GRID_COLUMNS + 0.5) * width / GRID_COLUMNS)
        v = int((cell // GRID_COLUMNS + 0.5) * height / GRID_ROWS)
        depth_m = float(depth_a[v, u])
        code = _code(instance_a, v, u) if has_ids else 0
        if not (depth_m > 0.0 and depth_m < SKY_FROM_M) or MOVING[code & 255]:
            continue
        u_b, v_b, depth_b_m = _reprojected(u, v, depth_m, intrinsics_a, intrinsics_b, b_from_a, a_in_b_m)
        # Not inside also where they are NaN.
        if not (BORDER_LOW_PX < u_b < width_b - BORDER_HIGH_PX and BORDER_LOW_PX < v_b < height_b - BORDER_HIGH_PX):
            continue
        least_error_m, is_missing, is_same, all_static = _compare_with_neighbours(
            depth_b, instance_b, int(v_b), int(u_b), depth_b_m, code, has_ids
        )
        if not all_static:
            continue
        counts[SEEN] += 1
        if least_error_m <= TOLERANCE_SHARE * depth_b_m + TOLERANCE_M:
            counts[AGREE] += 1
            counts[SAME] += is_same
            error = _error_on_plane(depth_b, u_b, v_b, depth_b_m)
            if not np.isnan(error):
                errors[num_errors] = error
                is_off_flat[num_errors] = has_ids and not FLAT[code & 255]
                num_errors += 1
        elif is_missing:
            counts[MISSING] += 1
    return counts, errors[:num_errors], is_off_flat[:num_errors]


@njit(cache=True, nogil=True)
def _reprojected(u, v, depth_m, intrinsics_a, intrinsics_b, b_from_a, a_in_b_m):  # type: ignore[no-untyped-def]
    """Return the reprojection of pixel (u, v) at a depth into the other picture, px, and its depth, m; or NaN."""
    x_m = (u + 0.5 - intrinsics_a[2]) / intrinsics_a[0] * depth_m
    y_m = (v + 0.5 - intrinsics_a[3]) / intrinsics_a[1] * depth_m
    z_m = b_from_a[2, 0] * x_m + b_from_a[2, 1] * y_m + b_from_a[2, 2] * depth_m + a_in_b_m[2]
    if z_m < LEAST_DEPTH_M:
        return np.nan, np.nan, z_m
    right_m = b_from_a[0, 0] * x_m + b_from_a[0, 1] * y_m + b_from_a[0, 2] * depth_m + a_in_b_m[0]
    down_m = b_from_a[1, 0] * x_m + b_from_a[1, 1] * y_m + b_from_a[1, 2] * depth_m + a_in_b_m[1]
    return intrinsics_b[0] * right_m / z_m + intrinsics_b[2], intrinsics_b[1] * down_m / z_m + intrinsics_b[3], z_m


@njit(cache=True, nogil=True)
def _code(instance, row, column):  # type: ignore[no-untyped-def]
    """Return a pixel of `instance.png` as one number, the kind lowest."""
    pixel = instance[row, column]
    return np.int64(pixel[0]) | np.int64(pixel[1]) << 8 | np.int64(pixel[2]) << 16


@njit(cache=True, nogil=True)
def _compare_with_neighbours(depth, instance, row, column, depth_m, code, has_ids):  # type: ignore[no-untyped-def]
    """Compare the nine pixels around a place with a point of a depth and of the instance of `_code`.

    Returns:
        least_error_m: the least difference in depth.
        is_missing: the point is clearly nearer than all pixels.
        is_same: one pixel shows its instance, or its kind of flat ground.
        all_static: no pixel shows a moving kind.
    """
    least_error_m = 1e9
    is_missing, is_same, all_static = True, not has_ids, True
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            difference_m = float(depth[y, x]) - depth_m
            least_error_m = min(least_error_m, abs(difference_m))
            is_missing &= difference_m > MISSING_SHARE * depth_m + MISSING_M
            if has_ids:
                pixel_code = _code(instance, y, x)
                kind = pixel_code & 255
                all_static &= not MOVING[kind]
                is_same |= pixel_code == code or (kind == code & 255 and FLAT[kind])
    return least_error_m, is_missing, is_same, all_static


@njit(cache=True, nogil=True)
def _error_on_plane(depth, u, v, depth_m):  # type: ignore[no-untyped-def]
    """Return the error of the depth at a place, px, as a share of `depth_m`; NaN if its four pixels are not a plane.

    On a plane 1 / depth is linear in the picture, so its interpolation between four pixels is exact.
    """
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    right, down = u - 0.5 - x, v - 0.5 - y  # weights of the right column and of the lower row
    if min(depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1]) <= 0.0:  # invalid
        return np.nan
    # Inverse depths: row, column.
    q00, q01 = 1.0 / float(depth[y, x]), 1.0 / float(depth[y, x + 1])
    q10, q11 = 1.0 / float(depth[y + 1, x]), 1.0 / float(depth[y + 1, x + 1])
    if not abs(q00 + q11 - q01 - q10) < PLANE_SHARE / depth_m:
        return np.nan
    q = (1 - down) * ((1 - right) * q00 + right * q01) + down * ((1 - right) * q10 + right * q11)
    return abs(1.0 / q - depth_m) / depth_m
