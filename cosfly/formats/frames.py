"""The files of one frame folder of the playback tree: rgb.png, depth, instance.png and meta.json.

Depth is float32: `depth_float32.png`, packed without loss, or `depth.npy` as in the public layout. `frame_path` finds a
file by its name in the public layout. `meta.json` uses CARLA's axes (left-handed), `FrameMeta` those of the project.
"""

import io
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator

from cosfly.formats.columns import ANGLES, POSE, XYZ, numbers
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import People
from cosfly.formats.places import tree_of_track
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_poses
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.config import Config
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import FileFormat, Record, dump_json, read_model
from cosfly.runtime.png import PNG_SIGNATURE, areas_png, colours_png, floats_of, floats_png, read_picture

FRAMES_DIR = "frames_playback"
FrameFile = Literal["rgb", "depth", "instance"]
DepthFormat = Literal["png", "npy"]
DEPTH_NPY, DEPTH_PNG = "depth.npy", "depth_float32.png"
# Names in the public layout.
FILE_NAMES: dict[FrameFile, str] = {"rgb": "rgb.png", "depth": DEPTH_NPY, "instance": "instance.png"}
FRAME_FILES = (*FILE_NAMES.values(), "meta.json")
FILM_WIDTH_MM = 36.0  # width of a picture on 35 mm film
# Limits of the horizontal field of view: towards 0 a picture shows a single point, towards 180 it degenerates.
LEAST_FOV_DEG, MOST_FOV_DEG = 0.1, 179.0
LEVEL_NAMES: dict[float, str] = {110: "wide-angle", 90: "standard", 60: "narrow", 30: "telephoto"}  # tab:zoom_config
SKY_DEPTH_M = 1000.0  # depth of the sky and of everything beyond
INVALID_DEPTH_M = 0.0
PERSON_ID = 65535  # instance id of the target in `instance.png`
SHARED_ID = 65534  # of all boxes beyond the range of ids: docs/files.md
META_FORMAT = FileFormat("cosfly.frame", "1.0", "frame annotation")
# A visible target is legible if it reaches these minima.
LEGIBLE_HEIGHT_PX = 16.0
LEGIBLE_SHARE = 0.3  # of its box that is not hidden
LEGIBLE_CONTRAST = 5.0  # colour difference from its surroundings, CIE76; 2.3 is just noticeable
# Columns of `others` in a track: see `BystandersMeta.people_of`.
BYSTANDER_COLUMNS = ("in_view", "nearest_m", "nearest_id", "alike_id", "alike_differences")

COORDINATES = {
    "frame": "carla",
    "handedness": "left",
    "position": "metres, x forward (east), y right (south), z up",
    "rotation": "degrees; yaw clockwise seen from above, pitch nose-up, roll right-side-down",
    "camera": "pose of the camera; image x right, y down; depth along the optical axis",
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels."""

    width_px: int
    height_px: int
    intrinsic: np.ndarray  # (3, 3), px

    @property
    def focal_px(self) -> float:
        return float(self.intrinsic[0, 0])

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view, degrees."""
        return float(np.degrees(2.0 * np.arctan(self.width_px / (2.0 * self.focal_px))))

    @property
    def focal_35mm_mm(self) -> float:
        """Focal length of a lens with the same horizontal field of view on 35 mm film."""
        return FILM_WIDTH_MM * self.focal_px / self.width_px

    def focal_record(self) -> dict[str, Any]:
        """Return the fields of the lens in files."""
        focal = {"focal_length_px": self.focal_px, "focal_length_35mm_mm": round(self.focal_35mm_mm, 6)}
        return {**focal, "intrinsic": self.intrinsic.tolist()}


def level_name(fov_deg: float) -> str:
    """Return the paper's name of a zoom level; "" for a field of view that has none."""
    return LEVEL_NAMES.get(round(fov_deg, 3), "")


class Look(Config):
    """Sunlight and haze of a run without weather, the same in every frame."""

    sun_azimuth_deg: float = Field(
        235.0, ge=0, le=360, description="direction towards the sun, counter-clockwise from east"
    )
    sun_elevation_deg: float = Field(42.0, ge=5, le=85, description="height of the sun above the horizon, degrees")
    haze_m: float = Field(520.0, gt=1, description="distance at which haze hides two thirds of an object, m")
    exposure: float = Field(0.82, gt=0, le=10, description="brightness of the picture, a factor; 1 is neutral")

    def sun_direction(self) -> np.ndarray:
        """Return the unit vector towards the sun, (3,)."""
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


# --- meta.json --------------------------------------------------------------------------------------------------------


def _read_axes(names: tuple[str, ...], value: Any) -> np.ndarray:
    """Convert an object of a file, in the tree's axes, to an array in the project's axes; return an array as it is."""
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, dict) and len(value) == len(names):
        row = numbers([value.get(name) for name in names], len(names))
        if row is not None:
            return mirror_poses(row)
    raise ValueError(f"the value must be an object whose fields {', '.join(names)} are finite numbers")


def write_axes(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    """Convert an array in the project's axes to an object of a file, in the tree's axes."""
    return dict(zip(names, (mirror_poses(values) + 0.0).tolist(), strict=True))  # + 0.0 turns -0.0 into 0.0


# In memory arrays in the project's axes: Position (3,) m, Angles (3,) degrees, Pose (6,) both. In a file objects of
# numbers by name, in the tree's axes.
Position = Annotated[np.ndarray, PlainValidator(partial(_read_axes, XYZ)), PlainSerializer(partial(write_axes, XYZ))]
Angles = Annotated[
    np.ndarray, PlainValidator(partial(_read_axes, ANGLES)), PlainSerializer(partial(write_axes, ANGLES))
]
Pose = Annotated[np.ndarray, PlainValidator(partial(_read_axes, POSE)), PlainSerializer(partial(write_axes, POSE))]


def tree_yaw(yaw_deg: float) -> float:
    """Convert a yaw between the project's and the tree's axes, degrees; the function is its own inverse."""
    return 0.0 - yaw_deg  # not -yaw_deg: no minus zero


class CameraMeta(Record):
    width: int
    height: int
    fov_deg: float
    focal_length_px: float
    focal_length_35mm_mm: float | None = None  # null in older trees
    intrinsic: list[list[float]]  # 3 x 3, px
    near_m: float  # clip planes
    far_m: float


def camera_meta(camera: Camera, near_m: float, far_m: float) -> CameraMeta:
    """Return the record of a camera; clip planes in m."""
    return CameraMeta(
        width=camera.width_px,
        height=camera.height_px,
        fov_deg=round(camera.fov_deg, 6),
        **camera.focal_record(),
        near_m=near_m,
        far_m=far_m,
    )


class TargetMeta(Record):
    """The target in a frame: its hip, box and visibility."""

    world_location: Position  # of the hip
    half_extents_m: tuple[float, float, float]
    instance_id: int
    semantic_id: int
    # Picture coordinates are px, null if the target is not in view.
    image_uv: list[float] | None  # of the hip
    bbox_2d: list[float] | None  # of its projected 3D box
    mask_bbox_2d: list[float] | None = None  # of its pixels; absent in older trees
    depth_m: float
    in_view: bool
    visible: bool
    visibility: float
    num_pixels: int
    # Measured in the picture; absent in older trees. The contrast is null if no pixel of the target is visible.
    height_px: float | None = None
    contrast: float | None = None
    legible: bool | None = None


class PerturbationMeta(Record):
    position: str  # outcome of the event: none, applied, or fallback: reason
    rotation: str  # outcome of the event
    drone_position: Position  # offsets
    target_position: Position
    drone_rotation: Angles


class BystanderMeta(Record):
    instance_id: int
    semantic_id: int
    world_location: Position  # of the centre of its box
    yaw: float  # heading, degrees clockwise from east
    half_extents_m: tuple[float, float, float]
    num_pixels: int

    @property
    def heading_rad(self) -> float:
        """Heading, rad counter-clockwise from east."""
        return float(np.radians(tree_yaw(self.yaw)))


class BystandersMeta(Record):
    """The bystanders of a frame, and the shares of the target's box, 0 to 1, that they hide and that the map hides."""

    target_hidden_by_others: float
    target_hidden_by_map: float
    others: list[BystanderMeta]

    def people_of(self, target_m: np.ndarray, people: People | None) -> dict[str, float | None]:
        """Return BYSTANDER_COLUMNS of the people with at least one pixel.

        in_view: Their number. nearest_m, nearest_id: Horizontal distance from the target to the nearest one, and its
        instance id. alike_id, alike_differences: The one that looks most like the target, and the number of
        differences; None without `people`. All but the first are None if nobody is in view.
        """
        distances_m: dict[int, float] = {}  # by instance id
        for body in self.others:
            if body.semantic_id == KINDS["Pedestrians"] and body.num_pixels:
                distances_m[body.instance_id] = float(np.hypot(*(body.world_location - target_m)[:2]))
        nearest_id = min(distances_m, key=distances_m.__getitem__, default=None)
        alike_id, alike_differences = (None, None) if people is None else people.most_alike(distances_m)
        return {
            "in_view": len(distances_m),
            "nearest_m": None if nearest_id is None else round(distances_m[nearest_id], 3),
            "nearest_id": nearest_id,
            "alike_id": alike_id,
            "alike_differences": alike_differences,
        }


class FrameMeta(Record):
    """`meta.json`: all that a loader needs of one frame."""

    coordinates: dict[str, str] = COORDINATES
    index: int
    time_s: float
    town: str
    trajectory: str
    variant: str
    camera: CameraMeta
    drone_pose: Pose  # of the camera
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
    """Return the folder of a frame relative to its track: `frames_playback/frame_00000`."""
    return f"{FRAMES_DIR}/frame_{index:05d}"


def public_name(name: str) -> str:
    """Return the name of a frame's file in the public layout."""
    return DEPTH_NPY if name == DEPTH_PNG else name


def frame_path(frame: Path, name: str) -> Path:
    """Return the path of a frame's file from its name in the public layout; for depth the packed file if it exists."""
    packed = frame / DEPTH_PNG
    return packed if name == DEPTH_NPY and packed.exists() else frame / name


def files_in(frame: Path) -> frozenset[str]:
    """Return the names of the files of a frame folder in the public layout; an empty set if there is no folder."""
    try:
        return frozenset(map(public_name, os.listdir(frame)))
    except OSError:
        return frozenset()


def tree_of(frame: Path) -> Path:
    return tree_of_track(frame.absolute().parents[1])


def read_rgb(frame: Path) -> np.ndarray:
    """Read `rgb.png` of a frame folder, (h, w, 3) uint8 RGB without alpha."""
    return read_picture(frame / "rgb.png", tree=tree_of(frame))


def read_instance(frame: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read `instance.png` of a frame folder: semantic kinds (h, w) uint8 and instance ids (h, w) uint16."""
    kinds, low_bytes, high_bytes = np.moveaxis(read_picture(frame / "instance.png", tree=tree_of(frame)), 2, 0)
    return kinds, low_bytes.astype(np.uint16) | high_bytes.astype(np.uint16) << 8


def read_depth(frame: Path) -> np.ndarray:
    """Read the depth of a frame folder, (h, w) float32 z-depth in m: at most SKY_DEPTH_M, or INVALID_DEPTH_M."""
    path = frame_path(frame, DEPTH_NPY)
    return depth_values(read_bytes(path, what="depth image", tree=tree_of(frame)), path)


def depth_values(data: bytes | memoryview, where: Path) -> np.ndarray:
    """Return the depth in the bytes of a file of either format, as `read_depth`; a `.npy` is not copied."""
    if data[: len(PNG_SIGNATURE)] == PNG_SIGNATURE:
        depth = floats_of(data, where)
    else:
        depth = parse_array(data, where, dtype=np.float32, ndim=2, what="depth image", copy=False)
    if SKY_DEPTH_M < depth.max(initial=0.0) < np.inf:
        return np.minimum(depth, np.float32(SKY_DEPTH_M))
    return depth


def rgb_bytes(rgb: np.ndarray) -> bytes:
    """Return the content of `rgb.png` for a picture, (h, w, 3) uint8."""
    return colours_png(rgb)


def instance_bytes(kinds: np.ndarray, ids: np.ndarray) -> bytes:
    """Return the content of `instance.png` in CARLA's encoding: R the kind, G the low and B the high byte of the id."""
    return areas_png(kinds, (ids & 0xFF).astype(np.uint8), (ids >> 8).astype(np.uint8))


def depth_file(depth: np.ndarray, form: DepthFormat) -> tuple[str, bytes]:
    """Return the name and the content of the file of a depth image, (h, w) float32."""
    if form == "png":
        return DEPTH_PNG, floats_png(depth)
    return DEPTH_NPY, depth_bytes(depth)


def depth_bytes(depth: np.ndarray) -> bytes:
    """Return the content of `depth.npy` for a depth image, (h, w) float32."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(depth), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def as_depth_npy(data: bytes, where: Path) -> bytes:
    """Convert the bytes of a depth file of either format to the content of `depth.npy`."""
    return depth_bytes(depth_values(data, where)) if data.startswith(PNG_SIGNATURE) else data
