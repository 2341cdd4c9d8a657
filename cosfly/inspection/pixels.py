"""Figures of all pixels of one frame: missing textures, Z-fighting, and the box of pedestrians.

A missing texture shows as the magenta of many engines, or as a large surface of one colour. Where two surfaces lie in
one plane, rounding decides which one is drawn at each pixel (Z-fighting): ids alternate while the depth is that of one
plane. Z-fighting counts only where colours or kinds differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosfly.formats.frames import DEPTH_NPY, INVALID_DEPTH_M, SKY_DEPTH_M, depth_values, public_name
from cosfly.formats.kinds import KINDS
from cosfly.formats.png import colours_of
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError

NO_DEPTH = np.empty((0, 0), np.float32)
NO_DEPTH.flags.writeable = False
NO_IDS = np.empty((0, 0, 3), np.uint8)
NUM_IDS = 1 << 16
PERSON, NOTHING, SKY = KINDS["Pedestrians"], KINDS["NONE"], KINDS["Sky"]
SHARED_ID = 65534  # the id of all boxes beyond the range of ids (docs/files.md)
MAGENTA_LEAST = 200  # least red and blue
MAGENTA_MOST = 60  # most green
DARK = 16  # grey levels; darker surfaces have one colour at night
SHORTEST_RUN_PX = 3  # longer runs of one id are not caused by rounding
# 1 / depth of a plane is linear in the picture, so surfaces fight only on that line. The tolerance is 1 cm at 30 m.
PLANE_SHARE = 3e-4
GRAINLESS = 0.9  # share of equal neighbours on all other surfaces
VISIBLE_STEP = 60  # sum over red, green and blue; more than the grain of one surface
LEAST_PAIRS = 400  # neighbouring pixels of a surface that is judged


@dataclass(frozen=True)
class Picture:
    """A frame. colours, instance: (h, w, 3) uint8; depth: (h, w) float32 m; the last two may be empty."""

    colours: np.ndarray
    depth: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True)
class PixelFigures:
    """Figures of a frame.

    Attributes:
        flat: Share of the picture that the largest surface of one colour covers; 0 if no surface or all are like that.
        flat_kind: The kind of that surface.
        magenta, fighting: Shares of the picture.
        person_box: Box of the pedestrian pixels that belong to no bystander, xmin, ymin, xmax, ymax px, or None.
    """

    flat: float
    flat_kind: int
    magenta: float
    fighting: float
    person_box: tuple[int, int, int, int] | None


def unpack(files: dict[str, bytes], where: Path) -> Picture:
    """Decode the files of a frame, by name; depth and `instance.png` are optional.

    Raises:
        InputError: If a file is invalid.
    """
    colours = colours_of(files["rgb.png"], where / "rgb.png")
    instance = colours_of(files["instance.png"], where / "instance.png") if "instance.png" in files else NO_IDS
    depth_name = next((name for name in files if public_name(name) == DEPTH_NPY), DEPTH_NPY)
    depth = depth_values(memoryview(files[depth_name]), where / depth_name) if depth_name in files else NO_DEPTH
    depth.flags.writeable = False  # the kernels are compiled for read-only arrays only
    for name, values in (("instance.png", instance), (depth_name, depth)):
        if values.size and values.shape[:2] != colours.shape[:2]:
            got, expected = ("{1} x {0} px".format(*found.shape) for found in (values, colours))
            raise InputError("the size differs from rgb.png", where=where / name, got=got, expected=expected)
    return Picture(colours, depth, instance)


def measure_pixels(picture: Picture, is_bystander: np.ndarray, flat_share: float) -> PixelFigures:
    """Return the figures of a frame.

    Args:
        is_bystander: (65536,) bool, by id. flat_share: share of equal neighbours in a surface of one colour.
    """
    num_pixels = picture.colours.shape[0] * picture.colours.shape[1]
    if not picture.instance.size:
        red, green, blue = (picture.colours[..., k] for k in range(3))
        magenta = (red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST)
        return PixelFigures(0.0, 0, float(magenta.mean()), 0.0, None)
    all_pairs, all_equal, all_bright, kinds, counts, box = _measure(
        picture.colours, picture.instance, picture.depth, is_bystander
    )
    ids = np.unique(np.append(np.flatnonzero(all_pairs), 0))  # few of all, and 0
    pairs, equal, bright = all_pairs[ids], all_equal[ids], all_bright[ids]
    candidates = (pairs >= LEAST_PAIRS) & (equal >= flat_share * pairs) & (bright >= DARK * pairs)
    largest = int(np.argmax(np.where(candidates, pairs, 0)))
    # A renderer without grain on any surface misses no texture.
    other_equal = int(equal.sum() - equal[largest])
    other_pairs = int(pairs.sum() - pairs[largest])
    is_judged = bool(candidates[largest]) and other_equal < GRAINLESS * other_pairs
    flat = float(pairs[largest]) / num_pixels if is_judged else 0.0
    person = None if box[2] < 0 else (int(box[0]), int(box[1]), int(box[2]), int(box[3]))
    return PixelFigures(flat, int(kinds[ids[largest]]), counts[0] / num_pixels, counts[1] / num_pixels, person)


@njit(cache=True, nogil=True)
def _fights(colours, instance, depth, code, other, begins, line, down):  # type: ignore[no-untyped-def]
    """Return whether two ids alternate over one plane and differ visibly.

    Args:
        code, other: Id and kind of both. line: Index of a row, or of a column if `down` is 1.
        begins: First pixels of their last three runs, of which the first two must be short.
    """
    low, middle, end = begins
    if end - middle > SHORTEST_RUN_PX or middle - low > SHORTEST_RUN_PX:
        return False
    # Distant fields are narrow stripes without an id.
    if code >> 8 == SHARED_ID or other >> 8 == SHARED_ID or (code | other) >> 8 == 0:
        return False
    across = 1 - down
    y, x = across * line, down * line  # of the line's first pixel
    before = low - 1
    first, last = float(depth[y + down * before, x + across * before]), float(depth[y + down * end, x + across * end])
    if not (INVALID_DEPTH_M < first < SKY_DEPTH_M and INVALID_DEPTH_M < last < SKY_DEPTH_M):
        return False
    first, last = 1.0 / first, 1.0 / last
    for k in range(low, end):
        here = float(depth[y + down * k, x + across * k])
        plane = first + (last - first) * (k - before) / (end - before)
        if not here > 0.0 or abs(1.0 / here - plane) > PLANE_SHARE * plane:
            return False
    for k in (middle, end):
        y0, x0, y1, x1 = y + down * (k - 1), x + across * (k - 1), y + down * k, x + across * k
        step = np.int64(0)
        for c in range(3):
            step += abs(np.int64(colours[y0, x0, c]) - np.int64(colours[y1, x1, c]))
        if instance[y0, x0, 0] == instance[y1, x1, 0] and step <= VISIBLE_STEP:
            return False
    return True


@njit(cache=True, nogil=True)
def _pack(row, tones, codes, shades):  # type: ignore[no-untyped-def]
    """Pack each pixel of a row into one number, kind and red lowest. Unsigned indices avoid numba's wraparound
    checks."""
    for x in range(np.uint64(len(row))):
        codes[x] = np.int32(row[x, 0]) | np.int32(row[x, 1]) << 8 | np.int32(row[x, 2]) << 16
        shades[x] = np.uint32(tones[x, 0]) | np.uint32(tones[x, 1]) << 8 | np.uint32(tones[x, 2]) << 16


@njit(cache=True, nogil=True)
def _measure(colours, instance, depth, is_bystander):  # type: ignore[no-untyped-def]
    """Measure a frame.

    Returns:
        By id: pairs of neighbours in a row, pairs of one colour, sum of green, kind. Then the counts of magenta and of
        fighting pixels, and the box of the pedestrians that are no bystanders.
    """
    height, width = instance.shape[:2]
    has_depth = depth.shape[0] > 0
    pairs, equal, bright = np.zeros(NUM_IDS, np.int64), np.zeros(NUM_IDS, np.int64), np.zeros(NUM_IDS, np.int64)
    kinds, counts = np.zeros(NUM_IDS, np.uint8), np.zeros(2, np.int64)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    # Id and first row of the current run of each column, and of the two before it.
    ids, firsts = np.full((3, width), -1, np.int32), np.zeros((3, width), np.int32)
    codes, shades = np.full(width + 1, -1, np.int32), np.empty(width, np.uint32)
    one, size, byte = np.uint64(1), np.uint64(width), np.uint32(255)
    for y in range(height):
        _pack(instance[y], colours[y], codes, shades)
        first = np.uint64(0)
        id1, id2, id3 = np.int64(-1), np.int64(-1), np.int64(-1)  # of the three previous runs
        first1, first2 = np.int64(0), np.int64(0)
        while first < size:
            code, end = np.int64(codes[first]), first + one
            while codes[end] == code:  # -1 follows the row
                end += one
            begin, kind, number = np.int64(first), code & 255, code >> 8
            if kind == PERSON and not is_bystander[number]:
                box[0], box[1] = min(box[0], begin), min(box[1], y)
                box[2], box[3] = max(box[2], np.int64(end)), max(box[3], y + 1)
            if kind not in (NOTHING, SKY):
                kinds[number] = kind
                same, light, pink = np.uint32(0), np.uint32(0), np.uint32(0)
                for x in range(first, end - one):
                    shade = shades[x]
                    red, green, blue = shade & byte, shade >> np.uint32(8) & byte, shade >> np.uint32(16)
                    same += np.uint32(shade == shades[x + one])
                    light += green
                    pink += np.uint32((red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST))
                pairs[number] += np.int64(end) - 1 - begin
                equal[number] += same
                bright[number] += light
                counts[0] += pink
            if has_depth:
                # Runs 3, 2, 1 and this one: A, B, A, B, with short ones in the middle.
                runs = (first2, first1, begin)
                if code == id2 and id1 == id3 and _fights(colours, instance, depth, code, id1, runs, y, 0):
                    counts[1] += begin - first1
                id3, id2, id1 = id2, id1, code
                first2, first1 = first1, begin
            first = end
        if has_depth:
            for column in range(size):
                if ids[0, column] != codes[column]:
                    x, code = np.int64(column), np.int64(codes[column])  # type: ignore[assignment]
                    other, runs = np.int64(ids[0, x]), (np.int64(firsts[1, x]), np.int64(firsts[0, x]), np.int64(y))
                    is_turn = code == ids[1, x] and other == ids[2, x]
                    if is_turn and _fights(colours, instance, depth, code, other, runs, x, 1):
                        counts[1] += y - runs[1]
                    ids[2, x], ids[1, x], ids[0, x] = ids[1, x], ids[0, x], code
                    firsts[2, x], firsts[1, x], firsts[0, x] = firsts[1, x], firsts[0, x], y
    return pairs, equal, bright, kinds, counts, box
