"""Checks on the pictures of one flight: do they decode, and do they show what the poses and the frames before say?

The inspection's eyes. It judges nothing: findings go into a Report, numbers into FrameNumbers; the thresholds that make
a flight acceptable stand in flight.py.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    BystanderMeta,
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
from cosfly.inspection.pixels import NUM_IDS, Picture, PixelFigures, look_at, unpack
from cosfly.inspection.settings import (
    FLAT_PAIRS_MIN,
    FLAT_SURFACE_MAX,
    JUMP_GONE_MAX,
    MAGENTA_MAX,
    MASK_VISIBILITY_MIN,
    Z_FIGHTING_MAX,
    InspectConfig,
)
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.worker import advance

# --- jumps ------------------------------------------------------------------------------------------------------------
# Do the frames of a flight show one world? What stands still is carried from each frame into the next
# (`cosfly/geometry/reprojection.py`), and what comes out otherwise than the poses say is a jump: something vanished, or
# another place.


NEAR_FRAMES = 2  # farther apart, more is hidden behind other things than is seen twice
USUAL_AGREE, ROUGH_ERROR = 0.8, 1e-3  # of the points; of planes, as a share of the depth


@dataclass
class Jumps:
    """Compares depth and ids of successive frames through their poses; colours change with light, rain and zoom."""

    flight: Track
    _before: tuple[int, View] | None = None
    _frames: list[int] = field(default_factory=list)
    _found: list[Agreement] = field(default_factory=list)

    def see(self, i: int, picture: Picture) -> None:
        """Take the next frame, which has depth."""
        flight = self.flight
        pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
        view = View(picture.depth, picture.instance, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
        if self._before is not None and i - self._before[0] <= NEAR_FRAMES:
            k, before = self._before
            intrinsics = [flight.camera_at(j).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] for j in (k, i)]
            self._frames.append(i)
            self._found.append(compare_views(before, view, *intrinsics))
        self._before = (i, view)

    def judge(self, cfg: InspectConfig, report: Report) -> int:
        """Report the jumps; gives how many frames were judged: none of a foreign flight whose depth is no world's."""
        if not self.flight.is_ours and not self._is_one_world():
            return 0
        for i, pair in zip(self._frames, self._found, strict=True):
            if pair.gone > JUMP_GONE_MAX:
                got = f"{pair.gone:.1%} of what this frame or the one before shows is not there in the other"
                report.warn("temporal_jump", _depth_place(self.flight, i), got, f"at most {JUMP_GONE_MAX:.1%}")
        return len(self._found)

    def _is_one_world(self) -> bool:
        """Return whether most pairs of frames agree: rough depth agrees with nothing, and is equally rough
        everywhere."""
        pairs = [pair for pair in self._found if pair.seen >= LEAST_SEEN]
        agree = [pair.agree / pair.seen for pair in pairs]
        errors = [pair.error for pair in pairs if np.isfinite(pair.error)]
        is_near = bool(pairs) and float(np.median(agree)) >= USUAL_AGREE
        return is_near and (not errors or float(np.median(errors)) <= ROUGH_ERROR)


# --- others -----------------------------------------------------------------------------------------------------------
# Checks on who else moves in a flight: do they keep clear of drone and person, and what do they hide of the person?


def others_told(flight: Track, metas: Mapping[int, FrameMeta | None]) -> dict[int, BystandersMeta]:
    """Return what the annotations of frames tell of others, by frame; empty for foreign flights."""
    if not flight.is_ours:
        return {}
    return {i: meta.others for i, meta in metas.items() if meta is not None and meta.others is not None}


def check_others(
    flight: Track, told: dict[int, BystandersMeta], clearance_min_m: float, report: Report, metrics: dict
) -> None:
    """Measure how near others come to drone and person, and add what they hide of the person."""
    nearest_m = np.inf
    for i, frame in told.items():
        for line in frame.others:
            other = _other(line)
            if other is None:
                where = f"meta.json of frame {i}: others"
                report.error("broken_annotation", where, f"semantic_id {line.semantic_id}", " or ".join(BUILDS))
                continue
            distance_m = float(distances_to_boxes_m(flight.positions_m[i], other)[0])
            nearest_m = min(nearest_m, distance_m)
            if distance_m < clearance_min_m - CLEARANCE_TOLERANCE_M:
                where, expected = (
                    f"trajectory.json: points[{i}].drone_pose",
                    f"at least {clearance_min_m:g} m to others",
                )
                report.error("clearance", where, f"{distance_m:.2f} m to {line.instance_id}", expected)
            if other.gap_to_person_m(flight.targets_m[i]) < -CLEARANCE_TOLERANCE_M:
                where = f"trajectory.json: points[{i}].target.world_location"
                report.error("collision", where, f"in {line.instance_id}", "a person who touches nobody")
    if told:
        hidden = np.array([frame.target_hidden_by_others for frame in told.values()])
        metrics.update(
            num_others=max(len(frame.others) for frame in told.values()),
            others_clearance_min_m=nearest_m if np.isfinite(nearest_m) else None,
            occluded_by_others_share=float((hidden > 0).mean()),
            hidden_by_others_max=float(hidden.max()),
        )


def _other(line: BystanderMeta) -> Bystander | None:
    """Return the other of an annotation in right-handed axes; None of an unknown kind."""
    kind = KIND_NAMES.get(line.semantic_id, "")
    if kind not in BUILDS:
        return None
    feet_m = line.center_m - np.array([0.0, 0.0, BUILDS[kind].half_extents_m[2]])
    return Bystander(kind, feet_m[None], np.array([line.heading_rad]))


SMALL_PX, SMALL_ROWS = (128, 72), 5  # frames are shrunk to this, of every fifth row, before they are compared
BLANK_STD = 2.0  # grey levels; a frame of one colour has 0, fog over a street still has more than 5
# The centre of the person's box and its visible surface are at most a half height apart along the optical axis.
SURFACE_TOLERANCE_M = PERSON_HALF_EXTENTS_M[2] + 0.3
MASK_MIN_BOX_PX2 = 24.0  # a box of fewer pixels can lose the person between two pixel centres


@dataclass
class FrameNumbers:
    """What the pixels of one flight say; lists run over the checked frames that show the target."""

    num_checked: int = 0
    num_compared: int = 0  # with the frame before
    track_ious: list[float] = field(default_factory=list)
    invalid_depth_shares: list[float] = field(default_factory=list)


def choose_frames(indices: list[int], setting: str, num_sample: int) -> list[int]:
    """Return the frames whose pixels are looked at: all, none, or `num_sample` evenly spread with both ends."""
    if setting == "none" or not indices:
        return []
    if setting == "all" or num_sample >= len(indices):
        return indices
    return [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, num_sample).round().astype(int))]


def check_frames(
    flight: Track,
    indices: list[int],
    told: Mapping[int, BystandersMeta],
    checksums: Checksums,
    cfg: InspectConfig,
    report: Report,
) -> FrameNumbers:
    """Unpack frames and compare colour, depth and mask with each other, with the geometry and with the frame before.

    Each file is read once, for its checksum too.

    Args:
        told: what annotations tell of others, by frame.
    """
    assert flight.folder is not None
    numbers, jumps, tree = FrameNumbers(), Jumps(flight), tree_of_track(flight.folder)
    previous: tuple[int, np.ndarray] | None = None
    for i in indices:
        advance()
        where = frame_name(i)
        try:
            picture = unpack(_read(flight, i, tree, checksums), Path(where))
        except InputError as error:
            report.error("broken_image", str(error.where), f"{error.what}: {error.got}", "a file that decodes in full")
            continue
        numbers.num_checked += 1
        small = cv2.resize(picture.colours[::SMALL_ROWS], SMALL_PX, interpolation=cv2.INTER_AREA)
        if small.std() < BLANK_STD:
            report.error("blank_frame", f"{where}/rgb.png", f"standard deviation {small.std():.2f}", "a picture")
        if previous is not None and (previous[1] == small).all() and _moved(flight, previous[0], i):
            got = f"the picture of frame {previous[0]}"
            report.error("frozen_frame", f"{where}/rgb.png", got, "another picture: the camera has moved")
        previous = (i, small)
        left_out = _ids_of(told.get(i))
        look = look_at(picture, left_out, FLAT_PAIRS_MIN)
        _check_surfaces(look, where, cfg, report)
        if picture.depth.size and _check_depth(picture.depth, _depth_place(flight, i), numbers, report):
            jumps.see(i, picture)
            if picture.instance.size:
                _check_mask(flight, i, picture, look, left_out, MASK_VISIBILITY_MIN, numbers, report)
    numbers.num_compared = jumps.judge(cfg, report)
    return numbers


def _read(flight: Track, i: int, tree: Path, checksums: Checksums) -> dict[str, bytes]:
    """Read the pictures of a frame that are there; `check_files` said which are not."""
    folder, files = flight.frame_folder(i), dict[str, bytes]()
    for name in FILE_NAMES.values():
        if (path := frame_path(folder, name)).exists():
            files[path.name] = read_bytes(path, what="image", tree=tree)
            checksums.compare(f"{frame_name(i)}/{path.name}", files[path.name])
    return files


def _ids_of(told: BystandersMeta | None) -> np.ndarray:
    """Ids of people who are not the target, (65536,) bool."""
    ids = np.zeros(NUM_IDS, dtype=np.bool_)
    if told is not None:
        ids[[other.instance_id for other in told.others if other.instance_id < NUM_IDS]] = True
    return ids


def _check_surfaces(look: PixelFigures, where: str, cfg: InspectConfig, report: Report) -> None:
    """Return where a texture may be missing, and where surfaces fight for pixels."""
    if look.flat > FLAT_SURFACE_MAX:
        got = (
            f"{look.flat:.1%} of the picture is a surface of one colour "
            f"({KIND_NAMES.get(look.flat_kind, look.flat_kind)})"
        )
        report.warn("missing_texture", f"{where}/rgb.png", got, f"at most {FLAT_SURFACE_MAX:.1%}")
    if look.magenta > MAGENTA_MAX:
        report.warn("missing_texture", f"{where}/rgb.png", f"{look.magenta:.2%} magenta", f"at most {MAGENTA_MAX:.2%}")
    if look.fighting > Z_FIGHTING_MAX:
        got = f"{look.fighting:.3%} of the pixels alternate between two surfaces of one plane"
        report.warn("z_fighting", f"{where}/instance.png", got, f"at most {Z_FIGHTING_MAX:.3%}")


def _moved(flight: Track, i: int, k: int) -> bool:
    """Return whether the camera changed so much between two frames that equal pictures are an error."""
    shift_m = np.linalg.norm(flight.positions_m[k] - flight.positions_m[i])
    turn_deg = np.abs(flight.rotations_deg[k] - flight.rotations_deg[i]).max()
    return bool(shift_m > 0.5 or turn_deg > 2.0)


def _depth_place(flight: Track, i: int) -> str:
    """Name the file that a finding on the depth of frame i is about."""
    return f"{frame_name(i)}/{frame_path(flight.frame_folder(i), DEPTH_NPY).name}"


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
    flight: Track,
    i: int,
    picture: Picture,
    look: PixelFigures,
    left_out: np.ndarray,
    visibility_min: float,
    numbers: FrameNumbers,
    report: Report,
) -> None:
    """Compare pedestrian pixels with the target's projected and recorded box, and their depth with its own."""
    box = target_box(flight, i)
    visibility = flight.target.visibility[i]
    if np.isnan(box).any() or not visibility > 0:
        return
    where, region = f"{frame_name(i)}/instance.png", None
    x0, y0, x1, y1 = people = look.person_box or (0, 0, 0, 0)
    corner = np.array([x0, y0, x0, y0], dtype=np.float64)
    if look.person_box is not None:
        region = pedestrian_region(_kinds_without(picture.instance[y0:y1, x0:x1], left_out), box - corner)
    if region is None:
        area_px2 = (box[2] - box[0]) * (box[3] - box[1])
        if visibility >= visibility_min and area_px2 >= MASK_MIN_BOX_PX2:
            got = f"no pedestrian pixel at the target's box, visibility {visibility:.2f}"
            report.error("mask_disagrees", where, got, "pedestrian pixels where the pose puts the person")
        numbers.track_ious.append(0.0)
        return
    found = mask_box(region) + corner
    numbers.track_ious.append(pixels_iou(box, found))
    if flight.target.mask_bbox is not None:
        recorded = flight.target.mask_bbox[i]
        # Between this part of the person and all pedestrian pixels: a pole in front cuts a person into parts. NaN is
        # neither.
        if not (_encloses(recorded, found) and _encloses(np.array(people), recorded)):
            place = f"trajectory.json: points[{i}].target.mask_bbox_2d"
            report.error("mask_disagrees", place, str(recorded.tolist()), f"the box of the pixels, {found.tolist()}")
    expected_m = float(flight.target.depth_m[i])
    found_m = float(np.median(picture.depth[y0:y1, x0:x1][region]))
    if np.isfinite(expected_m) and abs(found_m - expected_m) > SURFACE_TOLERANCE_M:
        expected = f"{expected_m:.2f} m (target.depth) within {SURFACE_TOLERANCE_M:.1f} m"
        report.error("depth_disagrees", _depth_place(flight, i), f"{found_m:.2f} m at the person", expected)


def pixels_iou(box: np.ndarray, found: np.ndarray) -> float:
    """Return the IoU of a box and that of the pixels in it, (4,) px each.

    A pixel is seen at its middle, so that each edge of the pixels may be half a pixel off: of a person of three pixels
    that is a third. So much is forgiven at any size.
    """
    return box_iou(np.clip(found, box - 0.5, box + 0.5), found)


def _kinds_without(instance: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Return the kinds of pixels, (h, w); those of ids left out are NONE: the pedestrian who stays is the target."""
    ids = instance[..., 1].astype(np.uint16) | (instance[..., 2].astype(np.uint16) << 8)
    return np.where(left_out[ids], KINDS["NONE"], instance[..., 0])


def target_box(flight: Track, i: int) -> np.ndarray:
    """Project the target's 3D box: xmin, ymin, xmax, ymax px, cut to the image; NaN where it is not in view."""
    camera = flight.camera_at(i)
    corners_m = box_corners(flight.targets_m[i], np.array(PERSON_HALF_EXTENTS_M))
    uv, _ = project(corners_m, world_from_camera(flight.positions_m[i], flight.rotations_deg[i]), camera.intrinsic)
    low, high = uv.min(axis=0), uv.max(axis=0)  # NaN where a corner lies behind the camera
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    if not (np.isfinite(uv).all() and (high > 0).all() and (low < size).all()):
        return np.full(4, np.nan)
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])


def pedestrian_region(kinds: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Return the region of pedestrian pixels that shares most pixels with a box, (h, w) bool; None if none does."""
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
