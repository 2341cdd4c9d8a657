"""People of a trajectory as renderers draw them: clothes, gait along the path and bystanders, and the figure of a
walking person as solids for any renderer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cosfly.formats.bystanders import Bystander
from cosfly.formats.frames import BystanderMeta, BystandersMeta, tree_yaw
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, TARGET_HEIGHT_M
from cosfly.formats.people import COLORS, EMPTY_SHARE, FIGURES, GARMENTS, HAIR, Appearance, People
from cosfly.geometry.axes import headings_of, rotation_matrices, rotation_matrix
from cosfly.geometry.kernels import distances_to_boxes_m
from cosfly.render.camera import RenderedVisibility
from cosfly.render.contract import Clothes, Frame, PosedPeople, PosedPerson, other_id

STRIDE_M = 1.35  # two steps
SLOW_MPS = 0.7  # below this speed the swing shrinks, down to standing

HAIR_RGB = np.array([[0.02, 0.015, 0.01], [0.07, 0.035, 0.015], [0.22, 0.14, 0.05], [0.20, 0.19, 0.18]])
SKIN = np.array([[0.58, 0.36, 0.26], [0.46, 0.27, 0.18], [0.30, 0.16, 0.10], [0.15, 0.08, 0.05]])
SHOES = np.array([[0.03, 0.025, 0.02], [0.55, 0.55, 0.53], [0.14, 0.07, 0.03]])


def choose_clothes(rng: np.random.Generator, looks: Appearance | None = None) -> Clothes:
    """Choose clothes at random: an appearance, unless one is given, and the colours of hair, skin and shoes."""
    looks = looks or choose_appearance(rng)
    return Clothes(looks, *(palette[rng.integers(len(palette))] for palette in (HAIR_RGB, SKIN, SHOES)))


def choose_appearance(rng: np.random.Generator) -> Appearance:
    """Choose an appearance at random, whose garments can all be seen.

    Garments and colours are equally likely; EMPTY_SHARE is the share of people without a hat or a bag.
    """
    while True:
        fields = {"figure": _choose(rng, tuple(FIGURES))}
        for slot in GARMENTS:
            fields |= _choose_garment(rng, slot)
        if (person := Appearance(**fields)).is_all_seen:
            return person


def choose_look_alike(person: Appearance, rng: np.random.Generator) -> Appearance:
    """Choose an appearance at random that differs from a given one in one garment or its colour."""
    slot = _choose(rng, tuple(GARMENTS))
    while True:
        other = replace(person, **_choose_garment(rng, slot))
        if person.differences(other) and other.is_all_seen:
            return other


def _choose_garment(rng: np.random.Generator, slot: str) -> dict[str, str]:
    """Return the fields of an appearance for a garment and its colour; nobody wears a hat in a colour of hair."""
    if rng.random() < EMPTY_SHARE.get(slot, 0.0):
        return {slot: "", f"{slot}_color": ""}
    colors = tuple(color for color in COLORS if slot != "hat" or color not in HAIR)
    return {slot: _choose(rng, tuple(filter(None, GARMENTS[slot]))), f"{slot}_color": _choose(rng, colors)}


def _choose(rng: np.random.Generator, names: tuple[str, ...]) -> str:
    return names[rng.integers(len(names))]


@dataclass(frozen=True)
class Gait:
    """Motion of a person in n frames."""

    headings_rad: np.ndarray  # (n,)
    phases_rad: np.ndarray  # (n,) of the stride
    swings: np.ndarray  # (n,) in [0, 1], of arms and legs; 0 for a standing person

    def since(self, first: int) -> Gait:
        """Return the gait from frame `first` on."""
        return Gait(self.headings_rad[first:], self.phases_rad[first:], self.swings[first:])

    def posed(self, i: int, hip_m: np.ndarray, clothes: Clothes) -> PosedPerson:
        """Return the person of frame i, at a hip point, (3,) world."""
        heading_rad = float(self.headings_rad[i])
        return PosedPerson(hip_m, heading_rad, float(self.phases_rad[i]), float(self.swings[i]), clothes)


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
    """The n bystanders of one trajectory."""

    others: list[Bystander]
    gaits: list[Gait]
    clothes: list[Clothes]

    def __len__(self) -> int:
        return len(self.others)

    def people(self, target: Appearance) -> People:
        """Return the appearance of the target and of every bystander."""
        return People(target, {other_id(number): clothes.looks for number, clothes in enumerate(self.clothes)})

    def dressed(self, instance_id: int, looks: Appearance) -> DressedBystanders:
        """Return the bystanders with one of them in another appearance."""
        clothes = [
            replace(worn, looks=looks) if other_id(number) == instance_id else worn
            for number, worn in enumerate(self.clothes)
        ]
        return replace(self, clothes=clothes)

    def posed(self, i: int) -> PosedPeople:
        """Return all bystanders in frame i."""
        return {
            other_id(number): self.gaits[number].posed(i, other.centers_m[i], self.clothes[number])
            for number, other in enumerate(self.others)
        }

    def meta(self, i: int, frame: Frame, visibility: RenderedVisibility) -> BystandersMeta:
        """Return the annotation of the bystanders in frame i; visibility: that of the target."""
        pixels = np.bincount(frame.ids.ravel(), minlength=other_id(0) + 1)
        return BystandersMeta(
            target_hidden_by_others=round(visibility.hidden_by_bystanders, SHARE_DIGITS),
            target_hidden_by_map=round(visibility.hidden_by_map, SHARE_DIGITS),
            others=[
                BystanderMeta(
                    instance_id=other_id(number),
                    semantic_id=KINDS["Pedestrians"],
                    world_location=other.centers_m[i],
                    yaw=tree_yaw(float(np.degrees(other.headings_rad[i]))),
                    half_extents_m=PERSON_HALF_EXTENTS_M,
                    num_pixels=int(pixels[other_id(number)]),
                )
                for number, other in enumerate(self.others)
            ],
        )

    def distance_m(self, i: int, point_m: np.ndarray) -> float:
        """Return the distance of a point, (3,), to the nearest bystander in frame i; infinity without bystanders."""
        return min((float(distances_to_boxes_m(point_m, other.at(i))[0]) for other in self.others), default=np.inf)

    def are_in_the_way(self, i: int, person_m: np.ndarray) -> bool:
        """Return whether a person with the hip at a point, (3,), would touch a bystander in frame i."""
        return any(other.at(i).gap_to_person_m(person_m) < 0.0 for other in self.others)


NO_BYSTANDERS = DressedBystanders([], [], [])


def dress_bystanders(
    others: list[Bystander], time_s: np.ndarray, target: Appearance, rng: np.random.Generator
) -> DressedBystanders:
    """Dress the bystanders: hard distractors differ from the target in one garment, the others in at least one."""
    gaits = [gait_of(other.positions_m, time_s) for other in others]
    clothes = []
    for other in others:
        looks = target
        while not target.differences(looks):
            looks = choose_look_alike(target, rng) if other.is_look_alike else choose_appearance(rng)
        clothes.append(choose_clothes(rng, looks))
    return DressedBystanders(others, gaits, clothes)


# --- figures ----------------------------------------------------------------------------------------------------------

# Lengths in this section are m, of a figure of 1.8 m, in the person's own axes: x forward, y left, z up, feet at 0. The
# figure stays within the circle around the target's box (PERSON_HALF_EXTENTS_M), to 3 mm.
HIP_SWING_RAD, ARM_SWING_RAD, KNEE_BEND_RAD = 0.25, 0.38, 0.65  # largest angles of a stride
HIP_M, KNEE_M, ANKLE_M, SHOULDER_M = 0.93, 0.50, 0.085, 1.45  # heights of joints
SIZES = {"woman": 0.96, "man": 1.0}
BREADTHS = {"woman": 0.84, "man": 1.05}
LIMB_OVERLAP = 0.6  # a limb reaches beyond its joints by this share of its radius


class Hem(NamedTuple):
    """A garment that hangs open below the waist."""

    low: float
    high: float
    ahead: float  # radius
    aside: float  # radius


HEMS = {
    "jacket": Hem(0.82, 1.12, 0.15, 0.19), "coat": Hem(0.46, 1.14, 0.22, 0.235), "skirt": Hem(0.47, 1.04, 0.24, 0.26)
}  # fmt: skip


@dataclass(frozen=True)
class PersonFigure:
    """A posed figure of k solids. Axes: world."""

    shapes: tuple[str, ...]  # k of: ball, rounded (a box), limb (thicker at its upper end), disc
    centers_m: np.ndarray  # (k, 3)
    turns: np.ndarray  # (k, 3, 3) world_from_solid
    half_m: np.ndarray  # (k, 3) half sizes in the solid's own axes
    colors: np.ndarray  # (k, 3) linear RGB


class _Solid(NamedTuple):
    """A piece of a figure that is not a limb."""

    shape: str
    center: list[float]
    half: list[float]
    color: np.ndarray
    lean_rad: float  # forward
    roll_rad: float


class _Limb(NamedTuple):
    """A piece of a figure between two points, thicker at `high`."""

    low: np.ndarray
    high: np.ndarray
    radius: float
    color: np.ndarray


@dataclass
class _Body:
    """The pieces of a figure."""

    solids: list[_Solid] = field(default_factory=list)
    limbs: list[_Limb] = field(default_factory=list)

    def solid(
        self, shape: str, center: list[float], half: list[float], color: np.ndarray, lean_rad: float = 0.0,
        roll_rad: float = 0.0,
    ) -> None:  # fmt: skip
        self.solids.append(_Solid(shape, center, half, color, lean_rad, roll_rad))

    def limb(self, low: np.ndarray, high: np.ndarray, radius: float, color: np.ndarray) -> None:
        self.limbs.append(_Limb(low, high, radius, color))

    def placed(self, feet_m: np.ndarray, heading_rad: float, size: float) -> PersonFigure:
        """Return the figure at a place. It turns all pieces at once, which is four times as fast as one by one."""
        shapes, centers, half, colors, lean, roll = zip(*self.solids, strict=True)
        # A positive pitch raises the x axis, so it leans backwards.
        turns = rotation_matrices(np.column_stack([-np.array(lean), np.zeros(len(lean)), roll]))
        limb_lows, limb_highs, limb_radii, limb_colors = (np.array(column) for column in zip(*self.limbs, strict=True))
        lengths = np.linalg.norm(limb_highs - limb_lows, axis=1)
        # Axes of a limb: z along it, x across it in the person's plane of forward and up.
        z = (limb_highs - limb_lows) / lengths[:, None]
        x = np.stack([z[:, 2], 0.0 * lengths, -z[:, 0]], axis=1) / np.hypot(z[:, 0], z[:, 2])[:, None]
        limb_turns = np.stack([x, np.cross(z, x), z], axis=2)
        limb_half = np.stack([limb_radii, limb_radii, lengths / 2.0 + LIMB_OVERLAP * limb_radii], axis=1)
        turn = rotation_matrix(0.0, heading_rad, 0.0)
        return PersonFigure(
            shapes=(*shapes, *["limb"] * len(lengths)),
            centers_m=feet_m + size * np.concatenate([centers, (limb_lows + limb_highs) / 2.0]) @ turn.T,
            turns=turn @ np.concatenate([turns, limb_turns]),
            half_m=size * np.concatenate([half, limb_half]),
            colors=np.concatenate([colors, limb_colors]),
        )


def figure_of(person: PosedPerson) -> PersonFigure:
    """Build the figure of a posed person."""
    body = _Body()
    swing = person.swing
    clothes = person.clothes
    size = SIZES[clothes.looks.figure]
    breadth = BREADTHS[clothes.looks.figure]
    sides = ((1.0, person.phase_rad), (-1.0, person.phase_rad + np.pi))  # left, right
    ankles = [_leg(body, side, phase, swing, clothes) for side, phase in sides]
    lift_m = size * (min(ankle[2] for ankle in ankles) - ANKLE_M)  # so that the lower foot is on the ground
    for side, phase in sides:
        _arm(body, breadth * side, phase, swing, clothes)
    _trunk(body, breadth, swing, clothes)
    _head(body, clothes)
    _bag(body, breadth, clothes)
    return body.placed(person.hip_m - [0.0, 0.0, TARGET_HEIGHT_M + lift_m], person.heading_rad, size)


def _swung(angle_rad: float, length: float) -> np.ndarray:
    """Return a vector that points down, turned forward by an angle."""
    return length * np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)])


def _leg(body: _Body, side: float, phase: float, swing: float, clothes: Clothes) -> np.ndarray:
    """Add thigh, shin and shoe; return the ankle."""
    hip = np.array([0.0, 0.09 * side, HIP_M])
    angle = HIP_SWING_RAD * swing * np.sin(phase)
    bend = swing * (0.12 + KNEE_BEND_RAD * max(0.0, np.cos(phase)) ** 1.5)  # the leg that swings forward is bent
    knee = hip + _swung(angle, HIP_M - KNEE_M)
    ankle = knee + _swung(angle - bend, KNEE_M - ANKLE_M)
    legs = clothes.looks.legs
    cloth = clothes.color("legs")
    body.limb(knee, hip, 0.088, clothes.skin if legs == "skirt" else cloth)
    body.limb(ankle - [0, 0, 0.02], knee, 0.066, cloth if legs == "trousers" else clothes.skin)
    toe = 0.5 * (angle - bend)
    center = ankle + np.array([0.048 * np.cos(toe), 0.0, -0.043 + 0.048 * np.sin(toe)])
    body.solid("rounded", center.tolist(), [0.115, 0.048, 0.042], clothes.shoes, lean_rad=-toe)
    return ankle


def _arm(body: _Body, side: float, phase: float, swing: float, clothes: Clothes) -> None:
    shoulder = np.array([0.0, 0.205 * side, SHOULDER_M - 0.03])
    angle = -ARM_SWING_RAD * swing * np.sin(phase)
    elbow = shoulder + _swung(angle, 0.29) + [0.0, 0.025 * side, 0.0]
    wrist = elbow + _swung(angle + 0.18 + 0.3 * swing, 0.25)
    is_bare = clothes.looks.top == "t_shirt"
    body.limb(elbow, shoulder, 0.058, clothes.color("top"))
    body.limb(wrist, elbow, 0.041 if is_bare else 0.055, clothes.skin if is_bare else clothes.color("top"))
    body.solid("ball", (wrist + np.array([0.01, 0, -0.05])).tolist(), [0.04, 0.03, 0.065], clothes.skin)


def _trunk(body: _Body, breadth: float, swing: float, clothes: Clothes) -> None:
    lean = 0.03 * swing
    top = clothes.color("top")
    covered = top if clothes.looks.top in HEMS else clothes.color("legs")
    body.solid("rounded", [0.0, 0.0, 0.95], [0.115, 0.165, 0.12], covered)
    body.solid("limb", [0.01, 0.0, 1.22], [0.125, 0.195 * breadth, 0.29], top, lean_rad=lean)
    body.solid("ball", [0.015, 0.0, 1.42], [0.10, 0.205 * breadth, 0.085], top, lean_rad=lean)
    for slot in ("top", "legs"):
        hem = HEMS.get(getattr(clothes.looks, slot))
        if hem is not None:
            center = [0.0, 0.0, (hem.low + hem.high) / 2.0]
            half = [hem.ahead, hem.aside, (hem.high - hem.low) / 2.0]
            body.solid("limb", center, half, clothes.color(slot), lean_rad=np.pi)  # wider at its lower end


def _head(body: _Body, clothes: Clothes) -> None:
    hat = clothes.looks.hat
    skin = clothes.skin
    hair = clothes.hair
    body.limb(np.array([0.01, 0.0, 1.46]), np.array([0.025, 0.0, 1.60]), 0.055, skin)
    body.solid("ball", [0.035, 0.0, 1.665], [0.10, 0.078, 0.125], skin)
    body.solid("ball", [0.008, 0.0, 1.68 if hat else 1.70], [0.105, 0.088, 0.10], hair)
    body.solid("ball", [0.132, 0.0, 1.65], [0.02, 0.016, 0.025], skin)
    if clothes.looks.figure == "woman":
        body.solid("ball", [-0.055, 0.0, 1.55], [0.075, 0.105, 0.20], hair)
    if hat:
        color = clothes.color("hat")
        body.solid("ball", [0.01, 0.0, 1.70], [0.118, 0.102, 0.10], color)
        if hat == "cap":
            body.solid("rounded", [0.14, 0.0, 1.70], [0.085, 0.075, 0.012], color, lean_rad=0.15)
        else:
            body.solid("disc", [0.01, 0.0, 1.69], [0.235, 0.225, 0.012], color)


def _bag(body: _Body, breadth: float, clothes: Clothes) -> None:
    bag = clothes.looks.bag
    if bag == "backpack":  # with two straps
        body.solid("rounded", [-0.205, 0.0, 1.24], [0.10, 0.155, 0.22], clothes.color("bag"))
        for side in (-1.0, 1.0):
            body.solid("rounded", [0.0, 0.11 * breadth * side, 1.33], [0.145, 0.025, 0.17], clothes.color("bag"))
    elif bag:  # at the right hip, with a strap across the chest
        body.solid("rounded", [0.0, -0.285, 0.88], [0.15, 0.075, 0.12], clothes.color("bag"))
        body.solid("rounded", [0.0, -0.05, 1.21], [0.15, 0.025, 0.33], clothes.color("bag"), roll_rad=-0.58)
