"""Appearance of people and the goal, `people` and `goal` of `trajectory.json`: the wardrobe in words and colours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import validated

Words = dict[Language, str]

# Words and linear RGB for a renderer. The colours are far enough apart to be recognized in any daylight.
COLORS: dict[str, tuple[Words, tuple[float, float, float]]] = {
    "red": ({"en": "red", "zh": "红色"}, (0.55, 0.02, 0.02)),
    "orange": ({"en": "orange", "zh": "橙色"}, (0.75, 0.21, 0.01)),
    "yellow": ({"en": "yellow", "zh": "黄色"}, (0.75, 0.55, 0.02)),
    "green": ({"en": "green", "zh": "绿色"}, (0.02, 0.28, 0.06)),
    "blue": ({"en": "blue", "zh": "蓝色"}, (0.02, 0.10, 0.50)),
    "purple": ({"en": "purple", "zh": "紫色"}, (0.22, 0.03, 0.34)),
    "pink": ({"en": "pink", "zh": "粉色"}, (0.75, 0.24, 0.38)),
    "brown": ({"en": "brown", "zh": "棕色"}, (0.16, 0.07, 0.03)),
    "white": ({"en": "white", "zh": "白色"}, (0.75, 0.75, 0.72)),
    "grey": ({"en": "grey", "zh": "灰色"}, (0.18, 0.18, 0.19)),
    "black": ({"en": "black", "zh": "黑色"}, (0.012, 0.012, 0.014)),
}

# Slot -> (name, English, Chinese) of its garments. "" is none: a bare head, no bag.
_WORN = (
    ("top", (("t_shirt", "T-shirt", "T恤"), ("jacket", "jacket", "夹克"), ("coat", "long coat", "长大衣"))),
    ("legs", (("trousers", "trousers", "长裤"), ("shorts", "shorts", "短裤"), ("skirt", "skirt", "裙子"))),
    ("hat", (("", "", ""), ("cap", "cap", "鸭舌帽"), ("brim", "wide hat", "宽檐帽"))),
    ("bag", (("", "", ""), ("backpack", "backpack", "背包"), ("shoulder", "shoulder bag", "挎包"))),
)
GARMENTS: dict[str, dict[str, Words]] = {
    slot: {name: {"en": en, "zh": zh} for name, en, zh in garments} for slot, garments in _WORN
}
FIGURES: dict[str, Words] = {"woman": {"en": "woman", "zh": "女子"}, "man": {"en": "man", "zh": "男子"}}
EMPTY_SHARE = {"hat": 0.6, "bag": 0.4}  # share of people without one
HAIR = ("brown", "grey", "black")  # no hat has these colours: from the air it would look like hair


@dataclass(frozen=True)
class Appearance:
    """The appearance of one person, in the names of the tables above; the colour of a missing garment is ""."""

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
        """Whether each garment can be seen: a long coat hides shorts and skirts."""
        return self.top != "coat" or self.legs == "trousers"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            allowed = _rows(name, vars(self))
            if value not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}")

    def differences(self, other: Appearance) -> tuple[str, ...]:
        """Return the fields in which two people differ; a garment counts once."""
        fields = asdict(self)
        other_fields = asdict(other)
        differing = {name.removesuffix("_color") for name in fields if fields[name] != other_fields[name]}
        return tuple(slot for slot in ("figure", *GARMENTS) if slot in differing)


@dataclass(frozen=True)
class People:
    """The appearance of the people in one track: the target, and the bystanders by instance id."""

    target: Appearance
    others: dict[int, Appearance]

    def most_alike(self, numbers: Iterable[int]) -> tuple[int, int] | tuple[None, None]:
        """Return the id of the person most similar to the target, and the number of differences.

        Of several equally similar ones, the largest id; (None, None) without any.
        """
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


GARMENT_TERMS = ("top", "legs", "bag", "hat")
PLACE_TERMS = ("left", "right", "near", "far", "Vegetation", "Poles", "Car", "TrafficLight", "Fences", "Buildings")
GOAL_TERMS = ("figure", *GARMENT_TERMS, *PLACE_TERMS)  # the terms that a goal may use, in the order of its words


@dataclass(frozen=True)
class Goal:
    """A description that is true only of the target in one frame. says: The GOAL_TERMS that it uses."""

    frame: Annotated[int, Field(strict=True, ge=0)]
    en: str
    zh: str
    says: tuple[str, ...]

    def __post_init__(self) -> None:
        in_order = tuple(term for term in GOAL_TERMS if term in self.says)
        if self.says != in_order or not {*self.says} & {*GARMENT_TERMS}:
            raise ValueError(
                f"says must list some of {', '.join(GOAL_TERMS)}, in this order, with at least one garment"
            )


def read_goal(record: Any, num_frames: int, where: str) -> Goal:
    """Read the goal of a track of `num_frames` frames from a record."""
    goal = validated(Goal, record, where)
    if goal.frame >= num_frames:
        expected = f"a frame from 0 to {num_frames - 1}"
        raise InputError("the track has no such frame", where=f"{where}.frame", got=str(goal.frame), expected=expected)
    return goal
