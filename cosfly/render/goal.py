"""The goal of a drawn flight: whom its pictures tell from all others, tried by drawing the target otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from cosfly.products.goals import Goal, SeenFrame, find_says, otherwise, words_of
from cosfly.products.people import Appearance, People
from cosfly.render.contract import PERSON_ID, Frame

MOST_TRIED = 8  # frames of a flight, the first in which the target is legible
# Two looks are told apart by so many pixels, and such a share of a person's, of so much colour difference (CIE76).
TOLD_PX, TOLD_SHARE, TOLD_CONTRAST = 8, 0.04, 10.0


def find_goal(
    people: People, i: int, draw: Callable[[Appearance], Frame], intrinsic: np.ndarray, rotation: np.ndarray
) -> Goal | None:
    """Find what tells the target of frame i from the others that have a pixel in it.

    Args:
        draw: the frame with a target of that look. intrinsic: (3, 3) px. rotation: (3, 3), world from camera.
    """
    looks, frame = people.target, draw(people.target)

    @cache
    def differs(other: Appearance) -> bool:
        return are_told_apart(frame, draw(other))

    def tells(slot: str, other: Appearance) -> bool:
        if slot == "figure":
            return differs(replace(looks, figure=other.figure))
        kept, worn = ((getattr(one, slot), getattr(one, f"{slot}_color")) for one in (looks, other))
        if kept[1] and worn[1] and kept[1] != worn[1]:  # the wardrobe's colours are told apart where they are seen
            other = otherwise(looks, slot)
        return differs(replace(looks, **{name: getattr(other, name) for name in (slot, f"{slot}_color")}))

    seen = SeenFrame(frame.kinds, frame.ids, frame.depth, intrinsic, rotation)
    says = find_says({PERSON_ID: looks, **people.others}, seen, tells)
    return None if says is None else Goal(i, **words_of(says, looks), says=says)


def are_told_apart(frame: Frame, other: Frame) -> bool:
    """Tell whether the target of two frames that differ in its look alone is another one to the eye."""
    is_person = (frame.ids == PERSON_ID) | (other.ids == PERSON_ID)
    colors = [cv2.cvtColor(one.rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[is_person] for one in (frame, other)]
    num_px = np.count_nonzero(np.linalg.norm(colors[0] - colors[1], axis=-1) >= TOLD_CONTRAST)
    return bool(num_px >= max(TOLD_PX, TOLD_SHARE * np.count_nonzero(is_person)))
