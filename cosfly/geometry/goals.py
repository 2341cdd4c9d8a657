"""A goal in words: the shortest description that, of all people in a picture, only the target satisfies.

A description is a tuple of slots of clothing and relations (SIDES). It is measured: clothing comes from the records,
positions from ids and depth of the picture. `meant` computes from the same data whom a goal describes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.frames import PERSON_ID
from cosfly.formats.people import COLORS, FIGURES, GARMENTS, Appearance, Words

# Slots of clothing, large ones first: Chinese verb for wearing it; English and Chinese words for an empty slot.
SLOTS = {"top": ("穿",), "legs": ("穿",), "bag": ("背", "no bag", "不带包"), "hat": ("戴", "no hat", "不戴帽子")}
# Relations to other people: words; sign of the value that is least for the target; least margin, as a share of the
# picture's width or m from the camera.
SIDES = {
    "left": ("leftmost", "最左边的", 1.0, 0.05), "right": ("rightmost", "最右边的", -1.0, 0.05),
    "near": ("nearest", "离镜头最近的", 1.0, 1.0), "far": ("farthest", "离镜头最远的", -1.0, 1.0),
}  # fmt: skip
PICTURE_PX = 160  # least longer side of a target picture
ROOM_SHARE, ROOM_PX = 0.25, 8  # room around the person in it, the larger of both: share of the box's longer side, px
_WITH = (("in", ("top", "legs")), ("with", ("bag", "hat")))


@dataclass(frozen=True)
class SeenFrame:
    """A frame in numbers: the instance ids and the depth, (h, w) m, of its pixels."""

    ids: np.ndarray
    depth: np.ndarray

    def column_share(self, number: int) -> float:
        """Return the mean column of a person's pixels as a share of the picture's width."""
        return float(np.nonzero(self.ids == number)[1].mean()) / self.ids.shape[1]

    def depth_m(self, number: int) -> float:
        """Return the median depth of a person's pixels, m."""
        return float(np.median(self.depth[self.ids == number]))


def meant(says: Iterable[str], looks: Appearance, people: Mapping[int, Appearance], picture: SeenFrame) -> set[int]:
    """Return the instance ids of the people that a description fits.

    says: the description. looks: appearance for its slots. people: appearance by instance id.
    """
    slots = {*says} - {*SIDES}
    fitting = {
        number
        for number, person in people.items()
        if not slots & {*looks.differences(person)} and (picture.ids == number).any()
    }
    for relation in {*says} - slots:
        fitting = {number for number, excess in _excess(relation, fitting, picture).items() if excess <= 0.0}
    return fitting


def _excess(relation: str, numbers: Collection[int], picture: SeenFrame) -> dict[int, float]:
    """Return how far each person is from fulfilling a relation, m or shares of the width; 0 or less where it holds."""
    measure = picture.depth_m if relation in ("near", "far") else picture.column_share
    sign = SIDES[relation][2]
    values = {number: sign * measure(number) for number in numbers}
    return {number: value - min(values.values()) for number, value in values.items()}


def find_says(
    people: Mapping[int, Appearance], picture: SeenFrame, tells: Callable[[str, Appearance], bool],
    shows: Callable[[str, int], bool] = lambda slot, number: True,
) -> tuple[str, ...] | None:  # fmt: skip
    """Find the shortest description that only the target (PERSON_ID) fits in a picture; None if there is none.

    tells: (slot, appearance) -> whether the picture shows that the target does not look like that in the slot. shows:
    (slot, id) -> whether it shows that this other person does not look like the target in the slot.
    """
    looks = people[PERSON_ID]
    rivals = {
        number: person for number, person in people.items() if number != PERSON_ID and (picture.ids == number).any()
    }
    noun = ("figure",) if tells("figure", otherwise(looks, "figure")) else ()
    best_says: tuple[str, ...] | None = None
    best_rivals: set[int] = set()  # rivals that the best description fits too
    for chosen in (slots for size in range(1, len(SLOTS) + 1) for slots in combinations(SLOTS, size)):
        says = (*noun, *chosen)
        differing = {number: {*says} & {*looks.differences(person)} for number, person in rivals.items()}
        num_equal = sum(not slots for slots in differing.values())
        if best_says is not None and num_equal >= len(best_rivals):
            continue  # it cannot be better; `tells` renders pictures
        if all(tells(slot, otherwise(looks, slot)) for slot in chosen):
            confused = {
                number
                for number, slots in differing.items()
                if not any(tells(slot, rivals[number]) and shows(slot, number) for slot in slots)
            }
            if best_says is None or len(confused) < len(best_rivals):
                best_says = says
                best_rivals = confused
    if best_says is None or not best_rivals:
        return best_says
    for relation, (_, _, _, margin) in SIDES.items():
        excess = _excess(relation, {PERSON_ID, *best_rivals}, picture)
        target_excess = excess.pop(PERSON_ID)
        if target_excess <= 0.0 and min(excess.values()) >= margin:
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
    side_en, side_zh, *_ = next((SIDES[name] for name in says if name in SIDES), ("", ""))

    def worn(slot: str, language: Language) -> str:
        verb, *bare = SLOTS[slot]
        if not (color := getattr(looks, f"{slot}_color")):
            return bare[language == "zh"]
        color_word = COLORS[color][0][language]
        garment = GARMENTS[slot][getattr(looks, slot)][language]
        return f"the {color_word} {garment}" if language == "en" else verb + color_word + garment

    lists = [(word, [worn(slot, "en") for slot in slots if slot in says]) for word, slots in _WITH]
    phrases = [f"{word} {' and '.join(garments)}" for word, garments in lists if garments]
    en = " ".join(filter(None, ("the", side_en, noun["en"], *phrases)))
    phrases_zh = [worn(slot, "zh") for slot in SLOTS if slot in says]
    return {"en": en, "zh": f"{side_zh}{'、'.join(phrases_zh)}的{noun['zh']}"}


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
