"""People as drawable parts of one frame, and the rectangles of pixels that their shadows may change."""

from __future__ import annotations

from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import box_corners
from cosfly.render.contract import LAYER_STEP, STANDING_LAYER, PosedPeople, PosedPerson
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import CLOTH, PART, CameraView, tags
from cosfly.render.person import PersonFigure, figure_of

SHAPES = {"ball": meshes.SPHERE, "rounded": meshes.ROUNDED, "limb": meshes.LIMB, "disc": meshes.CYLINDER}
MOST_CAPSULES = 32  # size of the shader's array; it holds the capsules nearest to the camera
SHADOW_M = 5.0  # radius of a sphere that holds a bystander and its shadow, under a sun of usual height
PERSON_RADIUS_M = 1.0  # radius of a sphere that holds a person
PERSON_CAPSULE_M = (0.15, 1.62, 0.19)  # lower and upper end above the feet, radius


class Mover(NamedTuple):
    """A person as k parts, relative to the origin."""

    records: np.ndarray  # (k,) PART
    mesh_numbers: np.ndarray  # (k,)


def figure_parts(figure: PersonFigure, instance_id: int, origin_m: np.ndarray) -> Mover:
    """Return the parts of a figure."""
    records = np.zeros(len(figure.shapes), PART)
    records["center"] = figure.centers_m - origin_m
    records["half"] = figure.half_m
    records["color"][:, :3] = figure.colors
    records["quaternion"] = Rotation.from_matrix(figure.turns).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), instance_id))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    return Mover(records, np.array([SHAPES[shape] for shape in figure.shapes]))


def bystander_parts(others: PosedPeople, origin_m: np.ndarray, view: CameraView) -> list[Mover]:
    """Return the parts of the bystanders that the camera may see."""
    return [
        figure_parts(figure_of(person), instance_id, origin_m)
        for instance_id, person in others.items()
        if view.can_show(person.hip_m - origin_m, PERSON_RADIUS_M)
    ]


def capsules_of(others: PosedPeople, origin_m: np.ndarray, view: CameraView) -> np.ndarray:
    """Return capsules of the bystanders that may cast a visible shadow.

    The shader tests each pixel of a shadow region against each of its capsules, the largest cost of bystanders.

    Returns:
        (k, 2, 4) float32, metres, relative to the origin: [start, radius] and [end, instance id].
    """

    def distance_m(other: tuple[int, PosedPerson]) -> float:
        return float(np.linalg.norm(other[1].hip_m - origin_m - view.eye))

    visible = [other for other in others.items() if view.can_show(other[1].hip_m - origin_m, SHADOW_M)]
    nearest = sorted(visible, key=distance_m)[:MOST_CAPSULES]
    capsules = np.zeros((len(nearest), 2, 4), np.float32)
    low, high, radius = PERSON_CAPSULE_M
    for capsule, (instance_id, person) in zip(capsules, nearest, strict=True):
        feet = person.hip_m - origin_m - [0.0, 0.0, TARGET_HEIGHT_M]
        capsule[:, :3] = feet + np.array([[0.0, 0.0, low], [0.0, 0.0, high]])
        capsule[0, 3] = radius
        capsule[1, 3] = instance_id
    return capsules


# --- shadow regions ---------------------------------------------------------------------------------------------------

# A program that draws shadows of movers runs their loops in every pixel. On a CPU this takes a third of a frame's time,
# though the shadows cover a hundredth of its pixels. So the scene is drawn without these shadows, and then the shadow
# regions are drawn again with them.
PERSON_REACH_M = 30.0**0.5  # reach of the person's shadow in the shader, from the hip
EDGE = 1.25  # a shadow ends this many radii from a capsule's axis
SKY_RADII = 4.5  # a capsule blocks light of the sky this many radii to each side
PERSON_SKY_M = 1.0  # the person blocks light of the sky this far to each side
BELOW_M = 1.5  # a shadow ends this far below the feet
LONGEST_M = 60.0  # length of the longest shadow


class ShadowRegion(NamedTuple):
    """One rectangle of pixels and the movers whose shadows may change it."""

    rectangle_px: tuple[int, int, int, int]  # x0, y0, x1, y1
    points: np.ndarray  # (k, 3) m, relative to the scene's origin; their hull holds the shadows
    capsules: np.ndarray  # (c, 2, 4) of `capsules_of`
    has_person: bool  # whether the target is one of the movers

    def overlaps(self, other: ShadowRegion) -> bool:
        a, b = self.rectangle_px, other.rectangle_px
        return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]

    def merged(self, other: ShadowRegion) -> ShadowRegion:
        """Return one region in the rectangle around both."""
        x0, y0, x1, y1 = zip(self.rectangle_px, other.rectangle_px, strict=True)
        return ShadowRegion(
            rectangle_px=(min(x0), min(y0), max(x1), max(y1)),
            points=np.concatenate([self.points, other.points]),
            capsules=np.concatenate([self.capsules, other.capsules]),
            has_person=self.has_person or other.has_person,
        )


def shadow_regions(bones: np.ndarray, capsules: np.ndarray, sun: np.ndarray, view: CameraView) -> list[ShadowRegion]:
    """Return the shadow regions of a frame, merged where they overlap.

    Args:
        bones: (b, 2, 4) capsules of the person, [start, radius] and [end, 0]; b is 0 without a person.
        capsules: (c, 2, 4) of bystanders.
        sun: (3,) unit vector towards the sun.
    """
    movers = []  # points, capsules, whether it is the person
    for capsule in capsules[:, None]:
        points = _shadow_points(capsule, sun, SKY_RADII * float(capsule[0, 0, 3]), LONGEST_M)
        movers.append((points, capsule, False))
    if len(bones):
        movers.append((_shadow_points(bones, sun, PERSON_SKY_M, PERSON_REACH_M), capsules[:0], True))
    regions: list[ShadowRegion] = []
    for points, mover_capsules, is_person in movers:
        if (rectangle := view.rectangle_px(points)) is not None:
            regions = _with_region(regions, ShadowRegion(rectangle, points, mover_capsules, is_person))
    return regions


def _with_region(regions: list[ShadowRegion], region: ShadowRegion) -> list[ShadowRegion]:
    """Add a region to disjoint ones, merging until none overlap."""
    overlaps = [other.overlaps(region) for other in regions]
    if not any(overlaps):
        return [*regions, region]
    for other in compress(regions, overlaps):
        region = other.merged(region)
    return _with_region([other for other, is_merged in zip(regions, overlaps, strict=True) if not is_merged], region)


def _shadow_points(capsules: np.ndarray, sun: np.ndarray, aside_m: float, longest_m: float) -> np.ndarray:
    """Return corners around capsules, their shadows down to BELOW_M under them, and the sky light they block, (24, 3).

    Args:
        capsules: (c, 2, 4).
        sun: (3,) unit vector towards the sun.
        aside_m: How far to each side the capsules block light of the sky.
        longest_m: Length of the longest shadow.
    """
    ends = capsules[..., :3]
    radii = capsules[:, :1, 3:]
    low = (ends - EDGE * radii).min(axis=(0, 1))
    high = (ends + EDGE * radii).max(axis=(0, 1))
    length_m = min((high[2] - low[2] + BELOW_M) / max(float(sun[2]), 1e-3), longest_m)
    body = _corners(low, high)
    sky_low = low - np.array([aside_m, aside_m, BELOW_M])
    sky_high = high + np.array([aside_m, aside_m, 0.0])
    return np.concatenate([body, body - length_m * sun, _corners(sky_low, sky_high)])


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners of the box from low to high, (8, 3)."""
    return box_corners((low + high) / 2.0, (high - low) / 2.0)
