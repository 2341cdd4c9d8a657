"""References: one address for every fact of a window, which slots and the table of facts use.

    distance@t4            the value at a frame; without `@` at the current one
    change:distance@t0-t4  last less first of a span; without `@` of the whole window. So too
    rate: (per second)  growth: (percent)  mean:  min:  max:  trend:  side:
    comparison:speed       the drone's mean speed against the target's; compared:speed the other way round
    visibility@t2          a word instead of a number; framing: in the picture; walking: towards the drone, away or
    across; target_motion, drone_motion
    box@t4                 width and height of the target in the picture

`look_up` returns the fact at an address, or why there is none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import Literal, NamedTuple

from caption.verification.facts import STANDING_MPS, Facts, Series, wrapped

Missing = Literal["unknown_reference", "unobserved_frame", "unknown_fact"]
HOVERING_MPS = 0.3  # slower than this the drone hovers
CENTRED_SHARE = 0.02  # of the picture's width: nearer than this to the middle counts as centred
MATCHING_MPS, MATCHING_SHARE = 0.1, 0.1  # speeds that differ by less match
ACROSS_DEG = 45.0  # nearer than this to the line of sight a person walks towards the drone or away from it
CLEAR_RATIO = 3.0  # a trend is larger than the deviation from its straight line by this factor; else it is jitter


# --- what can be named ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A measured series.

    Args:
        unit: a key of the glossary's units. digits: after the point, as printed.
        steady: the widest spread over a span that counts as no change; steady_share: or this share of the value.
        sides: words for positive, negative and neither; () where the sign says nothing about a side.
    """

    read: Callable[[Facts], Series]
    unit: str
    digits: int
    steady: float
    steady_share: float = 0.0
    sides: tuple[str, str, str] | tuple[()] = ()

    def allowed_spread(self, values: Sequence[float]) -> float:
        return max(self.steady, self.steady_share * max(map(abs, values)))


TURNS = ("left", "right", "straight")
TURNING = ("yaw", "heading", "target_heading")  # whose side is that of a change
ANGLES = frozenset({"heading", "target_heading"})  # whose differences are turns


def _now(read: Callable[[Facts], float | None]) -> Callable[[Facts], Series]:
    """Return the series of what is known for the whole window: its value stands at the current frame."""
    return lambda f: (*(None,) * (len(f) - 1), read(f))


def _difference(f: Facts) -> float | None:
    return None if f.target_speed_mps is None else round(f.mean_speed_mps - f.target_speed_mps, 2) + 0.0


def _ratio(f: Facts) -> float | None:
    return round(f.mean_speed_mps / f.target_speed_mps, 2) if f.target_speed_mps else None


def _of_target(axis: int) -> Callable[[Facts], float | None]:
    return lambda f: None if f.target_velocity_mps is None else f.target_velocity_mps[axis]


QUANTITIES: dict[str, Quantity] = {
    "speed": Quantity(attrgetter("speed_mps"), "mps", 2, 0.3),
    "forward_speed": Quantity(_now(lambda f: f.velocity_mps[0]), "mps", 2, 0.3),
    "sideways_speed": Quantity(_now(lambda f: f.velocity_mps[1]), "mps", 2, 0.3, sides=TURNS),
    "climb_rate": Quantity(attrgetter("climb_mps"), "mps", 2, 0.3),
    "altitude": Quantity(attrgetter("altitude_m"), "m", 1, 0.5),
    "yaw": Quantity(attrgetter("yaw_deg"), "deg", 1, 1.0, sides=TURNS),
    "heading": Quantity(attrgetter("heading_deg"), "deg", 1, 1.0, sides=TURNS),
    "yaw_rate": Quantity(attrgetter("yaw_rate_dps"), "dps", 1, 2.0, sides=TURNS),
    "pitch": Quantity(attrgetter("pitch_deg"), "deg", 1, 1.0),
    "travelled": Quantity(attrgetter("travelled_m"), "m", 1, 0.5),
    "displacement": Quantity(attrgetter("displacement_m"), "m", 1, 0.5),
    "ahead": Quantity(lambda f: [place and place[0] for place in f.place_m], "m", 1, 0.5),
    "distance": Quantity(attrgetter("distance_m"), "m", 1, 0.5),
    "slant": Quantity(attrgetter("slant_m"), "m", 1, 0.5),
    "height_over_target": Quantity(attrgetter("height_over_target_m"), "m", 1, 0.5),
    "target_speed": Quantity(attrgetter("target_speeds_mps"), "mps", 2, 0.3),
    "target_forward_speed": Quantity(_now(_of_target(0)), "mps", 2, 0.3),
    "target_sideways_speed": Quantity(_now(_of_target(1)), "mps", 2, 0.3, sides=TURNS),
    "target_heading": Quantity(attrgetter("target_headings_deg"), "deg", 1, 10.0, sides=TURNS),
    "target_travelled": Quantity(attrgetter("target_travelled_m"), "m", 1, 0.5),
    "speed_difference": Quantity(_now(_difference), "mps", 2, 0.3),
    "speed_ratio": Quantity(_now(_ratio), "times", 2, 0.1, 0.1),
    "bearing": Quantity(attrgetter("bearing_deg"), "deg", 1, 1.0, sides=TURNS),
    "depression": Quantity(attrgetter("depression_deg"), "deg", 1, 1.0),
    "box_width": Quantity(attrgetter("box_width_px"), "px", 0, 2.0, 0.08),
    "box_height": Quantity(attrgetter("box_height_px"), "px", 0, 2.0, 0.08),
    "others_in_view": Quantity(attrgetter("others_in_view"), "people", 0, 0.0),
    "other_distance": Quantity(attrgetter("other_distance_m"), "m", 1, 0.5),
    "alike_differences": Quantity(attrgetter("alike_differences"), "items", 0, 0.0),
    "offset_x": Quantity(attrgetter("offset_x_px"), "px", 0, 5.0, sides=("right", "left", "centred")),
    "offset_y": Quantity(attrgetter("offset_y_px"), "px", 0, 5.0, sides=("below", "above", "centred")),
}
MOTIONS = {"target_motion": ("standing", "walking"), "drone_motion": ("hovering", "moving")}
_STILL_MPS = {"target_motion": STANDING_MPS, "drone_motion": HOVERING_MPS}
ASPECTS = ("change", "rate", "growth", "mean", "min", "max", "trend", "side", "comparison", "compared")
RATE_UNITS = {"m": "mps", "deg": "dps"}
_REVERSED = {"increasing": "decreasing", "decreasing": "increasing"}
_TURNED = {"faster": "slower", "slower": "faster"}  # of the target against the drone
NO_ASPECT = ("visibility", "framing", "walking", "box", *MOTIONS)


class Reference(NamedTuple):
    """An address. aspect: "" for the value at a frame. first, last: frames of the span, None for the default."""

    quantity: str
    aspect: str = ""
    first: int | None = None
    last: int | None = None

    def __str__(self) -> str:
        name = f"{self.aspect}:{self.quantity}" if self.aspect else self.quantity
        frames = [f"t{i}" for i in (self.first, self.last) if i is not None]
        return name + ("@" + "-".join(dict.fromkeys(frames)) if frames else "")


class Fact(NamedTuple):
    """What is true at an address: a number with its unit and the digits it is printed with, or a word."""

    value: float | str
    unit: str = ""
    digits: int = 0


_REFERENCE = re.compile(r"(?:([a-z]+):)?([a-z_]+)(?:@t(\d{1,2})(?:\s*[-–]\s*t(\d{1,2}))?)?")


@lru_cache(maxsize=4096)
def parse_reference(text: str) -> Reference | None:
    """Read a reference; None where it names nothing that can be measured."""
    match = _REFERENCE.fullmatch(text.strip())
    if match is None:
        return None
    aspect, quantity = match[1] or "", match[2]
    first, last = (None if digits is None else int(digits) for digits in (match[3], match[4]))
    if quantity in NO_ASPECT:
        is_known = not aspect and last is None
    elif aspect in ("comparison", "compared"):
        first = last = None  # of the whole window
        is_known = quantity == "speed"
    elif quantity not in QUANTITIES or (aspect and aspect not in ASPECTS):
        return None
    else:
        is_known = (bool(aspect) or last is None) and (aspect != "side" or bool(QUANTITIES[quantity].sides))
        is_known = is_known and (aspect != "rate" or QUANTITIES[quantity].unit in RATE_UNITS)
    if not is_known or (first is not None and last is not None and first > last):
        return None
    return Reference(quantity, aspect, first, last)


# --- what is true -----------------------------------------------------------------------------------------------------


def look_up(reference: Reference, facts: Facts) -> Fact | Missing:
    """Return the fact at an address, or why there is none."""
    found = facts.found.get(reference)
    if found is None:
        found = facts.found[reference] = find_fact(reference, facts)
    return found


def find_fact(reference: Reference, facts: Facts) -> Fact | Missing:
    """Look a fact up without keeping it; for a caller that keeps it under a name of its own."""
    name, aspect, first, last = reference
    count = len(facts)
    if (first is not None and first >= count) or (last is not None and last >= count):
        return "unobserved_frame"
    at = count - 1 if first is None else first
    if name in QUANTITIES and not aspect:
        quantity = QUANTITIES[name]
        value = quantity.read(facts)[at]
        return "unknown_fact" if value is None else Fact(value, quantity.unit, quantity.digits)
    if name == "visibility":
        return Fact(facts.visibility[at])
    if name in MOTIONS:
        return _motion(name, facts, at if first is not None else None)
    if name == "framing":
        return _framing(facts, at)
    if name == "walking":
        return _walking(facts, at)
    if name == "box":
        width, height = facts.box_width_px[at], facts.box_height_px[at]
        return "unknown_fact" if width is None or height is None else Fact(f"{width} x {height}", "px")
    if aspect in ("comparison", "compared"):
        return _comparison(facts, aspect)
    return _over_span(reference, facts)


def span_of(reference: Reference, facts: Facts) -> list[float] | None:
    """Return the known values of a reference's span; None where an end that it names, or the last, is not known."""
    series = QUANTITIES[reference.quantity].read(facts)
    start = 0 if reference.first is None else reference.first
    end = len(series) - 1 if reference.last is None else reference.last
    if (reference.first is not None and series[start] is None) or series[end] is None:
        return None
    return [value for value in series[start : end + 1] if value is not None]


def _over_span(reference: Reference, facts: Facts) -> Fact | Missing:
    quantity, aspect = QUANTITIES[reference.quantity], reference.aspect
    if aspect == "side" and reference.quantity not in TURNING:
        value = quantity.read(facts)[-1 if reference.first is None else reference.first]
        return "unknown_fact" if value is None else Fact(_side(quantity, value, dead_band_of(reference, facts)))
    whole = {"speed": facts.mean_speed_mps, "target_speed": facts.target_speed_mps}
    if aspect == "mean" and reference.quantity in whole and reference.first is None and reference.last is None:
        mean = whole[reference.quantity]  # of the straight line through all positions, not of its jitter
        return "unknown_fact" if mean is None else Fact(mean, quantity.unit, quantity.digits)
    values = span_of(reference, facts)
    if not values or (len(values) < 2 and aspect not in ("mean", "min", "max")):
        return "unknown_fact"
    if aspect == "trend":
        trend = trend_of(quantity, values)
        if has_sides(reference.quantity) and trend in _REVERSED and min(values) < 0:
            # Of the size: an offset to the left that shrinks is no increase.
            return Fact(_REVERSED[trend]) if max(values) <= 0 else "unknown_fact"
        return Fact(trend)
    change = values[-1] - values[0]
    if reference.quantity in ANGLES:
        change = wrapped(change)
    if aspect == "side":
        return Fact(_side(quantity, change, quantity.steady))
    unit, digits = quantity.unit, quantity.digits
    match aspect:
        case "mean":
            number = sum(values) / len(values)
        case "min":
            number = min(values)
        case "max":
            number = max(values)
        case "rate":
            number, unit = change / (facts.step_s * (len(values) - 1)), RATE_UNITS[unit]
        case "growth":
            if not values[0]:
                return "unknown_fact"
            number, unit, digits = 100.0 * change / abs(values[0]), "percent", 0
        case _:
            number = change
    return Fact(round(number, digits) + 0.0, unit, digits)


def has_sides(quantity: str) -> bool:
    """Return whether the sign of a quantity says on which side of something it is."""
    return bool(QUANTITIES[quantity].sides) and quantity not in ANGLES


def trend_of(quantity: Quantity, values: Sequence[float]) -> str:
    """Name the course of a series: increasing, decreasing, steady or mixed.

    A course is a trend where the straight line that fits it best changes by more than the steady band and by
    CLEAR_RATIO times the deviation from it.
    """
    band = quantity.allowed_spread(values)
    if max(values) - min(values) <= band:
        return "steady"
    count = len(values)
    middle, mean = (count - 1) / 2.0, sum(values) / count
    norm = sum((i - middle) ** 2 for i in range(count))
    slope = sum((i - middle) * value for i, value in enumerate(values)) / norm
    deviation = math.sqrt(sum((value - mean - slope * (i - middle)) ** 2 for i, value in enumerate(values)) / count)
    fitted, change = slope * (count - 1), values[-1] - values[0]
    goes_one_way = all(change * (after - before) >= 0 for before, after in pairwise(values))
    if change * fitted > 0 and (goes_one_way or abs(fitted) >= max(band, CLEAR_RATIO * deviation)):
        return "increasing" if change > 0 else "decreasing"
    return "mixed"


def dead_band_of(reference: Reference, facts: Facts) -> float:
    """Return how far a quantity may be off and still be steady or centred, in its unit."""
    if reference.quantity in ("offset_x", "offset_y"):
        return max(2.0, CENTRED_SHARE * facts.width_px)
    return QUANTITIES[reference.quantity].steady


def _side(quantity: Quantity, value: float, dead_band: float) -> str:
    positive, negative, between = quantity.sides or ("", "", "")
    return between if abs(value) < dead_band else positive if value > 0 else negative


def _framing(facts: Facts, at: int) -> Fact | Missing:
    x, y = facts.offset_x_px[at], facts.offset_y_px[at]
    if x is None or y is None:
        return "unknown_fact"
    is_centred = max(abs(x), abs(y)) < max(2.0, CENTRED_SHARE * facts.width_px)
    return Fact("centred" if is_centred else "off_centre")


def _walking(facts: Facts, at: int) -> Fact | Missing:
    """Return whether the target walks towards the drone, away from it or across its line of sight."""
    course, bearing = facts.target_headings_deg[at], facts.bearing_deg[at]
    if course is None or bearing is None:
        return "unknown_fact"
    off_deg = abs(wrapped(course - facts.heading_deg[at] - bearing))
    return Fact("away" if off_deg < ACROSS_DEG else "towards" if off_deg > 180.0 - ACROSS_DEG else "across")


def _motion(name: str, facts: Facts, at: int | None) -> Fact | Missing:
    """Return whether something moves: over the whole window, or at a frame."""
    if name == "drone_motion":
        speed = facts.mean_speed_mps if at is None else facts.speed_mps[at]
    else:
        speed = facts.target_speed_mps if at is None else facts.target_speeds_mps[at]
    still, moving = MOTIONS[name]
    return "unknown_fact" if speed is None else Fact(still if speed < _STILL_MPS[name] else moving)


def _comparison(facts: Facts, aspect: str) -> Fact | Missing:
    ours, theirs = facts.mean_speed_mps, facts.target_speed_mps
    if theirs is None:
        return "unknown_fact"
    word = "faster" if ours > theirs else "slower"
    if abs(ours - theirs) <= max(MATCHING_MPS, MATCHING_SHARE * theirs):
        word = "matching"
    return Fact(word if aspect == "comparison" else _TURNED.get(word, word))
