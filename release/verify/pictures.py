"""The pictures of one row: are they whole, of the right size and kind, and do they show what the row says?"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosfly.errors import InputError
from cosfly.products.frames import SKY_DEPTH_M, FrameFile, depth_values
from cosfly.products.kinds import KINDS
from cosfly.products.png import colours_of
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.space.reprojection import COLUMNS, GRID_ROWS, SHARED_ID, median_of
from cosfly.work.compiled import njit
from release.columns import PICTURES
from release.flight_rows import FlightRows
from release.verify.findings import Findings
from release.verify.sources import Pictures

SURFACE_M = PERSON_HALF_EXTENTS_M[2] + 0.3  # between the hip and the visible surface of a person along the optical axis
PERSON, SKY, MOST_KIND = KINDS["Pedestrians"], KINDS["Sky"], max(KINDS.values())
NUM_IDS = 65536
NOTHING = np.empty((0, 0), np.float32)
NOTHING.flags.writeable = False
NO_IDS = np.empty((0, 0, 3), np.uint8)
Decoded = tuple[np.ndarray, np.ndarray]  # depth, instance


def decode(flight: FlightRows, i: int, files: Pictures, findings: Findings) -> Decoded | None:
    """Unpack the pictures of a row; None, with findings, where one is not a whole picture of the row's size."""
    width, height = (int(n) for n in flight.size_px[i])
    found: dict[FrameFile, np.ndarray] = {}
    for file, data in files.items():
        where = flight.where(i, PICTURES[file].name)
        try:
            if not data:
                raise InputError("no picture", got="null" if data is None else "0 bytes")
            if file == "depth":
                found[file] = depth_values(memoryview(data), Path(where))
                found[file].flags.writeable = False  # the compiled checks are compiled for such, once
            else:
                found[file] = colours_of(data, where)
        except InputError as error:
            findings.error("picture", where, f"{error.what}: {error.got}", f"a {file} picture of {width} x {height} px")
            continue
        size = found[file].shape[1::-1]
        if size != (width, height):
            findings.error("picture", where, f"{size[0]} x {size[1]} px", f"{width} x {height} px, as the row says")
            found.pop(file)
    if len(found) < len(files):
        return None
    return found.get("depth", NOTHING), found.get("instance", NO_IDS)


def check_picture(flight: FlightRows, i: int, decoded: Decoded, findings: Findings) -> bool:
    """Check depth and mask of a row with each other and with the row; False where the depth is no depth."""
    depth, instance = decoded
    found = survey(depth, instance)
    good = not depth.size or 0.0 <= found.low_m < found.high_m
    if not good:
        got, expected = f"{found.low_m:.3f} to {found.high_m:.3f} m", f"a range within 0 to {SKY_DEPTH_M:g} m"
        findings.error("depth_range", flight.where(i, "depth"), got, expected)
    if instance.size:
        if not flight.is_foreign:
            _check_instance(flight, i, found, bool(depth.size), findings)
        if depth.size and good:
            _check_person_depth(flight, i, instance, depth, findings)
    return good


def _check_instance(flight: FlightRows, i: int, found: Survey, has_depth: bool, findings: Findings) -> None:
    """Check the mask: the person where the row has it, kinds that exist, sky where the depth is the sky's."""
    where, recorded = flight.where(i, "instance"), flight.mask_box[i]
    box = found.box.astype(np.float64) if found.num_person else np.full(4, np.nan)
    if not np.array_equal(box, recorded, equal_nan=True):
        got = f"pixels in {box.tolist()}" if found.num_person else "no pixel of the person"
        is_null = np.isnan(recorded).any()
        expected = "none: target_mask_bbox is null" if is_null else f"{recorded.tolist()}, target_mask_bbox"
        findings.error("mask", where, got, expected)
    if found.num_odd_person:
        findings.error("mask", where, f"{found.num_odd_person} pixels of the person of another kind", f"kind {PERSON}")
    if found.most_kind > MOST_KIND:
        findings.error("mask", where, f"kind {found.most_kind}", f"kinds of 0 to {MOST_KIND}")
    if has_depth and found.num_odd_sky:
        got = f"{found.num_odd_sky:,} pixels are sky in one of instance and depth"
        findings.error("sky", where, got, "the same sky in both")


def _check_person_depth(
    flight: FlightRows, i: int, instance: np.ndarray, depth: np.ndarray, findings: Findings
) -> None:
    """The surface of the person is about as far as the row says its hip is."""
    expected = flight.rows[i].get("target_depth_m")
    box = flight.box[i] if flight.is_foreign or np.isnan(flight.mask_box[i]).any() else flight.mask_box[i]
    if expected is None or np.isnan([expected, *box]).any() or not flight.rows[i].get("target_visible"):
        return
    size = depth.shape[::-1]
    low, high = (np.clip(end, 0, size).astype(int) for end in (np.floor(box[:2]), np.ceil(box[2:])))
    surface = depths_of_person(depth, instance, np.concatenate([low, high]), not flight.is_foreign)
    if len(surface) and abs((found := median_of(surface)) - expected) > SURFACE_M:
        wanted = f"{expected:.2f} m (target_depth_m) within {SURFACE_M:.1f} m"
        findings.error("depth", flight.where(i, "depth"), f"{found:.2f} m at the person", wanted)


# --- pixels: every one of mask and depth ----------------------------------------------------------


class Survey(NamedTuple):
    """Least and greatest depth of a frame, NaN where one is not finite; pixels that are sky by one of depth and kind
    alone, of the person, of its id with another kind; the greatest kind; box (4,) of the person, edges at borders."""

    low_m: float
    high_m: float
    num_odd_sky: int
    num_person: int
    num_odd_person: int
    most_kind: int
    box: np.ndarray


def survey(depth: np.ndarray, instance: np.ndarray) -> Survey:
    """Look at every pixel once. depth: (h, w) float32, or (0, 0); instance: (h, w, 3) uint8, or (0, 0, 3)."""
    limits = np.array([depth.min(initial=np.inf), depth.max(initial=-np.inf)]) if depth.size else np.zeros(2)
    low, high = limits.tolist() if np.isfinite(limits).all() else (np.nan, np.nan)
    counts, box = _survey(depth, np.ascontiguousarray(instance))
    num_odd_sky, num_person, num_odd_person, most_kind = counts.tolist()
    return Survey(low, high, num_odd_sky, num_person, num_odd_person, most_kind, box)


def new_kinds(instance: np.ndarray, known: np.ndarray) -> list[int]:
    """Return id * 256 + kind of things at the grid's points that have another kind than is known of them, each once.
    known: (NUM_IDS,) int16, -1: not seen yet."""
    height, width = instance.shape[:2]
    rows = ((np.arange(GRID_ROWS) + 0.5) * height / GRID_ROWS).astype(int)
    columns = ((np.arange(COLUMNS) + 0.5) * width / COLUMNS).astype(int)
    kinds, low, high = np.moveaxis(instance[np.ix_(rows, columns)].astype(np.int64), 2, 0)
    ids = low | high << 8
    is_new = (ids != 0) & (ids != SHARED_ID) & (known[ids] != kinds)
    return np.unique((ids << 8 | kinds)[is_new]).tolist()


def depths_of_person(depth: np.ndarray, instance: np.ndarray, box: np.ndarray, is_ours: bool) -> np.ndarray:
    """Give the depths, (k,) float32 m, of the person's pixels in a box (4,) of whole pixels. is_ours: those of the
    person's id alone."""
    x0, y0, x1, y1 = box
    part = instance[y0:y1, x0:x1]
    is_person = part[..., 0] == PERSON
    return depth[y0:y1, x0:x1][is_person & (part[..., 1:] == 255).all(axis=-1) if is_ours else is_person]


@njit(cache=True, nogil=True)
def _survey(depth, instance):  # type: ignore[no-untyped-def]
    """Give the counts of a `Survey` (4,), and its box."""
    num_odd_sky, num_person, num_odd_person, most_kind = 0, 0, 0, 0
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    for y in range(len(instance)):
        for x in range(instance.shape[1]):
            kind = instance[y, x, 0]
            most_kind = max(most_kind, kind)
            if len(depth) > 0:
                num_odd_sky += (kind == SKY) != (depth[y, x] == SKY_DEPTH_M)
            if instance[y, x, 1] == 255 and instance[y, x, 2] == 255:
                num_person += 1
                num_odd_person += kind != PERSON
                box[0], box[1] = min(box[0], x), min(box[1], y)
                box[2], box[3] = max(box[2], x + 1), max(box[3], y + 1)
    return np.array([num_odd_sky, num_person, num_odd_person, most_kind], np.int64), box
