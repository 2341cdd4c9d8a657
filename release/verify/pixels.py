"""What each picture of a release is measured by, compiled: every pixel of mask and depth, some rows of the colours, rays to the person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.products.frames import GRID_ROWS, SKY_DEPTH_M, grid_rows
from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import COLUMNS, median_of
from cosfly.work.compiled import njit

PERSON_ID = 65535  # the person in `instance.png`: docs/files.md
SHARED_ID, NOBODY = 65534, 0  # ids that stand for several things, or for none
NUM_IDS = 65536
PERSON, SKY = KINDS["Pedestrians"], KINDS["Sky"]
BLOCK_PX = 8  # of JPEG, WebP and videos
MOVED_PX = 4  # how far to each side edges of the mask are laid over the colours
LEAST_EDGES, MOST_STEP = (
    30,
    120,
)  # edges, for their mean to say something; grey levels of three channels, of which more count no more
EIGHT_PIXELS = 24  # bytes of a mask's row that are looked at at once
BEND_EVERY, LEAST_BENDS = 4, 200  # pixels of a row; points, for their median to say something
LOOK_EVERY = 3  # of the rows that are unpacked, and of the columns
NEAR_M = 0.3  # where rays begin: the renderers' near plane
SURFACE_SLACK_M = 0.05  # how far before a person's box what is drawn may lie and not hide it
# Numbers of a float's bits are ordered as floats above 0 are, and compared several at once, as no bits are not a number.
FAR_BITS = np.float32(SKY_DEPTH_M).view(np.int32)
INFINITE_BITS = np.float32(np.inf).view(np.int32)


class Survey(NamedTuple):
    """A frame's mask and depth. low_m, high_m: least and greatest depth, NaN where one is not finite; num_odd_sky: pixels of sky by one of
    depth and kind alone; num_person: of the person; num_odd_person: of the person's id with another kind; most_kind: the greatest there is;
    box: (4,) of the person's pixels, edges at pixel borders."""

    low_m: float
    high_m: float
    num_odd_sky: int
    num_person: int
    num_odd_person: int
    most_kind: int
    box: np.ndarray


def survey(depth: np.ndarray, instance: np.ndarray) -> Survey:
    """Look at every pixel of a frame once.

    Args:
        depth: (h, w) float32, or (0, 0) where there is none; instance: (h, w, 3) uint8, or (0, 0, 3).
    """
    kinds_alone = np.zeros(instance.shape[1] * 3, np.uint8)
    kinds_alone[::3] = 255
    bits = depth.view(np.int32)
    counts, box = _survey(bits, np.ascontiguousarray(instance).reshape(len(instance), len(kinds_alone)), kinds_alone)
    low, high = counts[:2].tolist()
    if 0 <= low <= high < INFINITE_BITS:
        limits = counts[:2].astype(np.int32).view(np.float32).tolist()
    else:  # not positive, not finite, or nothing
        limits = [float(depth.min()), float(depth.max())] if depth.size else [0.0, 0.0]
    if not np.isfinite(limits).all():
        limits = [np.nan, np.nan]
    num_odd_sky, num_person, num_odd_person, most_kind = counts[2:].tolist()
    return Survey(limits[0], limits[1], num_odd_sky, num_person, num_odd_person, most_kind, box)


def look_of(colours: np.ndarray) -> np.ndarray:
    """Tell how a picture looks, (8,) grey levels.

    How colourful and how sharp it is: how far channels lie from their mean, and pixels from the next. How far pixels lie from the next over
    edges of blocks of 8 px, which lossy codings pack apart, and elsewhere. Red and blue less green. Mean and deviation of all its numbers.

    Args:
        colours: (k, w, 3 or 4) uint8, some of its rows.
    """
    hue, grey, (red, green, blue), (total, squares) = _look(colours)
    height, width = colours.shape[:2]
    num_rows, num_numbers = -(-height // LOOK_EVERY), height * width * 3
    steps = grey / (3.0 * num_rows)
    edges = steps[BLOCK_PX - 1 :: BLOCK_PX]
    inside = (steps.sum() - edges.sum()) / max(len(steps) - len(edges), 1)
    num_pixels, num_hues = num_rows * width, num_rows * -(-width // LOOK_EVERY) * 3
    brightness = total / num_numbers
    spread = np.sqrt(max(squares / num_numbers - brightness**2, 0.0))
    over = edges.mean() if len(edges) else np.nan
    tint = (red - green) / num_pixels, (blue - green) / num_pixels
    sharp = steps.mean() if len(steps) else np.nan
    return np.array([hue / (3.0 * num_hues), sharp, over, inside, *tint, brightness, spread])


class Edges(NamedTuple):
    """How much colours change where the mask does. num: edges of the mask in the rows of the colours; rival: change at edges that were moved by
    two pixels and more, where it is greatest, to that at the edges themselves; deviations: how sure the difference of both is; shift_px: of
    the rival, to the right and down."""

    num: int
    rival: float
    deviations: float
    shift_px: tuple[int, int]


def edges_of(colours: np.ndarray, instance: np.ndarray) -> Edges | None:
    """Lay the edges of a mask over the colours, as they are and moved by up to 4 px to the sides and 2 px up or down.

    Args:
        colours: (k, w, 3 or 4) uint8, the first k of the grid's rows; instance: (h, w, 3) uint8.
    Returns:
        None where there are fewer than LEAST_EDGES of them.
    """
    rows = grid_rows(len(instance))[: len(colours)]
    sums, squares, counts = _edge_steps(colours, instance, rows)
    here = counts[1]
    if here < LEAST_EDGES:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        means = sums / counts[:, None]
        errors = (squares / counts[:, None] - means**2) / counts[:, None]
    own, error = means[1, MOVED_PX], errors[1, MOVED_PX]
    means[1, MOVED_PX - 1 : MOVED_PX + 2] = 0.0  # a pixel on an edge may be of both sides
    means[counts < LEAST_EDGES] = 0.0
    up, side = np.unravel_index(int(means.argmax()), means.shape)
    deviation = float(np.sqrt(max(error + errors[up, side], 1e-12)))
    shift_px = int(side) - MOVED_PX, 2 * (1 - int(up))
    return Edges(int(here), float(means[up, side] / max(own, 1e-9)), float((means[up, side] - own) / deviation), shift_px)  # fmt: skip


def bend_of(depth: np.ndarray, instance: np.ndarray) -> float:
    """Tell how far surfaces are from planes: of points whose neighbours to the left and right are of the same thing, the median of how far one over
    depth, which is linear on a plane, is from the mean of both, as a share of it twice. NaN: fewer than LEAST_BENDS points.

    Args:
        depth: (h, w) float32; instance: (h, w, 3) uint8.
    """
    bends = _bends(depth, instance, grid_rows(len(depth)))
    return median_of(bends) if len(bends) >= LEAST_BENDS else np.nan


def new_kinds(instance: np.ndarray, known: np.ndarray) -> list[int]:
    """Give id * 256 + kind of things at the grid's points that have another kind than is known of them, each once.

    Args:
        known: (NUM_IDS,) int16, -1: not seen yet.
    """
    return np.unique(_new_kinds(instance, known)).tolist()


@njit(cache=True, nogil=True)
def _survey(bits, mask, kinds_alone):  # type: ignore[no-untyped-def]
    """Row by row: what most rows have not is looked for in all their bytes at once, and pixel by pixel only where it is. Give the numbers of
    a `Survey`, the first two as bits, and its box."""
    most, least = np.int32(2147483647), np.int32(-2147483648)
    low, high, most_kind = most, least, np.uint8(0)
    num_odd_sky, num_person, num_odd_person = np.int64(0), np.int64(0), np.int64(0)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    for y in range(max(len(bits), len(mask))):
        num_far = np.int32(0)
        if len(bits) > 0:
            row = bits[y]
            for x in range(len(row)):
                low, high = min(low, row[x]), max(high, row[x])
            for x in range(len(row)):
                num_far = np.int32(num_far + np.int32(row[x] == FAR_BITS))
        if len(mask) == 0:
            continue
        own, after = mask[y, :-1], mask[y, 1:]  # the last byte is no kind
        of_person, of_sky = np.uint8(0), np.uint8(0)
        # Numba makes each result 64 bits wide, so that fewer are computed at once, where nothing says that it is a byte.
        for k in range(len(own)):
            kind = np.uint8(own[k] & kinds_alone[k])
            most_kind = np.uint8(max(most_kind, kind))
            of_sky = np.uint8(of_sky | np.uint8(kind == SKY))
            of_person = np.uint8(max(of_person, np.uint8(own[k] & after[k])))  # 255 only where both bytes of an id are
        if len(bits) > 0 and (of_sky > 0 or num_far > 0):
            for x in range(len(bits[y])):
                num_odd_sky += (own[3 * x] == SKY) != (bits[y, x] == FAR_BITS)
        if of_person == 255:
            for x in range(len(mask[y]) // 3):
                if after[3 * x] == 255 and after[3 * x + 1] == 255:
                    num_person += 1
                    num_odd_person += own[3 * x] != PERSON
                    box[0], box[1] = min(box[0], x), min(box[1], y)
                    box[2], box[3] = max(box[2], x + 1), max(box[3], y + 1)
    return np.array([low, high, num_odd_sky, num_person, num_odd_person, np.int64(most_kind)]), box


@njit(cache=True, nogil=True)
def _look(colours):  # type: ignore[no-untyped-def]
    """Of some rows sums of three times the hue, of three times the step from each column to the next (w - 1,), and of the channels (3,); of
    all rows those of all numbers and of their squares (2,)."""
    height, width = colours.shape[:2]
    hue, channels, numbers = np.int64(0), np.zeros(3, np.int64), np.zeros(2, np.int64)
    steps, grey = np.zeros(max(width - 1, 0), np.int64), np.zeros(width, np.int64)
    for y in range(height):
        for x in range(width):
            red, green, blue = np.int64(colours[y, x, 0]), np.int64(colours[y, x, 1]), np.int64(colours[y, x, 2])
            numbers[0] += red + green + blue
            numbers[1] += red * red + green * green + blue * blue
            if y % LOOK_EVERY == 0:
                channels[0] += red
                channels[1] += green
                channels[2] += blue
                grey[x] = red + green + blue
                if x % LOOK_EVERY == 0:
                    hue += abs(3 * red - grey[x]) + abs(3 * green - grey[x]) + abs(3 * blue - grey[x])
        if y % LOOK_EVERY == 0:
            for x in range(width - 1):
                steps[x] += abs(grey[x + 1] - grey[x])
    return hue, steps, channels, numbers


@njit(cache=True, nogil=True)
def _bends(depth, instance, rows):  # type: ignore[no-untyped-def]
    """Of each BEND_EVERYth pixel of some rows what `bend_of` says, (k,)."""
    width = depth.shape[1]
    found, num = np.empty(len(rows) * (width // BEND_EVERY + 1)), 0
    for row in rows:
        for x in range(1, width - 1, BEND_EVERY):
            is_one = True
            for c in range(3):
                own = instance[row, x, c]
                is_one &= instance[row, x - 1, c] == own and instance[row, x + 1, c] == own
            left, here, right = float(depth[row, x - 1]), float(depth[row, x]), float(depth[row, x + 1])
            if is_one and min(left, here, right) > 0.0 and here < SKY_DEPTH_M:
                found[num] = abs(here / left - 2.0 + here / right)
                num += 1
    return found[:num]


@njit(cache=True, nogil=True)
def _edge_steps(colours, instance, rows):  # type: ignore[no-untyped-def]
    """Steps of colours beside edges of the mask 2 rows above, in and 2 rows below each row: sums and sums of squares (3, 2 * MOVED_PX + 1) by how
    far to the right of the edge they are, and numbers of edges (3,)."""
    height, width = instance.shape[:2]
    sums, squares = np.zeros((3, 2 * MOVED_PX + 1)), np.zeros((3, 2 * MOVED_PX + 1))
    counts, steps = np.zeros(3, np.int64), np.zeros(max(width - 1, 0))
    num_bytes = 3 * max(width - 1, 0)
    changes = np.zeros(-(-num_bytes // EIGHT_PIXELS) * EIGHT_PIXELS, np.uint8)
    words = changes.view(np.uint64)
    for j in range(len(rows)):
        for x in range(width - 1):
            step = np.int64(0)
            for c in range(3):
                step += abs(np.int64(colours[j, x + 1, c]) - np.int64(colours[j, x, c]))
            steps[x] = min(step, MOST_STEP)
        for k in range(3):
            row = rows[j] + 2 * (k - 1)
            if row < 0 or row >= height:
                continue
            mask = instance[row].reshape(3 * width)
            for b in range(num_bytes):
                changes[b] = mask[b] ^ mask[b + 3]
            for w in range(0, len(words), 3):
                if words[w] | words[w + 1] | words[w + 2] == 0:
                    continue
                for x in range(max(w // 3 * 8, MOVED_PX), min(w // 3 * 8 + 8, width - 1 - MOVED_PX)):
                    if changes[3 * x] | changes[3 * x + 1] | changes[3 * x + 2] == 0:
                        continue
                    counts[k] += 1
                    for side in range(2 * MOVED_PX + 1):
                        step_there = steps[x + side - MOVED_PX]
                        sums[k, side] += step_there
                        squares[k, side] += step_there * step_there
    return sums, squares, counts


@njit(cache=True, nogil=True)
def outline_of(colours, instance, rows, begin, end):  # type: ignore[no-untyped-def]
    """Look along some rows for the person's outline.

    Args:
        colours: (k, w, 3 or 4) uint8, those rows; instance: (h, w, 3) uint8; rows: (k,) int64; begin, end: columns between which is looked.
    Returns:
        the sum of the steps of colours from pixel to pixel there, grey levels of three channels, and how many they are.
    """
    total, num = np.int64(0), np.int64(0)
    for j in range(len(rows)):
        mask = instance[rows[j]]
        for x in range(begin, end - 1):
            is_here = mask[x, 1] == PERSON_ID & 255 and mask[x, 2] == PERSON_ID >> 8
            is_next = mask[x + 1, 1] == PERSON_ID & 255 and mask[x + 1, 2] == PERSON_ID >> 8
            if is_here == is_next:
                continue
            step = np.int64(0)
            for c in range(3):
                step += abs(np.int64(colours[j, x + 1, c]) - np.int64(colours[j, x, c]))
            total += step if step < MOST_STEP else MOST_STEP
            num += 1
    return total, num


@njit(cache=True, nogil=True)
def _new_kinds(instance, known):  # type: ignore[no-untyped-def]
    height, width = instance.shape[:2]
    found, num = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    for j in range(GRID_ROWS):
        for i in range(COLUMNS):
            pixel = instance[int((j + 0.5) * height / GRID_ROWS), int((i + 0.5) * width / COLUMNS)]
            own = np.int64(pixel[1]) | np.int64(pixel[2]) << 8
            if own != NOBODY and own != SHARED_ID and known[own] != pixel[0]:
                found[num] = own << 8 | np.int64(pixel[0])
                num += 1
    return found[:num]


@njit(cache=True, nogil=True)
def depths_of_person(depth, instance, box, is_ours):  # type: ignore[no-untyped-def]
    """Give the depths, (k,) float32 m, of the person's pixels in a box (4,) of whole pixels. is_ours: those of the person's id alone."""
    x0, y0, x1, y1 = box
    found, num = np.empty((y1 - y0) * (x1 - x0), np.float32), 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            kind, low, high = instance[y, x, 0], instance[y, x, 1], instance[y, x, 2]
            if kind == PERSON and (not is_ours or (low == 255 and high == 255)):
                found[num] = depth[y, x]
                num += 1
    return found[:num]


@njit(cache=True, nogil=True)
def rays_to_person(depth, instance, columns, rows, intrinsics, world_from_camera, away_m, half_m):  # type: ignore[no-untyped-def]
    """Cast rays through the middles of pixels (columns, rows), also beyond the picture, to a box that stands upright, `away_m` (3,) from the
    camera with `half_m` (3,) to each side: how many hit it, and how many of these nothing hides."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    num_hits, num_seen = np.int64(0), np.int64(0)
    for v in rows:
        for u in columns:
            x, y = (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy
            enter, leave = NEAR_M, np.inf
            for axis in range(3):
                ray = world_from_camera[axis, 0] * x + world_from_camera[axis, 1] * y + world_from_camera[axis, 2]
                if abs(ray) < 1e-12:
                    ray = 1e-12
                one, other = (away_m[axis] - half_m[axis]) / ray, (away_m[axis] + half_m[axis]) / ray
                enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
            if leave <= enter:
                continue
            num_hits += 1
            if 0 <= u < width and 0 <= v < height:
                column, row = int(u), int(v)
                is_person = instance[row, column, 1] == 255 and instance[row, column, 2] == 255
                num_seen += is_person or depth[row, column] > enter - SURFACE_SLACK_M
    return num_hits, num_seen
