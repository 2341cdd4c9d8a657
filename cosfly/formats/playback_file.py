"""`trajectory.json` of the playback tree, read as a `Track` and written.

The file uses CARLA's left-handed axes, a `Track` right-handed ones. Unknown keys of a file are kept in `Track.raw` and
are written again. Where both the file and the arrays have a value, that of the arrays is written.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from pydantic import AliasChoices, AliasPath, BaseModel, Field, PlainValidator

from cosfly.formats.columns import ANGLES, LARGEST, POSE, XYZ, is_number, numbers
from cosfly.formats.frames import BYSTANDER_COLUMNS, COORDINATES, FRAMES_DIR, Camera, write_axes
from cosfly.formats.people import People, read_goal
from cosfly.formats.places import place_of, tree_of_track
from cosfly.formats.playback import DATASET_FORMAT, ORIGINAL, Perturbation, TargetRecord, Track, object_of
from cosfly.formats.segments import flown_as_json, mirrored, read_flown
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_poses, step_s
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.json_io import read_object, validated, write_json
from cosfly.runtime.png import check_pixels

Value = TypeVar("Value")

SCHEMA, SCHEMA_VERSION = "drone_nav_traj_v7", "7.0.0"
WAYPOINT_TOLERANCE_M = 1e-5  # the bound of the public readers on nav_waypoint.t1_world
INTRINSIC = "a 3x3 matrix with a positive focal length"
MOST_POINTS = 500_000  # four hours at 30 Hz; each takes kilobytes of memory while it is read
STEP_TOLERANCE_S = 1e-3  # largest difference between a time step and the median step
BBOX = ("xmin", "ymin", "xmax", "ymax")
UV = ("u", "v")
OFFSETS = {"drone_position": XYZ, "drone_rotation": ANGLES, "target_position": XYZ}  # in a point's perturbation
TREE_ACTION = ("forward_mps", "right_mps", "up_mps", "yaw_rate_degps", "gimbal_pitch_deg")  # motion.ACTION, mirrored
TREE_ACTION_SIGNS = np.array([1.0, -1.0, 1.0, -1.0, 1.0])  # left becomes right, counter-clockwise clockwise


# --- the fields of the file -------------------------------------------------------------------------------------------


def _matrix(value: Any) -> np.ndarray | None:
    """Return the intrinsic matrix of a camera; None if it is not 3 x 3 numbers or has no positive focal length."""
    matrix = numbers(value, 3, 3)
    return None if matrix is None or matrix[0, 0] <= 0 else matrix


def _number_or_nan(value: Any) -> float:
    return float(value) if is_number(value) else np.nan


def _vector(names: tuple[str, ...], value: Any) -> list[float]:
    """Return the numbers of {"x": .., "y": ..} or [.., ..], and NaN for anything else."""
    parts = [value.get(name) for name in names] if isinstance(value, dict) else value
    if isinstance(parts, list) and len(parts) == len(names) and all(map(is_number, parts)):
        return parts
    return [np.nan] * len(names)


def _offset(names: tuple[str, ...], value: Any) -> list[float]:
    """Return the numbers of an offset; zeros for the flag false, with which public files say that there is none."""
    return [0.0] * len(names) if value is False else _vector(names, value)


def _at(*paths: str, default: Any = None) -> Any:
    """Return a field of a point that is read from the first of some paths that exists, else from its default."""
    choices = AliasChoices(*(AliasPath(*path.split(".")) for path in paths))
    return Field(default, validation_alias=choices, validate_default=True)


Number = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]
NumberOrNan = Annotated[float, PlainValidator(_number_or_nan)]
Flag = Annotated[bool, PlainValidator(bool)]
Position = Annotated[list[float], PlainValidator(partial(_vector, XYZ))]
Offset = Annotated[list[float], PlainValidator(partial(_offset, XYZ))]
AngleOffset = Annotated[list[float], PlainValidator(partial(_offset, ANGLES))]
Box = Annotated[list[float], PlainValidator(partial(_vector, BBOX))]
Pixel = Annotated[list[float], PlainValidator(partial(_vector, UV))]


class _Camera(BaseModel):
    width: float = Field(strict=True, ge=1, le=LARGEST)
    height: float = Field(strict=True, ge=1, le=LARGEST)
    intrinsic: Any


class _Pose(BaseModel):
    x: Number
    y: Number
    z: Number
    pitch: Number | None = None  # missing in older files
    yaw: Number
    roll: Number | None = None


class _Point(BaseModel):
    """The fields of a point that become arrays, in the axes of the file; NaN where an optional one is not valid."""

    index: Any = None
    time_s: Number = _at("timing.trace_timestamp", "timing.timestamp", "timestamp", default=...)
    drone_pose: _Pose
    waypoint: Any = _at("nav_waypoint.t1_world", default="missing")
    intrinsic: Any = _at("camera.intrinsic")
    is_perturbed: Any = None
    drone_offset: Offset = _at("perturbation.offsets.drone_position", "perturbation.drone_position")
    rotation_offset: AngleOffset = _at("perturbation.offsets.drone_rotation", "perturbation.drone_rotation")
    target_offset: Offset = _at("perturbation.offsets.target_position", "perturbation.target_position")
    target: Any = "missing"
    world_location: Position = _at("target.world_location")
    in_view: Flag = _at("target.in_view", "target.visible")
    visible: Flag = _at("target.visible")
    depth: NumberOrNan = _at("target.depth")
    image_uv: Pixel = _at("target.image_uv")
    bbox_2d: Box = _at("target.bbox_2d")
    mask_bbox_2d: Box = _at("target.mask_bbox_2d")
    visibility: NumberOrNan = _at("target.visibility")
    legible: Any = _at("target.legible")
    others: Any = None


class _File(BaseModel):
    points: list[_Point] = Field(
        min_length=1, max_length=MOST_POINTS, validation_alias=AliasChoices("points", "waypoints")
    )
    camera: _Camera


# --- reading ----------------------------------------------------------------------------------------------------------


def read_track(folder: Path) -> Track:
    """Read one track's folder.

    Older names and missing optional fields are accepted and listed in `Track.issues`. Poses and times must be finite.
    """
    path = folder / "trajectory.json"
    raw = read_object(path, what="trajectory", tree=tree_of_track(folder))
    place = place_of(folder)
    file = validated(_File, raw, path)
    points = file.points
    camera = _camera_of(file.camera, path)
    poses = np.array([[getattr(point.drone_pose, name) for name in POSE] for point in points], dtype=np.float64)
    poses = np.nan_to_num(poses)  # a missing angle has become NaN
    time_s = np.array([point.time_s for point in points])
    _check_order(time_s, path)
    what = "the field does not follow the format of the file"
    issues = [
        InputError(what, where=f"{path}: {deviation.field}", got=deviation.got, expected=deviation.expected)
        for deviation in _deviations(raw, place.variant, points, time_s, poses)
    ]
    segments, mission = _optional(lambda: read_flown(raw, len(points), str(path)), issues) or ((), None)
    people = None
    goal = None
    if "people" in raw:
        people = _optional(lambda: validated(People, raw["people"], f"{path}: people"), issues)
    if raw.get("goal") is not None and "absent" not in object_of(raw, "goal"):
        goal = _optional(lambda: read_goal(raw["goal"], len(points), f"{path}: goal"), issues)
    if {"params", "mode"} & object_of(raw, "weather").keys():  # public files may use this key otherwise
        _optional(lambda: validated(WeatherRecord, raw["weather"], f"{path}: weather"), issues)
    is_original = bool(object_of(raw, "augmentation").get("is_original", place.variant == ORIGINAL))
    matrices = np.stack([_intrinsic_of(point, camera) for point in points])
    positions_m, rotations_deg = np.hsplit(mirror_poses(poses), 2)
    return Track(
        **vars(place),
        camera=camera,
        time_s=time_s,
        positions_m=positions_m,
        rotations_deg=rotations_deg,
        targets_m=mirror_poses(_column(points, "world_location")),
        target=_target(points),
        perturbation=_perturbation(points, is_original),
        source=object_of(raw, "source"),
        is_original=is_original,
        folder=folder,
        raw=raw,
        issues=tuple(issues),
        segments=segments,
        mission=mirrored(mission),
        intrinsics=None if (matrices == camera.intrinsic).all() else matrices,
        people=people,
        goal=goal,
        bystanders=_bystanders(points),
    )


def _optional(read: Callable[[], Value], issues: list[InputError]) -> Value | None:
    """Return an optional field; add its error to the issues and return None if its content is invalid."""
    try:
        return read()
    except InputError as error:
        issues.append(error)
        return None


def _camera_of(record: _Camera, path: Path) -> Camera:
    matrix = _matrix(record.intrinsic)
    if matrix is None:
        what = "the intrinsic matrix of the camera is invalid"
        got = shown(record.intrinsic)
        raise InputError(what, where=f"{path}: camera.intrinsic", got=got, expected=INTRINSIC)
    check_pixels(record.width * record.height, f"{path}: camera", f"{record.width:g} x {record.height:g} px")
    return Camera(int(record.width), int(record.height), matrix)


def _intrinsic_of(point: _Point, camera: Camera) -> np.ndarray:
    """Return the intrinsic matrix of a point, (3, 3): its own, or that of the track's camera."""
    matrix = _matrix(point.intrinsic)
    return camera.intrinsic if matrix is None else matrix


def _check_order(time_s: np.ndarray, path: Path) -> None:
    steps = np.diff(time_s)
    if (steps <= 0).any():
        where = f"{path}: points[{int(np.argmax(steps <= 0)) + 1}].timing.trace_timestamp"
        what = "the times of the points do not increase"
        got = f"a step of {steps.min():g} s"
        raise InputError(what, where=where, got=got, expected="strictly increasing times")


class _Deviation(NamedTuple):
    """A field that does not follow the format, and still can be read."""

    field: str
    got: str
    expected: str


def _deviations(
    raw: dict, variant: str, points: list[_Point], time_s: np.ndarray, poses: np.ndarray
) -> Iterator[_Deviation]:
    """Yield the deviations of a file from the format. poses: (n, 6), in the axes of the file."""
    for key, value in {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "trace_dir": variant}.items():
        if raw.get(key) != value:
            yield _Deviation(key, shown(raw.get(key)), shown(value))
    if "points" not in raw:
        yield _Deviation("points", "missing", "a list of objects")
    for i, (point, record) in enumerate(zip(points, raw.get("points") or raw["waypoints"], strict=True)):
        if point.index != i:
            yield _Deviation(f"points[{i}].index", shown(point.index), str(i))
        if "trace_timestamp" not in object_of(record, "timing"):
            yield _Deviation(f"points[{i}].timing.trace_timestamp", "missing", "a finite number")
        for name in ("pitch", "roll"):
            if getattr(point.drone_pose, name) is None:
                yield _Deviation(f"points[{i}].drone_pose.{name}", "null", "a finite number")
        if point.intrinsic is not None and _matrix(point.intrinsic) is None:
            yield _Deviation(f"points[{i}].camera.intrinsic", shown(point.intrinsic), INTRINSIC)
    steps = np.diff(time_s)
    dt_s = step_s(time_s)
    if (np.abs(steps - dt_s) > STEP_TOLERANCE_S).any():
        got = f"steps of {steps.min():.3f} to {steps.max():.3f} s"
        yield _Deviation("points[].timing.trace_timestamp", got, f"equal steps of {dt_s:g} s")
    yield from _first_wrong_waypoint(points, poses)
    if any(point.target is not None and not (isinstance(point.target, dict) and point.target) for point in points):
        yield _Deviation("points[].target", "missing", "an object, or null without a target")


def _first_wrong_waypoint(points: list[_Point], poses: np.ndarray) -> Iterator[_Deviation]:
    """Yield one deviation if a waypoint is not the position of the next point, or the last one is not null."""
    waypoints = np.array([_vector(XYZ, point.waypoint) for point in points])
    is_right = (np.abs(waypoints[:-1] - poses[1:, :3]) <= WAYPOINT_TOLERANCE_M).all(axis=1)
    if not is_right.all():
        i = int(np.argmin(is_right))
        expected = f"the next point's position {poses[i + 1, :3].tolist()}"
    elif points[-1].waypoint is not None:
        i = len(points) - 1
        expected = "null at the last point"
    else:
        return
    yield _Deviation(f"points[{i}].nav_waypoint.t1_world", shown(points[i].waypoint), expected)


def _column(points: list[_Point], name: str) -> np.ndarray:
    return np.array([getattr(point, name) for point in points])


def _target(points: list[_Point]) -> TargetRecord:
    has_mask = any("mask_bbox_2d" in point.model_fields_set for point in points)
    is_judged = all(isinstance(point.legible, bool) for point in points)
    return TargetRecord(
        in_view=_column(points, "in_view"),
        visible=_column(points, "visible"),
        depth_m=_column(points, "depth"),
        uv=_column(points, "image_uv"),
        bbox=_column(points, "bbox_2d"),
        visibility=_column(points, "visibility"),
        mask_bbox=_column(points, "mask_bbox_2d") if has_mask else None,
        legible=_column(points, "legible") if is_judged else None,
    )


def _perturbation(points: list[_Point], is_original: bool) -> Perturbation:
    is_zero = np.array([is_original or point.is_perturbed is False for point in points])

    def offsets(name: str) -> np.ndarray:
        """Return an offset of each point, (n, 3); zero if it is unknown and nothing was applied to the point."""
        values = mirror_poses(_column(points, name))
        values[np.isnan(values).any(axis=1) & is_zero] = 0.0
        return values

    is_perturbed = np.array([bool(point.is_perturbed) for point in points])
    return Perturbation(is_perturbed, offsets("drone_offset"), offsets("rotation_offset"), offsets("target_offset"))


def _bystanders(points: list[_Point]) -> np.ndarray | None:
    groups = [point.others if isinstance(point.others, dict) else {} for point in points]
    columns = np.array([[_number_or_nan(group.get(name)) for name in BYSTANDER_COLUMNS] for group in groups])
    return None if np.isnan(columns[:, 0]).any() else columns


# --- writing ----------------------------------------------------------------------------------------------------------


def write_track(folder: Path, track: Track, *, with_flags: bool = False) -> None:
    """Write `trajectory.json` into a folder.

    with_flags: As in the public files, a perturbation is flags; its offsets are in `offsets`, next to them.
    """
    raw = copy.deepcopy(track.raw)
    points = raw.pop("points", None) or raw.pop("waypoints", None) or [{} for _ in range(len(track))]
    assert len(points) == len(track), "raw points and columns differ in number"
    for i, point in enumerate(points):
        _put_point(point, track, i)
        if with_flags:
            _put_flags(point["perturbation"])
    write_json(folder / "trajectory.json", raw | _header(track, raw) | {"points": points})


def _merged(group: dict, key: str, ours: dict, defaults: dict | None = None) -> dict:
    """Return the object under a key with our values; `defaults` are values of ours that those of the file replace."""
    return {**(defaults or {}), **object_of(group, key), **ours}


def _header(track: Track, raw: dict) -> dict:
    """Return the keys of the file besides the points."""
    camera = {"width": track.camera.width_px, "height": track.camera.height_px, **track.camera.focal_record()}
    augmentation = {"enabled": not track.is_original, "aug_index": 0 if track.is_original else 1}
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "trace_dir": track.variant,
        "dataset_format": raw.get("dataset_format", DATASET_FORMAT),
        "frames_dir": raw.get("frames_dir", FRAMES_DIR),
        "coordinates": raw.get("coordinates", COORDINATES),
        "source": track.source,
        **flown_as_json(track.segments, mirrored(track.mission)),
        **({} if track.people is None else {"people": asdict(track.people)}),
        **({} if track.goal is None else {"goal": asdict(track.goal)}),
        "camera": _merged(raw, "camera", camera),
        "augmentation": _merged(raw, "augmentation", {"is_original": track.is_original}, augmentation),
    }


def _put_point(point: dict, track: Track, i: int) -> None:
    """Set the fields of point i; a target that is null stays null where the track has none."""
    time_s = float(track.time_s[i])
    pose = np.hstack([track.positions_m[i], track.rotations_deg[i]])
    waypoint = write_axes(XYZ, track.positions_m[i + 1]) if i + 1 < len(track) else None
    point |= {
        "index": i,
        "is_perturbed": bool(track.perturbation.is_perturbed[i]),
        "timing": _merged(point, "timing", {"trace_timestamp": time_s}, {"sim_timestamp": time_s}),
        "drone_pose": _merged(point, "drone_pose", write_axes(POSE, pose)),
        "nav_waypoint": _merged(point, "nav_waypoint", {"t1_world": waypoint}),
        "perturbation": object_of(point, "perturbation"),
        "action": _action(track.motion.action[i]),
    }
    if track.intrinsics is not None:
        point["camera"] = _merged(point, "camera", track.camera_at(i).focal_record())
    offsets = (track.perturbation.drone_m, track.perturbation.rotation_deg, track.perturbation.target_m)
    for (name, axes), values in zip(OFFSETS.items(), offsets, strict=True):
        _put_vector(point["perturbation"], name, axes, mirror_poses(values[i]))
    has_target = point.get("target", {}) is not None or not np.isnan(track.targets_m[i]).all()
    if has_target:
        point["target"] = _merged_target(point, track, i)


def _merged_target(point: dict, track: Track, i: int) -> dict:
    """Return the object `target` of point i with our values."""
    ours = {
        "visible": bool(track.target.visible[i]),
        "in_view": bool(track.target.in_view[i]),
        "depth": _number_or_null(track.target.depth_m[i]),
    }
    target = _merged(point, "target", ours, {"enabled": True})
    visibility = _number_or_null(track.target.visibility[i])
    if visibility is not None or "visibility" in target:
        target["visibility"] = visibility
    _put_vector(target, "world_location", XYZ, mirror_poses(track.targets_m[i]))
    _put_vector(target, "image_uv", None, track.target.uv[i])
    _put_vector(target, "bbox_2d", BBOX, track.target.bbox[i])
    if track.target.mask_bbox is not None:
        _put_vector(target, "mask_bbox_2d", BBOX, track.target.mask_bbox[i])
    return target


def _put_vector(group: dict, key: str, names: tuple[str, ...] | None, values: np.ndarray) -> None:
    """Set a vector in the form that the file has, else as an object with `names`, or a list without them.

    An unknown vector is null. A flag of a public file, whether there was an offset, stays if the values say no more.
    """
    present = group.get(key)
    is_unknown = bool(np.isnan(values).any())
    if (present is True and is_unknown) or (present is False and not values.any()):
        return
    row = (values + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0
    if is_unknown:
        group[key] = None
    elif names is None or isinstance(present, list):
        group[key] = row
    else:
        group[key] = dict(zip(names, row, strict=True))


def _put_flags(perturbation: dict) -> None:
    """Replace the offsets of a perturbation by flags, and move those that are not zero to `offsets`."""
    offsets = {}
    for name in OFFSETS:
        value = perturbation.get(name)
        if isinstance(value, dict) and any(value.values()):
            offsets[name] = value
        perturbation[name] = name in offsets or value is True
    if offsets:
        perturbation["offsets"] = offsets


def _action(action: np.ndarray) -> dict[str, float] | None:
    """Return an action in the tree's axes by name; None if it is unknown."""
    if np.isnan(action).any():
        return None
    return dict(zip(TREE_ACTION, (action * TREE_ACTION_SIGNS + 0.0).tolist(), strict=True))


def _number_or_null(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
