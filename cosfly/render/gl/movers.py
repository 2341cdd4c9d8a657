"""People and cars as drawable parts of one frame, and the rectangles of pixels that their shadows may darken."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import box_corners, rotation_matrix
from cosfly.render.contract import LAYER_STEP, STANDING_LAYER, Others, PosedCar, PosedPerson
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import CLOTH, PART, Boxes, CameraView, Parts, tags
from cosfly.render.gl.shapes import parts_of
from cosfly.render.person import PersonFigure, figure_of

SHAPES = {"ball": meshes.SPHERE, "rounded": meshes.ROUNDED, "limb": meshes.LIMB, "disc": meshes.CYLINDER}
MOST_CAPSULES = 32  # as many as the shader has room for: the nearest to the camera
SHADOW_M = 5.0  # of a sphere round a person and its shadow, under a sun of usual height
PERSON_RADIUS_M = 1.0  # of a sphere round a person
PERSON_CAPSULE_M = (0.15, 1.62, 0.19)  # low and high end over the feet, radius


def figure_parts(figure: PersonFigure, instance_id: int, origin_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the records (k,) PART and meshes (k,) of a figure, relative to the origin."""
    records = np.zeros(len(figure.shapes), PART)
    records["center"], records["half"] = figure.centers_m - origin_m, figure.half_m
    records["color"][:, :3] = figure.colors
    records["quaternion"] = Rotation.from_matrix(figure.turns).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), instance_id))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    return records, np.array([SHAPES[shape] for shape in figure.shapes])


def draw_bystanders(others: Others, origin_m: np.ndarray, view: CameraView) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return records and meshes of the bystanders that the camera may see."""
    found = []
    for other in others:
        center = other.center_m - origin_m
        if isinstance(other.body, PosedPerson):
            if view.can_show(center, PERSON_RADIUS_M):
                found.append(figure_parts(figure_of(other.body), other.instance_id, origin_m))
        elif view.can_show(center, float(np.linalg.norm(other.body.half_extents_m))):
            found.append(_car(other.body, other.instance_id, center, view))
    return found


def _car(car: PosedCar, instance_id: int, center: np.ndarray, view: CameraView) -> tuple[np.ndarray, np.ndarray]:
    """Return a car of the same shape as the parked cars of a map."""
    turn, half = rotation_matrix(0.0, car.heading_rad, 0.0), np.array(car.half_extents_m)
    ids, seeds = np.array([instance_id], np.uint16), np.array([car.seed])
    boxes = Boxes(center[None], half[None], turn[None], ids, seeds, KINDS["Car"], np.zeros(1))
    parts = Parts.joined(parts_of(boxes))
    rows = view.rows(parts)
    return parts.records[rows], parts.mesh[rows]


def capsules_of(others: Others, origin_m: np.ndarray, view: CameraView) -> np.ndarray:
    """Return capsules of the bystanders that may cast a visible shadow, relative to the origin, (k, 2, 4): from and
    radius, to and instance id.

    Each pixel tests each capsule, which takes longer than all else that is drawn of bystanders.
    """
    seen = (other for other in others if view.can_show(other.center_m - origin_m, SHADOW_M))
    nearest = sorted(seen, key=lambda other: float(np.linalg.norm(other.center_m - origin_m - view.eye)))[
        :MOST_CAPSULES
    ]
    capsules = np.zeros((len(nearest), 2, 4), np.float32)
    for capsule, other in zip(capsules, nearest, strict=True):
        center = other.center_m - origin_m
        if isinstance(other.body, PosedPerson):
            low, high, radius = PERSON_CAPSULE_M
            ends = center + np.array([[0.0, 0.0, low], [0.0, 0.0, high]]) - [0.0, 0.0, TARGET_HEIGHT_M]
        else:
            length, width, height = other.body.half_extents_m
            ahead = (length - width) * np.array([np.cos(other.body.heading_rad), np.sin(other.body.heading_rad), 0.0])
            radius = max(width, height)
            ends = center + np.array([-ahead, ahead])
        capsule[:, :3], capsule[0, 3], capsule[1, 3] = ends, radius, other.instance_id
    return capsules


# --- rectangles of shadows --------------------------------------------------------------------------------------------

# In a program that draws shadows of movers every pixel runs its loops, a third of a frame on a CPU, though the shadows
# cover a hundredth of it. So the scene is drawn without them, and these rectangles once more with them.
PERSON_REACH_M = 30.0**0.5  # reach of the person's shadow in the shader, from the hip
SHORTEST_CAR_M, HEADLIGHT_M, HEADLIGHT_ASIDE_M = 0.5, 26.0, 9.0  # as in the shader; shorter capsules are people
EDGE = 1.25  # radii of a capsule where its shadow ends
SKY_RADII, PERSON_SKY_M = 4.5, 1.0  # how far aside a capsule, in its radii, and the person darken the light of the sky
BELOW_M, LONGEST_M = 1.5, 60.0  # a shadow ends this far below the feet, and is at most this long


class Shade(NamedTuple):
    """One rectangle of pixels and the movers that may darken it.

    rectangle_px: x0, y0, x1, y1; points: (k, 3) relative to the scene's origin, whose hull holds all that is darkened;
    capsules: (c, 2, 4) of `capsules_of`; has_person: whether the person is one of the movers.
    """

    rectangle_px: tuple[int, int, int, int]
    points: np.ndarray
    capsules: np.ndarray
    has_person: bool


def shades_of(
    bones: np.ndarray, capsules: np.ndarray, sun: np.ndarray, view: CameraView, has_headlights: bool = False
) -> list[Shade]:
    """Return the rectangles of a frame, merged where they overlap.

    Args:
        bones: (b, 2, 4) capsules of the person, b is 0 without one: from and radius, to and 0. capsules: (c, 2, 4) of
            bystanders. sun: (3,) unit vector towards it. has_headlights: Cars light the ground in front of them.
    """
    found = []
    for own in capsules[:, None]:
        points = _darkened(own, sun, SKY_RADII * float(own[0, 0, 3]), LONGEST_M)
        found.append((np.concatenate([points, _lit(own)]) if has_headlights else points, own, False))
    if len(bones):
        found.append((_darkened(bones, sun, PERSON_SKY_M, PERSON_REACH_M), capsules[:0], True))
    shades: list[Shade] = []
    for points, own, is_person in found:
        if (rectangle := view.rectangle_px(points)) is None:
            continue
        new = Shade(rectangle, points, own, is_person)
        while touching := [shade for shade in shades if _overlap(shade.rectangle_px, new.rectangle_px)]:
            shades = [shade for shade in shades if not _overlap(shade.rectangle_px, new.rectangle_px)]
            for shade in touching:
                x0, y0, x1, y1 = zip(shade.rectangle_px, new.rectangle_px, strict=True)
                points, own = (np.concatenate([shade[k], new[k]]) for k in (1, 2))
                rectangle = min(x0), min(y0), max(x1), max(y1)
                new = Shade(rectangle, points, own, shade.has_person or new.has_person)
        shades.append(new)
    return shades


def _darkened(capsules: np.ndarray, sun: np.ndarray, aside_m: float, longest_m: float) -> np.ndarray:
    """Return corners around capsules and around their shadows down to BELOW_M under them, (24, 3)."""
    ends, radii = capsules[..., :3], capsules[:, :1, 3:]
    low, high = (ends - EDGE * radii).min(axis=(0, 1)), (ends + EDGE * radii).max(axis=(0, 1))
    length_m = min((high[2] - low[2] + BELOW_M) / max(float(sun[2]), 1e-3), longest_m)
    body = _corners(low, high)
    wide_low, wide_high = low - np.array([aside_m, aside_m, BELOW_M]), high + np.array([aside_m, aside_m, 0.0])
    return np.concatenate([body, body - length_m * sun, _corners(wide_low, wide_high)])


def _lit(car: np.ndarray) -> np.ndarray:
    """Return corners of what a car's headlights may light, (8, 3), none for a person; car: (1, 2, 4), back, front."""
    back, front = car[0, :, :3]
    along = front - back
    if np.linalg.norm(along) < SHORTEST_CAR_M:
        return np.zeros((0, 3))
    end = front + along / np.linalg.norm(along) * HEADLIGHT_M
    aside = np.array([HEADLIGHT_ASIDE_M, HEADLIGHT_ASIDE_M, 3.0])
    return _corners(np.minimum(front, end) - aside, np.maximum(front, end) + aside)


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return box_corners((low + high) / 2.0, (high - low) / 2.0)


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
