"""The playback tree (stages 5-7 and the release): the layout of the public CosFly-Track v7 data set.

    Town*/trajectory_<unix seconds>/ORI/        the clean track
    Town*/trajectory_<unix seconds>/aug_001/    the perturbed track, same frame indices
        trajectory.json
        frames_playback/frame_00000/{rgb.png, depth_float32.png or depth.npy, instance.png, meta.json}

The files use CARLA's left-handed axes. This module converts those of `trajectory.json`, and frames.py those of
`meta.json`; all other code uses right-handed axes. Unknown keys are kept in `Track.raw` and are written again.
"""

import copy
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from cosfly.formats.columns import ANGLES, POSE, XYZ, is_number, numbers
from cosfly.formats.frames import (
    BYSTANDER_COLUMNS,
    COORDINATES,
    FRAME_FILES,
    FRAMES_DIR,
    Camera,
    frame_name,
    frame_path,
)
from cosfly.formats.pedestrian_paths import pace_of
from cosfly.formats.people import Goal, People, read_goal
from cosfly.formats.places import place_of, tree_of_track
from cosfly.formats.segments import FOLLOW, Mission, Segment, flown_as_json, mirrored, read_flown
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_poses, step_s
from cosfly.geometry.motion import PlannedMotion, without_perturbation
from cosfly.runtime.errors import InputError, json_type, shown
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import MISSING, read_object, validated, write_json
from cosfly.runtime.png import check_pixels

Value = TypeVar("Value")

SCHEMA, SCHEMA_VERSION = "drone_nav_traj_v7", "7.0.0"
WAYPOINT_TOLERANCE_M = 1e-5  # the bound of the public readers on nav_waypoint.t1_world
STEP_TOLERANCE_S = 1e-3  # largest difference between a time step and the median step
BBOX = ("xmin", "ymin", "xmax", "ymax")
ORIGINAL = "ORI"  # the folder of a clean track
TARGET_FILE = "target.png"  # in a track's folder: the target, cut out of the frame of the goal
TREE_ACTION = ("forward_mps", "right_mps", "up_mps", "yaw_rate_degps", "gimbal_pitch_deg")  # motion.ACTION, mirrored
TREE_ACTION_SIGNS = np.array([1.0, -1.0, 1.0, -1.0, 1.0])  # left becomes right, counter-clockwise clockwise
LEGIBILITY = ("height_px", "contrast", "legible")  # fields of a point's target, measured in cosfly/render/camera.py
EVENTS = ("position", "rotation")  # events of a perturbed frame; docs/files.md lists their outcomes
# States of the frames of a perturbed track. Index: 1 if the position is perturbed, plus 2 if the rotation is.
STATES = ("unperturbed", "position only", "rotation only", "full")
DATASET_FORMAT = "cosfly_playback"  # marks tracks that cosfly made
HEADING_FRAMES = 2  # a heading points from the position this many frames before to that as many frames after
STANDS_M = 0.1  # a target that moves less between these two frames is standing


@dataclass(frozen=True)
class TargetRecord:
    """The target in the n frames of a track; values that are null or unknown are NaN.

    in_view, visible: (n,) bool, `visible` accounts for occlusion. depth_m: (n,) z-depth. uv: (n, 2) px. bbox: (n, 4)
    xmin, ymin, xmax, ymax px of the projected 3D box. visibility: (n,) rendered score in [0, 1]. mask_bbox: (n, 4) of
    the target's pixels. legible: (n,) bool. The last two are None if the file has no such field.
    """

    in_view: np.ndarray
    visible: np.ndarray
    depth_m: np.ndarray
    uv: np.ndarray
    bbox: np.ndarray
    visibility: np.ndarray
    mask_bbox: np.ndarray | None = None
    legible: np.ndarray | None = None


@dataclass(frozen=True)
class Perturbation:
    """The offsets that were applied to each of n frames.

    is_perturbed: (n,) bool. drone_m, rotation_deg, target_m: (n, 3), zero if nothing was applied, NaN if unknown:
    public files store only that there was an offset.
    """

    is_perturbed: np.ndarray
    drone_m: np.ndarray
    rotation_deg: np.ndarray
    target_m: np.ndarray


@dataclass(frozen=True)
class Track:
    """One `trajectory.json`, n points, in right-handed axes: poses, times, target and camera, and optional records.

    time_s: (n,) strictly increasing. positions_m: (n, 3). rotations_deg: (n, 3) pitch, yaw, roll of the camera.
    targets_m: (n, 3) hip of the target, NaN if the file has none. segments, mission: As planned.

    Optional fields, None if the file has none. intrinsics: (n, 3, 3) of a camera that zooms; otherwise `camera` is that
    of all frames (`camera_at` covers both). people: Their appearance. goal: The description of the target. bystanders:
    (n, 5), frames.BYSTANDER_COLUMNS.
    """

    town: str
    trajectory: str
    variant: str
    camera: Camera
    time_s: np.ndarray
    positions_m: np.ndarray
    rotations_deg: np.ndarray
    targets_m: np.ndarray
    target: TargetRecord
    perturbation: Perturbation
    source: dict = field(default_factory=dict)
    is_original: bool = True
    folder: Path | None = None
    raw: dict = field(default_factory=dict)
    issues: tuple[InputError, ...] = ()  # deviations from the layout
    run: str = ""  # set if tracks of several runs are combined
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    intrinsics: np.ndarray | None = None
    people: People | None = None
    goal: Goal | None = None
    bystanders: np.ndarray | None = None
    given_id: str | None = None  # set if the plain id is not unique among several towns or runs (places.py)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def flight_id(self) -> str:
        """The id of the track, such as `trajectory_1776047127_ORI`, with which its sample ids begin."""
        return self.given_id or f"{self.trajectory}_{self.variant}"

    def camera_at(self, index: int) -> Camera:
        """Return the camera of frame `index`."""
        return self.camera if self.intrinsics is None else replace(self.camera, intrinsic=self.intrinsics[index])

    @property
    def fovs_deg(self) -> tuple[float, float]:
        """Smallest and largest field of view, degrees."""
        num_cameras = 1 if self.intrinsics is None else len(self)
        fovs = [self.camera_at(i).fov_deg for i in range(num_cameras)]
        return min(fovs), max(fovs)

    @cached_property
    def styles(self) -> list[str]:
        """Manoeuvre style of each frame."""
        styles = [FOLLOW] * len(self)
        for part in self.segments:
            styles[part.begin : part.end] = [part.style] * (part.end - part.begin)
        return styles

    @property
    def keeps_sight(self) -> np.ndarray:
        """Whether the visibility of the target counts in each frame, (n,) bool."""
        keeps = np.ones(len(self), dtype=bool)
        for part in self.segments:
            keeps[part.begin : part.end] = part.keeps_sight
        return keeps

    @cached_property
    def target_headings_deg(self) -> np.ndarray:
        """Heading of the target, (n,) counter-clockwise from east; NaN before its first step or if unknown."""
        frames = np.arange(len(self))
        ahead = np.minimum(frames + HEADING_FRAMES, len(self) - 1)
        behind = np.maximum(frames - HEADING_FRAMES, 0)
        steps = self.targets_m[ahead, :2] - self.targets_m[behind, :2]
        moves = np.linalg.norm(np.nan_to_num(steps), axis=1) >= STANDS_M
        last = np.maximum.accumulate(np.where(moves, frames, -1))  # a standing target keeps the last heading
        return np.where(last >= 0, np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))[last], np.nan)

    @property
    def walked_m(self) -> np.ndarray:
        """Target positions without perturbation, (n, 3); NaN if unknown."""
        return self.targets_m - self.perturbation.target_m

    @cached_property
    def planned(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (n, 6) and target positions (n, 3) without perturbation; NaN if unknown."""
        poses = np.hstack([self.positions_m, self.rotations_deg])
        if self.is_original:
            return poses, self.targets_m
        offsets = np.hstack([self.perturbation.drone_m, self.perturbation.rotation_deg])
        return without_perturbation(poses, self.targets_m, offsets, self.perturbation.target_m)

    @cached_property
    def motion(self) -> PlannedMotion:
        """The planned motion that a policy learns."""
        return PlannedMotion(self.time_s, self.planned[0], self.rotations_deg[:, 1], self.positions_m)

    @property
    def pace(self) -> str:
        """Pace of the pedestrian trajectory."""
        return pace_of(self.source, str(self.folder))

    @property
    def planner(self) -> str | None:
        """Name of the planner; None if the file has none."""
        name = self.source.get("algorithm")
        return name if isinstance(name, str) and name else None

    @property
    def weather(self) -> dict[str, str | None]:
        """Names of the presets of weather and time of day; None if the file has none."""
        record = self.weather_record
        return {
            "weather": None if record is None else record.weather_name,
            "time_of_day": None if record is None else record.tod_name,
        }

    @cached_property
    def weather_record(self) -> WeatherRecord | None:
        """The complete weather record; None if the file has none in the paper's form."""
        try:
            return WeatherRecord.model_validate(self.raw.get("weather"))
        except ValidationError:
            return None

    def _point(self, index: int, key: str) -> dict:
        points = self.raw.get("points", [])
        return object_of(points[index], key) if index < len(points) else {}

    def legibility_at(self, index: int) -> dict[str, float | bool | None]:
        """Return the LEGIBILITY fields of a point; None for a field that is missing or invalid."""
        target = self._point(index, "target")
        values = {name: target.get(name) for name in LEGIBILITY}
        return {name: value if isinstance(value, bool) or is_number(value) else None for name, value in values.items()}

    def events(self, index: int) -> dict[str, str] | None:
        """Return the outcome of a point's EVENTS (none, applied, fallback); None if the file does not store them."""
        perturbation = self._point(index, "perturbation")
        if not all(isinstance(perturbation.get(event), str) for event in EVENTS):
            return None
        return {event: perturbation[event] for event in EVENTS}

    @cached_property
    def states(self) -> list[str | None]:
        """State of each frame after fallbacks, one of STATES; None if unknown."""
        offsets = self.perturbation
        states = list[str | None]()
        for i in range(len(self)):
            point = self._point(i, "perturbation")
            positions = np.stack([offsets.drone_m[i], offsets.target_m[i]])
            is_shifted = _was_moved(positions, point.get("drone_position"))
            is_turned = _was_moved(offsets.rotation_deg[i : i + 1], point.get("drone_rotation"))
            states.append(None if is_shifted is None or is_turned is None else STATES[is_shifted + 2 * is_turned])
        return states

    @property
    def is_ours(self) -> bool:
        """Whether cosfly made the track."""
        return DATASET_FORMAT in (self.raw.get("dataset_format"), self.raw.get("made_by"))

    def target_picture(self, index: int) -> dict[str, str | bytes] | None:
        """Return the picture of the target and its name; None for other frames than that of the goal."""
        path = None if self.folder is None else self.folder / TARGET_FILE
        if self.goal is None or self.goal.frame != index or path is None or not path.is_file():
            return None
        data = read_bytes(path, what="target picture", tree=tree_of_track(path.parent))
        return {"bytes": data, "path": f"{self.flight_id}_{TARGET_FILE}"}

    def frame_folder(self, index: int) -> Path:
        assert self.folder is not None
        return self.folder / frame_name(index)

    def missing_frames(self, names: tuple[str, ...] = FRAME_FILES) -> list[int]:
        """Return the indices of the points that lack one of the files, named as in the public layout."""
        folders = [self.frame_folder(i) for i in range(len(self))]
        return [i for i, folder in enumerate(folders) if not all(frame_path(folder, name).is_file() for name in names)]


def _was_moved(offsets: np.ndarray, flag: object) -> bool | None:
    """Return whether any offset (k, 3) is not zero; if unknown, the flag in the file, or None without a flag."""
    is_known = ~np.isnan(offsets).any(axis=1)
    if (offsets[is_known] != 0).any() or is_known.all():
        return bool((offsets[is_known] != 0).any())
    return flag if isinstance(flag, bool) else None


# --- reading ----------------------------------------------------------------------------------------------------------


def read_track(folder: Path) -> Track:
    """Read one track's folder.

    Older names and missing optional fields are accepted and listed in `Track.issues`. Poses and times must be finite.
    """
    path = folder / "trajectory.json"
    raw = read_object(path, what="trajectory", tree=tree_of_track(folder))
    reader = _FieldReader(path)
    _, town, trajectory, variant = astuple(place_of(folder))
    for name, expected in (("schema", SCHEMA), ("schema_version", SCHEMA_VERSION), ("trace_dir", variant)):
        reader.equal(name, raw.get(name), expected)
    points = reader.points(raw)
    time_s = reader.times(points)
    poses = mirror_poses(reader.poses(points))
    targets = [object_of(point, "target") for point in points]
    bystander_groups = [object_of(point, "others") for point in points]
    if not all(target or point.get("target", "missing") is None for target, point in zip(targets, points, strict=True)):
        reader.issue("points[].target", "missing", "an object, or null without a target")
    bystanders = np.column_stack([_numbers_of(bystander_groups, name) for name in BYSTANDER_COLUMNS])
    segments, mission = reader.optional(lambda: read_flown(raw, len(points), str(path))) or ((), None)
    people = goal = None
    if "people" in raw:
        people = reader.optional(lambda: validated(People, raw["people"], f"{path}: people"))
    if raw.get("goal") is not None and "absent" not in object_of(raw, "goal"):
        goal = reader.optional(lambda: read_goal(raw["goal"], len(points), f"{path}: goal"))
    if {"params", "mode"} & object_of(raw, "weather").keys():  # public files may use this key otherwise
        reader.optional(lambda: validated(WeatherRecord, raw["weather"], f"{path}: weather"))
    is_original = bool(object_of(raw, "augmentation").get("is_original", variant == ORIGINAL))
    camera = reader.camera(raw.get("camera"))
    return Track(
        town=town,
        trajectory=trajectory,
        variant=variant,
        camera=camera,
        time_s=time_s,
        positions_m=poses[:, :3],
        rotations_deg=poses[:, 3:],
        targets_m=mirror_poses(_vectors_of(targets, "world_location", XYZ)),
        target=_target_view(targets),
        perturbation=_perturbation(points, is_original),
        source=object_of(raw, "source"),
        is_original=is_original,
        folder=folder,
        raw=raw,
        segments=segments,
        mission=mirrored(mission),
        intrinsics=reader.intrinsics(points, camera),
        people=people,
        goal=goal,
        bystanders=None if np.isnan(bystanders[:, 0]).any() else bystanders,
        issues=tuple(reader.issues),  # last: the calls above add to it
    )


class _FieldReader:
    """Reads and checks the fields of one file; `issues` records deviations."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.issues: list[InputError] = []

    def error(self, message: str, where: str, got: object, expected: str) -> InputError:
        if got == "null":
            return InputError(MISSING, where=f"{self.path}: {where}", expected=expected)
        return InputError(message, where=f"{self.path}: {where}", got=str(got), expected=expected)

    def issue(self, where: str, got: object, expected: str) -> None:
        self.issues.append(self.error("the field does not follow the format of the file", where, got, expected))

    def optional(self, read: Callable[[], Value]) -> Value | None:
        """Return an optional field; record an issue and return None if its content is invalid."""
        try:
            return read()
        except InputError as error:
            self.issues.append(error)
            return None

    def equal(self, where: str, got: object, expected: object) -> None:
        if got != expected:
            self.issue(where, shown(got), shown(expected))

    def points(self, raw: dict) -> list[dict]:
        if "points" not in raw:
            self.issue("points", "missing", "a list of objects")
        points = raw.get("points", raw.get("waypoints"))
        if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
            raise self.error("the field is not a list of objects", "points", json_type(points), "a list of objects")
        for i, point in enumerate(points):
            self.equal(f"points[{i}].index", point.get("index"), i)
        return points

    def times(self, points: list[dict]) -> np.ndarray:
        """Read the times of the points, (n,) s; they must increase."""
        time_s = np.array([self.time(i, point) for i, point in enumerate(points)])
        steps = np.diff(time_s)
        if (steps <= 0).any():
            where = f"points[{int(np.argmax(steps <= 0)) + 1}].timing.trace_timestamp"
            got = f"a step of {steps.min():g} s"
            raise self.error("the times of the points do not increase", where, got, "strictly increasing times")
        dt_s = step_s(time_s)
        if len(steps) and np.abs(steps - dt_s).max() > STEP_TOLERANCE_S:
            got = f"steps of {steps.min():.3f} to {steps.max():.3f} s"
            self.issue("points[].timing.trace_timestamp", got, f"equal steps of {dt_s:g} s")
        return time_s

    def time(self, i: int, point: dict) -> float:
        timing = object_of(point, "timing")
        where = f"points[{i}].timing"
        if "trace_timestamp" in timing:
            return self.number(where, timing, "trace_timestamp")
        self.issue(f"{where}.trace_timestamp", "missing", "a finite number")
        return self.number(where, timing if "timestamp" in timing else point, "timestamp")

    def number(self, where: str, group: Any, name: str) -> float:
        value = group.get(name) if isinstance(group, dict) else None
        if value is None and name in ("pitch", "roll"):
            self.issue(f"{where}.{name}", "null", "a finite number")
            return 0.0
        if value is None or not is_number(value):
            raise self.error("the field is not a number", f"{where}.{name}", shown(value), "a finite number")
        return float(value)

    def poses(self, points: list[dict]) -> np.ndarray:
        """Read poses as in the file, (n, 6) in CARLA's axes, and check the waypoints."""
        groups = [(f"points[{i}].drone_pose", point.get("drone_pose")) for i, point in enumerate(points)]
        poses = np.array([[self.number(where, group, name) for name in POSE] for where, group in groups])
        for i, point in enumerate(points):
            nav = point.get("nav_waypoint")
            waypoint = nav.get("t1_world") if isinstance(nav, dict) else "missing"
            if i + 1 < len(points):
                next_m = poses[i + 1, :3]
                expected = f"the next point's position {next_m.tolist()}"
                distances_m = np.abs(np.subtract(_parts_of(waypoint, XYZ), next_m))
                is_right = bool((distances_m <= WAYPOINT_TOLERANCE_M).all())
            else:
                expected = "null at the last point"
                is_right = waypoint is None
            if not is_right:
                self.issue(f"points[{i}].nav_waypoint.t1_world", shown(waypoint), expected)
                break  # one issue per file
        return poses

    def camera(self, group: Any) -> Camera:
        if not isinstance(group, dict):
            raise InputError(MISSING, where=f"{self.path}: camera", expected="width, height, intrinsic")
        width = self.number("camera", group, "width")
        height = self.number("camera", group, "height")
        matrix = numbers(group.get("intrinsic"), 3, 3)
        if width < 1 or height < 1:
            got, expected = f"{width:g} x {height:g} px", "at least 1 x 1 px"
            raise self.error("the picture size of the camera is not positive", "camera", got, expected)
        if matrix is None or matrix[0, 0] <= 0:
            got = shown(group.get("intrinsic"))
            expected = "a 3x3 matrix with a positive focal length"
            raise self.error("the intrinsic matrix of the camera is invalid", "camera.intrinsic", got, expected)
        check_pixels(width * height, f"{self.path}: camera", f"{width:g} x {height:g} px")
        return Camera(int(width), int(height), matrix)

    def intrinsics(self, points: list[dict], camera: Camera) -> np.ndarray | None:
        """Read the matrix of each frame, (n, 3, 3); None if all are that of `camera`."""
        matrices = [camera.intrinsic] * len(points)
        size = {"width": camera.width_px, "height": camera.height_px}
        for i, point in enumerate(points):
            value = object_of(point, "camera").get("intrinsic")
            if value is None:
                continue
            try:
                matrices[i] = self.camera({**size, "intrinsic": value}).intrinsic
            except InputError as error:
                self.issue(f"points[{i}].camera.intrinsic", error.got, error.expected or "a camera")
        return None if (np.array(matrices) == camera.intrinsic).all() else np.array(matrices)


def object_of(group: dict, key: str) -> dict:
    """Return the object under a key; an empty one for anything else."""
    value = group.get(key)
    return value if isinstance(value, dict) else {}


def _parts_of(value: Any, names: tuple[str, ...]) -> list:
    """Return the numbers of {"x": .., "y": ..} or [.., ..]; NaN for anything else, nulls included."""
    parts = [value.get(name) for name in names] if isinstance(value, dict) else value
    if isinstance(parts, list) and len(parts) == len(names) and all(map(is_number, parts)):
        return parts
    return [np.nan] * len(names)


def _vectors_of(groups: list[dict], key: str, names: tuple[str, ...]) -> np.ndarray:
    """Read a vector of each group, (n, len(names))."""
    return np.array([_parts_of(group.get(key), names) for group in groups], np.float64).reshape(-1, len(names))


def _numbers_of(groups: list[dict], key: str) -> np.ndarray:
    """Read one number of each group, (n,); NaN for anything else."""
    return np.array([value if is_number(value := group.get(key)) else np.nan for group in groups], dtype=np.float64)


def _target_view(targets: list[dict]) -> TargetRecord:
    flags = [target.get("legible") for target in targets]
    has_mask = any("mask_bbox_2d" in target for target in targets)
    return TargetRecord(
        in_view=np.array([bool(target.get("in_view", target.get("visible", False))) for target in targets]),
        visible=np.array([bool(target.get("visible", False)) for target in targets]),
        depth_m=_numbers_of(targets, "depth"),
        uv=_vectors_of(targets, "image_uv", ("u", "v")),
        bbox=_vectors_of(targets, "bbox_2d", BBOX),
        visibility=_numbers_of(targets, "visibility"),
        mask_bbox=_vectors_of(targets, "mask_bbox_2d", BBOX) if has_mask else None,
        legible=np.array(flags) if all(isinstance(flag, bool) for flag in flags) else None,
    )


def _perturbation(points: list[dict], is_original: bool) -> Perturbation:
    groups = [object_of(point, "perturbation") for point in points]
    flags = [point.get("is_perturbed") for point in points]

    def offsets(key: str, names: tuple[str, ...]) -> np.ndarray:
        """Read the offsets under a key, (n, 3); zero if the file has none and states that nothing was applied."""
        exact = [object_of(group, "offsets") if key in object_of(group, "offsets") else group for group in groups]
        vectors = mirror_poses(_vectors_of(exact, key, names))
        is_zero = [
            is_original or flag is False or group.get(key) is False for flag, group in zip(flags, groups, strict=True)
        ]
        vectors[np.isnan(vectors).any(axis=1) & np.array(is_zero)] = 0.0
        return vectors

    return Perturbation(
        is_perturbed=np.array([bool(flag) for flag in flags]),
        drone_m=offsets("drone_position", XYZ),
        rotation_deg=offsets("drone_rotation", ANGLES),
        target_m=offsets("target_position", XYZ),
    )


# --- writing ----------------------------------------------------------------------------------------------------------


def write_track(folder: Path, track: Track, *, with_flags: bool = False) -> None:
    """Write `trajectory.json` into a folder. Unknown keys of `track.raw` are kept, known ones follow the arrays.

    with_flags: As in the public files, a perturbation is flags; its offsets are in `offsets`, next to them.
    """
    raw = copy.deepcopy(track.raw)
    points = raw.pop("points", None) or raw.pop("waypoints", None) or [{} for _ in range(len(track))]
    assert len(points) == len(track), "raw points and columns differ in number"
    camera = track.camera
    target = track.target
    perturbation = track.perturbation
    raw |= {
        "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "trace_dir": track.variant,
        "dataset_format": raw.get("dataset_format", DATASET_FORMAT), "frames_dir": raw.get("frames_dir", FRAMES_DIR),
        "coordinates": raw.get("coordinates", COORDINATES), "source": track.source,
        **flown_as_json(track.segments, mirrored(track.mission)),
        **({} if track.people is None else {"people": asdict(track.people)}),
        **({} if track.goal is None else {"goal": asdict(track.goal)}),
        "camera": object_of(raw, "camera")
        | {"width": camera.width_px, "height": camera.height_px, **camera.focal_record()},
        "augmentation": {"enabled": not track.is_original, "aug_index": 0 if track.is_original else 1}
        | object_of(raw, "augmentation") | {"is_original": track.is_original},
    }  # fmt: skip
    poses = mirror_poses(np.hstack([track.positions_m, track.rotations_deg])) + 0.0
    # Group and key in a point, names of the components, values by point.
    vectors: list[tuple[str, str, tuple[str, ...], np.ndarray | None]] = [
        ("target", "world_location", XYZ, mirror_poses(track.targets_m)),
        ("target", "image_uv", (), target.uv),
        ("target", "bbox_2d", BBOX, target.bbox),
        ("perturbation", "drone_position", XYZ, mirror_poses(perturbation.drone_m)),
        ("perturbation", "drone_rotation", ANGLES, mirror_poses(perturbation.rotation_deg)),
        ("perturbation", "target_position", XYZ, mirror_poses(perturbation.target_m)),
        ("target", "mask_bbox_2d", BBOX, target.mask_bbox),
    ]
    for i, point in enumerate(points):
        time_s = float(track.time_s[i])
        is_last = i + 1 == len(points)
        waypoint = None if is_last else dict(zip(XYZ, poses[i + 1, :3].tolist(), strict=True))
        point |= {
            "index": i,
            "is_perturbed": bool(perturbation.is_perturbed[i]),
            "timing": {"sim_timestamp": time_s, **object_of(point, "timing"), "trace_timestamp": time_s},
            "drone_pose": {**object_of(point, "drone_pose"), **dict(zip(POSE, poses[i].tolist(), strict=True))},
            "nav_waypoint": {**object_of(point, "nav_waypoint"), "t1_world": waypoint},
            "perturbation": object_of(point, "perturbation"),
            "action": _tree_action(track.motion.action[i]),
        }
        if track.intrinsics is not None:
            point["camera"] = {**object_of(point, "camera"), **track.camera_at(i).focal_record()}
        has_no_target = "target" in point and point["target"] is None and np.isnan(track.targets_m[i]).all()
        if not has_no_target:
            point["target"] = _target(object_of(point, "target"), target, i)
        for group, key, names, values in vectors:
            if values is not None and not (has_no_target and group == "target"):
                _put_vector(point[group], key, names, values[i])
        if with_flags:
            _put_flags(point["perturbation"])
    write_json(folder / "trajectory.json", raw | {"points": points})


def _put_flags(perturbation: dict) -> None:
    """Replace the offsets of a perturbation by flags, and move those that are not zero to `offsets`."""
    found = {key: perturbation.get(key) for key in ("drone_position", "drone_rotation", "target_position")}
    offsets = {key: value for key, value in found.items() if isinstance(value, dict) and any(value.values())}
    flags = {key: key in offsets or value is True for key, value in found.items()}
    perturbation |= flags | ({"offsets": offsets} if offsets else {})


def _tree_action(action: np.ndarray) -> dict[str, float] | None:
    """Return an action in the tree's axes by name; None if it is unknown."""
    if np.isnan(action).any():
        return None
    return dict(zip(TREE_ACTION, (action * TREE_ACTION_SIGNS + 0.0).tolist(), strict=True))


def _target(group: dict, target: TargetRecord, i: int) -> dict:
    """Return the target of point i without its vectors; unknown keys of the file are kept."""
    fields = {
        "enabled": True,
        **group,
        "visible": bool(target.visible[i]),
        "in_view": bool(target.in_view[i]),
        "depth": None if np.isnan(target.depth_m[i]) else float(target.depth_m[i]),
    }
    if not np.isnan(target.visibility[i]):
        fields["visibility"] = float(target.visibility[i])
    elif "visibility" in fields:
        fields["visibility"] = None
    return fields


def _put_vector(group: dict, key: str, names: tuple[str, ...], values: np.ndarray) -> None:
    """Set a vector as null, as a list if the file has a list or there are no names, else as an object."""
    present = group.get(key)
    is_unknown = bool(np.isnan(values).any())
    if (present is True and is_unknown) or (present is False and not values.any()):
        return  # a public file stores only whether there was an offset
    if is_unknown:
        group[key] = None
    elif isinstance(present, list) or not names:
        group[key] = (values + 0.0).tolist()
    else:
        group[key] = dict(zip(names, (values + 0.0).tolist(), strict=True))
