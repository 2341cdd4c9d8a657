"""The playback tree (stages 5-7 and the release): the layout of the public CosFly-Track v7 data set.

    Town*/trajectory_<unix seconds>/ORI/        the clean track
    Town*/trajectory_<unix seconds>/aug_001/    the perturbed track, same frame indices
        trajectory.json
        frames_playback/frame_00000/{rgb.png, depth_float32.png or depth.npy, instance.png, meta.json}

This module is a track in memory, in right-handed axes. playback_file.py reads and writes `trajectory.json`, and
frames.py the files of a frame.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from cosfly.formats.columns import is_number
from cosfly.formats.frames import FRAME_FILES, Camera, frame_name, frame_path
from cosfly.formats.pedestrian_paths import pace_of
from cosfly.formats.people import Goal, People
from cosfly.formats.places import tree_of_track
from cosfly.formats.segments import FOLLOW, Mission, Segment
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.motion import PlannedMotion, without_perturbation
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes

ORIGINAL = "ORI"  # the folder of a clean track
TARGET_FILE = "target.png"  # in a track's folder: the target, cut out of the frame of the goal
LEGIBILITY = ("height_px", "contrast", "legible")  # fields of a point's target, measured in cosfly/render/camera.py
EVENTS = ("position", "rotation")  # events of a perturbed frame; docs/files.md lists their outcomes
# States of the frames of a perturbed track. Index: 1 if the position is perturbed, plus 2 if the rotation is.
STATES = ("unperturbed", "position only", "rotation only", "full")
DATASET_FORMAT = "cosfly_playback"  # marks tracks that cosfly made
HEADING_FRAMES = 2  # a heading points from the position this many frames before to that as many frames after
STANDS_M = 0.1  # a target that moves less between these two frames is standing


@dataclass(frozen=True)
class TargetRecord:
    """The target in the n frames of a track; values that are null or unknown are NaN."""

    in_view: np.ndarray  # (n,) bool
    visible: np.ndarray  # (n,) bool, accounts for occlusion
    depth_m: np.ndarray  # (n,) z-depth
    uv: np.ndarray  # (n, 2) px
    bbox: np.ndarray  # (n, 4) xmin, ymin, xmax, ymax px of the projected 3D box
    visibility: np.ndarray  # (n,) rendered score in [0, 1]
    mask_bbox: np.ndarray | None = None  # (n, 4) of the target's pixels; None if the file has no such field
    legible: np.ndarray | None = None  # (n,) bool; None if the file has no such field


@dataclass(frozen=True)
class Perturbation:
    """The offsets that were applied to each of n frames.

    They are zero if nothing was applied, and NaN if unknown: public files store only that there was an offset.
    """

    is_perturbed: np.ndarray  # (n,) bool
    drone_m: np.ndarray  # (n, 3)
    rotation_deg: np.ndarray  # (n, 3) pitch, yaw, roll
    target_m: np.ndarray  # (n, 3)


@dataclass(frozen=True)
class Track:
    """One `trajectory.json`, n points, in right-handed axes; optional records are None if the file has none."""

    town: str
    trajectory: str
    variant: str
    camera: Camera  # of the file; `camera_at` returns that of a frame
    time_s: np.ndarray  # (n,) strictly increasing
    positions_m: np.ndarray  # (n, 3) of the drone
    rotations_deg: np.ndarray  # (n, 3) pitch, yaw, roll of the camera
    targets_m: np.ndarray  # (n, 3) hip of the target, NaN if the file has none
    target: TargetRecord
    perturbation: Perturbation
    source: dict = field(default_factory=dict)  # facts of the plan
    is_original: bool = True  # a clean track
    folder: Path | None = None
    raw: dict = field(default_factory=dict)  # the file, with its unknown keys
    issues: tuple[InputError, ...] = ()  # deviations from the layout
    run: str = ""  # set if tracks of several runs are combined
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    intrinsics: np.ndarray | None = None  # (n, 3, 3) of a camera that zooms
    people: People | None = None
    goal: Goal | None = None
    bystanders: np.ndarray | None = None  # (n, 5), frames.BYSTANDER_COLUMNS
    given_id: str | None = None  # set if the plain id is not unique among several towns or runs (places.py)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def flight_id(self) -> str:
        """The id of the track, such as `trajectory_1776047127_ORI`, with which its sample ids begin."""
        return self.given_id or f"{self.trajectory}_{self.variant}"

    def camera_at(self, index: int) -> Camera:
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


def object_of(group: dict, key: str) -> dict:
    """Return the object under a key; an empty one for anything else."""
    value = group.get(key)
    return value if isinstance(value, dict) else {}
