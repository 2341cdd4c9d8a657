"""Checks of the pictures of one track: whether they decode, and agree with the poses and with each other.

Findings go into a Report, numbers into FrameNumbers; the thresholds of acceptance are in track.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from cosfly.formats.bystanders import BUILDS, Bystander
from cosfly.formats.frames import (
    DEPTH_NPY,
    FILE_NAMES,
    INVALID_DEPTH_M,
    SKY_DEPTH_M,
    BystandersMeta,
    FrameMeta,
    frame_name,
    frame_path,
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
from cosfly.inspection.files import Checksums
from cosfly.inspection.pixels import NUM_IDS, Picture, PixelFigures, measure_pixels, unpack
from cosfly.inspection.settings import (
    FLAT_PAIRS_MIN,
    FLAT_SURFACE_MAX,
    JUMP_GONE_MAX,
    MAGENTA_MAX,
    MASK_VISIBILITY_MIN,
    Z_FIGHTING_MAX,
)
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.worker import advance

# --- jumps ------------------------------------------------------------------------------------------------------------
# Static surfaces are carried from each frame into the next (cosfly/geometry/reprojection.py). What does not agree with
# the poses is a jump: something vanished, or the place changed.

NEAR_FRAMES = 2  # farther apart, more surface is hidden than seen twice
USUAL_AGREE, ROUGH_ERROR = 0.8, 1e-3  # share of points; error of planes as a share of the depth


@dataclass
class Jumps:
    """Compares depth and ids of successive frames through their poses; colours change with light, rain and zoom."""

    track: Track
    _previous: tuple[int, View] | None = None
    _frames: list[int] = field(default_factory=list)
    _found: list[Agreement] = field(default_factory=list)

    def add(self, i: int, picture: Picture) -> None:
        """Compare the next frame, which has depth, with the previous one."""
        track = self.track
        pose = world_from_camera(track.positions_m[i], track.rotations_deg[i])
        view = View(picture.depth, picture.instance, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
        if self._previous is not None and i - self._previous[0] <= NEAR_FRAMES:
            k, previous = self._previous
            intrinsics = [track.camera_at(j).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] for j in (k, i)]
            self._frames.append(i)
            self._found.append(compare_views(previous, view, *intrinsics))
        self._previous = (i, view)

    def report(self, report: Report) -> int:
        """Report the jumps; return how many frames were compared, 0 for a foreign track with inaccurate depth."""
        if not self.track.is_ours and not self._is_consistent():
            return 0
        for i, pair in zip(self._frames, self._found, strict=True):
            if pair.gone > JUMP_GONE_MAX:
                got = f"{pair.gone:.1%} of this frame or the previous one is missing in the other"
                report.warn("temporal_jump", _depth_place(self.track, i), got, f"at most {JUMP_GONE_MAX:.1%}")
        return len(self._found)

    def _is_consistent(self) -> bool:
        """Return whether most pairs of frames agree; inaccurate depth agrees nowhere."""
        pairs = [pair for pair in self._found if pair.seen >= LEAST_SEEN]
        agree = [pair.agree / pair.seen for pair in pairs]
        errors = [pair.error for pair in pairs if np.isfinite(pair.error)]
        is_near = bool(pairs) and float(np.median(agree)) >= USUAL_AGREE
        return is_near and (not errors or float(np.median(errors)) <= ROUGH_ERROR)


# --- bystanders -------------------------------------------------------------------------------------------------------


def bystanders_of_frames(track: Track, metas: Mapping[int, FrameMeta | None]) -> dict[int, BystandersMeta]:
    """Return the bystanders in the annotations, by frame; empty for foreign tracks."""
    if not track.is_ours:
        return {}
    return {i: meta.others for i, meta in metas.items() if meta is not None and meta.others is not None}


def check_bystanders(
    track: Track, frames: dict[int, BystandersMeta], clearance_min_m: float, report: Report, metrics: dict
) -> None:
    """Check the distance of bystanders to drone and target, and measure how much of the target they hide."""
    nearest_m = np.inf
    for i, frame in frames.items():
        for line in frame.others:
            kind = KIND_NAMES.get(line.semantic_id, "")
            if kind not in BUILDS:
                where = f"meta.json of frame {i}: others"
                report.error("broken_annotation", where, f"semantic_id {line.semantic_id}", " or ".join(BUILDS))
                continue
            feet_m = line.center_m - np.array([0.0, 0.0, BUILDS[kind].half_extents_m[2]])
            bystander = Bystander(kind, feet_m[None], np.array([line.heading_rad]))
            distance_m = float(distances_to_boxes_m(track.positions_m[i], bystander)[0])
            nearest_m = min(nearest_m, distance_m)
            if distance_m < clearance_min_m - CLEARANCE_TOLERANCE_M:
                got, expected = f"{distance_m:.2f} m to {line.instance_id}", f"at least {clearance_min_m:g} m to others"
                report.error("clearance", f"trajectory.json: points[{i}].drone_pose", got, expected)
            if bystander.gap_to_person_m(track.targets_m[i]) < -CLEARANCE_TOLERANCE_M:
                where = f"trajectory.json: points[{i}].target.world_location"
                report.error("collision", where, f"in {line.instance_id}", "no contact")
    if frames:
        hidden = np.array([frame.target_hidden_by_others for frame in frames.values()])
        metrics.update(
            num_others=max(len(frame.others) for frame in frames.values()),
            others_clearance_min_m=nearest_m if np.isfinite(nearest_m) else None,
            occluded_by_others_share=float((hidden > 0).mean()),
            hidden_by_others_max=float(hidden.max()),
        )


# --- pixels -----------------------------------------------------------------------------------------------------------

SMALL_PX, SMALL_ROWS = (128, 72), 5  # size at which frames are compared, from every fifth row
BLANK_STD = 2.0  # grey levels; a frame of one colour has 0, fog over a street more than 5
# The centre of the target's box is at most half its height from its visible surface along the optical axis.
SURFACE_TOLERANCE_M = PERSON_HALF_EXTENTS_M[2] + 0.3
MASK_MIN_BOX_PX2 = 24.0  # a smaller box may contain no pixel centre of the target


@dataclass
class FrameNumbers:
    """Figures of the pixels of one track; lists are over the checked frames that show the target."""

    num_checked: int = 0
    num_compared: int = 0  # with the previous frame
    track_ious: list[float] = field(default_factory=list)
    invalid_depth_shares: list[float] = field(default_factory=list)


def check_frames(
    track: Track, indices: Iterable[int], bystanders: Mapping[int, BystandersMeta], checksums: Checksums, report: Report
) -> FrameNumbers:
    """Decode frames, each file once; compare colour, depth and mask with each other, the poses and the previous
    frame."""
    assert track.folder is not None
    numbers, jumps, tree = FrameNumbers(), Jumps(track), tree_of_track(track.folder)
    previous: tuple[int, np.ndarray] | None = None
    for i in indices:
        advance()
        where = frame_name(i)
        try:
            picture = unpack(_read(track, i, tree, checksums), Path(where))
        except InputError as error:
            report.error("broken_image", str(error.where), f"{error.what}: {error.got}", "a file that decodes in full")
            continue
        numbers.num_checked += 1
        small = cv2.resize(picture.colours[::SMALL_ROWS], SMALL_PX, interpolation=cv2.INTER_AREA)
        if small.std() < BLANK_STD:
            report.error("blank_frame", f"{where}/rgb.png", f"standard deviation {small.std():.2f}", "a picture")
        if previous is not None and (previous[1] == small).all() and _moved(track, previous[0], i):
            got = f"the picture of frame {previous[0]}"
            report.error("frozen_frame", f"{where}/rgb.png", got, "another picture: the camera has moved")
        previous = (i, small)
        is_bystander = np.zeros(NUM_IDS, dtype=np.bool_)
        others = bystanders[i].others if i in bystanders else ()
        is_bystander[[other.instance_id for other in others if other.instance_id < NUM_IDS]] = True
        figures = measure_pixels(picture, is_bystander, FLAT_PAIRS_MIN)
        _check_surfaces(figures, where, report)
        if picture.depth.size and _check_depth(picture.depth, _depth_place(track, i), numbers, report):
            jumps.add(i, picture)
            if picture.instance.size:
                _check_mask(track, i, picture, figures, is_bystander, numbers, report)
    numbers.num_compared = jumps.report(report)
    return numbers


def _read(track: Track, i: int, tree: Path, checksums: Checksums) -> dict[str, bytes]:
    """Read the existing pictures of a frame; `check_files` reports missing ones."""
    folder, files = track.frame_folder(i), dict[str, bytes]()
    for name in FILE_NAMES.values():
        if (path := frame_path(folder, name)).exists():
            files[path.name] = read_bytes(path, what="image", tree=tree)
            checksums.compare(f"{frame_name(i)}/{path.name}", files[path.name])
    return files


def _check_surfaces(figures: PixelFigures, where: str, report: Report) -> None:
    """Report missing textures and surfaces that fight for pixels."""
    if figures.flat > FLAT_SURFACE_MAX:
        kind = KIND_NAMES.get(figures.flat_kind, figures.flat_kind)
        got = f"{figures.flat:.1%} of the picture is a surface of one colour ({kind})"
        report.warn("missing_texture", f"{where}/rgb.png", got, f"at most {FLAT_SURFACE_MAX:.1%}")
    if figures.magenta > MAGENTA_MAX:
        got = f"{figures.magenta:.2%} magenta"
        report.warn("missing_texture", f"{where}/rgb.png", got, f"at most {MAGENTA_MAX:.2%}")
    if figures.fighting > Z_FIGHTING_MAX:
        got = f"{figures.fighting:.3%} of the pixels alternate between two surfaces of one plane"
        report.warn("z_fighting", f"{where}/instance.png", got, f"at most {Z_FIGHTING_MAX:.3%}")


def _moved(track: Track, i: int, k: int) -> bool:
    """Return whether the camera moved so far between two frames that equal pictures are an error."""
    shift_m = np.linalg.norm(track.positions_m[k] - track.positions_m[i])
    turn_deg = np.abs(track.rotations_deg[k] - track.rotations_deg[i]).max()
    return bool(shift_m > 0.5 or turn_deg > 2.0)


def _depth_place(track: Track, i: int) -> str:
    """Return the depth file of frame i, for findings."""
    return f"{frame_name(i)}/{frame_path(track.frame_folder(i), DEPTH_NPY).name}"


def _check_depth(depth: np.ndarray, place: str, numbers: FrameNumbers, report: Report) -> bool:
    """Check that depths are metres between invalid (0) and sky (1000)."""
    low, high = float(depth.min()), float(depth.max())  # NaN if any is
    if not np.isfinite([low, high]).all():
        report.error("depth_range", place, f"{int((~np.isfinite(depth)).sum())} pixels not finite", "finite metres")
        return False
    if low < INVALID_DEPTH_M:
        report.error("depth_range", place, f"{low:.3f} to {high:.3f} m", f"{INVALID_DEPTH_M} to {SKY_DEPTH_M} m")
        return False
    if low == high:
        report.error("depth_range", place, f"{low:.3f} m everywhere", "a depth image")
        return False
    numbers.invalid_depth_shares.append(float((depth == INVALID_DEPTH_M).mean()) if low == INVALID_DEPTH_M else 0.0)
    return True


def _check_mask(
    track: Track,
    i: int,
    picture: Picture,
    figures: PixelFigures,
    is_bystander: np.ndarray,
    numbers: FrameNumbers,
    report: Report,
) -> None:
    """Compare pedestrian pixels with the target's projected and recorded box, and with its depth."""
    box = target_box(track, i)
    visibility = track.target.visibility[i]
    if np.isnan(box).any() or not visibility > 0:
        return
    where, region = f"{frame_name(i)}/instance.png", None
    x0, y0, x1, y1 = people = figures.person_box or (0, 0, 0, 0)
    corner = np.array([x0, y0, x0, y0], dtype=np.float64)
    if figures.person_box is not None:
        instance = picture.instance[y0:y1, x0:x1]
        ids = instance[..., 1].astype(np.uint16) | (instance[..., 2].astype(np.uint16) << 8)
        region = pedestrian_region(np.where(is_bystander[ids], KINDS["NONE"], instance[..., 0]), box - corner)
    if region is None:
        area_px2 = (box[2] - box[0]) * (box[3] - box[1])
        if visibility >= MASK_VISIBILITY_MIN and area_px2 >= MASK_MIN_BOX_PX2:
            got = f"no pedestrian pixel at the target's box, visibility {visibility:.2f}"
            report.error("mask_disagrees", where, got, "pedestrian pixels at the projected target")
        numbers.track_ious.append(0.0)
        return
    found = mask_box(region) + corner
    numbers.track_ious.append(pixels_iou(box, found))
    if track.target.mask_bbox is not None:
        recorded = track.target.mask_bbox[i]
        # A pole may cut the target into parts: its box lies between this part and all pedestrian pixels. NaN fails.
        if not (_encloses(recorded, found) and _encloses(np.array(people), recorded)):
            place = f"trajectory.json: points[{i}].target.mask_bbox_2d"
            report.error("mask_disagrees", place, str(recorded.tolist()), f"the box of the pixels, {found.tolist()}")
    expected_m = float(track.target.depth_m[i])
    found_m = float(np.median(picture.depth[y0:y1, x0:x1][region]))
    if np.isfinite(expected_m) and abs(found_m - expected_m) > SURFACE_TOLERANCE_M:
        expected = f"{expected_m:.2f} m (target.depth) within {SURFACE_TOLERANCE_M:.1f} m"
        report.error("depth_disagrees", _depth_place(track, i), f"{found_m:.2f} m at the target", expected)


def pixels_iou(box: np.ndarray, found: np.ndarray) -> float:
    """Return the IoU of a box and the box of its pixels, (4,) px each, with a tolerance of half a pixel at each
    edge."""
    return box_iou(np.clip(found, box - 0.5, box + 0.5), found)


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
    shared = np.bincount(labels[y0:y1, x0:x1].ravel())
    shared[:1] = 0  # the background
    return labels == int(shared.argmax()) if shared.any() else None


def _encloses(outer: np.ndarray, inner: np.ndarray) -> bool:
    return bool((outer[:2] <= inner[:2]).all() and (inner[2:] <= outer[2:]).all())
