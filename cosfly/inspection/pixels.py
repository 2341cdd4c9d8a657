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
from cosfly.runtime.errors import InputError
from cosfly.runtime.png import colours_of

NO_DEPTH = np.empty((0, 0), np.float32)
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
    red, green, blue = np.moveaxis(picture.colours, 2, 0)
    magenta = (red >= MAGENTA_LEAST) & (blue >= MAGENTA_LEAST) & (green <= MAGENTA_MOST)
    if not picture.instance.size:
        return PixelFigures(flat=0.0, flat_kind=0, magenta=float(magenta.mean()), fighting=0.0, person_box=None)
    kinds = picture.instance[..., 0]
    ids = picture.instance[..., 1].astype(np.uint16) | picture.instance[..., 2].astype(np.uint16) << 8
    codes = kinds | ids.astype(np.int32) << 8
    is_surface = (kinds != NOTHING) & (kinds != SKY)
    flat_id, num_flat_pairs = _flat_surface(picture.colours, codes, is_surface, flat_share) or (None, 0)
    num_fighting = 0
    if picture.depth.size:
        num_fighting = _num_fighting(codes, picture.depth, picture.colours)
        num_fighting += _num_fighting(codes.T, picture.depth.T, picture.colours.transpose(1, 0, 2))
    return PixelFigures(
        flat=num_flat_pairs / num_pixels,
        flat_kind=0 if flat_id is None else int(kinds[ids == flat_id][-1]),  # of a shared id, the lowest pixel decides
        magenta=float((magenta & is_surface).sum()) / num_pixels,  # not the sky, which may be magenta
        fighting=num_fighting / num_pixels,
        person_box=_box_of((kinds == PERSON) & ~is_bystander[ids]),
    )


def _flat_surface(
    colours: np.ndarray, codes: np.ndarray, is_surface: np.ndarray, flat_share: float
) -> tuple[int, int] | None:
    """Return the id of the largest surface without texture, and its number of pixel pairs; None if there is none.

    A pair is two neighbours of one surface in a row. If the other surfaces have no grain either, the renderer draws
    without textures, so none is missing.
    """
    red, green, blue = np.moveaxis(colours.astype(np.int32), 2, 0)
    shades = red | green << 8 | blue << 16
    is_pair = is_surface[:, :-1] & (codes[:, :-1] == codes[:, 1:])
    if not is_pair.any():
        return None
    is_equal = is_pair & (shades[:, :-1] == shades[:, 1:])
    ids = codes[:, :-1] >> 8
    num_pairs, num_equal = _counts_by_id(ids, (is_pair, is_equal))
    candidates = np.flatnonzero((num_pairs >= LEAST_PAIRS) & (num_equal >= flat_share * num_pairs))
    for flat_id in sorted(candidates.tolist(), key=lambda k: -num_pairs[k]):
        if green[:, :-1][is_pair & (ids == flat_id)].mean() >= DARK:
            num_other_pairs = num_pairs.sum() - num_pairs[flat_id]
            others_have_grain = num_equal.sum() - num_equal[flat_id] < GRAINLESS * num_other_pairs
            return (flat_id, int(num_pairs[flat_id])) if others_have_grain else None
    return None


def _counts_by_id(ids: np.ndarray, masks: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Return the number of pixels of each id in each mask, (h, w) bool; it sums the few stretches of one id first."""
    ids = ids.ravel()
    starts = np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1)
    return [np.bincount(ids[starts], np.add.reduceat(mask.ravel(), starts, dtype=np.int64)) for mask in masks]


def _num_fighting(codes: np.ndarray, depth: np.ndarray, colours: np.ndarray) -> int:
    """Return the number of pixels at which two surfaces of one plane alternate along the rows and differ visibly.

    Surfaces alternate where four runs of equal pixels in a row are A | B | A | B and those in the middle are short:

        A | B | A | B
            low     end: the first pixels of the second and of the last run
                middle: that of the third

    Args:
        codes: (h, w) int32, id << 8 | kind.
    """
    rows, last_columns = np.nonzero(codes[:, 1:] != codes[:, :-1])
    starts = last_columns + 1  # the first pixels of all runs but the first of a row
    is_short = np.diff(starts) <= SHORTEST_RUN_PX
    runs = np.flatnonzero((rows[2:] == rows[:-2]) & is_short[:-1] & is_short[1:])  # of B, the second of four runs
    a, b = codes[rows[runs], starts[runs] - 1], codes[rows[runs], starts[runs]]
    alternates = (a == codes[rows[runs], starts[runs + 1]]) & (b == codes[rows[runs], starts[runs + 2]])
    # Distant fields are narrow stripes without an id.
    has_ids = (a >> 8 != SHARED_ID) & (b >> 8 != SHARED_ID) & ((a | b) >> 8 != 0)
    runs = runs[alternates & has_ids]
    rows, low, middle, end = rows[runs], starts[runs], starts[runs + 1], starts[runs + 2]
    fights = _lie_in_plane(depth, rows, low, end)
    for edge in (middle, end):
        step = np.abs(colours[rows, edge].astype(int) - colours[rows, edge - 1]).sum(axis=1)
        kind_changes = (codes[rows, edge] ^ codes[rows, edge - 1]) & 255 != 0
        fights &= kind_changes | (step > VISIBLE_STEP)
    return int((end - middle)[fights].sum())


def _lie_in_plane(depth: np.ndarray, rows: np.ndarray, low: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return whether the pixels from low - 1 to end of a row lie in one plane, (n,) bool."""
    before_m = depth[rows, low - 1]
    last_m = depth[rows, end]
    in_plane = (before_m > INVALID_DEPTH_M) & (before_m < SKY_DEPTH_M)
    in_plane &= (last_m > INVALID_DEPTH_M) & (last_m < SKY_DEPTH_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_before = 1.0 / before_m.astype(float)
        inverse_last = 1.0 / last_m.astype(float)
        for k in range(2 * SHORTEST_RUN_PX):
            column = np.minimum(low + k, end)
            inverse_plane = inverse_before + (inverse_last - inverse_before) * (column - low + 1) / (end - low + 1)
            depth_m = depth[rows, column].astype(float)
            in_plane &= (depth_m > 0.0) & (np.abs(1.0 / depth_m - inverse_plane) <= PLANE_SHARE * inverse_plane)
    return in_plane


def _box_of(mask: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return xmin, ymin, xmax, ymax of the pixels of a mask; None without any."""
    columns = np.flatnonzero(mask.any(axis=0))
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
