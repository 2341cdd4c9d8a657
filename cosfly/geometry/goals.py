"""A goal in words: the shortest description that, of all people in a picture, only the target satisfies.

What it says is measured: garments as on record, places from ids, kinds and depth of the picture. So whoever has these
can tell of whom a goal is true (`meant`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.frames import PERSON_ID
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import COLORS, FIGURES, GARMENTS, Appearance, Words

# What is large is said first. Slot -> how Chinese says that it is worn; what both languages say of nothing there.
SLOTS = {"top": ("穿",), "legs": ("穿",), "bag": ("背", "no bag", "不带包"), "hat": ("戴", "no hat", "不戴帽子")}
# Of whom the value is least, with a sign, and by how much it must be: of the picture's width, m from the camera.
SIDES = {
    "left": ("leftmost", "最左边的", 1.0, 0.05), "right": ("rightmost", "最右边的", -1.0, 0.05),
    "near": ("nearest", "离镜头最近的", 1.0, 1.0), "far": ("farthest", "离镜头最远的", -1.0, 1.0),
}  # fmt: skip
# What people stand by, and how high over somebody's middle what is seen of it must be: of plants trees alone.
LANDMARKS = {
    "Vegetation": ("tree", "树", 1.0), "Poles": ("post", "杆子", -np.inf), "Car": ("car", "汽车", -np.inf),
    "TrafficLight": ("traffic light", "红绿灯", -np.inf), "Fences": ("fence", "栅栏", -np.inf),
    "Buildings": ("building", "建筑", -np.inf),
}  # fmt: skip
PICTURE_PX, ROOM_SHARE, ROOM_PX = 160, 0.25, 8  # of a target picture: longer side at least; room round a person
_WITH = (("in", ("top", "legs")), ("with", ("bag", "hat")))
BY_M, BY_MARGIN_M = 4.0, 2.0  # who is as near as this is by something; who is not is so much farther


@dataclass(frozen=True)
class SeenFrame:
    """A frame in numbers. kinds, ids, depth: (h, w), m; intrinsic: (3, 3) px; rotation: (3, 3), world from camera."""

    kinds: np.ndarray
    ids: np.ndarray
    depth: np.ndarray
    intrinsic: np.ndarray
    rotation: np.ndarray

    def column_share(self, number: int) -> float:
        """Return the mean column of a person's pixels as a share of the picture's width."""
        return float(np.nonzero(self.ids == number)[1].mean()) / self.ids.shape[1]

    def depth_m(self, number: int) -> float:
        """Return the median depth of a person's pixels, m."""
        return float(np.median(self.depth[self.ids == number]))

    def place_m(self, number: int) -> np.ndarray:
        """Return the median place of a person's pixels, (3,) m, from the camera along the world axes."""
        return np.median(self._points_m(self.ids == number), axis=0)

    def distance_m(self, number: int, kind: str) -> float:
        """Return the distance over ground from a person to visible pixels of a kind, m; infinity without any."""
        x, y, z = self.place_m(number)
        points = self._points_m(self.kinds == KINDS[kind])
        points = points[points[:, 2] >= z + LANDMARKS[kind][2]]
        return float(np.hypot(points[:, 0] - x, points[:, 1] - y).min(initial=np.inf))

    def _points_m(self, mask: np.ndarray) -> np.ndarray:
        """Points of pixels, (n, 3), from the camera in the world's directions."""
        rows, columns = np.nonzero(mask)
        rays = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]) @ np.linalg.inv(self.intrinsic).T
        return (rays * self.depth[mask][:, None]) @ self.rotation.T


def meant(says: Iterable[str], looks: Appearance, people: Mapping[int, Appearance], picture: SeenFrame) -> set[int]:
    """Return the people that a description fits. looks: slots of the description. people: by instance id."""
    slots = {*says} - {*SIDES, *LANDMARKS}
    found = {n for n, one in people.items() if not slots & {*looks.differences(one)} and (picture.ids == n).any()}
    for relation in {*says} - slots:
        found = {n for n, off in _off(relation, found, picture).items() if off <= 0.0}
    return found


def _off(relation: str, numbers: Collection[int], picture: SeenFrame) -> dict[int, float]:
    """Return how far people are from a relation, not above 0 where it holds: m, or shares of the picture's width."""
    if relation in LANDMARKS:
        return {n: picture.distance_m(n, relation) - BY_M for n in numbers}
    measure, sign = picture.depth_m if relation in ("near", "far") else picture.column_share, SIDES[relation][2]
    where = {n: sign * measure(n) for n in numbers}
    return {n: one - min(where.values()) for n, one in where.items()}


def find_says(
    people: Mapping[int, Appearance], picture: SeenFrame, tells: Callable[[str, Appearance], bool]
) -> tuple[str, ...] | None:
    """Find the least that tells the target (PERSON_ID) from all others in a picture; None where nothing does.

    Args:
        tells: whether the picture shows that the target does not look so in that slot.
    """
    looks, best = people[PERSON_ID], None
    rivals = {n: one for n, one in people.items() if n != PERSON_ID and (picture.ids == n).any()}
    noun = ("figure",) if tells("figure", otherwise(looks, "figure")) else ()
    for chosen in (c for size in range(1, len(SLOTS) + 1) for c in combinations(SLOTS, size)):
        says = (*noun, *chosen)
        differing = {n: {*says} & {*looks.differences(one)} for n, one in rivals.items()}
        if best is not None and sum(not slots for slots in differing.values()) >= len(best[0]):
            continue  # before anything is drawn
        if all(tells(slot, otherwise(looks, slot)) for slot in chosen):
            left = {n for n, slots in differing.items() if not any(tells(slot, rivals[n]) for slot in slots)}
            best = (left, says) if best is None or len(left) < len(best[0]) else best
    if best is None or not best[0]:
        return best and best[1]
    for relation in (*SIDES, *LANDMARKS):
        off = _off(relation, {PERSON_ID, *best[0]}, picture)
        own, margin = off.pop(PERSON_ID), SIDES[relation][3] if relation in SIDES else BY_MARGIN_M
        if own <= 0.0 and min(off.values()) >= max(own + margin, 1e-9):
            return (*best[1], relation)
    return None


def otherwise(looks: Appearance, slot: str) -> Appearance:
    """Return the same person without what is in a slot, or in another colour."""
    if slot == "figure":
        return replace(looks, figure=next(one for one in FIGURES if one != looks.figure))
    worn, colors = getattr(looks, slot), list(COLORS)
    if "" in GARMENTS[slot]:
        bare = {slot: "", f"{slot}_color": ""}
        return replace(looks, **bare if worn else {slot: list(GARMENTS[slot])[1], f"{slot}_color": colors[0]})
    return replace(looks, **{f"{slot}_color": colors[colors.index(getattr(looks, f"{slot}_color")) - len(colors) // 2]})


def words_of(says: Sequence[str], looks: Appearance) -> Words:
    """Return the description in both languages."""
    noun = FIGURES[looks.figure] if "figure" in says else {"en": "person", "zh": "行人"}
    side = next((SIDES[one] for one in says if one in SIDES), ("", "", 0.0, 0.0))
    mark = next((LANDMARKS[one] for one in says if one in LANDMARKS), ("", "", 0.0))

    def worn(slot: str, language: Language) -> str:
        verb, *bare = SLOTS[slot]
        if not (color := getattr(looks, f"{slot}_color")):
            return bare[language == "zh"]
        words = COLORS[color][0][language], GARMENTS[slot][getattr(looks, slot)][language]
        return f"the {words[0]} {words[1]}" if language == "en" else verb + "".join(words)

    lists = [(word, [worn(slot, "en") for slot in slots if slot in says]) for word, slots in _WITH]
    texts = [f"{word} {' and '.join(found)}" for word, found in lists if found]
    en = " ".join(filter(None, ("the", side[0], noun["en"], *texts))) + (f", by a {mark[0]}" if mark[0] else "")
    texts = [f"在{mark[1]}旁边"] * bool(mark[0]) + [worn(slot, "zh") for slot in SLOTS if slot in says]
    return {"en": en, "zh": f"{side[1]}{'、'.join(texts)}的{noun['zh']}"}


def target_picture(rgb: np.ndarray, box: list[float]) -> np.ndarray:
    """Cut a person out of a frame, (h, w, 3) uint8, with room around, and enlarge it where it is small.

    Args:
        box: xmin, ymin, xmax, ymax px.
    """
    center, side = np.array([box[1] + box[3], box[0] + box[2]]) / 2.0, max(box[2] - box[0], box[3] - box[1])
    half = side / 2.0 + max(ROOM_SHARE * side, ROOM_PX)
    (top, left), (bottom, right) = np.maximum(center - half, 0).astype(int), np.ceil(center + half).astype(int)
    cut = rgb[top:bottom, left:right]
    factor = max(1.0, PICTURE_PX / max(cut.shape[:2]))
    return cv2.resize(cut, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
