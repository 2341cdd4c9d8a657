"""A goal in words: the shortest description that, of all people in a picture, only the target satisfies.

A description is a tuple of slots of clothing and relations (SIDES). It is measured: clothing comes from the records,
positions from ids and depth of the picture. `meant` computes from the same data whom a goal describes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import NamedTuple

import cv2
import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.frames import PERSON_ID
from cosfly.formats.people import COLORS, FIGURES, GARMENTS, Appearance, Words


class ClothingSlot(NamedTuple):
    """The words for a slot of clothing."""

    preposition: str  # "in the red coat"
    verb_zh: str  # for wearing it
    none: Words | None = None  # for an empty slot; top and legs are never empty


class Relation(NamedTuple):
    """A relation of the target to all others: it has the least, or the greatest, depth or column of the picture."""

    words: Words
    sign: float  # of the value that is least for the target
    margin: float  # least difference from the others: m of depth, or a share of the picture's width
    is_depth: bool


SLOTS = {  # large garments first
    "top": ClothingSlot("in", "穿"),
    "legs": ClothingSlot("in", "穿"),
    "bag": ClothingSlot("with", "背", {"en": "no bag", "zh": "不带包"}),
    "hat": ClothingSlot("with", "戴", {"en": "no hat", "zh": "不戴帽子"}),
}
SIDES = {
    "left": Relation({"en": "leftmost", "zh": "最左边的"}, 1.0, 0.05, is_depth=False),
    "right": Relation({"en": "rightmost", "zh": "最右边的"}, -1.0, 0.05, is_depth=False),
    "near": Relation({"en": "nearest", "zh": "离镜头最近的"}, 1.0, 1.0, is_depth=True),
    "far": Relation({"en": "farthest", "zh": "离镜头最远的"}, -1.0, 1.0, is_depth=True),
}
PICTURE_PX = 160  # least longer side of a target picture
ROOM_SHARE, ROOM_PX = 0.25, 8  # room around the person in it, the larger of both: share of the box's longer side, px


@dataclass(frozen=True)
class SeenFrame:
    """A frame in numbers."""

    ids: np.ndarray  # (h, w) instance ids
    depth: np.ndarray  # (h, w) m

    def shows(self, person_id: int) -> bool:
        return bool((self.ids == person_id).any())

    def column_share(self, person_id: int) -> float:
        """Return the mean column of a person's pixels as a share of the picture's width."""
        return float(np.nonzero(self.ids == person_id)[1].mean()) / self.ids.shape[1]

    def depth_m(self, person_id: int) -> float:
        """Return the median depth of a person's pixels, m."""
        return float(np.median(self.depth[self.ids == person_id]))


def meant(says: Iterable[str], looks: Appearance, people: Mapping[int, Appearance], picture: SeenFrame) -> set[int]:
    """Return the instance ids of the people that a description fits.

    Args:
        says: The description.
        looks: The appearance that its slots describe.
        people: Appearance by instance id.
    """
    slots = {*says} - {*SIDES}
    fitting = set()
    for person_id, person in people.items():
        if picture.shows(person_id) and slots.isdisjoint(looks.differences(person)):
            fitting.add(person_id)
    for relation in {*says} - slots:
        fitting = {person_id for person_id, excess in _excess(relation, fitting, picture).items() if excess <= 0.0}
    return fitting


def _excess(relation: str, person_ids: Collection[int], picture: SeenFrame) -> dict[int, float]:
    """Return how far each person is from fulfilling a relation, m or shares of the width; 0 for who fulfils it."""
    side = SIDES[relation]
    measure = picture.depth_m if side.is_depth else picture.column_share
    values = {person_id: side.sign * measure(person_id) for person_id in person_ids}
    return {person_id: value - min(values.values()) for person_id, value in values.items()}


def find_says(
    people: Mapping[int, Appearance], picture: SeenFrame, target_differs: Callable[[str, Appearance], bool],
    rival_differs: Callable[[str, int], bool] = lambda slot, person_id: True,
) -> tuple[str, ...] | None:  # fmt: skip
    """Find the shortest description that only the target (PERSON_ID) fits in a picture; None if there is none.

    A relation is added only if clothing alone fits others too.

    Args:
        people: Appearance by instance id.
        target_differs: Whether the picture shows that the target does not look like an appearance in a slot.
        rival_differs: Whether it shows that a person, by instance id, does not look like the target in a slot.
    """
    looks = people[PERSON_ID]
    rivals = {
        person_id: person for person_id, person in people.items() if person_id != PERSON_ID and picture.shows(person_id)
    }
    noun = ("figure",) if target_differs("figure", otherwise(looks, "figure")) else ()
    best_says: tuple[str, ...] | None = None
    best_rivals: set[int] = set()  # rivals that the best description fits too
    for chosen in chain.from_iterable(combinations(SLOTS, size) for size in range(1, len(SLOTS) + 1)):
        says = (*noun, *chosen)
        differing = {person_id: {*says} & {*looks.differences(person)} for person_id, person in rivals.items()}
        num_equal = sum(not slots for slots in differing.values())
        if best_says is not None and num_equal >= len(best_rivals):
            continue  # it cannot be better; `target_differs` renders pictures
        if not all(target_differs(slot, otherwise(looks, slot)) for slot in chosen):
            continue
        confused = set()
        for person_id, slots in differing.items():
            if not any(target_differs(slot, rivals[person_id]) and rival_differs(slot, person_id) for slot in slots):
                confused.add(person_id)
        if best_says is None or len(confused) < len(best_rivals):
            best_says = says
            best_rivals = confused
    if best_says is None or not best_rivals:
        return best_says
    for relation, side in SIDES.items():
        excess = _excess(relation, {PERSON_ID, *best_rivals}, picture)
        target_excess = excess.pop(PERSON_ID)
        if target_excess <= 0.0 and min(excess.values()) >= side.margin:
            return (*best_says, relation)
    return None


def otherwise(looks: Appearance, slot: str) -> Appearance:
    """Return an appearance that differs in one slot: without the garment, with one, or in another colour."""
    if slot == "figure":
        return replace(looks, figure=next(figure for figure in FIGURES if figure != looks.figure))
    colors = list(COLORS)
    color_field = f"{slot}_color"
    if "" not in GARMENTS[slot]:  # the slot is never empty
        color = colors[colors.index(getattr(looks, color_field)) - len(colors) // 2]
        return replace(looks, **{color_field: color})
    if getattr(looks, slot):
        return replace(looks, **{slot: "", color_field: ""})
    return replace(looks, **{slot: list(GARMENTS[slot])[1], color_field: colors[0]})


def words_of(says: Sequence[str], looks: Appearance) -> Words:
    """Return the description in both languages."""
    noun = FIGURES[looks.figure] if "figure" in says else {"en": "person", "zh": "行人"}
    side: Words = {"en": "", "zh": ""}
    for name in says:
        if name in SIDES:
            side = SIDES[name].words
            break

    def worn(slot: str, language: Language) -> str:
        color = getattr(looks, f"{slot}_color")
        words_for_none = SLOTS[slot].none
        if not color and words_for_none:
            return words_for_none[language]
        color_word = COLORS[color][0][language]
        garment = GARMENTS[slot][getattr(looks, slot)][language]
        return f"the {color_word} {garment}" if language == "en" else SLOTS[slot].verb_zh + color_word + garment

    phrases = []
    described = [name for name in SLOTS if name in says]
    for preposition in ("in", "with"):
        garments = [worn(slot, "en") for slot in described if SLOTS[slot].preposition == preposition]
        if garments:
            phrases.append(f"{preposition} {' and '.join(garments)}")
    en = " ".join(filter(None, ("the", side["en"], noun["en"], *phrases)))
    zh = "、".join(worn(slot, "zh") for slot in described)
    return {"en": en, "zh": f"{side['zh']}{zh}的{noun['zh']}"}


def target_picture(rgb: np.ndarray, box: list[float]) -> np.ndarray:
    """Cut a person out of a frame, (h, w, 3) uint8, with room around, and enlarge it where it is small.

    box: xmin, ymin, xmax, ymax px.
    """
    center = np.array([box[1] + box[3], box[0] + box[2]]) / 2.0
    side = max(box[2] - box[0], box[3] - box[1])
    half = side / 2.0 + max(ROOM_SHARE * side, ROOM_PX)
    top, left = np.maximum(center - half, 0).astype(int)
    bottom, right = np.ceil(center + half).astype(int)
    cut = rgb[top:bottom, left:right]
    factor = max(1.0, PICTURE_PX / max(cut.shape[:2]))
    return cv2.resize(cut, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
