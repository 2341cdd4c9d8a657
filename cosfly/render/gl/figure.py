"""The figure of the walking person: proportions of 1.8 m, a walk cycle driven by the distance walked.

It stays within the circle round the target's box (PERSON_HALF_EXTENTS_M): in mid-stride the tips of the shoes pass its
sides by up to 12 cm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.geometry import rotation_matrix
from cosfly.products.kinds import KINDS
from cosfly.products.walks import TARGET_HEIGHT_M
from cosfly.render.contract import LAYER_STEP, PERSON_ID, STANDING_LAYER, Clothes, PosedCar, PosedOther, PosedPerson
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import CLOTH, PART, Boxes, PartBuilder, tags
from cosfly.render.gl.shapes import BUILDERS
from cosfly.render.gl.view import CameraView

HIP_SWING_RAD, ARM_SWING_RAD, KNEE_BEND_RAD = 0.25, 0.38, 0.65
HIP_M, KNEE_M, ANKLE_M, SHOULDER_M = 0.93, 0.50, 0.085, 1.45


@dataclass(frozen=True)
class Body:
    """A posed figure as drawable parts, k of them and b bones.

    records: (k,) parts.PART without centers; mesh: (k,); centers_m: (k, 3) world; bones_m: (b, 2, 3) world, the ends of
    the capsules that cast the shadow; bone_radii_m: (b,); center_m: (3,) the hip point.
    """

    records: np.ndarray
    mesh: np.ndarray
    centers_m: np.ndarray
    bones_m: np.ndarray
    bone_radii_m: np.ndarray
    center_m: np.ndarray


@dataclass
class _Figure:
    """Collects parts in the person's own axes: x forward, y left, z up, feet at 0."""

    parts: list[tuple] = field(default_factory=list)  # (mesh, center, turn, half, color)
    bones: list[tuple[np.ndarray, np.ndarray, float]] = field(default_factory=list)

    def solid(
        self, mesh: int, center: list[float], half: list[float], color: np.ndarray, pitch_rad: float = 0.0
    ) -> None:
        turn = Rotation.from_euler("y", pitch_rad).as_matrix()
        self.parts.append((mesh, np.array(center), turn, tuple(half), color))

    def limb(self, low: np.ndarray, high: np.ndarray, radius: float, color: np.ndarray) -> None:
        """A limb between two points, thicker at `high`."""
        along = high - low
        length = float(np.linalg.norm(along))
        z = along / length
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        turn, half = np.stack([x, np.cross(z, x), z], axis=1), (radius, radius, length / 2.0 + 0.6 * radius)
        self.parts.append((meshes.LIMB, (low + high) / 2.0, turn, half, color))


def make_body(person: PosedPerson, instance_id: int = PERSON_ID) -> Body:
    """Build the figure of a posed person, the target or another."""
    figure, swing, clothes = _Figure(), person.swing, person.clothes
    sides = ((1.0, person.phase_rad), (-1.0, person.phase_rad + np.pi))
    feet = [_leg(figure, side, phase, swing, clothes) for side, phase in sides]
    lift = min(foot[2] for foot in feet) - ANKLE_M  # the lower foot stands on the ground
    for side, phase in sides:
        _arm(figure, side, phase, swing, clothes)
    _trunk_and_head(figure, swing, clothes)
    hip_m = np.asarray(person.hip_m, dtype=np.float64)
    return _placed(figure, hip_m - [0.0, 0.0, TARGET_HEIGHT_M + lift], person.heading_rad, hip_m, instance_id)


def _swung(angle_rad: float, length: float) -> np.ndarray:
    """A vector hanging down, turned forward by an angle."""
    return length * np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)])


def _leg(figure: _Figure, side: float, phase: float, swing: float, clothes: Clothes) -> np.ndarray:
    """Thigh, shin and shoe; gives the ankle."""
    hip = np.array([0.0, 0.09 * side, HIP_M])
    angle = HIP_SWING_RAD * swing * np.sin(phase)
    bend = swing * (0.12 + KNEE_BEND_RAD * max(0.0, np.cos(phase)) ** 1.5)  # the leg that swings forward is bent
    knee = hip + _swung(angle, HIP_M - KNEE_M)
    ankle = knee + _swung(angle - bend, KNEE_M - ANKLE_M)
    figure.limb(knee, hip, 0.088, clothes.color("legs"))
    figure.limb(ankle - [0, 0, 0.02], knee, 0.066, clothes.color("legs"))
    toe = 0.5 * (angle - bend)
    center = ankle + np.array([0.048 * np.cos(toe), 0.0, -0.043 + 0.048 * np.sin(toe)])
    figure.solid(meshes.ROUNDED, center.tolist(), [0.115, 0.048, 0.042], clothes.shoes, pitch_rad=-toe)
    figure.bones.append((ankle - [0, 0, 0.05], hip, 0.085))
    return ankle


def _arm(figure: _Figure, side: float, phase: float, swing: float, clothes: Clothes) -> None:
    shoulder = np.array([0.0, 0.205 * side, SHOULDER_M - 0.03])
    angle = -ARM_SWING_RAD * swing * np.sin(phase)
    elbow = shoulder + _swung(angle, 0.29) + [0.0, 0.025 * side, 0.0]
    wrist = elbow + _swung(angle + 0.18 + 0.3 * swing, 0.25)
    figure.limb(elbow, shoulder, 0.058, clothes.color("top"))
    figure.limb(wrist, elbow, 0.041, clothes.skin)
    figure.solid(meshes.SPHERE, (wrist + np.array([0.01, 0, -0.05])).tolist(), [0.04, 0.03, 0.065], clothes.skin)
    figure.bones.append((wrist, shoulder, 0.05))


def _trunk_and_head(figure: _Figure, swing: float, clothes: Clothes) -> None:
    lean = 0.03 * swing
    figure.solid(meshes.ROUNDED, [0.0, 0.0, 0.95], [0.115, 0.165, 0.12], clothes.color("legs"))
    figure.solid(meshes.LIMB, [0.01, 0.0, 1.22], [0.125, 0.195, 0.29], clothes.color("top"), pitch_rad=lean)
    figure.solid(meshes.SPHERE, [0.015, 0.0, 1.42], [0.10, 0.205, 0.085], clothes.color("top"), pitch_rad=lean)
    figure.limb(np.array([0.01, 0.0, 1.46]), np.array([0.025, 0.0, 1.60]), 0.055, clothes.skin)
    figure.solid(meshes.SPHERE, [0.035, 0.0, 1.665], [0.10, 0.078, 0.125], clothes.skin)
    figure.solid(meshes.SPHERE, [0.008, 0.0, 1.70], [0.105, 0.088, 0.10], clothes.hair)
    figure.solid(meshes.SPHERE, [0.132, 0.0, 1.65], [0.02, 0.016, 0.025], clothes.skin)
    figure.bones.append((np.array([0.0, 0.0, 0.95]), np.array([0.01, 0.0, 1.36]), 0.17))
    figure.bones.append((np.array([0.02, 0.0, 1.60]), np.array([0.02, 0.0, 1.70]), 0.095))


def _placed(figure: _Figure, feet_m: np.ndarray, heading_rad: float, hip_m: np.ndarray, instance_id: int) -> Body:
    turn = Rotation.from_euler("z", heading_rad).as_matrix()
    mesh, centers, turns, halves, colors = zip(*figure.parts, strict=True)
    records = np.zeros(len(mesh), PART)
    records["half"], records["color"][:, :3] = halves, colors
    records["quaternion"] = Rotation.from_matrix(turn @ np.array(turns)).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), instance_id))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    ends = np.array([[low, high] for low, high, _ in figure.bones]) @ turn.T + feet_m
    radii = np.array([radius for _, _, radius in figure.bones])
    return Body(records, np.array(mesh), np.array(centers) @ turn.T + feet_m, ends, radii, hip_m)


# --- moving -----------------------------------------------------------------------------------------------------------
# What moves, as drawable parts of one frame: the figures of people, cars, and the capsules that cast the shadows of
# others.


MOST_CAPSULES = 32  # as many as the shader has room for: the nearest to the camera
SHADOW_M = 5.0  # of a sphere that holds a shadow too, under a sun that stands as usual
PERSON_RADIUS_M = 1.0  # of a sphere round a person
PERSON_CAPSULE_M = (0.15, 1.62, 0.19)  # low and high end over the feet, radius


def placed(body: Body, origin_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the records of a figure with their places, and their meshes."""
    records = body.records.copy()
    records["center"] = body.centers_m - origin_m
    return records, body.mesh


def draw_others(
    others: Sequence[PosedOther], origin_m: np.ndarray, view: CameraView
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Give records and meshes of the others whom the camera may see."""
    found = []
    for other in others:
        center = other.center_m - origin_m
        if isinstance(other.body, PosedPerson):
            if view.can_show(center, PERSON_RADIUS_M):
                found.append(placed(make_body(other.body, other.instance_id), origin_m))
        elif view.can_show(center, float(np.linalg.norm(other.body.half_extents_m))):
            found.append(_car(other.body, other.instance_id, center, view))
    return found


def _car(car: PosedCar, instance_id: int, center: np.ndarray, view: CameraView) -> tuple[np.ndarray, np.ndarray]:
    """A car of the same shape as those that a map has parked."""
    builder, turn = PartBuilder(), rotation_matrix(0.0, car.heading_rad, 0.0)
    half, ids = np.array(car.half_extents_m), np.array([instance_id], np.uint16)
    BUILDERS[KINDS["Car"]](
        builder, Boxes(center[None], half[None], turn[None], ids, np.array([car.seed]), KINDS["Car"], np.zeros(1))
    )
    parts = builder.finish()
    rows = view.rows(parts)
    return parts.records[rows], parts.mesh[rows]


def capsules_of(others: Sequence[PosedOther], origin_m: np.ndarray, view: CameraView) -> np.ndarray:
    """Capsules of the others whose shadows the camera may see, relative to the origin, (k, 2, 4): from and radius, to
    and instance id.

    Every pixel asks every capsule, which costs more than all else that is drawn of others.
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
