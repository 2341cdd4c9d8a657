"""The pictures of one row: are they whole, of the right size and kind, and do they show what the row says?"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.png.read import Png, parse_png
from cosfly.products.frames import SKY_DEPTH_M, FrameFile, depth_values
from cosfly.products.kinds import KINDS
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.reprojection import COLUMNS, View, grid_rows, survey
from release.columns import PICTURES
from release.depth import depth_of
from release.record import DepthCoding
from release.verify.findings import Findings
from release.verify.rows import FlightRows
from release.verify.sources import Pictures

PERSON_ID = 65535  # the person in `instance.png`: docs/files.md
SHARED_ID, NOBODY = 65534, 0  # ids that stand for several things, or for none
SURFACE_M = PERSON_HALF_EXTENTS_M[2] + 0.3  # between the hip and the visible surface of a person along the optical axis
LEAST_BOX_PX2 = 24.0  # a box of fewer pixels can lose the person between two pixel centres
BLANK_STD = 2.0  # grey levels: a picture of one colour has 0, fog over a street more than 5
BLOCK_PX = 8  # of JPEG, WebP and videos
LOOK_EVERY = 3  # of the rows that are unpacked, and of the columns
MOST_RAYS = 900  # through the box of a person: the score is a share of them
SCORE = 0.12  # of the visibility: three deviations of a share of so many rays, and pixels on an edge
STEP_PIXELS = 20_000  # of a frame
MOST_KIND = max(KINDS.values())
NOTHING = np.empty((0, 0), np.float32)
NOTHING.flags.writeable = False
NO_IDS = np.empty((0, 0, 3), np.uint8)
Decoded = tuple[np.ndarray, np.ndarray, np.ndarray | None]  # depth, instance, colours at the grid's rows


def decode(flight: FlightRows, i: int, files: Pictures, coding: DepthCoding, findings: Findings) -> Decoded | None:  # fmt: skip
    """Unpack the pictures of a row; None, with findings, where one is not a whole picture of the row's size."""
    width, height = (int(n) for n in flight.size_px[i])
    found: dict[FrameFile, np.ndarray] = {}
    for file, data in files.items():
        where = flight.where(i, PICTURES[file].name)
        try:
            if not data:
                raise InputError("no picture", got="null" if data is None else "0 bytes")
            if file == "depth":
                is_raw = coding.coding == "float32"
                found[file] = (
                    depth_values(memoryview(data), Path(where)) if is_raw else depth_of(bytes(data), coding, where)
                )
                found[file].flags.writeable = False  # the compiled checks are compiled for such, once
                size = found[file].shape[::-1]
            else:
                png = parse_png(data, where)
                size = (png.width_px, png.height_px)
                if png.channels < 3:
                    raise InputError("not a colour picture", got=f"{png.channels} channels")
                _check_cargo(flight, png, where, findings)
                if file == "rgb":
                    found[file] = png.rows(grid_rows(png.height_px))
                    if png.channels == 4 and (found[file][..., 3] != 255).any():
                        findings.error("blank", where, "pixels that one sees through", "a picture that hides what is behind it")  # fmt: skip
                else:
                    found[file] = np.ascontiguousarray(png.pixels()[..., :3])
        except InputError as error:
            findings.error("picture", where, f"{error.what}: {error.got}", f"a {file} picture of {width} x {height} px")
            continue
        if size != (width, height):
            findings.error("picture", where, f"{size[0]} x {size[1]} px", f"{width} x {height} px, as the row says")
            found.pop(file)
    if len(found) < len(files):
        return None
    return found.get("depth", NOTHING), found.get("instance", NO_IDS), found.get("rgb")


def _check_cargo(flight: FlightRows, png: Png, where: str, findings: Findings) -> None:
    """A picture is its pixels: nothing behind its end, and of cosfly's own no words and no other meaning of its colours."""
    if png.num_behind:
        findings.error("cargo", where, f"{png.num_behind:,} bytes behind the picture's end", "nothing")
    if png.others and not flight.is_foreign:
        findings.error("cargo", where, f"chunks {', '.join(png.others)}", "pixels alone, as cosfly writes them")


def view_of(flight: FlightRows, i: int, decoded: Decoded) -> View:
    depth, instance, colours = decoded
    rotation = flight.rotations[i] @ BODY_FROM_CAMERA
    return View(depth, instance, colours, np.ascontiguousarray(rotation), flight.pose[i, :3].copy())


def check_picture(flight: FlightRows, i: int, decoded: Decoded, findings: Findings) -> bool:
    """Check depth, mask and colours of a row with each other and with the row; False where the depth is no depth."""
    depth, instance, colours = decoded
    limits, counts, box, kinds = survey(depth, instance, KINDS["Sky"], PERSON_ID)
    if colours is not None and float(colours[..., :3].std()) < BLANK_STD:
        findings.error("blank", flight.where(i, "image"), f"standard deviation {colours.std():.2f}", "a picture")
    good = not depth.size or _check_depth(flight, i, limits, findings)
    if instance.size:
        _check_instance(flight, i, instance, counts, box, kinds, bool(depth.size), findings)
        if depth.size and good:
            _check_person_depth(flight, i, instance, depth, findings)
    if depth.size and instance.size and good and not flight.is_foreign:
        _check_visibility(flight, i, instance, depth, findings)
    return good


def _check_depth(flight: FlightRows, i: int, limits: np.ndarray, findings: Findings) -> bool:
    low, high = limits
    where = flight.where(i, "depth")
    if np.isnan(low):
        findings.error("depth_range", where, "pixels that are not finite", "metres in every pixel")
    elif low < 0.0 or high > SKY_DEPTH_M:
        findings.error("depth_range", where, f"{low:.3f} to {high:.3f} m", f"0 to {SKY_DEPTH_M:g} m")
    elif low == high:
        findings.error("depth_range", where, f"{low:.3f} m everywhere", "a depth image")
    else:
        return True
    return False


def _check_instance(
    flight: FlightRows, i: int, instance: np.ndarray, counts: np.ndarray, box: np.ndarray, kinds: np.ndarray,
    has_depth: bool, findings: Findings,
) -> None:  # fmt: skip
    """Check the mask: the person where the row has it, kinds that exist, sky where the depth is the sky's."""
    where = flight.where(i, "instance")
    visible = bool(flight.rows[i].get("target_visible"))
    if flight.is_foreign:
        low, high = np.floor(flight.box[i, :2]), np.ceil(flight.box[i, 2:])
        if visible and not np.isnan(low).any() and np.prod(high - low) >= LEAST_BOX_PX2 and not kinds[KINDS["Pedestrians"]]:  # fmt: skip
            findings.error("mask", where, "no pedestrian", "pixels of the person, who is visible")
        elif visible and not np.isnan(low).any() and np.prod(high - low) >= LEAST_BOX_PX2:
            (x0, y0), (x1, y1) = np.maximum(low, 0).astype(int), high.astype(int)
            if not (instance[y0 : y1 + 1, x0 : x1 + 1, 0] == KINDS["Pedestrians"]).any():
                findings.error("mask", where, "no pedestrian at target_bbox", "pixels of the person, who is visible")
        return
    found = box.astype(np.float64) if counts[1] else np.full(4, np.nan)
    if not np.array_equal(found, flight.mask_box[i], equal_nan=True):
        got = "no pixel of the person" if not counts[1] else f"pixels in {found.tolist()}"
        recorded = flight.mask_box[i]
        expected = (
            "none: target_mask_bbox is null" if np.isnan(recorded).any() else f"{recorded.tolist()}, target_mask_bbox"
        )
        findings.error("mask", where, got, expected)
    if counts[2]:
        findings.error("mask", where, f"{counts[2]} pixels of the person of another kind", f"kind {KINDS['Pedestrians']}")  # fmt: skip
    if kinds[MOST_KIND + 1 :].any():
        findings.error("mask", where, f"kind {int(np.flatnonzero(kinds)[-1])}", f"kinds of 0 to {MOST_KIND}")
    if has_depth and counts[0]:
        findings.error("sky", where, f"{counts[0]:,} pixels are sky in one of instance and depth", "the same sky in both")  # fmt: skip


def _check_person_depth(
    flight: FlightRows, i: int, instance: np.ndarray, depth: np.ndarray, findings: Findings
) -> None:
    """The surface of the person is about as far as the row says its hip is."""
    expected = flight.numbers("target_depth_m")[i] if "target_depth_m" in flight.rows[i] else np.nan
    box = flight.box[i] if flight.is_foreign or np.isnan(flight.mask_box[i]).any() else flight.mask_box[i]
    if np.isnan(box).any() or np.isnan(expected) or not flight.rows[i].get("target_visible"):
        return
    height, width = depth.shape
    x0, y0 = np.clip(np.floor(box[:2]), 0, [width, height]).astype(int)
    x1, y1 = np.clip(np.ceil(box[2:]), 0, [width, height]).astype(int)
    part = instance[y0:y1, x0:x1]
    is_person = part[..., 0] == KINDS["Pedestrians"]
    if not flight.is_foreign:
        is_person &= (part[..., 1] == 255) & (part[..., 2] == 255)
    surface = depth[y0:y1, x0:x1][is_person]
    if len(surface) and abs(float(np.median(surface)) - expected) > SURFACE_M:
        got, wanted = f"{float(np.median(surface)):.2f} m at the person", f"{expected:.2f} m (target_depth_m) within {SURFACE_M:.1f} m"  # fmt: skip
        findings.error("depth", flight.where(i, "depth"), got, wanted)


def _check_visibility(flight: FlightRows, i: int, instance: np.ndarray, depth: np.ndarray, findings: Findings) -> None:
    """The score is the share of the person's box that nothing hides: rays through it, as the renderer casts them, but fewer."""
    score = flight.rows[i].get("visibility")
    corners = flight.projected_corners[i]
    if score is None or np.isnan(corners).any() or not flight.rows[i].get("target_in_view"):
        return
    (x0, y0), (x1, y1) = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    stride = max(1.0, float(np.sqrt((x1 - x0) * (y1 - y0) / MOST_RAYS)))
    pixels = np.meshgrid(np.floor(np.arange(x0, x1, stride)), np.floor(np.arange(y0, y1, stride)))
    u, v = (axis.ravel() for axis in pixels)
    fx, fy, cx, cy = flight.intrinsics[i]
    rays = np.stack([(u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, np.ones(len(u))], axis=1)
    rays = rays @ (flight.rotations[i] @ BODY_FROM_CAMERA).T
    rays[np.abs(rays) < 1e-12] = 1e-12
    half, away = np.array(PERSON_HALF_EXTENTS_M), flight.target_m[i] - flight.pose[i, :3]
    low, high = (away - half) / rays, (away + half) / rays
    enter, leave = np.maximum(np.minimum(low, high).max(axis=1), 0.3), np.maximum(low, high).min(axis=1)
    hits = leave > enter
    if hits.sum() < 30:
        return
    height, width = depth.shape
    inside = hits & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    column, row = u[inside].astype(int), v[inside].astype(int)
    seen = depth[row, column] > enter[inside] - 0.05
    seen |= (instance[row, column, 1] == 255) & (instance[row, column, 2] == 255)
    share = float(seen.sum() / hits.sum())
    if abs(share - score) > SCORE:
        findings.error("visibility", flight.where(i, "visibility"), f"{score:.2f}", f"{share:.2f}, of the depth image")


def look_of(colours: np.ndarray) -> np.ndarray:
    """Tell how a picture looks, (6,) grey levels.

    How colourful and how sharp it is: how far channels lie from their mean, and pixels from the next. How far pixels lie from the next over
    edges of blocks of 8 px, which lossy codings pack apart, and elsewhere. Red and blue less green.

    Args:
        colours: (k, w, 3 or 4) uint8, some of its rows.
    """
    few = colours[::LOOK_EVERY, :, :3].astype(np.int16)
    grey = few.sum(axis=2, dtype=np.int16)  # three times the brightness
    hue = np.abs(3 * few[:, ::LOOK_EVERY] - grey[:, ::LOOK_EVERY, None]).mean() / 3.0
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0) / 3.0
    edges = steps[BLOCK_PX - 1 :: BLOCK_PX]
    inside = (steps.sum() - edges.sum()) / max(len(steps) - len(edges), 1)
    red, green, blue = few.mean(axis=(0, 1))
    return np.array([hue, steps.mean(), edges.mean() if len(edges) else np.nan, inside, red - green, blue - green])


def least_step(depth: np.ndarray) -> float:
    """Give the least difference between two depths of some pixels, m; NaN where too few of them see anything."""
    seen = depth.reshape(-1)[:: max(1, depth.size // STEP_PIXELS)]
    seen = seen[seen < SKY_DEPTH_M]
    if len(seen) < STEP_PIXELS // 10:
        return np.nan
    gaps = np.diff(np.sort(seen))
    return float(gaps[gaps > 0.0].min(initial=np.inf))


def grid_kinds(instance: np.ndarray) -> np.ndarray:
    """Give id * 256 + kind at the grid's points, each once."""
    height, width = instance.shape[:2]
    columns = ((np.arange(COLUMNS) + 0.5) * width / COLUMNS).astype(np.int64)
    points = instance[grid_rows(height)][:, columns].reshape(-1, 3).astype(np.int64)
    return np.unique((points[:, 1] | points[:, 2] << 8) << 8 | points[:, 0])
