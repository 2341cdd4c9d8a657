"""The others of one flight as renderers are given them, frame by frame, and what a frame's annotation tells of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.products.frames import OtherMeta, OthersMeta, tree_position, tree_yaw
from cosfly.products.others import Other, distances_to_boxes_m
from cosfly.render.contract import Clothes, Frame, PosedCar, PosedOther, PosedPerson, other_id
from cosfly.render.person import Gait, choose_clothes, gait_of

SHARE_DIGITS = 6


@dataclass(frozen=True)
class Cast:
    """Everybody beside the target in one flight; gaits and clothes of those who walk, a seed for the paint of each."""

    others: list[Other]
    gaits: list[Gait]
    clothes: list[Clothes]
    seeds: np.ndarray

    def __len__(self) -> int:
        return len(self.others)

    def posed(self, i: int) -> list[PosedOther]:
        """All of them in frame i."""
        return [PosedOther(other_id(number), self._body(number, i)) for number in range(len(self))]

    def _body(self, number: int, i: int) -> PosedPerson | PosedCar:
        other = self.others[number]
        center_m = other.centers_m[i]
        if other.kind == "Pedestrians":
            return self.gaits[number].posed(i, center_m, self.clothes[number])
        return PosedCar(center_m, float(other.headings_rad[i]), other.build.half_extents_m, float(self.seeds[number]))

    def meta(self, i: int, frame: Frame, hidden_by_others: float, hidden_by_map: float) -> OthersMeta:
        """What the annotation of frame i says of them."""
        pixels = np.bincount(frame.ids.ravel(), minlength=other_id(0) + 1)
        lines = [
            OtherMeta(
                instance_id=other_id(number),
                semantic_id=other.kind_number,
                world_location=tree_position(other.centers_m[i]),
                yaw=tree_yaw(float(np.degrees(other.headings_rad[i]))),
                half_extents_m=other.build.half_extents_m,
                num_pixels=int(pixels[other_id(number)]),
            )
            for number, other in enumerate(self.others)
        ]
        return OthersMeta(
            target_hidden_by_others=round(hidden_by_others, SHARE_DIGITS),
            target_hidden_by_map=round(hidden_by_map, SHARE_DIGITS),
            others=lines,
        )

    def distance_m(self, i: int, point_m: np.ndarray) -> float:
        """From a point, (3,), to the nearest box of frame i; infinity without others."""
        return min((float(distances_to_boxes_m(point_m, other.at(i))[0]) for other in self.others), default=np.inf)

    def are_in_the_way(self, i: int, person_m: np.ndarray) -> bool:
        """Tell whether a person at a hip point, (3,), would touch somebody."""
        return any(other.at(i).gap_to_person_m(person_m) < 0.0 for other in self.others)


NOBODY = Cast([], [], [], np.empty(0))


def cast_of(others: list[Other], time_s: np.ndarray, rng: np.random.Generator) -> Cast:
    """Dress the others of a flight at times (n,)."""
    gaits = [gait_of(other.positions_m, time_s) for other in others]
    return Cast(others, gaits, [choose_clothes(rng) for _ in others], rng.random(len(others)))
