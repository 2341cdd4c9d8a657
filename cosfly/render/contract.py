"""The contract of renderers: from a map of boxes and a look to one frame for each camera and posed person.

All renderers draw the same things in the same places, so that depth, kinds and ids do not depend on the renderer:

- every box, or something of its kind that stays inside it, with its id of `instance_ids`; the person with PERSON_ID;
  bystanders, each with its own id from the caller (`other_id`);
- of a tree that is one box a stem, and foliage only from `crown_low` of `plants_of` up: people walk under it;
- a ground plane of Terrain (`ground_plane`), with NO_INSTANCE; sky where nothing is
  between NEAR_M and FAR_M (`far_as_sky`);
- of coplanar surfaces the one of the higher layer, and within a layer always the same one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import PERSON_ID as PERSON_ID
from cosfly.formats.frames import SHARED_ID as SHARED_ID
from cosfly.formats.frames import SKY_DEPTH_M
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.formats.people import COLORS, Appearance
from cosfly.formats.weather import WeatherParams
from cosfly.runtime.errors import RenderError

DEBIAN_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"  # OpenGL without a window, on a GPU or the CPU

NEAR_M = 0.3  # near clip plane (sec:step5)
FAR_M = SKY_DEPTH_M  # far clip plane

# Instance ids, 16 bits in instance.png, in addition to PERSON_ID: 0 is no instance (sky, ground plane).
MAX_BOX_ID = 65533
NO_INSTANCE = 0

GROUND_PLANE_HALF_M = 1500.0
GROUND_PLANE_DROP_M = 0.02  # under the lowest slab, so that no pixel alternates between the two

# A layer moves the depth *test* by LAYER_STEP of the distance, never the depth written (kinds.LAYERS).
LAYER_STEP = 1e-4
STANDING_LAYER = 7
LAWN_HALF_M = 0.2  # vegetation of a smaller half height is a lawn; it lies in the layer of road lines

# Forms of a box of vegetation. Lawns, hedges and trunks fill their box, the others are round, the last two on a stem.
LAWN, HEDGE, TRUNK, BUSH, CROWN, CONIFER, BROADLEAF = range(7)
CONIFER_LOW = -0.78  # of a conifer's half height


@dataclass(frozen=True)
class Frame:
    """One synchronous set of images, row 0 at the top, pixel (i, j) sampled at its centre (j + 0.5, i + 0.5)."""

    rgb: np.ndarray  # (h, w, 3) uint8
    depth: np.ndarray  # (h, w) float32 z-depth, m; sky 1000.0, invalid 0.0
    kinds: np.ndarray  # (h, w) uint8, of KINDS
    ids: np.ndarray  # (h, w) uint16 instance ids


@dataclass(frozen=True)
class Clothes:
    """The appearance of a person, and the colours that it does not contain."""

    looks: Appearance
    hair: np.ndarray  # (3,) linear RGB
    skin: np.ndarray  # (3,) linear RGB
    shoes: np.ndarray  # (3,) linear RGB

    def color(self, slot: str) -> np.ndarray:
        """Return the linear RGB of a garment, (3,)."""
        return np.array(COLORS[getattr(self.looks, f"{slot}_color")][1])


@dataclass(frozen=True)
class PosedPerson:
    """One person of 1.8 m at one time."""

    hip_m: np.ndarray  # (3,) world, the middle of the person's box; the feet are on its bottom
    heading_rad: float
    phase_rad: float  # of the stride: two steps are 2 pi
    swing: float  # of arms and legs, from 0 (standing) to 1 (walking)
    clothes: Clothes


PosedPeople = Mapping[int, PosedPerson]  # by ids in `instance.png`: PERSON_ID is the target


class Renderer(Protocol):
    """A renderer of one map, for one thread: `RENDERERS[name](box_map, width_px, height_px, look, num_others)`.

    num_others: ids of `other_id` that no box may have. Opening raises EnvironmentMissing if a package or driver is
    missing.
    """

    dresses: bool  # whether people wear the given clothes; otherwise tracks do not record appearances
    device: str  # hardware and driver, one line

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Compute shadows for a trajectory between two corners, (3,) each, in a weather, or in the look for None.

        Weather changes colours only, never depth, kinds and ids.

        Raises:
            RenderError: If this renderer draws no weather.
        """

    def render(self, camera_pose: np.ndarray, intrinsic: np.ndarray, people: PosedPeople) -> Frame:
        """Draw one frame from world_from_camera (4, 4), OpenCV axes, through K (3, 3) px.

        Raises:
            RenderError: If the pose is not finite.
        """
        ...

    def close(self) -> None:
        """Release the device."""


# --- shared by all renderers ------------------------------------------------------------------------------------------


def far_as_sky(frame: Frame) -> Frame:
    """Set pixels at FAR_M or beyond to sky: layers and rounding move the clip plane."""
    is_far = frame.depth >= FAR_M
    if np.count_nonzero(is_far) != np.count_nonzero(frame.kinds == KINDS["Sky"]):
        frame.depth[is_far] = SKY_DEPTH_M
        frame.kinds[is_far] = KINDS["Sky"]
        frame.ids[is_far] = NO_INSTANCE
    return frame


def other_id(number: int) -> int:
    """Return the id of a bystander by its number, from MAX_BOX_ID downwards."""
    return MAX_BOX_ID - number


def has_own_ids(box_map: BoxMap, num_others: int = 0) -> bool:
    """Return whether boxes can keep their ids in `instance.png`: all in 1..MAX_BOX_ID, none that of a bystander."""
    return bool(((box_map.ids >= 1) & (box_map.ids <= MAX_BOX_ID - num_others)).all())


def instance_ids(box_map: BoxMap, num_others: int = 0) -> np.ndarray:
    """Return the id of every box in `instance.png`, (n,) uint16 in the map's order.

    The boxes' own ids are used if possible. Otherwise ids are counted from 1, first for boxes that are not vegetation,
    then for vegetation, each in the map's order; the rest share SHARED_ID.
    """
    if has_own_ids(box_map, num_others):
        return box_map.ids.astype(np.uint16)
    order = np.argsort(box_map.kinds == KINDS["Vegetation"], kind="stable")
    ids = np.empty(len(box_map), dtype=np.uint16)
    counted = np.arange(1, len(box_map) + 1)
    ids[order] = np.where(counted <= MAX_BOX_ID - num_others, counted, SHARED_ID)
    return ids


def scene_origin(box_map: BoxMap) -> np.ndarray:
    """Return a whole-metre place in the middle of a map, (3,) world: the origin of float32 computations."""
    low, high = box_map.bounds() if len(box_map) else (np.zeros(3), np.zeros(3))
    return np.round((low + high) / 2.0)


def plane_z_m(box_map: BoxMap) -> float:
    """Return the height of the ground plane: the map's own, at most that of the lowest slab."""
    tops = box_map.maxs[np.isin(box_map.kinds, list(GROUND_KINDS)), 2]
    return float(tops.min(initial=box_map.header.ground_z_m))


def ground_plane(box_map: BoxMap) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half sizes, (3,) each, world, of the flat box of Terrain under everything, with NO_INSTANCE."""
    x, y, _ = scene_origin(box_map)
    center = np.array([x, y, plane_z_m(box_map) - GROUND_PLANE_DROP_M - 0.5])
    return center, np.array([GROUND_PLANE_HALF_M, GROUND_PLANE_HALF_M, 0.5])


def plants_of(centers_m: np.ndarray, half_m: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Classify plants by the shapes of their boxes.

    Args:
        centers_m, half_m: (n, 3).
        seeds: (n,), `seeds_of` their ids.
    Returns:
        forms: (n,), LAWN .. BROADLEAF.
        crown_low: (n,) where foliage begins, in units of the half height; -1 is the box's bottom. Under it is a stem of
            `stem_radius_m` along the box's axis.
    """
    hx, hy, hz = half_m.T
    wide, narrow = np.maximum(hx, hy), np.minimum(hx, hy)
    is_lawn = hz < LAWN_HALF_M
    is_hedge = (hz < 1.8) & (wide >= 0.45) & ((wide > 2.5 * narrow) | (wide > 4.0))  # low, and long or wide
    is_bush = hz < 1.3
    is_trunk = ~is_bush & (wide < 0.45) & (hz > 3.0 * wide)  # thin: maps that keep trunk and crown apart
    is_crown = np.zeros(len(centers_m), dtype=bool)  # over the foot of such a trunk nearby
    if is_trunk.any():
        from scipy.spatial import cKDTree  # takes half a second to import, which every command would pay

        gap_m, nearest = cKDTree(centers_m[is_trunk, :2]).query(centers_m[:, :2])
        foot_z_m = (centers_m[is_trunk, 2] - hz[is_trunk])[nearest]
        is_crown = (gap_m < wide + 1.0) & (centers_m[:, 2] - hz > foot_z_m + 0.8)
    is_conifer = (chance(seeds, 5) < 0.18) & (hz > 1.6 * wide)  # some of the slender trees
    is_form = [is_lawn, is_hedge, is_bush, is_trunk, is_crown, is_conifer]
    forms = np.select(is_form, [LAWN, HEDGE, BUSH, TRUNK, CROWN, CONIFER], BROADLEAF)
    broadleaf_low = np.where(hz > wide, -0.38, -0.55)
    return forms, np.select([forms == BROADLEAF, forms == CONIFER], [broadleaf_low, CONIFER_LOW], -1.0)


def stem_radius_m(half_m: np.ndarray) -> np.ndarray:
    """Return the radius of the stem of a tree that is one box, (n,)."""
    narrow = half_m[:, :2].min(axis=1)
    return np.minimum(np.clip(0.075 * narrow, 0.05, 0.32), narrow)


def seeds_of(ids: np.ndarray) -> np.ndarray:
    """Return a fixed number in [0, 1) for each box id, so that a house keeps its colour between runs.

    Source: splitmix64, Steele, Lea and Flood 2014.
    """
    with np.errstate(over="ignore"):
        x = np.asarray(ids, dtype=np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((x ^ (x >> np.uint64(31))) >> np.uint64(40)).astype(np.float64) / 2.0**24


def chance(seeds: np.ndarray, number: int) -> np.ndarray:
    """Return a further fixed number in [0, 1) for each seed."""
    return np.mod(seeds * 9973.0 + number * 0.61803399, 1.0)


def check_pose(camera_pose: np.ndarray, intrinsic: np.ndarray) -> None:
    """Raise RenderError where a camera is not finite."""
    if not (np.isfinite(camera_pose).all() and np.isfinite(intrinsic).all()):
        got = f"pose {camera_pose.tolist()}, intrinsic matrix {intrinsic.tolist()}"
        fix = "correct the drone trajectory or the camera settings"
        raise RenderError("the camera's pose or intrinsic matrix has a number that is not finite", got=got, fix=fix)
