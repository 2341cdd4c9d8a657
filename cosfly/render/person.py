"""People and cars of a trajectory as renderers draw them: clothes, gait along the path, bystanders, and the figure of a
walking person as solids for any renderer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cosfly.formats.bystanders import Bystander
from cosfly.formats.frames import BystanderMeta, BystandersMeta, tree_yaw
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.people import COLORS, EMPTY_SHARE, FIGURES, GARMENTS, HAIR, Appearance, People
from cosfly.geometry.axes import headings_of, rotation_matrices, rotation_matrix
from cosfly.geometry.kernels import distances_to_boxes_m
from cosfly.render.contract import Clothes, Frame, PosedBystander, PosedCar, PosedPerson, other_id

STRIDE_M = 1.35  # two steps
SLOW_MPS = 0.7  # below this speed the swing shrinks, down to standing

HAIR_RGB = np.array([[0.02, 0.015, 0.01], [0.07, 0.035, 0.015], [0.22, 0.14, 0.05], [0.20, 0.19, 0.18]])
SKIN = np.array([[0.58, 0.36, 0.26], [0.46, 0.27, 0.18], [0.30, 0.16, 0.10], [0.15, 0.08, 0.05]])
SHOES = np.array([[0.03, 0.025, 0.02], [0.55, 0.55, 0.53], [0.14, 0.07, 0.03]])


def choose_clothes(rng: np.random.Generator, looks: Appearance | None = None) -> Clothes:
    """Choose an appearance at random, or only what a given appearance does not fix."""
    looks = looks or draw_appearance(rng)
    return Clothes(looks, *(palette[rng.integers(len(palette))] for palette in (HAIR_RGB, SKIN, SHOES)))


def draw_appearance(rng: np.random.Generator) -> Appearance:
    """Draw a person, every garment and colour equally likely where all is seen, bare heads and hands by EMPTY_SHARE."""
    while True:
        drawn = {"figure": _one(rng, tuple(FIGURES))}
        for slot in GARMENTS:
            drawn |= _worn(rng, slot)
        if (person := Appearance(**drawn)).is_all_seen:
            return person


def look_alike(person: Appearance, rng: np.random.Generator) -> Appearance:
    """Draw an appearance that differs from a given one in one garment or its colour."""
    slot = _one(rng, tuple(GARMENTS))
    while True:
        other = replace(person, **_worn(rng, slot))
        if person.differences(other) and other.is_all_seen:
            return other


def _worn(rng: np.random.Generator, slot: str) -> dict[str, str]:
    if rng.random() < EMPTY_SHARE.get(slot, 0.0):
        return {slot: "", f"{slot}_color": ""}
    colors = tuple(color for color in COLORS if slot != "hat" or color not in HAIR)
    return {slot: _one(rng, tuple(filter(None, GARMENTS[slot]))), f"{slot}_color": _one(rng, colors)}


def _one(rng: np.random.Generator, names: tuple[str, ...]) -> str:
    return names[rng.integers(len(names))]


@dataclass(frozen=True)
class Gait:
    """Motion of a person, n frames: headings_rad (n,), phases_rad (n,) of the stride, swings (n,) in [0, 1]."""

    headings_rad: np.ndarray
    phases_rad: np.ndarray
    swings: np.ndarray

    def since(self, first: int) -> Gait:
        """Return the gait from a frame on."""
        return Gait(*(values[first:] for values in vars(self).values()))

    def posed(self, i: int, hip_m: np.ndarray, clothes: Clothes) -> PosedPerson:
        """Return the person of frame i, at a hip point, (3,) world."""
        heading_rad, phase_rad, swing = (float(values[i]) for values in vars(self).values())
        return PosedPerson(hip_m, heading_rad, phase_rad, swing, clothes)


def gait_of(targets_m: np.ndarray, time_s: np.ndarray) -> Gait:
    """Compute heading and stride from positions, (n, 3), at times (n,). A standing person keeps the last heading."""
    if len(targets_m) == 1:
        return Gait(np.zeros(1), np.zeros(1), np.zeros(1))
    steps_m = np.linalg.norm(np.diff(targets_m[:, :2], axis=0), axis=1)
    speed = np.linalg.norm(np.gradient(targets_m[:, :2], time_s, axis=0), axis=1)
    phases = 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(steps_m)]) / STRIDE_M
    return Gait(headings_of(targets_m, time_s), phases, np.clip(speed / SLOW_MPS, 0.0, 1.0))


# --- bystanders -------------------------------------------------------------------------------------------------------

SHARE_DIGITS = 6


@dataclass(frozen=True)
class DressedBystanders:
    """All bystanders of one trajectory: gaits and clothes of pedestrians, a seed for the paint of each."""

    others: list[Bystander]
    gaits: list[Gait]
    clothes: list[Clothes]
    seeds: np.ndarray

    def __len__(self) -> int:
        return len(self.others)

    def people(self, target: Appearance) -> People:
        """Return the appearance of the target and of every pedestrian."""
        pedestrians = (number for number, other in enumerate(self.others) if other.kind == "Pedestrians")
        return People(target, {other_id(number): self.clothes[number].looks for number in pedestrians})

    def posed(self, i: int) -> list[PosedBystander]:
        """Return all bystanders in frame i."""
        bystanders = []
        for number, other in enumerate(self.others):
            center_m = other.centers_m[i]
            body: PosedPerson | PosedCar = self.gaits[number].posed(i, center_m, self.clothes[number])
            if other.kind != "Pedestrians":
                heading_rad = float(other.headings_rad[i])
                body = PosedCar(center_m, heading_rad, other.build.half_extents_m, float(self.seeds[number]))
            bystanders.append(PosedBystander(other_id(number), body))
        return bystanders

    def meta(self, i: int, frame: Frame, hidden_by_others: float, hidden_by_map: float) -> BystandersMeta:
        """Return the annotation of the bystanders in frame i."""
        pixels = np.bincount(frame.ids.ravel(), minlength=other_id(0) + 1)
        return BystandersMeta(
            target_hidden_by_others=round(hidden_by_others, SHARE_DIGITS),
            target_hidden_by_map=round(hidden_by_map, SHARE_DIGITS),
            others=[
                BystanderMeta(
                    instance_id=other_id(number),
                    semantic_id=other.kind_number,
                    world_location=other.centers_m[i],
                    yaw=tree_yaw(float(np.degrees(other.headings_rad[i]))),
                    half_extents_m=other.build.half_extents_m,
                    num_pixels=int(pixels[other_id(number)]),
                )
                for number, other in enumerate(self.others)
            ],
        )

    def distance_m(self, i: int, point_m: np.ndarray) -> float:
        """Return the distance of a point, (3,), to the nearest box of frame i; infinity without bystanders."""
        return min((float(distances_to_boxes_m(point_m, other.at(i))[0]) for other in self.others), default=np.inf)

    def are_in_the_way(self, i: int, person_m: np.ndarray) -> bool:
        """Return whether a person at a hip point, (3,), would touch a bystander."""
        return any(other.at(i).gap_to_person_m(person_m) < 0.0 for other in self.others)


NO_BYSTANDERS = DressedBystanders([], [], [], np.empty(0))


def dress_bystanders(
    others: list[Bystander], time_s: np.ndarray, target: Appearance, rng: np.random.Generator
) -> DressedBystanders:
    """Dress the bystanders: hard distractors differ from the target in one garment, the others in at least one."""
    gaits = [gait_of(other.positions_m, time_s) for other in others]
    clothes = []
    for other in others:
        looks = target
        while not target.differences(looks):
            looks = look_alike(target, rng) if other.is_look_alike else draw_appearance(rng)
        clothes.append(choose_clothes(rng, looks))
    return DressedBystanders(others, gaits, clothes, rng.random(len(others)))


# --- figures ----------------------------------------------------------------------------------------------------------

# A figure of 1.8 m stays within the circle around the target's box (PERSON_HALF_EXTENTS_M), to 3 mm.
HIP_SWING_RAD, ARM_SWING_RAD, KNEE_BEND_RAD = 0.25, 0.38, 0.65  # largest angles of a stride
HIP_M, KNEE_M, ANKLE_M, SHOULDER_M = 0.93, 0.50, 0.085, 1.45  # heights of joints
SIZES = {"woman": 0.96, "man": 1.0}
BREADTHS = {"woman": 0.84, "man": 1.05}
# Garments that hang open below the waist: low end, high end, radii ahead and aside, m.
HEMS = {"jacket": (0.82, 1.12, 0.15, 0.19), "coat": (0.46, 1.14, 0.22, 0.235), "skirt": (0.47, 1.04, 0.24, 0.26)}


@dataclass(frozen=True)
class PersonFigure:
    """A posed figure, k solids and b bones, m, world.

    shapes: k of ball, rounded (a box), limb (thicker at its upper end), disc, each within half_m (k, 3) of centers_m
    (k, 3), turned by turns (k, 3, 3); colors: (k, 3) linear RGB; bones_m: (b, 2, 3), the ends of the capsules that cast
    the shadow; bone_radii_m: (b,).
    """

    shapes: tuple[str, ...]
    centers_m: np.ndarray
    turns: np.ndarray
    half_m: np.ndarray
    colors: np.ndarray
    bones_m: np.ndarray
    bone_radii_m: np.ndarray


@dataclass
class _Body:
    """The pieces of a figure in the person's own axes: x forward, y left, z up, feet at 0."""

    solids: list[tuple] = field(default_factory=list)  # (shape, center, half, color, pitch, roll)
    limbs: list[tuple] = field(default_factory=list)  # (low, high, radius, color)
    bones: list[tuple] = field(default_factory=list)  # (low, high, radius)

    def solid(
        self, shape: str, center: list[float], half: list[float], color: np.ndarray, pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
    ) -> None:  # fmt: skip
        self.solids.append((shape, center, half, color, -pitch_rad, roll_rad))

    def limb(self, low: np.ndarray, high: np.ndarray, radius: float, color: np.ndarray) -> None:
        """Add a limb between two points, thicker at `high`."""
        self.limbs.append((low, high, radius, color))

    def placed(self, feet_m: np.ndarray, heading_rad: float, size: float) -> PersonFigure:
        """Return the figure at a place; all pieces at once, four times as fast as one by one."""
        shapes, centers, half, colors, pitch, roll = zip(*self.solids, strict=True)
        turns = rotation_matrices(np.column_stack([pitch, np.zeros(len(pitch)), roll]))
        low, high, radius, limb_colors = (np.array(column) for column in zip(*self.limbs, strict=True))
        length = np.linalg.norm(high - low, axis=1)
        z = (high - low) / length[:, None]
        x = np.stack([z[:, 2], 0.0 * length, -z[:, 0]], axis=1) / np.hypot(z[:, 0], z[:, 2])[:, None]
        limb_turns = np.stack([x, np.cross(z, x), z], axis=2)
        limb_half = np.stack([radius, radius, length / 2.0 + 0.6 * radius], axis=1)
        from_, to, bone_radii = (np.array(column) for column in zip(*self.bones, strict=True))
        turn = rotation_matrix(0.0, heading_rad, 0.0)
        return PersonFigure(
            (*shapes, *["limb"] * len(length)),
            feet_m + size * np.concatenate([centers, (low + high) / 2.0]) @ turn.T,
            turn @ np.concatenate([turns, limb_turns]),
            size * np.concatenate([half, limb_half]),
            np.concatenate([colors, limb_colors]),
            feet_m + size * np.stack([from_, to], axis=1) @ turn.T,
            size * bone_radii,
        )


def figure_of(person: PosedPerson) -> PersonFigure:
    """Build the figure of a posed person."""
    figure, swing, clothes = _Body(), person.swing, person.clothes
    size, breadth = SIZES[clothes.looks.figure], BREADTHS[clothes.looks.figure]
    sides = ((1.0, person.phase_rad), (-1.0, person.phase_rad + np.pi))
    feet = [_leg(figure, side, phase, swing, clothes) for side, phase in sides]
    lift = size * (min(foot[2] for foot in feet) - ANKLE_M)  # the lower foot is on the ground
    for side, phase in sides:
        _arm(figure, breadth * side, phase, swing, clothes)
    _trunk(figure, breadth, swing, clothes)
    _head(figure, clothes)
    if clothes.looks.bag == "backpack":  # with two straps
        figure.solid("rounded", [-0.205, 0.0, 1.24], [0.10, 0.155, 0.22], clothes.color("bag"))
        for side in (-1.0, 1.0):
            figure.solid("rounded", [0.0, 0.11 * breadth * side, 1.33], [0.145, 0.025, 0.17], clothes.color("bag"))
    elif clothes.looks.bag:  # at the right hip, with a strap across
        figure.solid("rounded", [0.0, -0.285, 0.88], [0.15, 0.075, 0.12], clothes.color("bag"))
        figure.solid("rounded", [0.0, -0.05, 1.21], [0.15, 0.025, 0.33], clothes.color("bag"), roll_rad=-0.58)
    return figure.placed(person.hip_m - [0.0, 0.0, TARGET_HEIGHT_M + lift], person.heading_rad, size)


def _swung(angle_rad: float, length: float) -> np.ndarray:
    """Return a vector hanging down, turned forward by an angle."""
    return length * np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)])


def _leg(figure: _Body, side: float, phase: float, swing: float, clothes: Clothes) -> np.ndarray:
    """Add thigh, shin and shoe; return the ankle."""
    hip = np.array([0.0, 0.09 * side, HIP_M])
    angle = HIP_SWING_RAD * swing * np.sin(phase)
    bend = swing * (0.12 + KNEE_BEND_RAD * max(0.0, np.cos(phase)) ** 1.5)  # the leg that swings forward is bent
    knee = hip + _swung(angle, HIP_M - KNEE_M)
    ankle = knee + _swung(angle - bend, KNEE_M - ANKLE_M)
    legs, cloth = clothes.looks.legs, clothes.color("legs")
    figure.limb(knee, hip, 0.088, clothes.skin if legs == "skirt" else cloth)
    figure.limb(ankle - [0, 0, 0.02], knee, 0.066, cloth if legs == "trousers" else clothes.skin)
    toe = 0.5 * (angle - bend)
    center = ankle + np.array([0.048 * np.cos(toe), 0.0, -0.043 + 0.048 * np.sin(toe)])
    figure.solid("rounded", center.tolist(), [0.115, 0.048, 0.042], clothes.shoes, pitch_rad=-toe)
    is_wide = clothes.looks.top == "coat" or legs == "skirt"
    figure.bones.append((ankle - [0, 0, 0.05], hip, 0.12 if is_wide else 0.085))
    return ankle


def _arm(figure: _Body, side: float, phase: float, swing: float, clothes: Clothes) -> None:
    shoulder = np.array([0.0, 0.205 * side, SHOULDER_M - 0.03])
    angle = -ARM_SWING_RAD * swing * np.sin(phase)
    elbow = shoulder + _swung(angle, 0.29) + [0.0, 0.025 * side, 0.0]
    wrist = elbow + _swung(angle + 0.18 + 0.3 * swing, 0.25)
    is_bare = clothes.looks.top == "t_shirt"
    figure.limb(elbow, shoulder, 0.058, clothes.color("top"))
    figure.limb(wrist, elbow, 0.041 if is_bare else 0.055, clothes.skin if is_bare else clothes.color("top"))
    figure.solid("ball", (wrist + np.array([0.01, 0, -0.05])).tolist(), [0.04, 0.03, 0.065], clothes.skin)
    figure.bones.append((wrist, shoulder, 0.05))


def _trunk(figure: _Body, breadth: float, swing: float, clothes: Clothes) -> None:
    lean = 0.03 * swing
    top = clothes.color("top")
    covered = top if clothes.looks.top in HEMS else clothes.color("legs")
    figure.solid("rounded", [0.0, 0.0, 0.95], [0.115, 0.165, 0.12], covered)
    figure.solid("limb", [0.01, 0.0, 1.22], [0.125, 0.195 * breadth, 0.29], top, pitch_rad=lean)
    figure.solid("ball", [0.015, 0.0, 1.42], [0.10, 0.205 * breadth, 0.085], top, pitch_rad=lean)
    for slot in ("top", "legs"):
        if (garment := getattr(clothes.looks, slot)) in HEMS:
            low, high, ahead, aside = HEMS[garment]
            middle, half = [0.0, 0.0, (low + high) / 2.0], [ahead, aside, (high - low) / 2.0]
            figure.solid("limb", middle, half, clothes.color(slot), pitch_rad=np.pi)
    figure.bones.append((np.array([0.0, 0.0, 0.95]), np.array([0.01, 0.0, 1.36]), 0.17))


def _head(figure: _Body, clothes: Clothes) -> None:
    hat, skin, hair = clothes.looks.hat, clothes.skin, clothes.hair
    figure.limb(np.array([0.01, 0.0, 1.46]), np.array([0.025, 0.0, 1.60]), 0.055, skin)
    figure.solid("ball", [0.035, 0.0, 1.665], [0.10, 0.078, 0.125], skin)
    figure.solid("ball", [0.008, 0.0, 1.68 if hat else 1.70], [0.105, 0.088, 0.10], hair)
    figure.solid("ball", [0.132, 0.0, 1.65], [0.02, 0.016, 0.025], skin)
    if clothes.looks.figure == "woman":
        figure.solid("ball", [-0.055, 0.0, 1.55], [0.075, 0.105, 0.20], hair)
    if hat:
        color = clothes.color("hat")
        figure.solid("ball", [0.01, 0.0, 1.70], [0.118, 0.102, 0.10], color)
        if hat == "cap":
            figure.solid("rounded", [0.14, 0.0, 1.70], [0.085, 0.075, 0.012], color, pitch_rad=0.15)
        else:
            figure.solid("disc", [0.01, 0.0, 1.69], [0.235, 0.225, 0.012], color)
    figure.bones.append((np.array([0.02, 0.0, 1.60]), np.array([0.02, 0.0, 1.70]), 0.14 if hat == "brim" else 0.095))
