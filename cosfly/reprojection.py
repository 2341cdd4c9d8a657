"""One frame seen from another: points of a depth image carried through both poses into the next picture, and what is found there.

What stands still looks the same from both places: it has the depth that the poses give it, the same instance, and nearly the same
colour. So pictures, poses, intrinsics and times bear witness against each other, whatever a file says of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.compiled import njit, words_of

COLUMNS, ROWS = 64, 36  # points are taken at the middle of so many cells
NEAR_M = 0.3
FAR_M = np.float32(1000.0)  # of the sky
ZOOMED = 0.05  # logarithm of the ratio of two focal lengths
LEAST_CONTRAST = 4.0  # grey levels: less is a wall or a fog
LEAST_PAIRS = 4  # of frames, for one to be unusual among them
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
    it (hidden), or before it, where nothing is (through). same: of those that agree, the same instance, of flat ground the same kind. error: median of those on
    planes, as a share of the depth, NaN: too few. correlation: of brightness, NaN: too few, or no contrast. tint: median difference of
    the three channels, less that of brightness, grey levels. shade: median difference of brightness, grey levels, NaN: too few.
    shifted: points of one thing that is farther or nearer there, as most of it is; 0 where there is none.
    """

    seen: int
    agree: int
    hidden: int
    through: int
    same: int
    error: float
    correlation: float
    tint: float
    shade: float
    shifted: int


def grid_rows(height_px: int) -> np.ndarray:
    """Rows of the grid, (ROWS,)."""
    return ((np.arange(ROWS) + 0.5) * height_px / ROWS).astype(np.int64)


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
    intrinsics = intrinsics.astype(np.float64)
    others = intrinsics if others_intrinsics is None else others_intrinsics.astype(np.float64)
    turn = other.rotation.T @ one.rotation
    shift = other.rotation.T @ (one.position_m - other.position_m)
    counts, errors, brightness, firm, moved = _carry(
        one.depth, one.instance, other.depth, other.instance, intrinsics, others, turn, shift, MOVING, FLAT
    )
    pairs: np.ndarray = np.empty((0, 2))
    tint = shade = np.nan
    if one.colours is not None and other.colours is not None:
        here, there = _colours_at(brightness, one.colours, other.colours, one.depth.shape[0])
        pairs = np.stack([here.mean(axis=1), there.mean(axis=1)], axis=1)
        if len(pairs) >= 60:
            shade = float(np.median(pairs[:, 1] - pairs[:, 0]))
            hue = (there - pairs[:, 1:]) - (here - pairs[:, :1])
            tint = float(np.median(np.abs(hue).max(axis=1)))
    correlation = np.nan
    if len(pairs) >= 60 and (pairs.std(axis=0) > least_contrast).all():
        correlation = float(np.corrcoef(pairs.T)[0, 1])
    error = float(np.median(errors)) if len(errors) >= 30 else np.nan
    seen, agree, hidden, through, same = (int(n) for n in counts)
    return Agreement(seen, agree, hidden, through, same, error, correlation, tint, shade, _num_shifted(firm, moved))


def _num_shifted(firm: np.ndarray, moved: np.ndarray) -> int:
    """Give the points of the thing that moved most. firm, moved: ids at points well inside one thing, with its depth and without."""
    if len(moved) < LEAST_SHIFTED:
        return 0
    counts = np.bincount(moved, minlength=SHARED_ID + 1)
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


def _colours_at(matches: np.ndarray, one: np.ndarray, other: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours at points and where they came out, (k, 3) each; only those whose both rows of the grid were unpacked."""
    rows = grid_rows(height)
    nearest = np.clip(np.round((matches[:, 3] + 0.5) * ROWS / height - 0.5).astype(np.int64), 0, ROWS - 1)
    # A point that comes out between two rows of the grid has no colour there.
    usable = (matches[:, 1] < len(one)) & (nearest < len(other)) & (np.abs(rows[nearest] - matches[:, 3]) <= 1)
    m, nearest = matches[usable], nearest[usable]
    return one[m[:, 1], m[:, 0], :3].astype(np.float64), other[nearest, m[:, 2], :3].astype(np.float64)


def survey(
    depth: np.ndarray, instance: np.ndarray, sky_kind: int, person_id: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Look at every pixel of a frame once.

    Args:
        depth: (h, w) float32, or (0, 0) where there is none; instance: (h, w, 3) uint8, or (0, 0, 3).
    Returns:
        range (2,) least and greatest depth, NaN where one is not finite; counts (4,): pixels of sky by one of depth and kind alone; of the
        person; of the person's id with another kind than Pedestrians. box (4,) of the person's pixels, edges at pixel borders; kinds (256,)
        pixels.
    """
    limits = np.array([depth.min(), depth.max()]) if depth.size else np.zeros(2)
    instance = np.ascontiguousarray(instance)
    found = _survey(depth, instance, words_of(instance.reshape(-1)), sky_kind, person_id)
    return limits if np.isfinite(limits).all() else np.full(2, np.nan), *found


@njit(cache=True, nogil=True)
def _survey(depth, instance, words, sky_kind, person_id):  # type: ignore[no-untyped-def]
    """Count run by run: of a mask's row most neighbours are the same, which words of their bytes tell faster than pixels."""
    counts, kinds = np.zeros(3, np.int64), np.zeros(256, np.int64)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    height, width = instance.shape[:2]
    for y in range(height):
        begin, row, stop = np.int64(0), y * width * 3, (y + 1) * width * 3
        while begin < width:
            kind, low, high = instance[y, begin, 0], instance[y, begin, 1], instance[y, begin, 2]
            at = row + 3 * (begin + 1)
            while at + 8 <= stop and words[at] == words[at - 3]:
                at += 8
            end = (at - row) // 3
            while end < width and instance[y, end, 0] == kind and instance[y, end, 1] == low and instance[y, end, 2] == high:  # fmt: skip
                end += 1
            kinds[kind] += end - begin
            if depth.shape[0] > 0:
                num_far = _num_far(depth[y, begin:end])
                counts[0] += end - begin - num_far if kind == sky_kind else num_far
            if low == (person_id & 255) and high == (person_id >> 8):
                counts[1] += end - begin
                counts[2] += end - begin if kind != 12 else 0
                box[0], box[1] = min(box[0], begin), min(box[1], y)
                box[2], box[3] = max(box[2], end), max(box[3], y + 1)
            begin = end
    return counts, box, kinds


@njit(cache=True, nogil=True)
def _num_far(depth):  # type: ignore[no-untyped-def]
    """How many of a run's depths are the sky's."""
    num = np.int64(0)
    for k in range(len(depth)):
        num += depth[k] == FAR_M
    return num


@njit(cache=True, nogil=True)
def _carry(depth_a, inst_a, depth_b, inst_b, intrinsics, others, turn, shift, moving, flat):  # type: ignore[no-untyped-def]
    """Counts (5,), errors (k,), matches (k, 4): column, row of the grid, column and row in the other picture; of points among nothing but
    their own thing its id, of those with its depth and of the others."""
    height, width = depth_a.shape
    fx, fy, cx, cy = intrinsics
    other_fx, other_fy, other_cx, other_cy = others
    has_ids = inst_a.shape[0] > 0 and inst_b.shape[0] > 0
    counts = np.zeros(5, np.int64)
    errors, num_errors = np.empty(COLUMNS * ROWS), 0
    matches, num_matches = np.empty((COLUMNS * ROWS, 4), np.int64), 0
    firm, num_firm = np.empty(COLUMNS * ROWS, np.int64), 0
    moved, num_moved = np.empty(COLUMNS * ROWS, np.int64), 0
    for j in range(ROWS):
        v = int((j + 0.5) * height / ROWS)
        for i in range(COLUMNS):
            u = int((i + 0.5) * width / COLUMNS)
            d = float(depth_a[v, u])
            if not (d > 0.0 and d < 999.0) or (has_ids and moving[inst_a[v, u, 0]]):
                continue
            x, y = (u + 0.5 - cx) / fx * d, (v + 0.5 - cy) / fy * d
            px = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]
            py = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]
            z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
            if z < NEAR_M:
                continue
            s, t = other_fx * px / z + other_cx, other_fy * py / z + other_cy
            if not (s > 1.5 and t > 1.5 and s < width - 2.5 and t < height - 2.5):
                continue
            column, row = int(s), int(t)
            best, is_through, is_same, is_free, is_whole = 1e9, True, not has_ids, True, has_ids
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    off = float(depth_b[row + dy, column + dx]) - z
                    best = min(best, abs(off))
                    if off <= 0.05 * z + 0.3:
                        is_through = False
                    if has_ids:
                        y1, x1 = row + dy, column + dx
                        is_free &= not moving[inst_b[y1, x1, 0]]
                        is_own = (
                            inst_b[y1, x1, 0] == inst_a[v, u, 0]
                            and inst_b[y1, x1, 1] == inst_a[v, u, 1]
                            and inst_b[y1, x1, 2] == inst_a[v, u, 2]
                        )
                        is_same |= is_own or (flat[inst_a[v, u, 0]] and inst_b[y1, x1, 0] == inst_a[v, u, 0])
                        is_whole &= is_own
            if not is_free:
                continue
            counts[0] += 1
            is_there = best <= TOLERANCE_SHARE * z + TOLERANCE_M
            if is_whole:
                own = np.int64(inst_a[v, u, 1]) | np.int64(inst_a[v, u, 2]) << 8
                if is_there:
                    firm[num_firm] = own
                    num_firm += 1
                else:
                    moved[num_moved] = own
                    num_moved += 1
            if is_there:
                counts[1] += 1
                counts[4] += is_same
                matches[num_matches] = (u, j, column, row)
                num_matches += 1
                # Of a plane 1 / z is linear in the picture, so that between four pixels it is exact.
                x0, y0 = int(np.floor(s - 0.5)), int(np.floor(t - 0.5))
                a, b = s - 0.5 - x0, t - 0.5 - y0
                d00, d01 = float(depth_b[y0, x0]), float(depth_b[y0, x0 + 1])
                d10, d11 = float(depth_b[y0 + 1, x0]), float(depth_b[y0 + 1, x0 + 1])
                if min(d00, d01, d10, d11) <= 0.0:  # invalid
                    continue
                q00, q01, q10, q11 = 1.0 / d00, 1.0 / d01, 1.0 / d10, 1.0 / d11
                is_plane = abs(q00 + q11 - q01 - q10) < 1e-5 / z
                if is_plane:
                    q = (1 - b) * ((1 - a) * q00 + a * q01) + b * ((1 - a) * q10 + a * q11)
                    errors[num_errors] = abs(1.0 / q - z) / z
                    num_errors += 1
            elif is_through:
                counts[3] += 1
            else:
                counts[2] += 1
    return counts, errors[:num_errors], matches[:num_matches], firm[:num_firm], moved[:num_moved]
