"""The files of one frame folder of the playback tree: rgb.png, depth, instance.png and meta.json.

Depth is float32: `depth_float32.png`, packed without loss, or `depth.npy` as in the public layout. Ask `frame_path` for
a file by its name in the public layout. `meta.json` holds CARLA's axes (left-handed), FrameMeta the project's.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator

from cosfly.formats.columns import ANGLES, POSE, XYZ, numbers
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import People
from cosfly.formats.places import tree_of_track
from cosfly.formats.png import areas_png, colours_png, floats_of, floats_png
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_poses
from cosfly.runtime.arrays import PNG_SIGNATURE, parse_array, read_picture
from cosfly.runtime.config import Config
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import FileFormat, Record, dump_json, read_model

FRAMES_DIR = "frames_playback"
FrameFile = Literal["rgb", "depth", "instance"]
DepthFormat = Literal["png", "npy"]
DEPTH_NPY, DEPTH_PNG = "depth.npy", "depth_float32.png"
# In the public layout.
FILE_NAMES: dict[FrameFile, str] = {"rgb": "rgb.png", "depth": DEPTH_NPY, "instance": "instance.png"}
DEBUG_FILE = "debug.png"  # for people, where the settings ask for it: no label, and nobody reads it but they
FRAME_FILES = (*FILE_NAMES.values(), "meta.json")
FILM_WIDTH_MM = 36.0  # of a 35 mm film's picture
# Fields of view, degrees: nearer to 0 and 180 a picture is one point, or one line is all of it.
LEAST_FOV_DEG, MOST_FOV_DEG = 0.1, 179.0
LEVEL_NAMES: dict[float, str] = {110: "wide-angle", 90: "standard", 60: "narrow", 30: "telephoto"}  # tab:zoom_config
SKY_DEPTH_M, INVALID_DEPTH_M = 1000.0, 0.0
PERSON_ID = 65535  # of the target in `instance.png`
META_FORMAT = FileFormat("cosfly.frame", "1.0", "frame annotation")
# A person is legible who is visible, so high in the picture, of so much of the box unhidden, and of so much colour
# difference (CIE76, where 2.3 is just noticeable) from what is around.
LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE, LEGIBLE_CONTRAST = 16.0, 0.3, 5.0
BYSTANDER_COLUMNS = ("in_view", "nearest_m", "nearest_id", "alike_id", "alike_differences")  # of a point's `others`

COORDINATES = {
    "frame": "carla",
    "handedness": "left",
    "position": "metres, x forward (east), y right (south), z up",
    "rotation": "degrees; yaw clockwise seen from above, pitch nose-up, roll right-side-down",
    "camera": "pose of the camera; image x right, y down; depth along the optical axis",
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera of square pixels; `intrinsic` is (3, 3)."""

    width_px: int
    height_px: int
    intrinsic: np.ndarray

    @property
    def focal_px(self) -> float:
        return float(self.intrinsic[0, 0])

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view."""
        return float(np.degrees(2.0 * np.arctan(self.width_px / (2.0 * self.focal_px))))

    @property
    def focal_35mm_mm(self) -> float:
        """Focal length of a lens that shows as much, from left to right, on film 36 mm wide."""
        return FILM_WIDTH_MM * self.focal_px / self.width_px

    def focal_record(self) -> dict[str, Any]:
        """Return what files hold of the lens."""
        focal = {"focal_length_px": self.focal_px, "focal_length_35mm_mm": round(self.focal_35mm_mm, 6)}
        return {**focal, "intrinsic": self.intrinsic.tolist()}


def level_name(fov_deg: float) -> str:
    """Return the paper's name of a level of zoom, "" for one that is not among them."""
    return LEVEL_NAMES.get(round(fov_deg, 3), "")


class Look(Config):
    """Sun and air of a run without weather, the same for every frame."""

    sun_azimuth_deg: float = Field(
        235.0, ge=0, le=360, description="direction towards the sun, counter-clockwise from east"
    )
    sun_elevation_deg: float = Field(42.0, ge=5, le=85, description="height of the sun above the horizon, degrees")
    haze_m: float = Field(520.0, gt=1, description="distance at which haze hides two thirds of what stands there, m")
    exposure: float = Field(0.82, gt=0, le=10, description="brightness of the picture, a factor; 1 is neutral")

    def sun_direction(self) -> np.ndarray:
        """Return the unit vector towards the sun, (3,)."""
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


# --- meta.json --------------------------------------------------------------------------------------------------------


def _read_axes(names: tuple[str, ...], value: Any) -> np.ndarray:
    """Return what a file holds under these names in the tree's axes, in the project's."""
    if isinstance(value, np.ndarray):
        return value
    found = numbers([value.get(name) for name in names], len(names)) if isinstance(value, dict) else None
    if found is None or len(value) != len(names):
        raise ValueError(f"Value should be an object of finite numbers, {', '.join(names)}")
    return mirror_poses(found)


def _write_axes(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, (mirror_poses(values) + 0.0).tolist(), strict=True))  # + 0.0: no minus zero


# In a file in the tree's axes, by name; in memory in the project's: (3,) m, (3,) degrees, (6,) one after the other.
Position = Annotated[np.ndarray, PlainValidator(partial(_read_axes, XYZ)), PlainSerializer(partial(_write_axes, XYZ))]
Angles = Annotated[
    np.ndarray, PlainValidator(partial(_read_axes, ANGLES)), PlainSerializer(partial(_write_axes, ANGLES))
]
Pose = Annotated[np.ndarray, PlainValidator(partial(_read_axes, POSE)), PlainSerializer(partial(_write_axes, POSE))]


def tree_yaw(yaw_deg: float) -> float:
    """Return a yaw, degrees, in the tree's axes."""
    return 0.0 - yaw_deg


class CameraMeta(Record):
    """The camera that drew a frame; intrinsic 3x3 px, clip planes in m."""

    width: int
    height: int
    fov_deg: float
    focal_length_px: float
    focal_length_35mm_mm: float | None = None  # null in older trees
    intrinsic: list[list[float]]
    near_m: float
    far_m: float


def camera_meta(camera: Camera, near_m: float, far_m: float) -> CameraMeta:
    """Return the record of a camera; clip planes in m."""
    size = {"width": camera.width_px, "height": camera.height_px, "fov_deg": round(camera.fov_deg, 6)}
    return CameraMeta(**size, **camera.focal_record(), near_m=near_m, far_m=far_m)


class TargetMeta(Record):
    """The target in a frame: hip, (3,) m, box and visibility; px unless named otherwise, null where there is none."""

    world_location: Position
    half_extents_m: tuple[float, float, float]
    instance_id: int
    semantic_id: int
    image_uv: list[float] | None
    bbox_2d: list[float] | None  # of the projected 3D box
    mask_bbox_2d: list[float] | None = None  # of the target's pixels; absent in older trees
    depth_m: float
    in_view: bool
    visible: bool
    visibility: float
    num_pixels: int
    # Of the picture as written; absent in older trees, contrast null where no pixel of the target is seen.
    height_px: float | None = None
    contrast: float | None = None
    legible: bool | None = None


class PerturbationMeta(Record):
    """The outcome of a frame's events (none, applied, fallback: reason) and the offsets."""

    position: str
    rotation: str
    drone_position: Position
    target_position: Position
    drone_rotation: Angles


class BystanderMeta(Record):
    """A bystander: middle of the box, heading in degrees clockwise from east, and pixels in the picture."""

    instance_id: int
    semantic_id: int
    world_location: Position
    yaw: float
    half_extents_m: tuple[float, float, float]
    num_pixels: int

    @property
    def heading_rad(self) -> float:
        """Heading, counter-clockwise from east."""
        return float(-np.radians(self.yaw))


class BystandersMeta(Record):
    """The bystanders of a frame, and the shares of the target's box, 0 to 1, that they and the map hide."""

    target_hidden_by_others: float
    target_hidden_by_map: float
    others: list[BystanderMeta]

    def people_of(self, target_m: np.ndarray, people: People | None) -> dict[str, float | None]:
        """Return BYSTANDER_COLUMNS: how many people have a pixel, how far the nearest is from the target, m over the
        ground, its id, and who looks most like the target; None without any, the last also without `people`."""
        seen = [one for one in self.others if one.semantic_id == KINDS["Pedestrians"] and one.num_pixels]
        away_m = {one.instance_id: float(np.hypot(*(one.world_location - target_m)[:2])) for one in seen}
        nearest = min(away_m, key=away_m.__getitem__, default=None)
        how_far_m = None if nearest is None else round(away_m[nearest], 3)
        alike = (None, None) if people is None else people.most_alike(away_m)
        return dict(zip(BYSTANDER_COLUMNS, (len(seen), how_far_m, nearest, *alike), strict=True))


class FrameMeta(Record):
    """`meta.json`: all that a loader needs of one frame. drone_pose: (6,) x, y, z, pitch, yaw, roll of the camera."""

    coordinates: dict[str, str] = COORDINATES
    index: int
    time_s: float
    town: str
    trajectory: str
    variant: str
    camera: CameraMeta
    drone_pose: Pose
    target: TargetMeta
    perturbation: PerturbationMeta
    look: Look | None = None  # null with weather, and in older trees
    others: BystandersMeta | None = Field(None, exclude_if=lambda others: others is None)
    weather: WeatherRecord | None = Field(None, exclude_if=lambda weather: weather is None)  # instead of `look`

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        return (dump_json({**META_FORMAT.header, **self.model_dump()}, indent=1) + "\n").encode()


def read_meta(frame: Path) -> FrameMeta:
    """Read `meta.json` of a frame folder; raises as `read_model`."""
    return read_model(frame / "meta.json", FrameMeta, META_FORMAT, tree=tree_of(frame))


# --- the files --------------------------------------------------------------------------------------------------------


def frame_name(index: int) -> str:
    """Return a frame's folder below its track's: `frames_playback/frame_00000`."""
    return f"{FRAMES_DIR}/frame_{index:05d}"


def public_name(name: str) -> str:
    """Return the name of a frame's file in the public layout."""
    return DEPTH_NPY if name == DEPTH_PNG else name


def frame_path(frame: Path, name: str) -> Path:
    """Return the path of a frame's file by its name in the public layout; of depth the packed one if it exists."""
    packed = frame / DEPTH_PNG
    return packed if name == DEPTH_NPY and packed.exists() else frame / name


def files_in(frame: Path) -> frozenset[str]:
    """Return the names, in the public layout, of the files of a frame folder; none without a folder."""
    try:
        return frozenset(map(public_name, os.listdir(frame)))
    except OSError:
        return frozenset()


def tree_of(frame: Path) -> Path:
    """Return the playback tree of a frame."""
    return tree_of_track(frame.absolute().parents[1])


def read_rgb(frame: Path) -> np.ndarray:
    """Read `rgb.png` of a frame folder, (h, w, 3) uint8 RGB without alpha."""
    return cv2.cvtColor(read_picture(frame / "rgb.png", tree=tree_of(frame)), cv2.COLOR_BGR2RGB)


def read_instance(frame: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read `instance.png` of a frame folder: semantic kinds (h, w) uint8 and instance ids (h, w) uint16."""
    bgr = read_picture(frame / "instance.png", tree=tree_of(frame))
    # OpenCV loads B, G, R: R is the semantic tag, G the low and B the high byte of the id.
    return bgr[..., 2], bgr[..., 1].astype(np.uint16) | (bgr[..., 0].astype(np.uint16) << 8)


def read_depth(frame: Path) -> np.ndarray:
    """Read the depth of a frame folder, (h, w) float32 z-depth in m; 1000.0 is sky or as far, 0.0 invalid."""
    path = frame_path(frame, DEPTH_NPY)
    return depth_values(read_bytes(path, what="depth image", tree=tree_of(frame)), path)


def depth_values(data: bytes | memoryview, where: Path) -> np.ndarray:
    """Return the depth of an image's bytes in either form, as `read_depth`; a `.npy` is not copied."""
    if data[: len(PNG_SIGNATURE)] == PNG_SIGNATURE:
        depth = floats_of(data, where)
    else:
        depth = parse_array(data, where, dtype=np.float32, ndim=2, what="depth image", copy=False)
    is_beyond = SKY_DEPTH_M < depth.max(initial=0.0) < np.inf
    return np.minimum(depth, np.float32(SKY_DEPTH_M)) if is_beyond else depth


def rgb_bytes(rgb: np.ndarray) -> bytes:
    """Return the content of `rgb.png`, of (h, w, 3) uint8."""
    return colours_png(rgb)


def instance_bytes(kinds: np.ndarray, ids: np.ndarray) -> bytes:
    """Return the content of `instance.png` in CARLA's encoding: R the kind, G the low and B the high byte of the id."""
    return areas_png(kinds, (ids & 0xFF).astype(np.uint8), (ids >> 8).astype(np.uint8))


def depth_file(depth: np.ndarray, form: DepthFormat) -> tuple[str, bytes]:
    """Name and content of the file of a depth image, (h, w) float32."""
    return (DEPTH_PNG, floats_png(depth)) if form == "png" else (DEPTH_NPY, depth_bytes(depth))


def depth_bytes(depth: np.ndarray) -> bytes:
    """Return the content of `depth.npy`, of (h, w) float32."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(depth), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def as_depth_npy(data: bytes, where: Path) -> bytes:
    """Return the content of `depth.npy` of a depth image's bytes in either form."""
    return depth_bytes(depth_values(data, where)) if data.startswith(PNG_SIGNATURE) else data
