"""What people look like, in words and in colour: the wardrobe that walkers are dressed from.

A garment or colour is one row. Renderers draw what the rows say, a goal in words says it in both languages, and two
people look alike where their rows do.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

import numpy as np

from cosfly.formats.captions import Language

Words = dict[Language, str]


def _words(en: str, zh: str) -> Words:
    return {"en": en, "zh": zh}


# Linear RGB as a renderer takes it. So far apart that in any daylight each is seen as what it is called.
COLORS: dict[str, tuple[Words, tuple[float, float, float]]] = {
    "red": (_words("red", "红色"), (0.55, 0.02, 0.02)),
    "orange": (_words("orange", "橙色"), (0.75, 0.21, 0.01)),
    "yellow": (_words("yellow", "黄色"), (0.75, 0.55, 0.02)),
    "green": (_words("green", "绿色"), (0.02, 0.28, 0.06)),
    "blue": (_words("blue", "蓝色"), (0.02, 0.10, 0.50)),
    "purple": (_words("purple", "紫色"), (0.22, 0.03, 0.34)),
    "pink": (_words("pink", "粉色"), (0.75, 0.24, 0.38)),
    "brown": (_words("brown", "棕色"), (0.16, 0.07, 0.03)),
    "white": (_words("white", "白色"), (0.75, 0.75, 0.72)),
    "grey": (_words("grey", "灰色"), (0.18, 0.18, 0.19)),
    "black": (_words("black", "黑色"), (0.012, 0.012, 0.014)),
}

# Slot -> what may be worn there, in words. "" is nothing: a bare head, no bag.
GARMENTS: dict[str, dict[str, Words]] = {
    "top": {
        "t_shirt": _words("T-shirt", "T恤"),
        "jacket": _words("jacket", "夹克"),
        "coat": _words("long coat", "长大衣"),
    },
    "legs": {
        "trousers": _words("trousers", "长裤"),
        "shorts": _words("shorts", "短裤"),
        "skirt": _words("skirt", "裙子"),
    },
    "hat": {"": _words("", ""), "cap": _words("cap", "鸭舌帽"), "brim": _words("wide hat", "宽檐帽")},
    "bag": {"": _words("", ""), "backpack": _words("backpack", "背包"), "shoulder": _words("shoulder bag", "挎包")},
}
FIGURES: dict[str, Words] = {"woman": _words("woman", "女子"), "man": _words("man", "男子")}
EMPTY_SHARE = {"hat": 0.6, "bag": 0.4}  # of people, who have none
HAIR = ("brown", "grey", "black")  # a cap of such a colour is taken for hair from the air: no hat has it


@dataclass(frozen=True)
class Appearance:
    """What one person looks like: names of the rows above; the colour of what is not worn is "".

    figure: woman (slighter, long hair) or man (broader, short hair).
    """

    figure: str
    top: str
    top_color: str
    legs: str
    legs_color: str
    hat: str = ""
    hat_color: str = ""
    bag: str = ""
    bag_color: str = ""

    @property
    def is_all_seen(self) -> bool:
        """Whether each thing worn can be seen: a long coat leaves nothing of shorts or a skirt."""
        return self.top != "coat" or self.legs == "trousers"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value not in (rows := _rows(name, vars(self))):
                raise ValueError(f"{name} must be one of {', '.join(map(repr, rows))}")

    def differences(self, other: Appearance) -> tuple[str, ...]:
        """Name the fields that tell two people apart; empty where they look alike. A garment counts once."""
        slots = ("figure", *GARMENTS)
        mine, theirs = asdict(self), asdict(other)
        return tuple(
            slot for slot in slots
            if (mine[slot], mine.get(f"{slot}_color")) != (theirs[slot], theirs.get(f"{slot}_color"))
        )  # fmt: skip


@dataclass(frozen=True)
class People:
    """What the people of one flight look like: the target, and by instance id whoever else walks about."""

    target: Appearance
    others: dict[int, Appearance]

    def most_alike(self, numbers: Iterable[int]) -> tuple[int, int] | tuple[None, None]:
        """Return who of some others looks most like the target, the greatest id of several, and in how many things that
        one differs; nobody of nobody."""
        differing = [(len(self.target.differences(self.others[number])), -number) for number in numbers]
        if not differing:
            return None, None
        num_differences, number = min(differing)
        return -number, num_differences


def _rows(name: str, record: dict) -> tuple[str, ...]:
    if name == "figure":
        return tuple(FIGURES)
    if name in GARMENTS:
        return tuple(GARMENTS[name])
    return tuple(COLORS) if record.get(name.removesuffix("_color")) else ("",)


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
