"""The walking person: proportions of 1.8 m, a walk cycle driven by the distance walked, clothes drawn once for each flight.

The figure stays within the circle round the target's box (PERSON_HALF_EXTENTS_M): in mid-stride the tips of the shoes pass its
sides by up to 12 cm.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.products.kinds import KINDS
from cosfly.products.walks import TARGET_HEIGHT_M
from cosfly.render.gl import meshes
from cosfly.render.gl.body import Body
from cosfly.render.gl.parts import CLOTH, LAYER_STEP, PART, STANDING_LAYER, tags
from cosfly.render.gl.scene import PERSON_ID

STRIDE_M = 1.35  # two steps
HIP_SWING_RAD, ARM_SWING_RAD, KNEE_BEND_RAD = 0.25, 0.38, 0.65
SLOW_MPS = 0.7  # below this speed the swing shrinks, down to standing
HIP_M, KNEE_M, ANKLE_M, SHOULDER_M = 0.93, 0.50, 0.085, 1.45

SHIRTS = np.array([
    [0.55, 0.04, 0.04], [0.03, 0.16, 0.45], [0.62, 0.58, 0.50], [0.60, 0.36, 0.02], [0.03, 0.28, 0.14], [0.28, 0.05, 0.26],
    [0.68, 0.14, 0.02], [0.02, 0.25, 0.30],
])  # fmt: skip
TROUSERS = np.array(
    [[0.03, 0.05, 0.11], [0.03, 0.03, 0.035], [0.20, 0.16, 0.11], [0.10, 0.11, 0.12], [0.07, 0.10, 0.19]]
)
HAIR = np.array([[0.02, 0.015, 0.01], [0.07, 0.035, 0.015], [0.22, 0.14, 0.05], [0.20, 0.19, 0.18]])
SKIN = np.array([[0.58, 0.36, 0.26], [0.46, 0.27, 0.18], [0.30, 0.16, 0.10], [0.15, 0.08, 0.05]])
SHOES = np.array([[0.03, 0.025, 0.02], [0.55, 0.55, 0.53], [0.14, 0.07, 0.03]])


@dataclass(frozen=True)
class Clothes:
    """Linear RGB of what one person wears, (3,) each."""

    shirt: np.ndarray
    trousers: np.ndarray
    hair: np.ndarray
    skin: np.ndarray
    shoes: np.ndarray


def choose_clothes(rng: np.random.Generator) -> Clothes:
    return Clothes(*(palette[rng.integers(len(palette))] for palette in (SHIRTS, TROUSERS, HAIR, SKIN, SHOES)))


@dataclass(frozen=True)
class Walk:
    """How the person moves along a flight: headings_rad (n,), phases_rad (n,) of the stride, swings (n,) in [0, 1]."""

    headings_rad: np.ndarray
    phases_rad: np.ndarray
    swings: np.ndarray


def walk_of(targets_m: np.ndarray, time_s: np.ndarray) -> Walk:
    """Read heading and stride from the target's positions, (n, 3), at times (n,). A standing person keeps the last heading."""
    n = len(targets_m)
    if n == 1:
        return Walk(np.zeros(1), np.zeros(1), np.zeros(1))
    steps = np.diff(targets_m[:, :2], axis=0)
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    velocity = np.gradient(targets_m[:, :2], time_s, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    headings = np.arctan2(velocity[:, 1], velocity[:, 0])
    moving = np.flatnonzero(speed > 0.05)
    last = np.maximum.accumulate(np.where(speed > 0.05, np.arange(n), -1))
    last[last < 0] = moving[0] if len(moving) else 0
    return Walk(headings[last], 2.0 * np.pi * walked / STRIDE_M, np.clip(speed / SLOW_MPS, 0.0, 1.0))


@dataclass
class _Figure:
    """Collects parts in the person's own axes: x forward, y left, z up, feet at 0."""

    records: list[tuple] = field(default_factory=list)
    mesh: list[int] = field(default_factory=list)
    centers: list[np.ndarray] = field(default_factory=list)
    turns: list[np.ndarray] = field(default_factory=list)
    bones: list[tuple[np.ndarray, np.ndarray, float]] = field(default_factory=list)

    def solid(
        self, mesh: int, center: list[float], half: list[float], color: np.ndarray, pitch_rad: float = 0.0
    ) -> None:
        self.mesh.append(mesh)
        self.centers.append(np.array(center))
        self.turns.append(Rotation.from_euler("y", pitch_rad).as_matrix())
        self.records.append((tuple(half), tuple(color)))

    def limb(self, low: np.ndarray, high: np.ndarray, radius: float, color: np.ndarray) -> None:
        """A limb between two points, thicker at `high`."""
        along = high - low
        length = float(np.linalg.norm(along))
        z = along / length
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        self.mesh.append(meshes.LIMB)
        self.centers.append((low + high) / 2.0)
        self.turns.append(np.stack([x, np.cross(z, x), z], axis=1))
        self.records.append(((radius, radius, length / 2.0 + 0.6 * radius), tuple(color)))

    def bone(self, low: np.ndarray, high: np.ndarray, radius: float) -> None:
        self.bones.append((low, high, radius))


def pose_person(hip_m: np.ndarray, heading_rad: float, phase_rad: float, swing: float, clothes: Clothes) -> Body:
    """Pose the figure at a hip point, (3,) world."""
    figure = _Figure()
    lift = 0.0
    feet = []
    for side, phase in ((1.0, phase_rad), (-1.0, phase_rad + np.pi)):
        foot = _leg(figure, side, phase, swing, clothes)
        feet.append(foot)
    lift = min(foot[2] for foot in feet) - ANKLE_M  # the lower foot stands on the ground
    for side, phase in ((1.0, phase_rad), (-1.0, phase_rad + np.pi)):
        _arm(figure, side, phase, swing, clothes)
    _trunk_and_head(figure, swing, clothes)
    return _placed(figure, np.asarray(hip_m, dtype=np.float64) - [0.0, 0.0, TARGET_HEIGHT_M + lift], heading_rad, hip_m)


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
    figure.limb(knee, hip, 0.088, clothes.trousers)
    figure.limb(ankle - [0, 0, 0.02], knee, 0.066, clothes.trousers)
    toe = 0.5 * (angle - bend)
    center = ankle + np.array([0.048 * np.cos(toe), 0.0, -0.043 + 0.048 * np.sin(toe)])
    figure.solid(meshes.ROUNDED, center.tolist(), [0.115, 0.048, 0.042], clothes.shoes, pitch_rad=-toe)
    figure.bone(ankle - [0, 0, 0.05], hip, 0.085)
    return ankle


def _arm(figure: _Figure, side: float, phase: float, swing: float, clothes: Clothes) -> None:
    shoulder = np.array([0.0, 0.205 * side, SHOULDER_M - 0.03])
    angle = -ARM_SWING_RAD * swing * np.sin(phase)
    elbow = shoulder + _swung(angle, 0.29) + [0.0, 0.025 * side, 0.0]
    wrist = elbow + _swung(angle + 0.18 + 0.3 * swing, 0.25)
    figure.limb(elbow, shoulder, 0.058, clothes.shirt)
    figure.limb(wrist, elbow, 0.041, clothes.skin)
    figure.solid(meshes.SPHERE, (wrist + np.array([0.01, 0, -0.05])).tolist(), [0.04, 0.03, 0.065], clothes.skin)
    figure.bone(wrist, shoulder, 0.05)


def _trunk_and_head(figure: _Figure, swing: float, clothes: Clothes) -> None:
    lean = 0.03 * swing
    figure.solid(meshes.ROUNDED, [0.0, 0.0, 0.95], [0.115, 0.165, 0.12], clothes.trousers)
    figure.solid(meshes.LIMB, [0.01, 0.0, 1.22], [0.125, 0.195, 0.29], clothes.shirt, pitch_rad=lean)
    figure.solid(meshes.SPHERE, [0.015, 0.0, 1.42], [0.10, 0.205, 0.085], clothes.shirt, pitch_rad=lean)
    figure.limb(np.array([0.01, 0.0, 1.46]), np.array([0.025, 0.0, 1.60]), 0.055, clothes.skin)
    figure.solid(meshes.SPHERE, [0.035, 0.0, 1.665], [0.10, 0.078, 0.125], clothes.skin)
    figure.solid(meshes.SPHERE, [0.008, 0.0, 1.70], [0.105, 0.088, 0.10], clothes.hair)
    figure.solid(meshes.SPHERE, [0.132, 0.0, 1.65], [0.02, 0.016, 0.025], clothes.skin)
    figure.bone(np.array([0.0, 0.0, 0.95]), np.array([0.01, 0.0, 1.36]), 0.17)
    figure.bone(np.array([0.02, 0.0, 1.60]), np.array([0.02, 0.0, 1.70]), 0.095)


def _placed(figure: _Figure, feet_m: np.ndarray, heading_rad: float, hip_m: np.ndarray) -> Body:
    turn = Rotation.from_euler("z", heading_rad).as_matrix()
    records = np.zeros(len(figure.records), PART)
    for row, (half, color) in enumerate(figure.records):
        records["half"][row], records["color"][row, :3] = half, color
    records["quaternion"] = Rotation.from_matrix(turn @ np.array(figure.turns)).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), PERSON_ID))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    centers = np.array(figure.centers) @ turn.T + feet_m
    ends = np.array([[low, high] for low, high, _ in figure.bones]) @ turn.T + feet_m
    radii = np.array([radius for _, _, radius in figure.bones])
    return Body(records, np.array(figure.mesh), centers, ends, radii, np.asarray(hip_m, dtype=np.float64))
