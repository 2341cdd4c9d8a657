"""Checks on the files of one flight: are they all there, do they decode, and do they show what the poses say?

The inspection's eyes. It judges nothing: findings go into a Report, numbers into FrameNumbers; the thresholds that make a
flight acceptable stand in stage.py.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import box_corners, mask_box, project, world_from_camera
from cosfly.issues import Report
from cosfly.products.frames import (
    FRAME_FILES,
    FRAMES_DIR,
    INVALID_DEPTH_M,
    SKY_DEPTH_M,
    OthersMeta,
    frame_name,
    read_depth,
    read_instance,
    read_meta,
    read_rgb,
    tree_of,
)
from cosfly.products.kinds import KINDS
from cosfly.products.playback import Flight
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.reading.arrays import PNG_SIGNATURE, array_header, picture_size
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.runner import advance
from cosfly.store import CHECKSUMS, read_checksums

SMALL_PX = (128, 72)  # frames are shrunk to this before they are compared with each other
BLANK_STD = 2.0  # grey levels; a frame of one colour has 0, fog over a street still has more than 5
# The centre of the person's box and its visible surface are at most a half height apart along the optical axis.
SURFACE_TOLERANCE_M = PERSON_HALF_EXTENTS_M[2] + 0.3
MASK_MIN_BOX_PX2 = 24.0  # a box of fewer pixels can lose the person between two pixel centres


@dataclass
class FrameNumbers:
    """What the pixels of one flight say; lists run over the checked frames that show the target."""

    num_checked: int = 0
    track_ious: list[float] = field(default_factory=list)
    invalid_depth_shares: list[float] = field(default_factory=list)


# --- files ------------------------------------------------------------------------------------------------------------


def png_problem(data: bytes) -> str | None:
    """Say what is wrong with the chunks of a PNG, None if every checksum holds and the end is there.

    Decoders let much of this pass and fill the rest with grey.
    """
    if not data.startswith(PNG_SIGNATURE):
        return f"{len(data)} bytes without the PNG signature"
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind, end = data[position + 4 : position + 8], position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return f"a damaged {kind.decode('latin-1')} chunk at byte {position}"
        if kind == b"IEND":
            return None
        position = end + 4
    return f"the file ends at byte {len(data)}, before the image does"


def check_files(flight: Flight, report: Report) -> list[int]:
    """Check that every frame has its files, of the right size and type by their headers, and no frame stands alone.

    A tree of somebody else may lack a kind of file altogether: `meta.json` is cosfly's own, and public readers ask for `rgb.png` alone.

    Returns:
        indices of the frames that are complete so far.
    """
    assert flight.folder is not None
    size = (flight.camera.width_px, flight.camera.height_px)
    complete = []
    absent = [] if flight.is_ours else [name for name in FRAME_FILES[1:] if not _has_any(flight, name)]
    names = [name for name in FRAME_FILES if name not in absent]
    for name in absent:
        report.add(
            "note", "not_in_this_tree", f"{FRAMES_DIR}/*/{name}", "no such file", "one a frame, in cosfly's trees"
        )
    for i in range(len(flight)):
        advance()
        problems_before = len(report.issues)
        for name in names:
            path, where = flight.frame_folder(i) / name, f"{frame_name(i)}/{name}"
            if not path.is_file():
                report.error("missing_file", where, "no such file", "one file per frame and modality")
            elif name == "meta.json":
                _check_meta(flight, i, report)
            else:
                _check_header(path, size, where, report)
        if len(report.issues) == problems_before:
            complete.append(i)
    known = {Path(frame_name(i)).name for i in range(len(flight))}
    frames = flight.folder / FRAMES_DIR
    for stray in sorted(p.name for p in frames.iterdir() if p.name not in known) if frames.is_dir() else []:
        report.warn("stray_frame", f"{FRAMES_DIR}/{stray}", "no point of this index", f"{len(known)} frames")
    return complete


def _has_any(flight: Flight, name: str) -> bool:
    return any((flight.frame_folder(i) / name).exists() for i in range(len(flight)))


def _check_header(path: Path, size: tuple[int, int], where: str, report: Report) -> None:
    """Check type and (width, height) of a picture or a depth image, by its header."""
    is_depth = path.suffix == ".npy"
    expected = f"float32 ({size[1]}, {size[0]})" if is_depth else f"a PNG of {size[0]} x {size[1]} px"
    try:
        if is_depth:
            found: object = str(array_header(path, tree=tree_of(path.parent)))
        else:
            found = picture_size(path, tree=tree_of(path.parent)) or "no PNG header"
    except InputError as error:
        found = error.got or error.what
    if found != (expected if is_depth else size):
        report.error("wrong_format", where, found, expected)


def _check_meta(flight: Flight, i: int, report: Report) -> None:
    where = f"{frame_name(i)}/meta.json"
    try:
        meta = read_meta(flight.frame_folder(i))
    except InputError as error:
        report.error("broken_annotation", where, error.got, "a frame annotation")
        return
    if meta.index != i:
        report.error("broken_annotation", f"{where}: index", meta.index, str(i))


def check_checksums(flight: Flight, report: Report) -> None:
    """Compare every file that `checksums.sha256` lists with its digest."""
    assert flight.folder is not None
    if not (flight.folder / CHECKSUMS).is_file():
        report.add("note", "no_checksums", CHECKSUMS, "no such file", "digests of the flight's files")
        return
    try:
        digests = read_checksums(flight.folder)
    except InputError as error:
        report.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
        return
    for name, digest in digests.items():
        advance()
        path = flight.folder / name
        if not path.is_file():
            report.error("missing_file", name, "no such file", f"a file, listed in {CHECKSUMS}")
        elif sha256_file(path) != digest:
            report.error("checksum", name, "other bytes", f"the digest in {CHECKSUMS}")


def check_recorded(flight: Flight, root: Path, recorded: Mapping[str, str], report: Report) -> None:
    """Compare a flight's own records with the manifest of its tree, `recorded`: path in the tree -> sha256; empty without one."""
    assert flight.folder is not None
    for name in ("trajectory.json", CHECKSUMS) if recorded else ():
        path = flight.folder / name
        digest = recorded.get(path.relative_to(root).as_posix())
        if digest is None and name == "trajectory.json":
            report.error(
                "not_of_this_tree", name, "no such entry in the tree's manifest", "a flight that was made with it"
            )
        elif digest is not None and path.is_file() and sha256_file(path) != digest:
            report.error("checksum", name, "other bytes", "the digest in the tree's manifest")


# --- pixels -----------------------------------------------------------------------------------------------------------


def choose_frames(indices: list[int], setting: str, num_sample: int) -> list[int]:
    """Give the frames whose pixels are looked at: all, none, or `num_sample` evenly spread with both ends."""
    if setting == "none" or not indices:
        return []
    if setting == "all" or num_sample >= len(indices):
        return indices
    return [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, num_sample).round().astype(int))]


def check_pixels(
    flight: Flight, indices: list[int], told: dict[int, OthersMeta], mask_visibility_min: float, report: Report
) -> FrameNumbers:
    """Decode frames and compare colour, depth and mask with each other and with the geometry. told: others, by frame."""
    numbers = FrameNumbers()
    previous: tuple[int, np.ndarray] | None = None
    for i in indices:
        advance()
        frame, where = flight.frame_folder(i), frame_name(i)
        try:
            problems = [(name, _png_problem_of(frame / name)) for name in ("rgb.png", "instance.png")]
            for name, problem in problems:
                if problem:
                    report.error("broken_image", f"{where}/{name}", problem, "a PNG that decodes in full")
            if any(problem for _, problem in problems):
                continue
            rgb = read_rgb(frame)
            depth = read_depth(frame) if (frame / "depth.npy").exists() else None
            kinds = _kinds_without(told.get(i), frame) if (frame / "instance.png").exists() else None
        except InputError as error:
            report.error("broken_image", where, f"{error.what}: {error.got}", "files that decode in full")
            continue
        numbers.num_checked += 1
        small = cv2.resize(rgb, SMALL_PX, interpolation=cv2.INTER_AREA)
        if small.std() < BLANK_STD:
            report.error("blank_frame", f"{where}/rgb.png", f"standard deviation {small.std():.2f}", "a picture")
        if previous is not None and (previous[1] == small).all() and _moved(flight, previous[0], i):
            got = f"the picture of frame {previous[0]}"
            report.error("frozen_frame", f"{where}/rgb.png", got, "another picture: the camera has moved")
        previous = (i, small)
        if depth is not None and _check_depth(depth, where, report):
            numbers.invalid_depth_shares.append(float((depth == INVALID_DEPTH_M).mean()))
            if kinds is not None:
                _check_mask(flight, i, kinds, depth, mask_visibility_min, numbers, report)
    return numbers


def _png_problem_of(path: Path) -> str | None:
    """As `png_problem`; None for a file of a tree that has none, of which `check_files` said so."""
    return png_problem(read_bytes(path, what="image", tree=tree_of(path.parent))) if path.exists() else None


def _kinds_without(told: OthersMeta | None, frame: Path) -> np.ndarray:
    """Read the kinds of pixels, (h, w); those of others are NONE: the pedestrian who is left is the target."""
    kinds, ids = read_instance(frame)
    if told is None:
        return kinds
    return np.where(np.isin(ids, [other.instance_id for other in told.others]), KINDS["NONE"], kinds)


def _moved(flight: Flight, i: int, k: int) -> bool:
    """Tell whether the camera changed so much between two frames that equal pictures are an error."""
    shift_m = np.linalg.norm(flight.positions_m[k] - flight.positions_m[i])
    turn_deg = np.abs(flight.rotations_deg[k] - flight.rotations_deg[i]).max()
    return bool(shift_m > 0.5 or turn_deg > 2.0)


def _check_depth(depth: np.ndarray, where: str, report: Report) -> bool:
    """Check that depths are metres between invalid (0) and sky (1000)."""
    place = f"{where}/depth.npy"
    if not np.isfinite(depth).all():
        report.error("depth_range", place, f"{int((~np.isfinite(depth)).sum())} pixels not finite", "finite metres")
        return False
    low, high = float(depth.min()), float(depth.max())
    if low < INVALID_DEPTH_M or high > SKY_DEPTH_M:
        report.error("depth_range", place, f"{low:.3f} to {high:.3f} m", f"{INVALID_DEPTH_M} to {SKY_DEPTH_M} m")
        return False
    if low == high:
        report.error("depth_range", place, f"{low:.3f} m everywhere", "a depth image")
        return False
    return True


def _check_mask(
    flight: Flight,
    i: int,
    kinds: np.ndarray,
    depth: np.ndarray,
    visibility_min: float,
    numbers: FrameNumbers,
    report: Report,
) -> None:
    """Compare pedestrian pixels with the projected and the recorded box of the target, and their depth with the target's."""
    box = target_box(flight, i)
    visibility = flight.visibility[i]
    if np.isnan(box).any() or not visibility > 0:
        return
    where = f"{frame_name(i)}/instance.png"
    region = pedestrian_region(kinds, box)
    if region is None:
        area_px2 = (box[2] - box[0]) * (box[3] - box[1])
        if visibility >= visibility_min and area_px2 >= MASK_MIN_BOX_PX2:
            got = f"no pedestrian pixel at the target's box, visibility {visibility:.2f}"
            report.error("mask_disagrees", where, got, "pedestrian pixels where the pose puts the person")
        numbers.track_ious.append(0.0)
        return
    found = mask_box(region)
    numbers.track_ious.append(box_iou(box, found))
    if flight.target_mask_bbox is not None:
        recorded, everyone = flight.target_mask_bbox[i], mask_box(kinds == KINDS["Pedestrians"])
        # Between this part of the person and all pedestrian pixels: a pole in front cuts a person into parts. NaN is neither.
        if not (_encloses(recorded, found) and _encloses(everyone, recorded)):
            place = f"trajectory.json: points[{i}].target.mask_bbox_2d"
            report.error("mask_disagrees", place, str(recorded.tolist()), f"the box of the pixels, {found.tolist()}")
    expected_m, found_m = float(flight.target_depth_m[i]), float(np.median(depth[region]))
    if np.isfinite(expected_m) and abs(found_m - expected_m) > SURFACE_TOLERANCE_M:
        expected = f"{expected_m:.2f} m (target.depth) within {SURFACE_TOLERANCE_M:.1f} m"
        report.error("depth_disagrees", f"{frame_name(i)}/depth.npy", f"{found_m:.2f} m at the person", expected)


def target_box(flight: Flight, i: int) -> np.ndarray:
    """Project the target's 3D box: xmin, ymin, xmax, ymax px, cut to the image; NaN where it is not in view."""
    camera = flight.camera
    corners_m = box_corners(flight.targets_m[i], np.array(PERSON_HALF_EXTENTS_M))
    uv, _ = project(corners_m, world_from_camera(flight.positions_m[i], flight.rotations_deg[i]), camera.intrinsic)
    low, high = uv.min(axis=0), uv.max(axis=0)  # NaN where a corner lies behind the camera
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    if not (np.isfinite(uv).all() and (high > 0).all() and (low < size).all()):
        return np.full(4, np.nan)
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])


def pedestrian_region(kinds: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Give the connected region of pedestrian pixels that shares most pixels with a box, (h, w) bool; None if none does."""
    is_person = (kinds == KINDS["Pedestrians"]).astype(np.uint8)
    if not is_person.any():
        return None
    _, labels = cv2.connectedComponents(is_person, connectivity=8)
    x0, y0 = np.floor(box[:2]).astype(int)
    x1, y1 = np.ceil(box[2:]).astype(int)
    shared = np.bincount(labels[y0:y1, x0:x1].ravel())
    shared[:1] = 0  # the background
    return labels == int(shared.argmax()) if shared.any() else None


def _encloses(outer: np.ndarray, inner: np.ndarray) -> bool:
    return bool((outer[:2] <= inner[:2]).all() and (inner[2:] <= outer[2:]).all())


def box_iou(one: np.ndarray, two: np.ndarray) -> float:
    """Intersection over union of two boxes xmin, ymin, xmax, ymax; 0 when both are empty."""
    sides = np.minimum(one[2:], two[2:]) - np.maximum(one[:2], two[:2])
    shared = float(np.prod(np.clip(sides, 0, None)))
    union = float(np.prod(one[2:] - one[:2]) + np.prod(two[2:] - two[:2])) - shared
    return shared / union if union > 0 else 0.0
