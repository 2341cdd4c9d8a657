"""People and cars of a trajectory as renderers draw them: gait along the path, clothes, poses of bystanders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosfly.formats.bystanders import Bystander
from cosfly.formats.frames import BystanderMeta, BystandersMeta, tree_yaw
from cosfly.formats.people import COLORS, EMPTY_SHARE, FIGURES, GARMENTS, HAIR, Appearance, People
from cosfly.geometry.axes import headings_of
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
    """Draw somebody who looks like a person but for one garment or its colour."""
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
        walking = (number for number, other in enumerate(self.others) if other.kind == "Pedestrians")
        return People(target, {other_id(number): self.clothes[number].looks for number in walking})

    def posed(self, i: int) -> list[PosedBystander]:
        """Return all bystanders in frame i."""
        found = []
        for number, other in enumerate(self.others):
            center_m, half_m = other.centers_m[i], other.build.half_extents_m
            body: PosedPerson | PosedCar = self.gaits[number].posed(i, center_m, self.clothes[number])
            if other.kind != "Pedestrians":
                body = PosedCar(center_m, float(other.headings_rad[i]), half_m, float(self.seeds[number]))
            found.append(PosedBystander(other_id(number), body))
        return found

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
    """Dress the bystanders: hard distractors differ from the target in one garment, everybody in at least one."""
    gaits, clothes = [gait_of(other.positions_m, time_s) for other in others], []
    for other in others:
        looks = target
        while not target.differences(looks):
            looks = look_alike(target, rng) if other.is_look_alike else draw_appearance(rng)
        clothes.append(choose_clothes(rng, looks))
    return DressedBystanders(others, gaits, clothes, rng.random(len(others)))
