"""The files of one frame folder of the playback tree: rgb.png, depth, instance.png and meta.json.

Depth is float32: `depth_float32.png`, packed without loss, or `depth.npy` as in the public layout. Ask `frame_path` for
a file by its name in the public layout. Axes inside the tree are CARLA's (left-handed); `tree_...` functions take the
project's right-handed values.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from cosfly.formats.kinds import KINDS
from cosfly.formats.people import People
from cosfly.formats.places import tree_of_track
from cosfly.formats.png import areas_png, colours_png, floats_of, floats_png
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mirror_positions, mirror_rotations, world_from_camera
from cosfly.runtime.arrays import PNG_SIGNATURE, parse_array_header, read_array, read_picture
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
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
XYZ, ANGLES = ("x", "y", "z"), ("pitch", "yaw", "roll")

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


class TreePosition(Record):
    """A position or a shift in the tree's axes, m."""

    x: float
    y: float
    z: float

    @property
    def vector_m(self) -> np.ndarray:
        """Position in the project's axes, (3,)."""
        return mirror_positions(np.array([self.x, self.y, self.z]))


class TreeAngles(Record):
    """A turn in the tree's axes, degrees."""

    pitch: float
    yaw: float
    roll: float


class TreePose(TreeAngles, TreePosition):
    """The camera's pose in the tree's axes, m and degrees: x, y, z, pitch, yaw, roll."""

    @property
    def camera_pose(self) -> np.ndarray:
        """world_from_camera in the project's axes, (4, 4)."""
        return world_from_camera(self.vector_m, mirror_rotations(np.array([self.pitch, self.yaw, self.roll])))


def tree_position(position_m: np.ndarray) -> TreePosition:
    """Return a position, (3,) m, in the tree's axes."""
    x, y, z = (mirror_positions(position_m) + 0.0).tolist()  # + 0.0: no minus zero
    return TreePosition(x=x, y=y, z=z)


def tree_angles(rotation_deg: np.ndarray) -> TreeAngles:
    """Return pitch, yaw, roll, (3,) degrees, in the tree's axes."""
    return TreeAngles(**dict(zip(ANGLES, (mirror_rotations(rotation_deg) + 0.0).tolist(), strict=True)))


def tree_yaw(yaw_deg: float) -> float:
    """Return a yaw, degrees, in the tree's axes."""
    return float(mirror_rotations(np.array([0.0, yaw_deg, 0.0]))[1]) + 0.0


def tree_pose(position_m: np.ndarray, rotation_deg: np.ndarray) -> TreePose:
    """Return a pose, (3,) m and (3,) degrees, in the tree's axes."""
    return TreePose(**dict(tree_position(position_m)), **dict(tree_angles(rotation_deg)))


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
    return CameraMeta(
        width=camera.width_px,
        height=camera.height_px,
        fov_deg=round(camera.fov_deg, 6),
        focal_length_px=camera.focal_px,
        focal_length_35mm_mm=round(camera.focal_35mm_mm, 6),
        intrinsic=camera.intrinsic.tolist(),
        near_m=near_m,
        far_m=far_m,
    )


class TargetMeta(Record):
    """The target in a frame: hip point, box and visibility; px unless named otherwise, null where there is none."""

    world_location: TreePosition
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

    @property
    def center_m(self) -> np.ndarray:
        """Middle of the box in the project's axes, (3,)."""
        return self.world_location.vector_m


class PerturbationMeta(Record):
    """The outcome of a frame's events (none, applied, fallback: reason) and the offsets."""

    position: str
    rotation: str
    drone_position: TreePosition
    target_position: TreePosition
    drone_rotation: TreeAngles


class BystanderMeta(Record):
    """A bystander: middle of the box and yaw in the tree's axes, and pixels in the picture."""

    instance_id: int
    semantic_id: int
    world_location: TreePosition
    yaw: float
    half_extents_m: tuple[float, float, float]
    num_pixels: int

    @property
    def center_m(self) -> np.ndarray:
        """Middle of the box in the project's axes, (3,)."""
        return self.world_location.vector_m

    @property
    def heading_rad(self) -> float:
        """Heading, counter-clockwise from east."""
        return float(np.radians(mirror_rotations(np.array([0.0, self.yaw, 0.0]))[1]))


class BystandersMeta(Record):
    """The bystanders of a frame, and the shares of the target's box, 0 to 1, that they and the map hide."""

    target_hidden_by_others: float
    target_hidden_by_map: float
    others: list[BystanderMeta]

    def people_of(self, target_m: np.ndarray, people: People | None) -> dict[str, float | None]:
        """Return BYSTANDER_COLUMNS: how many people have a pixel, how far the nearest is from the target, m over the
        ground, its id, and who looks most like the target; None without any, the last also without `people`."""
        seen = [one for one in self.others if one.semantic_id == KINDS["Pedestrians"] and one.num_pixels]
        away_m = {one.instance_id: float(np.hypot(*(one.center_m - target_m)[:2])) for one in seen}
        nearest = min(away_m, key=away_m.__getitem__, default=None)
        how_far_m = None if nearest is None else round(away_m[nearest], 3)
        alike = (None, None) if people is None else people.most_alike(away_m)
        return dict(zip(BYSTANDER_COLUMNS, (len(seen), how_far_m, nearest, *alike), strict=True))


class FrameMeta(Record):
    """`meta.json`: all that a loader needs of one frame."""

    coordinates: dict[str, str] = COORDINATES
    index: int
    time_s: float
    town: str
    trajectory: str
    variant: str
    camera: CameraMeta
    drone_pose: TreePose
    target: TargetMeta
    perturbation: PerturbationMeta
    look: Look | None = None  # null with weather, and in older trees
    others: BystandersMeta | None = Field(None, exclude_if=lambda others: others is None)
    weather: WeatherRecord | None = Field(None, exclude_if=lambda weather: weather is None)  # instead of `look`

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        record = {**META_FORMAT.header, **self.model_dump()}
        return (dump_json(record, indent=1) + "\n").encode()


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
    if path.name == DEPTH_PNG:
        return depth_values(read_bytes(path, what="depth image", tree=tree_of(frame)), path)
    return _far_clipped(read_array(path, dtype=np.float32, ndim=2, what="depth image", tree=tree_of(frame)))


def _far_clipped(depth: np.ndarray) -> np.ndarray:
    """Return depths, m, clipped at SKY_DEPTH_M; unchanged where one is not finite."""
    is_beyond = SKY_DEPTH_M < depth.max(initial=0.0) < np.inf
    return np.minimum(depth, np.float32(SKY_DEPTH_M)) if is_beyond else depth


def depth_values(data: bytes | memoryview, where: Path) -> np.ndarray:
    """Return the depth of an image's bytes in either form, as `read_depth`; a `.npy` is not copied."""
    if is_packed(data):
        return _far_clipped(floats_of(data, where))
    header = parse_array_header(memoryview(data), where, what="depth image")
    if header.dtype != np.float32 or len(header.shape) != 2:
        raise InputError("not a depth image", where=where, got=str(header), expected="float32 of 2 dimensions")
    values = np.frombuffer(data, np.float32, offset=header.offset)
    return _far_clipped(values.reshape(header.shape, order="F" if header.is_fortran else "C"))


def rgb_bytes(rgb: np.ndarray) -> bytes:
    """Return the content of `rgb.png`, of (h, w, 3) uint8."""
    return colours_png(rgb)


def instance_bytes(kinds: np.ndarray, ids: np.ndarray) -> bytes:
    """Return the content of `instance.png` in CARLA's encoding: R the kind, G the low and B the high byte of the id."""
    return areas_png(kinds, (ids & 0xFF).astype(np.uint8), (ids >> 8).astype(np.uint8))


def is_packed(data: bytes | memoryview) -> bool:
    """Return whether a depth image's bytes are those of a `depth_float32.png`."""
    return data[: len(PNG_SIGNATURE)] == PNG_SIGNATURE


def depth_file(depth: np.ndarray, form: DepthFormat) -> tuple[str, bytes]:
    """Name and content of the file of a depth image, (h, w) float32."""
    return (DEPTH_PNG, floats_png(depth)) if form == "png" else (DEPTH_NPY, depth_bytes(depth))


def depth_bytes(depth: np.ndarray) -> bytes:
    """Return the content of `depth.npy`, of (h, w) float32."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(depth), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()
