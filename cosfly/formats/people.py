"""Appearance of people and the goal, `people` and `goal` of `trajectory.json`: the wardrobe of `wardrobe.yaml`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import validated

Words = dict[Language, str]

_WARDROBE = read_yaml(Path(__file__).with_name("wardrobe.yaml"))
COLORS: dict[str, tuple[Words, tuple[float, float, float]]] = {
    name: ({"en": row["en"], "zh": row["zh"]}, tuple(row["rgb"])) for name, row in _WARDROBE["colors"].items()
}
GARMENTS: dict[str, dict[str, Words]] = _WARDROBE["garments"]  # slot -> name -> words; the name "" is none
FIGURES: dict[str, Words] = _WARDROBE["figures"]
# The terms that a goal may use, in the order of its words.
GARMENT_TERMS = ("top", "legs", "bag", "hat")
GOAL_TERMS = ("figure", *GARMENT_TERMS, "left", "right", "near", "far")
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
            allowed = _allowed(name, vars(self))
            if value not in allowed:
                raise ValueError(f"the field {name} must be one of {', '.join(map(repr, allowed))}")

    def differences(self, other: Appearance) -> tuple[str, ...]:
        """Return the fields in which two people differ; a garment counts once."""
        fields = vars(other)
        differing = {name.removesuffix("_color") for name, value in vars(self).items() if fields[name] != value}
        return tuple(slot for slot in ("figure", *GARMENTS) if slot in differing)


@dataclass(frozen=True)
class People:
    """The appearance of the people in one track."""

    target: Appearance
    others: dict[int, Appearance]  # bystanders by instance id

    def most_alike(self, instance_ids: Iterable[int]) -> tuple[int, int] | tuple[None, None]:
        """Return the id of the bystander most similar to the target, and the number of differences.

        Of several equally similar ones, the largest id counts. Return (None, None) without any.
        """
        num_differences = {number: len(self.target.differences(self.others[number])) for number in instance_ids}
        if not num_differences:
            return None, None
        most_alike = min(num_differences, key=lambda number: (num_differences[number], -number))
        return most_alike, num_differences[most_alike]


def _allowed(name: str, record: dict) -> tuple[str, ...]:
    """Return the values that a field of an appearance may have; a missing garment has no colour."""
    if name == "figure":
        return tuple(FIGURES)
    if name in GARMENTS:
        return tuple(GARMENTS[name])
    return tuple(COLORS) if record.get(name.removesuffix("_color")) else ("",)


@dataclass(frozen=True)
class Goal:
    """A description that is true only of the target in one frame."""

    frame: Annotated[int, Field(strict=True, ge=0)]
    en: str
    zh: str
    says: tuple[str, ...]  # the GOAL_TERMS that it uses

    def __post_init__(self) -> None:
        in_order = tuple(term for term in GOAL_TERMS if term in self.says)
        if self.says != in_order or not {*self.says} & {*GARMENT_TERMS}:
            raise ValueError(
                f"the field `says` must name at least one of {', '.join(GARMENT_TERMS)}; its terms must be in "
                f"the order {', '.join(GOAL_TERMS)}"
            )


def read_goal(record: Any, num_frames: int, where: str) -> Goal:
    """Read the goal of a track of `num_frames` frames from a record."""
    goal = validated(Goal, record, where)
    if goal.frame >= num_frames:
        expected = f"a frame from 0 to {num_frames - 1}"
        what = "the goal names a frame that the track does not have"
        raise InputError(what, where=f"{where}.frame", got=str(goal.frame), expected=expected)
    return goal
