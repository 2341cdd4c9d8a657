"""Figures of all pixels of one frame: missing textures, Z-fighting, and the box of the target.

A missing texture shows as the magenta of many engines, or as a large surface of one colour. Z-fighting: where two
surfaces lie in one plane, rounding decides which of them is drawn at each pixel, so their ids alternate along a row or
a column while the depth is that of one plane. It counts only where the colours or the kinds differ visibly.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosfly.formats.frames import DEPTH_NPY, INVALID_DEPTH_M, SHARED_ID, SKY_DEPTH_M, depth_values, public_name
from cosfly.formats.kinds import KINDS
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError
from cosfly.runtime.png import colours_of

NO_DEPTH = np.empty((0, 0), np.float32)
NO_DEPTH.flags.writeable = False
NO_IDS = np.empty((0, 0, 3), np.uint8)
NUM_IDS = 1 << 16
PERSON, NOTHING, SKY = KINDS["Pedestrians"], KINDS["NONE"], KINDS["Sky"]
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
    """The decoded files of a frame."""

    colours: np.ndarray  # (h, w, 3) uint8 RGB
    depth: np.ndarray  # (h, w) float32, m; empty if the frame has none
    instance: np.ndarray  # (h, w, 3) uint8: kind, low byte and high byte of the id; empty if the frame has none


@dataclass(frozen=True)
class PixelFigures:
    """Figures of a frame."""

    flat: float  # share of the picture in the largest surface of one colour; 0 if no surface or every surface is flat
    flat_kind: int  # kind of that surface
    magenta: float  # share of magenta pixels in the picture
    fighting: float  # share of pixels with Z-fighting in the picture
    person_box: tuple[int, int, int, int] | None  # xmin, ymin, xmax, ymax px of the target's pixels; None without any


def unpack(files: dict[str, bytes], where: Path) -> Picture:
    """Decode the files of a frame, by name; depth and `instance.png` are optional."""
    colours = colours_of(files["rgb.png"], where / "rgb.png")
    instance = NO_IDS
    if "instance.png" in files:
        instance = colours_of(files["instance.png"], where / "instance.png")
        _check_size(instance, colours, where / "instance.png")
    depth = NO_DEPTH
    depth_name = next((name for name in files if public_name(name) == DEPTH_NPY), None)
    if depth_name is not None:
        depth = depth_values(memoryview(files[depth_name]), where / depth_name)
        _check_size(depth, colours, where / depth_name)
    depth.flags.writeable = False  # the kernels are compiled for read-only arrays only
    return Picture(colours, depth, instance)


def _check_size(values: np.ndarray, colours: np.ndarray, file: Path) -> None:
    if values.shape[:2] != colours.shape[:2]:
        raise InputError(
            "the picture does not have the same size as rgb.png of the same frame",
            where=file,
            got="{1} x {0} px".format(*values.shape),
            expected="{1} x {0} px".format(*colours.shape),
            fix="render this frame again",
        )


def measure_pixels(picture: Picture, is_bystander: np.ndarray, flat_share: float) -> PixelFigures:
    """Return the figures of a frame.

    Args:
        is_bystander: (65536,) bool, by id.
        flat_share: A surface of one colour has at least this share of equal neighbours.
    """
    num_pixels = picture.colours.shape[0] * picture.colours.shape[1]
    if not picture.instance.size:
        red, green, blue = (picture.colours[..., k] for k in range(3))
        magenta = (red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST)
        return PixelFigures(flat=0.0, flat_kind=0, magenta=float(magenta.mean()), fighting=0.0, person_box=None)
    all_pairs, all_equal, all_bright, kinds, num_magenta, num_fighting, box = _measure(
        picture.colours, picture.instance, picture.depth, is_bystander
    )
    ids = np.unique(np.append(np.flatnonzero(all_pairs), 0))  # those in the picture, and 0, so that there is one
    pairs = all_pairs[ids]
    equal = all_equal[ids]
    is_flat = (pairs >= LEAST_PAIRS) & (equal >= flat_share * pairs) & (all_bright[ids] >= DARK * pairs)
    largest = int(np.argmax(np.where(is_flat, pairs, 0)))
    # A renderer whose other surfaces have no grain either draws without textures, so none is missing.
    other_equal = int(equal.sum() - equal[largest])
    other_pairs = int(pairs.sum() - pairs[largest])
    lacks_texture = bool(is_flat[largest]) and other_equal < GRAINLESS * other_pairs
    return PixelFigures(
        flat=float(pairs[largest]) / num_pixels if lacks_texture else 0.0,
        flat_kind=int(kinds[ids[largest]]),
        magenta=num_magenta / num_pixels,
        fighting=num_fighting / num_pixels,
        person_box=None if box[2] < 0 else (int(box[0]), int(box[1]), int(box[2]), int(box[3])),
    )


@njit(cache=True, nogil=True)
def _fights(colours, instance, depth, code, other, begins, line, down):  # type: ignore[no-untyped-def]
    """Return whether two surfaces that alternate along a line lie in one plane and differ visibly.

    Args:
        code, other: Id << 8 | kind of each surface.
        begins: First pixels of the last three runs, of which the first two must be short.
        line: Index of the row, or of the column if `down` is 1.
    """
    low, middle, end = begins
    if end - middle > SHORTEST_RUN_PX or middle - low > SHORTEST_RUN_PX:
        return False
    # Distant fields are narrow stripes without an id.
    if code >> 8 == SHARED_ID or other >> 8 == SHARED_ID or (code | other) >> 8 == 0:
        return False
    across = 1 - down
    # The first pixel of the line.
    y = across * line
    x = down * line
    before = low - 1
    first_m = float(depth[y + down * before, x + across * before])
    last_m = float(depth[y + down * end, x + across * end])
    if not (INVALID_DEPTH_M < first_m < SKY_DEPTH_M and INVALID_DEPTH_M < last_m < SKY_DEPTH_M):
        return False
    first = 1.0 / first_m
    last = 1.0 / last_m
    for k in range(low, end):
        depth_m = float(depth[y + down * k, x + across * k])
        plane = first + (last - first) * (k - before) / (end - before)
        if not depth_m > 0.0 or abs(1.0 / depth_m - plane) > PLANE_SHARE * plane:
            return False
    for k in (middle, end):
        y0 = y + down * (k - 1)
        x0 = x + across * (k - 1)
        y1 = y + down * k
        x1 = x + across * k
        step = np.int64(0)
        for channel in range(3):
            step += abs(np.int64(colours[y0, x0, channel]) - np.int64(colours[y1, x1, channel]))
        if instance[y0, x0, 0] == instance[y1, x1, 0] and step <= VISIBLE_STEP:
            return False
    return True


@njit(cache=True, nogil=True)
def _pack(instance, colours, codes, shades):  # type: ignore[no-untyped-def]
    """Pack the pixels of a row, (w, 3) uint8 each: id << 8 | kind into `codes`, blue, green, red into `shades`."""
    for x in range(np.uint64(len(instance))):  # an unsigned index avoids numba's wraparound checks
        codes[x] = np.int32(instance[x, 0]) | np.int32(instance[x, 1]) << 8 | np.int32(instance[x, 2]) << 16
        shades[x] = np.uint32(colours[x, 0]) | np.uint32(colours[x, 1]) << 8 | np.uint32(colours[x, 2]) << 16


@njit(cache=True, nogil=True)
def _measure(colours, instance, depth, is_bystander):  # type: ignore[no-untyped-def]
    """Measure a frame run by run: a run is a stretch of pixels of one id and kind in a row.

    Returns:
        By id, (65536,) each: pairs of neighbours in a row, pairs of one colour, sum of green, kind. Then the counts of
        magenta and of fighting pixels, and the box of the pedestrians that are no bystanders.
    """
    height, width = instance.shape[:2]
    has_depth = depth.shape[0] > 0
    pairs = np.zeros(NUM_IDS, np.int64)
    equal = np.zeros(NUM_IDS, np.int64)
    bright = np.zeros(NUM_IDS, np.int64)
    kinds = np.zeros(NUM_IDS, np.uint8)
    num_magenta = np.int64(0)
    num_fighting = np.int64(0)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    # Code and first row of the current run of each column, and of the two runs before it.
    column_codes = np.full((3, width), -1, np.int32)
    column_firsts = np.zeros((3, width), np.int32)
    codes = np.full(width + 1, -1, np.int32)  # of the present row; -1 follows it
    shades = np.empty(width, np.uint32)
    one = np.uint64(1)  # numba keeps an index unsigned only if all operands are
    size = np.uint64(width)
    byte = np.uint32(255)
    for y in range(height):
        _pack(instance[y], colours[y], codes, shades)
        first = np.uint64(0)
        # Codes of the three previous runs of this row, the latest first, and first pixels of the last two.
        code1, code2, code3 = np.int64(-1), np.int64(-1), np.int64(-1)
        first1, first2 = np.int64(0), np.int64(0)
        while first < size:
            code = np.int64(codes[first])
            end = first + one
            while codes[end] == code:
                end += one
            begin = np.int64(first)
            kind = code & 255
            number = code >> 8
            if kind == PERSON and not is_bystander[number]:
                box[0], box[1] = min(box[0], begin), min(box[1], y)
                box[2], box[3] = max(box[2], np.int64(end)), max(box[3], y + 1)
            if kind not in (NOTHING, SKY):
                kinds[number] = kind
                num_equal, sum_green, num_pink = np.uint32(0), np.uint32(0), np.uint32(0)
                for x in range(first, end - one):
                    shade = shades[x]
                    red, green, blue = shade & byte, shade >> np.uint32(8) & byte, shade >> np.uint32(16)
                    num_equal += np.uint32(shade == shades[x + one])
                    sum_green += green
                    num_pink += np.uint32((red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST))
                pairs[number] += np.int64(end) - 1 - begin
                equal[number] += num_equal
                bright[number] += sum_green
                num_magenta += np.int64(num_pink)
            if has_depth:
                # Runs 3, 2, 1 and this one: A, B, A, B, with short ones in the middle.
                begins = (first2, first1, begin)
                if code == code2 and code1 == code3 and _fights(colours, instance, depth, code, code1, begins, y, 0):
                    num_fighting += begin - first1
                code3, code2, code1 = code2, code1, code
                first2, first1 = first1, begin
            first = end
        if has_depth:
            for index in range(size):
                if column_codes[0, index] != codes[index]:
                    column = np.int64(index)
                    code = np.int64(codes[index])
                    other = np.int64(column_codes[0, column])
                    begins = (np.int64(column_firsts[1, column]), np.int64(column_firsts[0, column]), np.int64(y))
                    alternates = code == column_codes[1, column] and other == column_codes[2, column]
                    if alternates and _fights(colours, instance, depth, code, other, begins, column, 1):
                        num_fighting += y - begins[1]
                    for age in (2, 1):
                        column_codes[age, column] = column_codes[age - 1, column]
                        column_firsts[age, column] = column_firsts[age - 1, column]
                    column_codes[0, column] = code
                    column_firsts[0, column] = y
    return pairs, equal, bright, kinds, num_magenta, num_fighting, box
