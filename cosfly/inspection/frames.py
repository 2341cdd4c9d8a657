"""Checks of the files and pictures of one track: they exist, match their digests, decode, and agree with the poses and
with each other.

Issues go into a Report, figures into FrameNumbers, which track.py compares with its thresholds.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cosfly.formats.bystanders import KIND, Bystander
from cosfly.formats.frames import (
    DEPTH_NPY,
    FILE_NAMES,
    FRAME_FILES,
    FRAMES_DIR,
    INVALID_DEPTH_M,
    SKY_DEPTH_M,
    BystandersMeta,
    FrameMeta,
    frame_name,
    frame_path,
    public_name,
    read_meta,
)
from cosfly.formats.issues import Report
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.places import tree_of_track
from cosfly.formats.playback import Track
from cosfly.geometry.axes import box_corners, box_iou, mask_box, project, world_from_camera
from cosfly.geometry.kernels import distances_to_boxes_m
from cosfly.geometry.reprojection import LEAST_SEEN, Agreement, View, compare_views
from cosfly.geometry.trajectory_metrics import CLEARANCE_TOLERANCE_M
from cosfly.inspection import settings as limits
from cosfly.inspection.pixels import NUM_IDS, Picture, PixelFigures, measure_pixels, unpack
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, read_bytes, read_checksums, sha256_bytes, sha256_file
from cosfly.runtime.png import png_size
from cosfly.runtime.worker import advance

# --- files ------------------------------------------------------------------------------------------------------------


def check_files(track: Track, report: Report) -> dict[int, FrameMeta | None]:
    """Check that every frame has its files, and read the annotations.

    A tree of another program may lack a kind of file, such as `meta.json`, if its checksums list none.

    Returns:
        The annotation of each complete frame, None in a tree without annotations.
    """
    assert track.folder is not None
    complete: dict[int, FrameMeta | None] = {}
    folders = [track.frame_folder(i) for i in range(len(track))]
    foreign = [name for name in FRAME_FILES[1:] if not any(frame_path(folder, name).exists() for folder in folders)]
    if foreign and _lists(track.folder, foreign):
        foreign = []  # then the files are missing
    for name in foreign:
        where = f"{FRAMES_DIR}/*/{name}"
        report.add("note", "not_in_this_tree", where, "no such file", "one per frame in cosfly's trees")
    for i, folder in enumerate(folders):
        num_issues = len(report.issues)
        meta = None
        for name in FRAME_FILES:
            if name in foreign:
                continue
            path = frame_path(folder, name)
            where = f"{frame_name(i)}/{path.name}"
            if not path.is_file():
                report.error("missing_file", where, "no such file", "one file per frame and modality")
            elif name == "meta.json":
                meta = _check_meta(folder, i, where, report)
        if len(report.issues) == num_issues:
            complete[i] = meta
    frames = track.folder / FRAMES_DIR
    found = {path.name for path in frames.iterdir()} if frames.is_dir() else set()
    for stray in sorted(found - {folder.name for folder in folders}):
        report.warn("stray_frame", f"{FRAMES_DIR}/{stray}", "no point of this index", f"{len(track)} frames")
    return complete


def _lists(folder: Path, names: list[str]) -> bool:
    """Return whether a track's checksums list files of these names, or cannot be read."""
    try:
        listed = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    except InputError:
        return True
    return any(public_name(name.rpartition("/")[2]) in names for name in listed)


def _check_meta(frame: Path, i: int, where: str, report: Report) -> FrameMeta | None:
    try:
        meta = read_meta(frame)
    except InputError as error:
        report.error("broken_annotation", where, error.got, "a frame annotation")
        return None
    if meta.index != i:
        report.error("broken_annotation", f"{where}: index", meta.index, str(i))
    return meta


def listed_digests(folder: Path, report: Report) -> dict[str, str]:
    """Read the digests of a track's `checksums.sha256`, by name in its folder; report where that is not possible."""
    if not (folder / CHECKSUMS).is_file():
        report.add("note", "no_checksums", CHECKSUMS, "no such file", "digests of the track's files")
        return {}
    try:
        return read_checksums(folder)
    except InputError as error:
        report.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
        return {}


def compare_file(folder: Path, name: str, digest: str, report: Report) -> None:
    """Compare a file of a track with its digest."""
    if not (folder / name).is_file():
        report.error("missing_file", name, "no such file", f"a file, listed in {CHECKSUMS}")
    elif sha256_file(folder / name) != digest:
        report.error("checksum", name, "other bytes", f"the digest in {CHECKSUMS}")


# --- jumps ------------------------------------------------------------------------------------------------------------
# Static surfaces are projected from each frame into the next (cosfly/geometry/reprojection.py) and compared by depth
# and ids, because colours change with light, rain and zoom. A disagreement is a jump: an object vanished, or the camera
# is not at its recorded pose.

NEAR_FRAMES = 2  # most frames between two compared ones; farther apart, they have too little surface in common
USUAL_AGREE = 0.8  # share of points that agree in most pairs of a consistent track
ROUGH_ERROR = 1e-3  # largest usual error of planes, as a share of the depth


class _Surfaces(NamedTuple):
    """The surfaces that a frame shows."""

    frame: int
    view: View
    lens: np.ndarray  # (4,) focal lengths and principal point, px


def _surfaces(track: Track, i: int, picture: Picture) -> _Surfaces:
    pose = world_from_camera(track.positions_m[i], track.rotations_deg[i])
    view = View(picture.depth, picture.instance, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
    return _Surfaces(i, view, track.camera_at(i).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]])


def _report_jumps(track: Track, pairs: dict[int, Agreement], report: Report) -> int:
    """Report the jumps; return how many frames were compared, 0 for a foreign track with inaccurate depth.

    Args:
        pairs: By frame, its agreement with the previous frame.
    """
    if not track.is_ours and not _is_consistent(pairs):
        return 0
    for i, pair in pairs.items():
        if pair.missing_share > limits.JUMP_GONE_MAX:
            got = f"{pair.missing_share:.1%} of this frame or the previous one is missing in the other"
            report.warn("temporal_jump", _depth_place(track, i), got, f"at most {limits.JUMP_GONE_MAX:.1%}")
    return len(pairs)


def _is_consistent(pairs: dict[int, Agreement]) -> bool:
    """Return whether most pairs of frames agree; inaccurate depth agrees nowhere."""
    judged = [pair for pair in pairs.values() if pair.seen >= LEAST_SEEN]
    errors = [pair.error for pair in judged if np.isfinite(pair.error)]
    is_near = bool(judged) and float(np.median([pair.agree / pair.seen for pair in judged])) >= USUAL_AGREE
    return is_near and (not errors or float(np.median(errors)) <= ROUGH_ERROR)


# --- bystanders -------------------------------------------------------------------------------------------------------


def check_bystanders(
    track: Track, frames: dict[int, BystandersMeta], clearance_min_m: float, report: Report, metrics: dict
) -> None:
    """Check the distance of bystanders to drone and target, and measure how much of the target they hide."""
    nearest_m = np.inf
    for i, frame in frames.items():
        for line in frame.others:
            if line.semantic_id != KINDS[KIND]:
                where = f"meta.json of frame {i}: others"
                report.error("broken_annotation", where, f"semantic_id {line.semantic_id}", f"{KINDS[KIND]}, {KIND}")
                continue
            feet_m = line.world_location - np.array([0.0, 0.0, PERSON_HALF_EXTENTS_M[2]])
            bystander = Bystander(feet_m[None], np.array([line.heading_rad]))
            distance_m = float(distances_to_boxes_m(track.positions_m[i], bystander)[0])
            nearest_m = min(nearest_m, distance_m)
            if distance_m < clearance_min_m - CLEARANCE_TOLERANCE_M:
                where = f"trajectory.json: points[{i}].drone_pose"
                got = f"{distance_m:.2f} m to {line.instance_id}"
                report.error("clearance", where, got, f"at least {clearance_min_m:g} m to bystanders")
            if bystander.gap_to_person_m(track.targets_m[i]) < -CLEARANCE_TOLERANCE_M:
                where = f"trajectory.json: points[{i}].target.world_location"
                report.error("collision", where, f"inside bystander {line.instance_id}", "no contact")
    if frames:
        hidden = np.array([frame.target_hidden_by_others for frame in frames.values()])
        metrics.update(
            num_others=max(len(frame.others) for frame in frames.values()),
            others_clearance_min_m=nearest_m if np.isfinite(nearest_m) else None,
            occluded_by_others_share=float((hidden > 0).mean()),
            hidden_by_others_max=float(hidden.max()),
        )


# --- pixels -----------------------------------------------------------------------------------------------------------

SMALL_PX = (128, 72)  # size at which frames are compared
SMALL_ROWS = 5  # one row in five is used for it
BLANK_STD = 2.0  # grey levels; a frame of one colour has 0, fog over a street more than 5
# The centre of the target's box is at most half its height from its visible surface along the optical axis.
SURFACE_TOLERANCE_M = PERSON_HALF_EXTENTS_M[2] + 0.3
MASK_MIN_BOX_PX2 = 24.0  # a smaller box may contain no pixel centre of the target
# A camera that moved or turned farther between two frames cannot give equal pictures.
MOVED_M, TURNED_DEG = 0.5, 2.0


@dataclass
class FrameNumbers:
    """Figures of the pixels of one track."""

    read_files: set[str] = field(default_factory=set)  # names in the track's folder; their digests were compared
    num_checked: int = 0
    num_compared: int = 0  # with the previous frame
    track_ious: list[float] = field(default_factory=list)  # of the frames that show the target
    invalid_depth_shares: list[float] = field(default_factory=list)  # of the frames with a depth image


def check_frames(
    track: Track, indices: Iterable[int], bystanders: dict[int, BystandersMeta], digests: dict[str, str], report: Report
) -> FrameNumbers:
    """Decode frames; compare colour, depth and mask with each other, the poses and the previous frame.

    Each file is read once, and compared with its digest if `digests` contains one.
    """
    numbers = FrameNumbers()
    agreements = dict[int, Agreement]()
    previous_small: _SmallPicture | None = None
    previous_surfaces: _Surfaces | None = None  # of the last frame with depth
    for i in indices:
        advance()
        picture = _read_picture(track, i, digests, numbers, report)
        if picture is None:
            continue
        numbers.num_checked += 1
        small = _SmallPicture(i, cv2.resize(picture.colours[::SMALL_ROWS], SMALL_PX, interpolation=cv2.INTER_AREA))
        _check_colours(track, small, previous_small, report)
        previous_small = small
        is_bystander = np.zeros(NUM_IDS, dtype=np.bool_)
        people = bystanders[i].others if i in bystanders else ()
        is_bystander[[person.instance_id for person in people if person.instance_id < NUM_IDS]] = True
        figures = measure_pixels(picture, is_bystander, limits.FLAT_PAIRS_MIN)
        _check_surfaces(figures, frame_name(i), report)
        if not picture.depth.size or not _check_depth(picture.depth, _depth_place(track, i), numbers, report):
            continue
        surfaces = _surfaces(track, i, picture)
        before = previous_surfaces
        if before is not None and i - before.frame <= NEAR_FRAMES:
            agreements[i] = compare_views(before.view, surfaces.view, before.lens, surfaces.lens)
        previous_surfaces = surfaces
        if picture.instance.size:
            _check_mask(track, i, picture, figures, is_bystander, numbers, report)
    numbers.num_compared = _report_jumps(track, agreements, report)
    return numbers


def _read_picture(
    track: Track, i: int, digests: dict[str, str], numbers: FrameNumbers, report: Report
) -> Picture | None:
    """Read and decode the existing pictures of a frame; report what is wrong with them, and return None."""
    assert track.folder is not None
    folder = track.frame_folder(i)
    tree = tree_of_track(track.folder)
    contents = dict[str, bytes]()
    size = track.camera.width_px, track.camera.height_px
    try:
        for path in (frame_path(folder, name) for name in FILE_NAMES.values()):
            if not path.exists():
                continue  # `check_files` reports missing ones
            name = f"{frame_name(i)}/{path.name}"
            contents[path.name] = read_bytes(path, what="image", tree=tree)
            numbers.read_files.add(name)
            if name in digests and sha256_bytes(contents[path.name]) != digests[name]:
                report.error("checksum", name, "other bytes", f"the digest in {CHECKSUMS}")
        if (found := png_size(contents["rgb.png"])) != size:
            report.error("wrong_format", f"{frame_name(i)}/rgb.png", str(found or "no PNG header"), str(size))
            return None
        return unpack(contents, Path(frame_name(i)))
    except InputError as error:
        report.error("broken_image", str(error.where), f"{error.what}: {error.got}", "a file that decodes in full")
        return None


class _SmallPicture(NamedTuple):
    """The reduced colours of a frame."""

    frame: int
    pixels: np.ndarray  # (72, 128, 3) uint8


def _check_colours(track: Track, small: _SmallPicture, previous: _SmallPicture | None, report: Report) -> None:
    """Report a picture of one colour, and one that equals the previous picture although the camera has moved."""
    where = f"{frame_name(small.frame)}/rgb.png"
    if small.pixels.std() < BLANK_STD:
        report.error("blank_frame", where, f"standard deviation {small.pixels.std():.2f}", "a picture")
    if previous is None or (previous.pixels != small.pixels).any():
        return
    shift_m = np.linalg.norm(track.positions_m[small.frame] - track.positions_m[previous.frame])
    turn_deg = np.abs(track.rotations_deg[small.frame] - track.rotations_deg[previous.frame]).max()
    if shift_m > MOVED_M or turn_deg > TURNED_DEG:
        got = f"the picture of frame {previous.frame}"
        report.error("frozen_frame", where, got, "a different picture, because the camera has moved")


def _check_surfaces(figures: PixelFigures, where: str, report: Report) -> None:
    """Report missing textures and surfaces that fight for pixels."""
    if figures.flat > limits.FLAT_SURFACE_MAX:
        kind = KIND_NAMES.get(figures.flat_kind, figures.flat_kind)
        most = f"at most {limits.FLAT_SURFACE_MAX:.1%}"
        got = f"{figures.flat:.1%} of the picture is a surface of one colour ({kind})"
        report.warn("missing_texture", f"{where}/rgb.png", got, most)
    if figures.magenta > limits.MAGENTA_MAX:
        most = f"at most {limits.MAGENTA_MAX:.2%}"
        report.warn("missing_texture", f"{where}/rgb.png", f"{figures.magenta:.2%} magenta", most)
    if figures.fighting > limits.Z_FIGHTING_MAX:
        got = f"{figures.fighting:.3%} of the pixels alternate between two surfaces of one plane"
        report.warn("z_fighting", f"{where}/instance.png", got, f"at most {limits.Z_FIGHTING_MAX:.3%}")


def _depth_place(track: Track, i: int) -> str:
    """Return the depth file of frame i, for findings."""
    return f"{frame_name(i)}/{frame_path(track.frame_folder(i), DEPTH_NPY).name}"


def _check_depth(depth: np.ndarray, where: str, numbers: FrameNumbers, report: Report) -> bool:
    """Check that depths are metres between invalid (0) and sky (1000); return whether they are."""
    low, high = float(depth.min()), float(depth.max())  # NaN if any pixel is
    num_issues = len(report.issues)
    if not np.isfinite([low, high]).all():
        got = f"{int((~np.isfinite(depth)).sum())} pixels not finite"
        report.error("depth_range", where, got, "finite metres")
    elif low < INVALID_DEPTH_M:
        report.error("depth_range", where, f"{low:.3f} to {high:.3f} m", f"{INVALID_DEPTH_M} to {SKY_DEPTH_M} m")
    elif low == high:
        report.error("depth_range", where, f"{low:.3f} m everywhere", "different depths")
    else:
        has_invalid = low <= INVALID_DEPTH_M
        numbers.invalid_depth_shares.append(float((depth == INVALID_DEPTH_M).mean()) if has_invalid else 0.0)
    return len(report.issues) == num_issues


def _check_mask(
    track: Track, i: int, picture: Picture, figures: PixelFigures, is_bystander: np.ndarray, numbers: FrameNumbers,
    report: Report,
) -> None:  # fmt: skip
    """Compare pedestrian pixels with the target's projected and recorded box, and with its depth."""
    box = target_box(track, i)
    visibility = track.target.visibility[i]
    if np.isnan(box).any() or not visibility > 0:
        return
    pixels = _target_pixels(picture, figures, is_bystander, box)
    if pixels is None or figures.person_box is None:
        area_px2 = (box[2] - box[0]) * (box[3] - box[1])
        if visibility >= limits.MASK_VISIBILITY_MIN and area_px2 >= MASK_MIN_BOX_PX2:
            got = f"no pedestrian pixel at the target's box, visibility {visibility:.2f}"
            where = f"{frame_name(i)}/instance.png"
            report.error("mask_disagrees", where, got, "pedestrian pixels at the projected target")
        numbers.track_ious.append(0.0)
        return
    # A tolerance of half a pixel at each edge.
    numbers.track_ious.append(box_iou(np.clip(pixels.box, box - 0.5, box + 0.5), pixels.box))
    if track.target.mask_bbox is not None:
        recorded = track.target.mask_bbox[i]
        # A pole may cut the target into parts: its box lies between this part and all pedestrian pixels. NaN fails.
        if not (_encloses(recorded, pixels.box) and _encloses(np.array(figures.person_box), recorded)):
            where = f"trajectory.json: points[{i}].target.mask_bbox_2d"
            report.error(
                "mask_disagrees", where, str(recorded.tolist()), f"the box of the pixels, {pixels.box.tolist()}"
            )
    expected_m = float(track.target.depth_m[i])
    if np.isfinite(expected_m) and abs(pixels.depth_m - expected_m) > SURFACE_TOLERANCE_M:
        expected = f"{expected_m:.2f} m (target.depth) within {SURFACE_TOLERANCE_M:.1f} m"
        report.error("depth_disagrees", _depth_place(track, i), f"{pixels.depth_m:.2f} m at the target", expected)


class _TargetPixels(NamedTuple):
    """The connected pedestrian pixels at the target's projected box."""

    box: np.ndarray  # (4,) xmin, ymin, xmax, ymax px
    depth_m: float  # median


def _target_pixels(
    picture: Picture, figures: PixelFigures, is_bystander: np.ndarray, box: np.ndarray
) -> _TargetPixels | None:
    """Find the target's pixels within `figures.person_box`; return None if no pedestrian pixel overlaps with `box`."""
    if figures.person_box is None:
        return None
    x0, y0, x1, y1 = figures.person_box
    instance = picture.instance[y0:y1, x0:x1]
    ids = instance[..., 1].astype(np.uint16) | (instance[..., 2].astype(np.uint16) << 8)
    corner = np.array([x0, y0, x0, y0], dtype=np.float64)
    region = pedestrian_region(np.where(is_bystander[ids], KINDS["NONE"], instance[..., 0]), box - corner)
    if region is None:
        return None
    return _TargetPixels(mask_box(region) + corner, float(np.median(picture.depth[y0:y1, x0:x1][region])))


def target_box(track: Track, i: int) -> np.ndarray:
    """Return the target's projected box: xmin, ymin, xmax, ymax px, cut to the image; NaN if it is not in view."""
    camera = track.camera_at(i)
    corners_m = box_corners(track.targets_m[i], np.array(PERSON_HALF_EXTENTS_M))
    uv, _ = project(corners_m, world_from_camera(track.positions_m[i], track.rotations_deg[i]), camera.intrinsic)
    low, high = uv.min(axis=0), uv.max(axis=0)  # NaN where a corner lies behind the camera
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    if not (np.isfinite(uv).all() and (high > 0).all() and (low < size).all()):
        return np.full(4, np.nan)
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])


def pedestrian_region(kinds: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Return the region of pedestrian pixels that overlaps most with a box, (h, w) bool; None if none does."""
    is_person = (kinds == KINDS["Pedestrians"]).astype(np.uint8)
    if not is_person.any():
        return None
    _, labels = cv2.connectedComponents(is_person, connectivity=8)
    x0, y0 = np.maximum(np.floor(box[:2]), 0).astype(int)
    x1, y1 = np.maximum(np.ceil(box[2:]), 0).astype(int)
    overlaps_px = np.bincount(labels[y0:y1, x0:x1].ravel())  # by label
    overlaps_px[:1] = 0  # the background
    return labels == int(overlaps_px.argmax()) if overlaps_px.any() else None


def _encloses(outer: np.ndarray, inner: np.ndarray) -> bool:
    return bool((outer[:2] <= inner[:2]).all() and (inner[2:] <= outer[2:]).all())
