"""The playback tree (stages 5-7 and the release): the layout of the public CosFly-Track v7 data set.

    Town*/trajectory_<unix seconds>/ORI/        the clean flight
    Town*/trajectory_<unix seconds>/aug_001/    the perturbed flight, same frame indices
        trajectory.json
        frames_playback/frame_00000/{rgb.png, depth_float32.png or depth.npy, instance.png, meta.json}

Axes inside the tree are CARLA's (left-handed); they are converted here and for `meta.json` in frames.py, and everything
else in the project sees the right-handed frame. Keys that we do not know are kept in `Track.raw` and survive a
read-write round trip.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, astuple, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from cosfly.formats.columns import is_number
from cosfly.formats.frames import (
    ANGLES,
    BYSTANDER_COLUMNS,
    COORDINATES,
    FRAME_FILES,
    FRAMES_DIR,
    XYZ,
    Camera,
    frame_name,
    frame_path,
)
from cosfly.formats.goals import Goal
from cosfly.formats.motion import PlannedMotion, without_perturbation
from cosfly.formats.pedestrian_paths import pace_of
from cosfly.formats.people import People
from cosfly.formats.places import place_of, tree_of_track
from cosfly.formats.segments import FOLLOW, Mission, Segment, flown_as_json, mirrored, read_flown
from cosfly.formats.trajectory import (
    BBOX,
    SCHEMA,
    SCHEMA_VERSION,
    FieldReader,
    flags_of,
    mask_boxes,
    numbers_of,
    object_of,
    offsets_of,
    vectors_of,
)
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_positions, mirror_rotations
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import read_json, validated, write_json

ORIGINAL = "ORI"  # the folder of a clean flight
TARGET_FILE = "target.png"  # of a flight: the person of its goal, cut out of the frame that this is true of
TREE_ACTION = ("forward_mps", "right_mps", "up_mps", "yaw_rate_degps", "gimbal_pitch_deg")  # motion.ACTION, mirrored
LEGIBILITY = ("height_px", "contrast", "legible")  # of a point's target: cosfly/render/camera.py
EVENTS = ("position", "rotation")  # of a frame of a perturbed flight; what became of them: docs/files.md
# A frame of a perturbed flight by what was applied to it, and the shares of the paper, where each event has a chance of
# 0.6 (tab:augmentation_states).
STATES = {"unperturbed": 0.16, "position only": 0.24, "rotation only": 0.24, "full": 0.36}
DATASET_FORMAT = "cosfly_playback"  # of the flights that cosfly makes
# What the record of a flight's presets may be called: the paper names it, no public file shows it.
WEATHER_KEYS = {
    "weather": ("weather_name", "weather", "preset", "name"),
    "time_of_day": ("tod_name", "time_of_day", "tod"),
}
# Whither a person walks: the way from so many frames before to so many after; who goes less than so far stands.
HEADING_FRAMES, STANDS_M = 2, 0.1


@dataclass(frozen=True)
class Track:
    """One `trajectory.json`, n points, in right-handed axes.

    time_s (n,) strictly increasing; positions_m (n, 3); rotations_deg (n, 3) pitch, yaw, roll of the camera;
    targets_m (n, 3) hip height, NaN where the file has none; target_uv (n, 2) px and target_bbox (n, 4) xmin, ymin,
    xmax, ymax px of its projected 3D box, NaN where null; target_mask_bbox (n, 4) the same of the person's pixels, NaN
    where none is seen, target_legible (n,) bool, both None where the file does not say; target_depth_m (n,) z-depth;
    target_in_view, target_visible (n,) bool (visible = occlusion-aware); visibility (n,) rendered score in [0, 1], NaN
    where the file has none;
    is_perturbed (n,) bool; drone_offsets_m, rotation_offsets_deg, target_offsets_m (n, 3): the perturbation applied to
    each point, zero where none, NaN where the file has none for a perturbed point (public files say only that there was
    one). segments, mission: the styles of its parts and the order that ended it, as its plan has them. intrinsics: (n,
    3, 3) of a camera that zooms, frame by frame, `camera` is that of the first; None where it is that of all. Who
    projects asks `camera_at`. between: (n, k - 1, 6) planned poses after each frame and before the next, of a flight
    that was planned at k times the rate of its frames; NaN after the last. people: what they look like, None
    where the file does not say. goal: whom to follow, None where nothing tells the target from others.
    company: (n, 5), frames.COMPANY: how many other people are seen, how far the nearest of them is from the target, m,
    its id, the id of who looks most like the target, in how many things that one differs; NaN where there is none, None
    where the file does not say.
    """

    town: str
    trajectory: str
    variant: str
    camera: Camera
    time_s: np.ndarray
    positions_m: np.ndarray
    rotations_deg: np.ndarray
    targets_m: np.ndarray
    target_in_view: np.ndarray
    target_visible: np.ndarray
    target_depth_m: np.ndarray
    target_uv: np.ndarray
    target_bbox: np.ndarray
    visibility: np.ndarray
    is_perturbed: np.ndarray
    drone_offsets_m: np.ndarray
    rotation_offsets_deg: np.ndarray
    target_offsets_m: np.ndarray
    target_mask_bbox: np.ndarray | None = None
    target_legible: np.ndarray | None = None
    source: dict = field(default_factory=dict)
    is_original: bool = True
    folder: Path | None = None
    raw: dict = field(default_factory=dict)
    issues: tuple[str, ...] = ()  # what a tolerant reader let pass
    run: str = ""  # where flights of several runs are put together
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    intrinsics: np.ndarray | None = None
    between: np.ndarray | None = None
    people: People | None = None
    goal: Goal | None = None
    bystanders: np.ndarray | None = None
    given_id: str | None = None  # where flights of several towns or runs share the plain one (places.py)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def flight_id(self) -> str:
        """`trajectory_1776047127_ORI`, the stem of its sample ids."""
        return self.given_id or f"{self.trajectory}_{self.variant}"

    def camera_at(self, index: int) -> Camera:
        """Return the camera that frame `index` was drawn with."""
        return self.camera if self.intrinsics is None else replace(self.camera, intrinsic=self.intrinsics[index])

    @property
    def fovs_deg(self) -> tuple[float, float]:
        """Least and greatest field of view."""
        fovs = [self.camera_at(i).fov_deg for i in range(len(self) if self.intrinsics is not None else 1)]
        return min(fovs), max(fovs)

    @cached_property
    def styles(self) -> list[str]:
        """The style that each frame was flown in."""
        styles = [FOLLOW] * len(self)
        for part in self.segments:
            styles[part.begin : part.end] = [part.style] * (part.end - part.begin)
        return styles

    @cached_property
    def target_headings_deg(self) -> np.ndarray:
        """Whither the person walks, (n,) counter-clockwise from east; NaN before the first step and where nobody is."""
        frames = np.arange(len(self))
        ahead, behind = np.minimum(frames + HEADING_FRAMES, len(self) - 1), np.maximum(frames - HEADING_FRAMES, 0)
        steps = self.targets_m[ahead, :2] - self.targets_m[behind, :2]
        moves = np.linalg.norm(np.nan_to_num(steps), axis=1) >= STANDS_M
        last = np.maximum.accumulate(np.where(moves, frames, -1))  # who stands keeps the direction of before
        return np.where(last >= 0, np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))[last], np.nan)

    @property
    def walked_m(self) -> np.ndarray:
        """Where the person walked, (n, 3), without what a perturbation added; NaN where nobody knows."""
        return self.targets_m - self.target_offsets_m

    @cached_property
    def planned(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (n, 6) and targets (n, 3) without what a perturbation added; NaN where nobody knows."""
        poses = np.hstack([self.positions_m, self.rotations_deg])
        if self.is_original:
            return poses, self.targets_m
        offsets = np.hstack([self.drone_offsets_m, self.rotation_offsets_deg])
        return without_perturbation(poses, self.targets_m, offsets, self.target_offsets_m)

    @cached_property
    def motion(self) -> PlannedMotion:
        """What it teaches a policy."""
        between = np.empty((len(self), 0, 6)) if self.between is None else self.between
        return PlannedMotion(self.time_s, self.planned[0], between, self.rotations_deg[:, 1], self.positions_m)

    @property
    def pace(self) -> str:
        """The pace of the walk that it follows."""
        return pace_of(self.source, str(self.folder))

    @property
    def weather(self) -> dict[str, str | None]:
        """The presets of weather and time of day that the file names; None where it has no such record."""
        word = self.raw.get("weather")
        told = {"weather": word} if isinstance(word, str) else object_of(self.raw, "weather")
        named = {own: (told.get(name) for name in names) for own, names in WEATHER_KEYS.items()}
        return {own: next((one for one in found if isinstance(one, str)), None) for own, found in named.items()}

    @cached_property
    def weather_record(self) -> WeatherRecord | None:
        """The whole record of weather, knobs and all; None where the file has none in the paper's form."""
        try:
            return WeatherRecord.model_validate(self.raw.get("weather"))
        except ValidationError:
            return None

    def told_legibility(self, index: int) -> dict[str, float | bool | None]:
        """Return what a point tells of LEGIBILITY; None where it says nothing."""
        points = self.raw.get("points", [])
        told = object_of(points[index], "target") if index < len(points) else {}
        return {name: one if isinstance(one := told.get(name), bool) or is_number(one) else None for name in LEGIBILITY}

    @property
    def keeps_sight(self) -> np.ndarray:
        """Tell of each frame whether it is judged by how much it sees of the target, (n,) bool."""
        keeps = np.ones(len(self), dtype=bool)
        for part in self.segments:
            keeps[part.begin : part.end] = part.keeps_sight
        return keeps

    @property
    def is_ours(self) -> bool:
        """Whether cosfly made it, and not somebody else."""
        return self.raw.get("dataset_format") == DATASET_FORMAT

    def target_picture(self, index: int) -> dict[str, str | bytes] | None:
        """Return the picture of the target and its name, at the frame of the goal alone and where there is one."""
        if self.goal is None or self.goal.frame != index or self.folder is None:
            return None
        if not (path := self.folder / TARGET_FILE).is_file():
            return None
        data = read_bytes(path, what="target picture", tree=tree_of_track(self.folder))
        return {"bytes": data, "path": f"{self.flight_id}_{TARGET_FILE}"}

    def frame_folder(self, index: int) -> Path:
        assert self.folder is not None
        return self.folder / frame_name(index)

    def events(self, index: int) -> dict[str, str] | None:
        """Return what became of a point's EVENTS (none, applied, why it fell back); None where the file does not
        say."""
        points = self.raw.get("points", [])
        told = object_of(points[index], "perturbation") if index < len(points) else {}
        return {event: told[event] for event in EVENTS} if all(isinstance(told.get(e), str) for e in EVENTS) else None

    @cached_property
    def states(self) -> list[str | None]:
        """Which of STATES each frame is in, after fallbacks; None where the file does not say."""
        raw = [object_of(point, "perturbation") for point in self.raw.get("points", [])] or [{}] * len(self)
        names, found = tuple(STATES), []
        for i, told in enumerate(raw):
            shifted = _was_moved((self.drone_offsets_m[i], self.target_offsets_m[i]), told.get("drone_position"))
            turned = _was_moved((self.rotation_offsets_deg[i],), told.get("drone_rotation"))
            found.append(None if shifted is None or turned is None else names[shifted + 2 * turned])
        return found

    def missing_frames(self, names: tuple[str, ...] = FRAME_FILES) -> list[int]:
        """Indices of the points that lack one of the files, by their names in the public layout."""
        folders = [self.frame_folder(i) for i in range(len(self))]
        return [i for i, folder in enumerate(folders) if not all(frame_path(folder, name).is_file() for name in names)]


def _was_moved(offsets: tuple[np.ndarray, ...], told: object) -> bool | None:
    """Return whether any offset is not zero; where they are not known, what the file says of the first; None where it
    says nothing."""
    if any((offset != 0).any() and not np.isnan(offset).any() for offset in offsets):
        return True
    if any(np.isnan(offset).any() for offset in offsets):
        return told if isinstance(told, bool) else None
    return False


# --- reading ----------------------------------------------------------------------------------------------------------


def read_track(folder: Path, *, strict: bool = True) -> Track:
    """Read one flight folder.

    Args:
        strict: every rule of the layout must hold. Tolerant: older names and missing optional fields are accepted, and
            what was let pass stands in `Track.issues`; poses and times must be there and finite either way.
    Raises:
        InputError: names the file, the point and the field.
    """
    path = folder / "trajectory.json"
    raw = read_json(path, what="trajectory", tree=tree_of_track(folder))
    if not isinstance(raw, dict):
        raise InputError("not a trajectory", where=path, got=type(raw).__name__, expected="an object")
    reader = FieldReader(path, strict)
    _, town, trajectory, variant = astuple(place_of(folder))
    reader.header(raw, variant)
    points = reader.points(raw)
    time_s, poses = reader.times(points), reader.poses(points)
    targets, others = ([object_of(p, name) for p in points] for name in ("target", "others"))
    if not all(target or p.get("target", "missing") is None for target, p in zip(targets, points, strict=True)):
        reader.issue("points[].target", "missing", "an object, or null where there is nobody")
    bystanders = np.column_stack([numbers_of(others, name) for name in BYSTANDER_COLUMNS])
    segments, mission = reader.told(lambda: read_flown(raw, len(points), f"{path}: ")) or ((), None)
    people = reader.told(lambda: validated(People, raw["people"], f"{path}: people")) if "people" in raw else None
    has_goal = raw.get("goal") is not None and "absent" not in object_of(raw, "goal")
    goal = reader.told(lambda: Goal.from_json(raw["goal"], len(points), f"{path}: goal")) if has_goal else None
    if {"params", "mode"} & object_of(raw, "weather").keys():  # public files may call something else so
        reader.told(lambda: validated(WeatherRecord, raw["weather"], f"{path}: weather"))
    is_original = bool(object_of(raw, "augmentation").get("is_original", variant == ORIGINAL))
    drone, turn, walker = (
        offsets_of(points, name, axes, is_original)
        for name, axes in (("drone_position", XYZ), ("drone_rotation", ANGLES), ("target_position", XYZ))
    )
    camera = reader.camera(raw.get("camera"))
    return Track(
        town=town,
        trajectory=trajectory,
        variant=variant,
        camera=camera,
        intrinsics=reader.intrinsics(points, camera),
        between=_mirrored_poses(reader.between(points)),
        time_s=time_s,
        positions_m=mirror_positions(poses[:, :3]),
        rotations_deg=mirror_rotations(poses[:, 3:]),
        targets_m=mirror_positions(vectors_of(targets, "world_location", XYZ)),
        target_in_view=flags_of(targets, "in_view", default_key="visible"),
        target_visible=flags_of(targets, "visible"),
        target_depth_m=numbers_of(targets, "depth"),
        target_uv=vectors_of(targets, "image_uv", ("u", "v")),
        target_bbox=vectors_of(targets, "bbox_2d", BBOX),
        target_mask_bbox=mask_boxes(targets),
        target_legible=flags_of(targets, "legible")
        if all(isinstance(t.get("legible"), bool) for t in targets)
        else None,
        visibility=numbers_of(targets, "visibility"),
        is_perturbed=np.array([bool(p.get("is_perturbed", False)) for p in points]),
        drone_offsets_m=mirror_positions(drone),
        rotation_offsets_deg=mirror_rotations(turn),
        target_offsets_m=mirror_positions(walker),
        source=object_of(raw, "source"),
        is_original=is_original,
        folder=folder,
        raw=raw,
        issues=tuple(reader.issues),
        segments=segments,
        mission=mirrored(mission),
        people=people,
        goal=goal,
        bystanders=None if np.isnan(bystanders[:, 0]).any() else bystanders,
    )


# --- writing ----------------------------------------------------------------------------------------------------------


def write_track(folder: Path, flight: Track) -> None:
    """Write `trajectory.json` into a folder. Unknown keys of `flight.raw` are kept, known ones set from the arrays."""
    raw = copy.deepcopy(flight.raw)
    points = raw.pop("points", None) or raw.pop("waypoints", None) or [{} for _ in range(len(flight))]
    assert len(points) == len(flight), "raw points and columns differ in number"
    raw.update(schema=SCHEMA, schema_version=SCHEMA_VERSION, trace_dir=flight.variant)
    raw.setdefault("dataset_format", DATASET_FORMAT)
    raw.setdefault("frames_dir", FRAMES_DIR)
    raw.setdefault("coordinates", COORDINATES)
    raw["source"] = flight.source
    raw.update(flown_as_json(flight.segments, mirrored(flight.mission)))
    if flight.people is not None:
        raw["people"] = asdict(flight.people)
    if flight.goal is not None:
        raw["goal"] = asdict(flight.goal)
    camera = flight.camera
    raw["camera"] = {**object_of(raw, "camera"), "width": camera.width_px, "height": camera.height_px, **_focal(camera)}
    raw["augmentation"] = {
        "enabled": not flight.is_original,
        "aug_index": 0 if flight.is_original else 1,
        **object_of(raw, "augmentation"),
        "is_original": flight.is_original,
    }
    positions = mirror_positions(flight.positions_m) + 0.0
    poses = np.hstack([positions, mirror_rotations(flight.rotations_deg) + 0.0]).tolist()
    between = _mirrored_poses(flight.between)
    vectors: list[tuple[str, str, tuple[str, ...], np.ndarray]] = [
        ("target", "world_location", XYZ, mirror_positions(flight.targets_m)),
        ("target", "image_uv", (), flight.target_uv),
        ("target", "bbox_2d", BBOX, flight.target_bbox),
        ("perturbation", "drone_position", XYZ, mirror_positions(flight.drone_offsets_m)),
        ("perturbation", "drone_rotation", ANGLES, mirror_rotations(flight.rotation_offsets_deg)),
        ("perturbation", "target_position", XYZ, mirror_positions(flight.target_offsets_m)),
    ]
    if flight.target_mask_bbox is not None:
        vectors.append(("target", "mask_bbox_2d", BBOX, flight.target_mask_bbox))
    for i, point in enumerate(points):
        point["index"] = i
        point["is_perturbed"] = bool(flight.is_perturbed[i])
        time_s = float(flight.time_s[i])
        point["timing"] = {"sim_timestamp": time_s, **object_of(point, "timing"), "trace_timestamp": time_s}
        point["drone_pose"] = {**object_of(point, "drone_pose"), **dict(zip(XYZ + ANGLES, poses[i], strict=True))}
        following = dict(zip(XYZ, poses[i + 1], strict=False)) if i + 1 < len(points) else None
        point["nav_waypoint"] = {**object_of(point, "nav_waypoint"), "t1_world": following}
        point["perturbation"] = object_of(point, "perturbation")
        point["action"] = _tree_action(flight.motion.action[i])
        if between is not None:
            point["between"] = None if i + 1 == len(points) else (between[i] + 0.0).tolist()
        if flight.intrinsics is not None:
            point["camera"] = {**object_of(point, "camera"), **_focal(flight.camera_at(i))}
        is_nobody = "target" in point and point["target"] is None and np.isnan(flight.targets_m[i]).all()
        if not is_nobody:
            point["target"] = _target(object_of(point, "target"), flight, i)
        for group, key, names, values in vectors:
            if not (is_nobody and group == "target"):
                _put_vector(point[group], key, names, values[i])
    raw["points"] = points
    write_json(folder / "trajectory.json", raw)


def _mirrored_poses(poses: np.ndarray | None) -> np.ndarray | None:
    """Change (..., 6) poses between right-handed and CARLA axes."""
    if poses is None:
        return None
    return np.concatenate([mirror_positions(poses[..., :3]), mirror_rotations(poses[..., 3:])], axis=-1)


def _tree_action(action: np.ndarray) -> dict[str, float] | None:
    """Return an action in the tree's axes: to the right, and clockwise."""
    if np.isnan(action).any():
        return None
    return dict(zip(TREE_ACTION, (action * [1.0, -1.0, 1.0, -1.0, 1.0] + 0.0).tolist(), strict=True))


def _focal(camera: Camera) -> dict:
    return {
        "focal_length_px": camera.focal_px,
        "focal_length_35mm_mm": round(camera.focal_35mm_mm, 6),
        "intrinsic": camera.intrinsic.tolist(),
    }


def _target(group: dict, flight: Track, i: int) -> dict:
    """Return the target of point i without its vectors; what else the file says of it stays."""
    target = {"enabled": True} | group
    target["visible"] = bool(flight.target_visible[i])
    target["in_view"] = bool(flight.target_in_view[i])
    target["depth"] = _number_or_none(flight.target_depth_m[i])
    if not np.isnan(flight.visibility[i]) or "visibility" in target:
        target["visibility"] = _number_or_none(flight.visibility[i])
    return target


def _put_vector(group: dict, key: str, names: tuple[str, ...], values: np.ndarray) -> None:
    """Set a vector in the form that the file uses already (object or list); ours is the object where it has names."""
    if isinstance(group.get(key), bool) and (np.isnan(values).any() if group[key] else not values.any()):
        return  # a public file says whether there was an offset, not which
    numbers = None if np.isnan(values).any() else (values + 0.0).tolist()
    if numbers is None or isinstance(group.get(key), list) or not names:
        group[key] = numbers
    else:
        group[key] = dict(zip(names, numbers, strict=True))


def _number_or_none(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
