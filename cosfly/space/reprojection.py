"""One frame seen from another: points of a depth image carried through both poses into the next picture, and what is found there.

What stands still looks the same from both places: it has the depth that the poses give it, the same instance, and nearly the same
colour. So pictures, poses, intrinsics and times bear witness against each other, whatever a file says of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cosfly.products.frames import GRID_ROWS, grid_rows
from cosfly.work.compiled import njit

COLUMNS = 64  # points are taken at the middle of so many cells of GRID_ROWS rows
NEAR_M, FAR_M = 0.3, 999.0  # beyond stands the sky
ZOOMED = 0.05  # logarithm of the ratio of two focal lengths
LEAST_CONTRAST = 4.0  # grey levels: less is a wall or a fog
LEAST_PAIRS = 4  # of frames, for one to be unusual among them
LEAST_COLOURS, LEAST_PLANES = 60, 30  # points, for their colours and their depth to say something
LEAST_SHIFTED = 12  # points of a thing
SHARED_ID = 65534  # of several things: docs/files.md
MOVING = np.zeros(256, np.bool_)  # kinds of pixels that may be elsewhere in the next frame
MOVING[[12, 13, 14, 15, 16, 17, 18, 19, 21]] = True  # people, riders, vehicles, what is dynamic (CARLA 0.9.16)
# Kinds of surfaces that people and cars stand on, and water. Maps lay them on each other in one plane (two roads at their crossing), where a
# renderer's rounding decides pixel by pixel whose id shows: of these the kind alone tells what is seen.
FLAT = np.zeros(256, np.bool_)
FLAT[[1, 2, 10, 23, 24, 25, 27]] = True
# Depth of a surface that is seen slantwise changes within a pixel; half a pixel of a 45 degree slope at 50 m and 500 px is 0.05 m.
TOLERANCE_SHARE, TOLERANCE_M = 0.02, 0.1
NO_COLOURS = np.empty((0, 0, 3), np.uint8)


@dataclass(frozen=True)
class View:
    """A frame. depth (h, w) float32 m; instance (h, w, 3) uint8 as in `instance.png`, or (0, 0, 3) where there is none; colours (k, w, 3 or
    4) uint8 of the first k of the grid's rows, None where there are none; rotation: world_from_camera (3, 3); position_m (3,).
    """

    depth: np.ndarray
    instance: np.ndarray
    colours: np.ndarray | None
    rotation: np.ndarray
    position_m: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """What became of the points. seen: those that lie in the other picture; of them have the depth that stands there (agree), lie behind
    it (hidden), or before it, where nothing is (through). same: of those that agree, the same instance, of flat ground the same kind. planes: of
    those that agree, on planes there; error: median of these, as a share of the depth, NaN: too few. correlation: of brightness, NaN: too few, or no contrast. tint: median difference of
    the three channels, less that of brightness, grey levels. shade: median difference of brightness, grey levels, NaN: too few.
    shifted: points of one thing that is farther there, as most of it is; renamed: of one that has its depth there and another id, as most of
    it has; 0 where there is none.
    """

    seen: int
    agree: int
    hidden: int
    through: int
    same: int
    planes: int
    error: float
    correlation: float
    tint: float
    shade: float
    shifted: int
    renamed: int


def is_zoomed(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether two cameras, (4,) fx, fy, cx, cy, draw things so differently large that their colours are not those of the same detail."""
    return bool(abs(np.log(one[0] / other[0])) > ZOOMED)


def compare_views(
    one: View,
    other: View,
    intrinsics: np.ndarray,
    others_intrinsics: np.ndarray | None = None,
    *,
    least_contrast: float = LEAST_CONTRAST,
) -> Agreement:
    """Carry the grid's points of one frame into another.

    Args:
        intrinsics: (4,) fx, fy, cx, cy of both. others_intrinsics: those of the other, where the camera zoomed between them.
        least_contrast: deviation of brightness, grey levels, below which nothing is said of the colours' correlation.
    """
    counts, errors, colours, firm, moved, renamed = _carried(
        one, other, intrinsics, others_intrinsics, only_colours=False
    )
    correlation, tint, shade = _agreement_of(colours, least_contrast)
    error = median_of(errors) if len(errors) >= LEAST_PLANES else np.nan
    seen, agree, hidden, through, same = counts.tolist()
    return Agreement(
        seen, agree, hidden, through, same, len(errors), error, correlation, tint, shade, _most_of_one(firm, moved),
        _most_of_one(firm, renamed),
    )  # fmt: skip


def correlate_colours(
    one: View, other: View, intrinsics: np.ndarray, others_intrinsics: np.ndarray, *, least_contrast: float
) -> float:
    """Give the correlation of `compare_views` alone, which takes a fraction of its time."""
    colours = _carried(one, other, intrinsics, others_intrinsics, only_colours=True)[2]
    return _agreement_of(colours, least_contrast)[0]


def way_px(one: View, other: View, intrinsics: np.ndarray, others_intrinsics: np.ndarray) -> float:
    """Give how far things lie apart in two pictures, px: the median of nine points of the first; 0 where none of them has a depth."""
    turn, shift = _from_to(one, other)
    ways = _ways(one.depth, intrinsics.astype(np.float64), others_intrinsics.astype(np.float64), turn, shift)
    return median_of(ways) if len(ways) else 0.0


def _carried(
    one: View, other: View, intrinsics: np.ndarray, others_intrinsics: np.ndarray | None, *, only_colours: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Give what `_carry` does of two views."""
    intrinsics = intrinsics.astype(np.float64)
    others = intrinsics if others_intrinsics is None else others_intrinsics.astype(np.float64)
    turn, shift = _from_to(one, other)
    colours, others_colours = one.colours, other.colours
    if colours is None or others_colours is None:
        colours = others_colours = NO_COLOURS
    return _carry(
        one.depth, one.instance, colours, other.depth, other.instance, others_colours, _grid_row_at(len(other.depth)),
        intrinsics, others, turn, shift, MOVING, FLAT, only_colours,
    )  # fmt: skip


def _from_to(one: View, other: View) -> tuple[np.ndarray, np.ndarray]:
    """Give what takes points of one camera to another's, (3, 3) and (3,) m."""
    return other.rotation.T @ one.rotation, other.rotation.T @ (one.position_m - other.position_m)


@lru_cache
def _grid_row_at(height_px: int) -> np.ndarray:
    """Number of the grid's row that is one of a picture's rows or lies beside it, (h,); -1: none."""
    rows = np.arange(height_px)
    nearest = np.clip(np.round((rows + 0.5) * GRID_ROWS / height_px - 0.5).astype(np.int64), 0, GRID_ROWS - 1)
    return np.where(np.abs(grid_rows(height_px)[nearest] - rows) <= 1, nearest, -1)


def _agreement_of(colours: np.ndarray, least_contrast: float) -> tuple[float, float, float]:
    """Give correlation, tint and shade (`Agreement`) of points' colours here and there, (k, 6)."""
    if len(colours) < LEAST_COLOURS:
        return np.nan, np.nan, np.nan
    shades, tints, (square, others_square, product) = _compare_colours(colours)
    has_contrast = min(square, others_square) > len(colours) * least_contrast**2
    return product / np.sqrt(square * others_square) if has_contrast else np.nan, median_of(tints), median_of(shades)


def median_of(values: np.ndarray) -> float:
    """Give what `np.median` does of numbers, in a quarter of its time for few."""
    middle = len(values) // 2
    found = np.partition(values, (middle - 1, middle))
    return float(found[middle] if len(values) % 2 else (found[middle - 1] + found[middle]) / 2.0)


def _most_of_one(firm: np.ndarray, odd: np.ndarray) -> int:
    """Give the points of the thing that is odd at most points. firm, odd: ids at points well inside one thing, as it should be and not."""
    if len(odd) < LEAST_SHIFTED:
        return 0
    counts = np.bincount(odd, minlength=SHARED_ID + 1)
    counts[counts <= np.bincount(firm, minlength=len(counts))[: len(counts)]] = 0
    counts[[0, SHARED_ID]] = 0  # ids of nothing and of many things
    most = int(counts.max())
    return most if most >= LEAST_SHIFTED else 0


def usual_correlations(
    correlations: np.ndarray, focal_px: np.ndarray, least_drop: float
) -> tuple[np.ndarray, np.ndarray]:
    """Give the usual correlation of a flight's frames with the one before each, and how much less is too little, (n,) each.

    Frames are judged by those of about their focal length, (n,) px: what is seen in more detail agrees otherwise. NaN where fewer than
    LEAST_PAIRS are known.
    """
    usual, drops = np.full(len(correlations), np.nan), np.full(len(correlations), np.nan)
    levels = np.round(np.log(focal_px) / ZOOMED)
    for level in np.unique(levels):
        rows = levels == level
        known = correlations[rows & np.isfinite(correlations)]
        if len(known) >= LEAST_PAIRS:
            usual[rows] = np.median(known)
            drops[rows] = max(least_drop, 8.0 * float(np.median(np.abs(known - np.median(known)))))
    return usual, drops


@njit(cache=True, nogil=True)
def _compare_colours(colours):  # type: ignore[no-untyped-def]
    """Differences of brightness (k,) and greatest ones of hue (k,), grey levels; of both brightnesses the squares and the product less
    their means, summed (3,)."""
    num = len(colours)
    both = np.empty((num, 2))
    shades, tints, sums, means = np.empty(num), np.empty(num), np.zeros(3), np.zeros(2)
    for k in range(num):
        one, other = colours[k, :3], colours[k, 3:]
        both[k, 0] = (one[0] + one[1] + one[2]) / 3.0
        both[k, 1] = (other[0] + other[1] + other[2]) / 3.0
        shades[k], tints[k] = both[k, 1] - both[k, 0], 0.0
        for c in range(3):
            tints[k] = max(tints[k], abs((other[c] - both[k, 1]) - (one[c] - both[k, 0])))
        means += both[k] / num
    for k in range(num):
        x, y = both[k, 0] - means[0], both[k, 1] - means[1]
        sums[0] += x * x
        sums[1] += y * y
        sums[2] += x * y
    return shades, tints, sums


@njit(cache=True, nogil=True)
def _carry(depth_a, inst_a, colours_a, depth_b, inst_b, colours_b, grid_row_at, intrinsics, others, turn, shift, moving, flat, only_colours):  # type: ignore[no-untyped-def]  # fmt: skip
    """Counts (5,), errors (k,), colours (k, 6) of points here and there, where both are known; of points among nothing but their own thing
    its id, of those with its depth and of those that are farther; of points with its depth among nothing but one other thing their own id. only_colours: points that come out where there are none are left out of everything."""
    height, width = depth_a.shape
    others_height, others_width = depth_b.shape
    has_ids = inst_a.shape[0] > 0 and inst_b.shape[0] > 0
    counts = np.zeros(5, np.int64)
    errors, num_errors = np.empty(COLUMNS * GRID_ROWS), 0
    colours, num_colours = np.empty((COLUMNS * GRID_ROWS, 6)), 0
    firm, num_firm = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    moved, num_moved = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    renamed, num_renamed = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    for j in range(GRID_ROWS):
        v = int((j + 0.5) * height / GRID_ROWS)
        if only_colours and j >= len(colours_a):
            break
        for i in range(COLUMNS):
            u = int((i + 0.5) * width / COLUMNS)
            d = float(depth_a[v, u])
            if not (d > 0.0 and d < FAR_M) or (has_ids and moving[inst_a[v, u, 0]]):
                continue
            s, t, z = _carried_point(u, v, d, intrinsics, others, turn, shift)
            if not (s > 1.5 and t > 1.5 and s < others_width - 2.5 and t < others_height - 2.5):
                continue
            column, row = int(s), int(t)
            k = grid_row_at[row]  # of the colours; a point that comes out between two of their rows has none
            has_colours = 0 <= k < len(colours_b) and column < colours_b.shape[1] and j < len(colours_a)
            if only_colours and not has_colours:
                continue
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
                if has_colours:
                    for c in range(3):
                        colours[num_colours, c] = colours_a[j, u, c]
                        colours[num_colours, 3 + c] = colours_b[k, column, c]
                    num_colours += 1
                error = _error_on_plane(depth_b, s, t, z)
                if not np.isnan(error):
                    errors[num_errors] = error
                    num_errors += 1
            elif is_through:
                counts[3] += 1
            else:
                counts[2] += 1
    return counts, errors[:num_errors], colours[:num_colours], firm[:num_firm], moved[:num_moved], renamed[:num_renamed]


@njit(cache=True, nogil=True)
def _ways(depth, intrinsics, others, turn, shift):  # type: ignore[no-untyped-def]
    """How far nine points come out from where they are, px, (k,) of those that have a depth."""
    height, width = depth.shape
    ways, num = np.empty(9), 0
    for j in range(9):
        u, v = width * (1 + 2 * (j % 3)) // 6, height * (1 + 2 * (j // 3)) // 6
        d = float(depth[v, u])
        s, t, _ = _carried_point(u, v, d, intrinsics, others, turn, shift)
        if 0.0 < d < FAR_M and not np.isnan(s):
            ways[num] = np.hypot(s - u - 0.5, t - v - 0.5)
            num += 1
    return ways[:num]


@njit(cache=True, nogil=True)
def _carried_point(u, v, d, intrinsics, others, turn, shift):  # type: ignore[no-untyped-def]
    """Where the middle of pixel (u, v), at depth d, comes out in the other picture: px, px, and its depth there, m; NaN px where nearer than NEAR_M."""
    x, y = (u + 0.5 - intrinsics[2]) / intrinsics[0] * d, (v + 0.5 - intrinsics[3]) / intrinsics[1] * d
    z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
    if z < NEAR_M:
        return np.nan, np.nan, z
    across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]
    down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]
    return others[0] * across / z + others[2], others[1] * down / z + others[3], z


@njit(cache=True, nogil=True)
def _around(depth, instance, row, column, z, inst_a, v, u, has_ids, moving, flat):  # type: ignore[no-untyped-def]
    """What nine pixels say of a point at depth z, of the thing at (v, u) of `inst_a`: least distance in depth, least depth beyond it; is it nearer than all;
    does one show its thing, or a surface that may show in its place; does none show who moves; do all show its thing; do all show one."""
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
