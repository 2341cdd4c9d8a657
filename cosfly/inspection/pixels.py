"""All pixels of one frame, unpacked once and looked at once: what surfaces look like, which ids fight for them, where
people are.

It judges nothing. A missing texture shows in two ways: the magenta that engines paint in its stead, or a large surface
whose pixels are all of one colour. Where two surfaces lie in one plane, rounding decides pixel by pixel which is drawn
(Z-fighting): their ids alternate over a depth that runs on as that of one plane. It counts where it shows, in colours
or in kinds.
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
SHARED_ID = 65534  # stands for all boxes beyond the ids that fit (docs/files.md): its neighbours tell nothing
MAGENTA_LEAST, MAGENTA_MOST = 200, 60  # red and blue at least, green at most; no light or haze makes that of a surface
DARK = 16  # grey levels: below, night leaves one colour of many
SHORTEST_RUN_PX = 3  # of an id: as much or less is a stripe that rounding made
# Of a plane 1 / depth is linear in the picture, so that two surfaces fight only where both lie on that line; 1 cm at 30
# m.
PLANE_SHARE = 3e-4
GRAINLESS = 0.9  # share of equal neighbours on all other surfaces
# Of red, green and blue together: more than the grain of one surface; two of one kind and colour fight unseen.
VISIBLE_STEP = 60
LEAST_PAIRS = 400  # neighbouring pixels of a surface, for a share of them to mean something


@dataclass(frozen=True)
class Picture:
    """A frame's pictures. colours, instance: (h, w, 3) uint8; depth: (h, w) float32 m; the last two may be empty."""

    colours: np.ndarray
    depth: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True)
class PixelFigures:
    """What the pixels of a frame show.

    flat: share of the picture of the largest surface that is of one colour where others have grain, 0 of none;
    flat_kind: its kind. magenta, fighting: shares of the picture. person_box: round all pixels of people, without those
    left out: (4,) xmin, ymin, xmax, ymax px; None: no such pixel.
    """

    flat: float
    flat_kind: int
    magenta: float
    fighting: float
    person_box: tuple[int, int, int, int] | None


def unpack(files: dict[str, bytes], where: Path) -> Picture:
    """Unpack the files of a frame, by their names; depth and `instance.png` may be absent.

    Raises:
        InputError: one is damaged, of another size than `rgb.png`, or no picture of a playback tree; names it.
    """
    colours = colours_of(files["rgb.png"], where / "rgb.png")
    instance = colours_of(files["instance.png"], where / "instance.png") if "instance.png" in files else NO_IDS
    depth_name = next((name for name in files if public_name(name) == DEPTH_NPY), DEPTH_NPY)
    depth = depth_values(memoryview(files[depth_name]), where / depth_name) if depth_name in files else NO_DEPTH
    depth.flags.writeable = False  # the compiled checks are compiled for such, once
    for name, values in (("instance.png", instance), (depth_name, depth)):
        if values.size and values.shape[:2] != colours.shape[:2]:
            got, expected = ("{1} x {0} px".format(*found.shape) for found in (values, colours))
            raise InputError("of another size than rgb.png", where=where / name, got=got, expected=expected)
    return Picture(colours, depth, instance)


def look_at(picture: Picture, left_out: np.ndarray, flat_share: float) -> PixelFigures:
    """Look at all pixels of a frame.

    Args:
        left_out: (65536,) bool, ids of people who are not the target. flat_share: so many neighbours of one colour make
            a surface flat.
    """
    num_pixels = picture.colours.shape[0] * picture.colours.shape[1]
    if not picture.instance.size:
        red, green, blue = (picture.colours[..., k] for k in range(3))
        magenta = (red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST)
        return PixelFigures(0.0, 0, float(magenta.mean()), 0.0, None)
    all_pairs, all_equal, all_bright, kinds, counts, box = _look(
        picture.colours, picture.instance, picture.depth, left_out
    )
    ids = np.unique(np.append(np.flatnonzero(all_pairs), 0))  # few of all; 0 also where there is none
    pairs, equal, bright = all_pairs[ids], all_equal[ids], all_bright[ids]
    candidates = (pairs >= LEAST_PAIRS) & (equal >= flat_share * pairs) & (bright >= DARK * pairs)
    largest = int(np.argmax(np.where(candidates, pairs, 0)))
    # A renderer that draws all surfaces without grain misses no texture.
    others_equal, others = int(equal.sum() - equal[largest]), int(pairs.sum() - pairs[largest])
    is_judged = bool(candidates[largest]) and others_equal < GRAINLESS * others
    flat = float(pairs[largest]) / num_pixels if is_judged else 0.0
    person = None if box[2] < 0 else (int(box[0]), int(box[1]), int(box[2]), int(box[3]))
    return PixelFigures(flat, int(kinds[ids[largest]]), counts[0] / num_pixels, counts[1] / num_pixels, person)


@njit(cache=True, nogil=True)
def _is_plane(depth, y0, x0, y1, x1):  # type: ignore[no-untyped-def]
    """Return whether the depth between two pixels of a row or a column is that of one plane."""
    first, last = float(depth[y0, x0]), float(depth[y1, x1])
    if not (INVALID_DEPTH_M < first < SKY_DEPTH_M and INVALID_DEPTH_M < last < SKY_DEPTH_M):
        return False
    first, last = 1.0 / first, 1.0 / last
    steps = (y1 - y0) + (x1 - x0)
    down = np.int64(y1 > y0)
    for k in range(1, steps):
        here = float(depth[y0 + down * k, x0 + (1 - down) * k])
        line = first + (last - first) * k / steps
        if not here > 0.0 or abs(1.0 / here - line) > PLANE_SHARE * line:
            return False
    return True


@njit(cache=True, nogil=True)
def _differs(colours, instance, y0, x0, y1, x1):  # type: ignore[no-untyped-def]
    """Return whether an eye or a mask of kinds tells two pixels apart."""
    step = np.int64(0)
    for c in range(3):
        step += abs(np.int64(colours[y0, x0, c]) - np.int64(colours[y1, x1, c]))
    return instance[y0, x0, 0] != instance[y1, x1, 0] or step > VISIBLE_STEP


@njit(cache=True, nogil=True)
def _pack(row, tones, codes, shades):  # type: ignore[no-untyped-def]
    """Write each pixel of a row as one number, kind lowest and red lowest.

    Its places are unsigned, here and in `_look`: of others numba looks whether they count from the end.
    """
    for x in range(np.uint64(len(row))):
        codes[x] = np.int32(row[x, 0]) | np.int32(row[x, 1]) << 8 | np.int32(row[x, 2]) << 16
        shades[x] = np.uint32(tones[x, 0]) | np.uint32(tones[x, 1]) << 8 | np.uint32(tones[x, 2]) << 16


@njit(cache=True, nogil=True)
def _look(colours, instance, depth, left_out):  # type: ignore[no-untyped-def]
    """Of each id: pairs of neighbours in a row, those of one colour, sum of their green, its kind. Counts: magenta,
    fighting. Box of people."""
    height, width = instance.shape[:2]
    has_depth = depth.shape[0] > 0
    pairs, equal, bright = np.zeros(NUM_IDS, np.int64), np.zeros(NUM_IDS, np.int64), np.zeros(NUM_IDS, np.int64)
    kinds, counts = np.zeros(NUM_IDS, np.uint8), np.zeros(2, np.int64)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    # Of the run of a column that goes on, and of the two before it: id and first row.
    ids, firsts = np.full((3, width), -1, np.int32), np.zeros((3, width), np.int32)
    codes, shades = np.full(width + 1, -1, np.int32), np.empty(width, np.uint32)
    one, size, byte = np.uint64(1), np.uint64(width), np.uint32(255)
    for y in range(height):
        _pack(instance[y], colours[y], codes, shades)
        first = np.uint64(0)
        id1, id2, id3 = np.int64(-1), np.int64(-1), np.int64(-1)  # of the three runs before this one
        first1, first2 = np.int64(0), np.int64(0)
        while first < size:
            code, end = np.int64(codes[first]), first + one
            while codes[end] == code:  # -1 stands behind the row
                end += one
            begin, kind, number = np.int64(first), code & 255, code >> 8
            if kind == PERSON and not left_out[number]:
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
                # Runs 3, 2, 1 and this: A, B, A, B, of which the two in the middle are short.
                if (
                    code == id2
                    and id1 == id3
                    and begin - first1 <= SHORTEST_RUN_PX
                    and first1 - first2 <= SHORTEST_RUN_PX
                    and number != SHARED_ID
                    and id1 >> 8 != SHARED_ID
                    and (code | id1) >> 8 != 0  # far fields are narrow stripes, all of them nobody's
                    and _is_plane(depth, y, first2 - 1, y, begin)
                    and _differs(colours, instance, y, first1 - 1, y, first1)
                    and _differs(colours, instance, y, begin - 1, y, begin)
                ):
                    counts[1] += begin - first1
                id3, id2, id1 = id2, id1, code
                first2, first1 = first1, begin
            first = end
        if has_depth:
            for column in range(size):
                if ids[0, column] != codes[column]:
                    x, code = np.int64(column), np.int64(codes[column])  # type: ignore[assignment]
                    a, b = firsts[1, x], firsts[0, x]
                    if (
                        code == ids[1, x]
                        and ids[0, x] == ids[2, x]
                        and ids[2, x] >= 0
                        and y - b <= SHORTEST_RUN_PX
                        and b - a <= SHORTEST_RUN_PX
                        and code >> 8 != SHARED_ID
                        and ids[0, x] >> 8 != SHARED_ID
                        and (code | ids[0, x]) >> 8 != 0
                        and _is_plane(depth, a - 1, x, y, x)
                        and _differs(colours, instance, b - 1, x, b, x)
                        and _differs(colours, instance, y - 1, x, y, x)
                    ):
                        counts[1] += y - b
                    ids[2, x], ids[1, x], ids[0, x] = ids[1, x], ids[0, x], code
                    firsts[2, x], firsts[1, x], firsts[0, x] = firsts[1, x], firsts[0, x], y
    return pairs, equal, bright, kinds, counts, box
