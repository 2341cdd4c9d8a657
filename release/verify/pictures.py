"""The pictures of one row: are they whole, of the right size and kind, and do they show what the row says?"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import SKY_DEPTH_M, FrameFile, depth_values
from cosfly.products.kinds import KINDS
from cosfly.products.png import parse_png
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.render.camera import contrast_of
from cosfly.space.reprojection import COLUMNS, FLAT, GRID_ROWS, View, median_of
from cosfly.work.compiled import njit
from release.columns import PICTURES
from release.depth import depth_of
from release.flight_rows import FlightRows
from release.record import DepthCoding
from release.verify.findings import Findings
from release.verify.sources import Pictures

SURFACE_M = PERSON_HALF_EXTENTS_M[2] + 0.3  # between the hip and the visible surface of a person along the optical axis
LEAST_BOX_PX2 = 24.0  # a box of fewer pixels can lose the person between two pixel centres
CONTRAST = 0.02  # rounded to 0.01
MOST_RAYS, LEAST_RAYS = 900, 30  # through the box of a person: the score is a share of them
# Of the visibility. Where a ray goes through each pixel of the box it is the renderer's own number: honest 0.000, of
# depth as float16 0.002. Of fewer rays, three deviations of a share of so many; honest 0.021.
SCORE, SCORE_OF_FEWER = 0.02, 0.06
STEP_PIXELS = 20_000  # of a frame
PERSON, SKY, MOST_KIND = KINDS["Pedestrians"], KINDS["Sky"], max(KINDS.values())
SHARED_ID, NOBODY = 65534, 0  # ids of `instance.png` that stand for several things, or for none
NUM_IDS = 65536
NEAR_M = 0.3  # where rays begin: the renderers' near plane
SURFACE_SLACK_M = 0.05  # how far before a person's box what is drawn may lie and not hide it
PERSON_HALF_M = np.array(PERSON_HALF_EXTENTS_M)
NOTHING = np.empty((0, 0), np.float32)
NOTHING.flags.writeable = False
NO_IDS = np.empty((0, 0, 3), np.uint8)
Decoded = tuple[np.ndarray, np.ndarray]  # depth, instance
BESIDE_M, BESIDE_PX, LEAST_GROUND = 0.6, 60, 12  # from the feet; columns and rows that are looked at; pixels of ground


def decode(flight: FlightRows, i: int, files: Pictures, coding: DepthCoding, findings: Findings) -> Decoded | None:
    """Unpack the pictures of a row; None, with findings, where one is not a whole picture of the row's size."""
    width, height = (int(n) for n in flight.size_px[i])
    found: dict[FrameFile, np.ndarray] = {}
    for file, data in files.items():
        where = flight.where(i, PICTURES[file].name)
        try:
            if not data:
                raise InputError("no picture", got="null" if data is None else "0 bytes")
            if file == "depth":
                found[file] = _depth(data, coding, where)
                size = found[file].shape[::-1]
            else:
                found[file], size = _colours(flight, data, where, file == "instance", findings)
        except InputError as error:
            findings.error("picture", where, f"{error.what}: {error.got}", f"a {file} picture of {width} x {height} px")
            continue
        if size != (width, height):
            findings.error("picture", where, f"{size[0]} x {size[1]} px", f"{width} x {height} px, as the row says")
            found.pop(file)
    if len(found) < len(files):
        return None
    if "rgb" in found and "instance" in found:
        _check_contrast(flight, i, found["rgb"], found["instance"], findings)
    return found.get("depth", NOTHING), found.get("instance", NO_IDS)


def _depth(data: bytes | memoryview, coding: DepthCoding, where: str) -> np.ndarray:
    is_raw = coding.coding == "float32"
    depth = depth_values(memoryview(data), Path(where)) if is_raw else depth_of(bytes(data), coding, where)
    depth.flags.writeable = False  # the compiled checks are compiled for such, once
    return depth


def _colours(
    flight: FlightRows, data: bytes | memoryview, where: str, is_mask: bool, findings: Findings
) -> tuple[np.ndarray, tuple[int, int]]:
    """Unpack a PNG. It is its pixels: nothing behind its end, of cosfly's own no words and no other meaning of its
    colours, and nothing that one sees through."""
    png = parse_png(data, where)
    if png.channels < 3:
        raise InputError("not a colour picture", got=f"{png.channels} channels")
    if png.num_behind:
        findings.error("cargo", where, f"{png.num_behind:,} bytes behind the picture's end", "nothing")
    if png.others and not flight.is_foreign:
        findings.error("cargo", where, f"chunks {', '.join(png.others)}", "pixels alone, as cosfly writes them")
    if not is_mask and png.channels == 4 and (png.pixels()[..., 3] != 255).any():
        findings.error("blank", where, "pixels that one sees through", "a picture that hides what is behind it")
    return np.ascontiguousarray(png.pixels()[..., :3]), (png.width_px, png.height_px)


def view_of(flight: FlightRows, i: int, decoded: Decoded) -> View:
    depth, instance = decoded
    rotation = flight.rotations[i] @ BODY_FROM_CAMERA
    return View(depth, instance, np.ascontiguousarray(rotation), flight.pose[i, :3].copy())


def check_picture(flight: FlightRows, i: int, decoded: Decoded, findings: Findings) -> bool:
    """Check depth and mask of a row with each other and with the row; False where the depth is no depth."""
    depth, instance = decoded
    found = survey(depth, instance)
    good = not depth.size or _check_depth(flight.where(i, "depth"), found.low_m, found.high_m, findings)
    if instance.size:
        if flight.is_foreign:
            _check_foreign_person(flight, i, instance, findings)
        else:
            _check_instance(flight, i, found, bool(depth.size), findings)
        if depth.size and good:
            _check_person_depth(flight, i, instance, depth, findings)
            if not flight.is_foreign:
                _check_visibility(flight, i, instance, depth, findings)
    return good


def _check_contrast(flight: FlightRows, i: int, rgb: np.ndarray, instance: np.ndarray, findings: Findings) -> None:
    """What the row says of how a person stands out, of which `target_legible` is told, is what the picture shows."""
    row = flight.rows[i]
    if row.get("target_height_px") is None or rgb.shape != instance.shape:
        return
    is_person = (instance[..., 1:] == 255).all(axis=2)  # PERSON_ID
    got, expected = row.get("target_contrast"), contrast_of(rgb, is_person)
    if (got is None) != (expected is None) or abs((got or 0.0) - (expected or 0.0)) > CONTRAST:
        findings.error("contrast", flight.where(i, "target_contrast"), got, f"{expected}, of the picture")


def _check_depth(where: str, low: float, high: float, findings: Findings) -> bool:
    if np.isnan(low):
        findings.error("depth_range", where, "pixels that are not finite", "metres in every pixel")
    elif low < 0.0:
        findings.error("depth_range", where, f"{low:.3f} to {high:.3f} m", f"0 to {SKY_DEPTH_M:g} m")
    elif low == high:
        findings.error("depth_range", where, f"{low:.3f} m everywhere", "a depth image")
    else:
        return True
    return False


def _check_foreign_person(flight: FlightRows, i: int, instance: np.ndarray, findings: Findings) -> None:
    low, high = np.floor(flight.box[i, :2]), np.ceil(flight.box[i, 2:])
    visible = bool(flight.rows[i].get("target_visible"))
    if visible and not np.isnan(low).any() and np.prod(high - low) >= LEAST_BOX_PX2:
        (x0, y0), (x1, y1) = np.maximum(low, 0).astype(int), high.astype(int)
        if not (instance[y0 : y1 + 1, x0 : x1 + 1, 0] == PERSON).any():
            got = "no pedestrian at target_bbox" if (instance[..., 0] == PERSON).any() else "no pedestrian"
            findings.error("mask", flight.where(i, "instance"), got, "pixels of the person, who is visible")


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


def _check_visibility(flight: FlightRows, i: int, instance: np.ndarray, depth: np.ndarray, findings: Findings) -> None:
    """The score is the share of the person's box that nothing hides: rays through it, as the renderer casts them, but
    fewer."""
    score, corners = flight.rows[i].get("visibility"), flight.projected_corners[i]
    if score is None or np.isnan(corners).any() or not flight.rows[i].get("target_in_view"):
        return
    (x0, y0), (x1, y1) = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    stride = max(1.0, float(np.sqrt((x1 - x0) * (y1 - y0) / MOST_RAYS)))
    columns, rows = (np.floor(np.arange(begin, end, stride)) for begin, end in ((x0, x1), (y0, y1)))
    num_hits, num_seen = rays_to_person(
        depth, instance, columns, rows, flight.intrinsics[i], flight.rotations[i] @ BODY_FROM_CAMERA,
        flight.target_m[i] - flight.pose[i, :3], PERSON_HALF_M,
    )  # fmt: skip
    if num_hits < LEAST_RAYS:
        return
    share = num_seen / num_hits
    if abs(share - score) > (SCORE if stride == 1.0 else SCORE_OF_FEWER):
        findings.error("visibility", flight.where(i, "visibility"), f"{score:.2f}", f"{share:.2f}, of the depth image")


def ground_beside(flight: FlightRows, i: int, depth: np.ndarray, instance: np.ndarray) -> float:
    """Give how far the ground that is drawn round the person's feet lies above them, m; NaN where too little of it is
    seen.

    Of a kerb the half that is nearer counts: a person walks on either.

    Args:
        depth: (h, w) float32 m, along the optical axis; instance: (h, w, 3) uint8.
    """
    feet = flight.target_m[i] - [0.0, 0.0, PERSON_HALF_EXTENTS_M[2]]
    rotation, (fx, fy, cx, cy) = flight.rotations[i] @ BODY_FROM_CAMERA, flight.intrinsics[i]
    x, y, z = rotation.T @ (feet - flight.pose[i, :3])
    if not (np.isfinite(z) and z > 0.0):
        return np.nan
    (height, width), u, v = depth.shape, fx * x / z + cx, fy * y / z + cy
    reach_px = min(BESIDE_PX, int(np.ceil(fx * BESIDE_M / z)) + 1)
    x0, x1 = np.clip([u - reach_px, u + reach_px + 1], 0, width).astype(int)
    y0, y1 = np.clip([v - reach_px, v + reach_px + 1], 0, height).astype(int)
    seen, mask = depth[y0:y1, x0:x1].astype(np.float64), instance[y0:y1, x0:x1]
    columns, rows = np.meshgrid((np.arange(x0, x1) + 0.5 - cx) / fx, (np.arange(y0, y1) + 0.5 - cy) / fy)
    points = np.stack([columns, rows, np.ones_like(seen)], axis=-1) * seen[..., None]
    is_slab = FLAT[mask[..., 0]] & (mask[..., 1:] != 0).any(axis=-1)  # the plane below everything has no id
    heights_m = (points @ rotation[2] + flight.pose[i, 2] - feet[2])[is_slab]
    if len(heights_m) < LEAST_GROUND:
        return np.nan
    return float(np.clip(0.0, *np.percentile(heights_m, [25, 75])))


def least_step(depth: np.ndarray) -> float:
    """Give the least difference between two depths of some pixels, m; NaN where too few of them see anything."""
    seen = depth.reshape(-1)[:: max(1, depth.size // STEP_PIXELS)]
    seen = seen[seen < SKY_DEPTH_M]
    if len(seen) < STEP_PIXELS // 10:
        return np.nan
    gaps = np.diff(np.sort(seen))
    return float(gaps[gaps > 0.0].min(initial=np.inf))


# --- pixels: every one of mask and depth, rays to the person ----------------------------------------------------------


class Survey(NamedTuple):
    """A frame's mask and depth. low_m, high_m: least and greatest depth, NaN where one is not finite; num_odd_sky:
    pixels of sky by one of depth and kind alone; num_person: of the person; num_odd_person: of the person's id with
    another kind; most_kind: the greatest there is; box: (4,) of the person's pixels, edges at pixel borders."""

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
    limits = np.array([depth.min(initial=np.inf), depth.max(initial=-np.inf)]) if depth.size else np.zeros(2)
    low, high = limits.tolist() if np.isfinite(limits).all() else (np.nan, np.nan)
    counts, box = _survey(depth, np.ascontiguousarray(instance))
    num_odd_sky, num_person, num_odd_person, most_kind = counts.tolist()
    return Survey(low, high, num_odd_sky, num_person, num_odd_person, most_kind, box)


def new_kinds(instance: np.ndarray, known: np.ndarray) -> list[int]:
    """Give id * 256 + kind of things at the grid's points that have another kind than is known of them, each once.

    Args:
        known: (NUM_IDS,) int16, -1: not seen yet.
    """
    height, width = instance.shape[:2]
    rows = ((np.arange(GRID_ROWS) + 0.5) * height / GRID_ROWS).astype(int)
    columns = ((np.arange(COLUMNS) + 0.5) * width / COLUMNS).astype(int)
    kinds, low, high = np.moveaxis(instance[np.ix_(rows, columns)].astype(np.int64), 2, 0)
    ids = low | high << 8
    is_new = (ids != NOBODY) & (ids != SHARED_ID) & (known[ids] != kinds)
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


@njit(cache=True, nogil=True)
def rays_to_person(  # type: ignore[no-untyped-def]
    depth, instance, columns, rows, intrinsics, world_from_camera, away_m, half_m
):
    """Cast rays through the middles of pixels (columns, rows), also beyond the picture, to a box that stands upright,
    `away_m` (3,) from the camera with `half_m` (3,) to each side: how many hit it, and how many of these nothing
    hides."""
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
