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

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import Literal, NamedTuple

from caption.verification.facts import STANDING_MPS, Facts, Series
from cosfly.geometry.axes import wrap_deg

Missing = Literal["unobserved_frame", "unknown_fact"]
HOVERING_MPS = 0.3  # slower than this the drone hovers
CENTRED_SHARE = 0.02  # of the picture's width: nearer than this to the middle counts as centred
MATCHING_MPS, MATCHING_SHARE = 0.1, 0.1  # speeds that differ by less match
ACROSS_DEG = 45.0  # nearer than this to the line of sight a person walks towards the drone or away from it
CLEAR_RATIO = 3.0  # a trend is larger than the deviation from its straight line by this factor; else it is jitter


# --- what can be named ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A measured series."""

    read: Callable[[Facts], Series]
    unit: str  # a key of the glossary's units
    digits: int  # after the point, as printed
    steady: float  # the widest spread over a span that counts as no change,
    steady_share: float = 0.0  # or this share of the value, whichever is more
    sides: tuple[str, str, str] | tuple[()] = ()  # words for positive, negative, neither; () if the sign is no side

    def side_of(self, value: float, dead_band: float) -> str:
        """Return the word for the side of a value; values nearer to 0 than the dead band are on neither."""
        positive, negative, neither = self.sides or ("", "", "")
        if abs(value) < dead_band:
            return neither
        return positive if value > 0 else negative


LEFT_RIGHT = ("left", "right", "straight")
TURNS = ("yaw", "target_heading")  # whose side is that of a change


def _now(read: Callable[[Facts], float | None]) -> Callable[[Facts], Series]:
    """Return the series of a value of the whole window: None at all frames but the current one."""
    return lambda f: (*[None] * (len(f) - 1), read(f))


_UNKNOWN = (None, None)  # for the velocity of a target that is not seen often enough

QUANTITIES: dict[str, Quantity] = {
    "speed": Quantity(attrgetter("speed_mps"), "mps", 2, 0.3),
    "forward_speed": Quantity(_now(lambda f: f.velocity_mps[0]), "mps", 2, 0.3),
    "backward_speed": Quantity(_now(lambda f: 0.0 - f.velocity_mps[0]), "mps", 2, 0.3),
    "sideways_speed": Quantity(_now(lambda f: f.velocity_mps[1]), "mps", 2, 0.3, sides=LEFT_RIGHT),
    "climb_rate": Quantity(attrgetter("climb_mps"), "mps", 2, 0.3),
    "sink_rate": Quantity(lambda f: [None if v is None else 0.0 - v for v in f.climb_mps], "mps", 2, 0.3),
    "altitude": Quantity(attrgetter("altitude_m"), "m", 1, 0.5),
    "yaw": Quantity(attrgetter("yaw_deg"), "deg", 1, 1.0, sides=LEFT_RIGHT),
    "yaw_rate": Quantity(attrgetter("yaw_rate_dps"), "dps", 1, 2.0, sides=LEFT_RIGHT),
    "pitch": Quantity(attrgetter("pitch_deg"), "deg", 1, 1.0),
    "travelled": Quantity(attrgetter("travelled_m"), "m", 1, 0.5),
    "ahead": Quantity(lambda f: f.place_axis_m(0), "m", 1, 0.5),
    "distance": Quantity(attrgetter("distance_m"), "m", 1, 0.5),
    "height_over_target": Quantity(attrgetter("height_over_target_m"), "m", 1, 0.5),
    "target_speed": Quantity(attrgetter("target_speeds_mps"), "mps", 2, 0.3),
    "target_forward_speed": Quantity(_now(lambda f: (f.target_velocity_mps or _UNKNOWN)[0]), "mps", 2, 0.3),
    "target_sideways_speed": Quantity(
        _now(lambda f: (f.target_velocity_mps or _UNKNOWN)[1]), "mps", 2, 0.3, sides=LEFT_RIGHT
    ),
    "target_heading": Quantity(attrgetter("target_headings_deg"), "deg", 1, 10.0, sides=LEFT_RIGHT),
    "target_travelled": Quantity(attrgetter("target_travelled_m"), "m", 1, 0.5),
    "bearing": Quantity(attrgetter("bearing_deg"), "deg", 1, 1.0, sides=LEFT_RIGHT),
    "depression": Quantity(attrgetter("depression_deg"), "deg", 1, 1.0),
    "box_height": Quantity(attrgetter("box_height_px"), "px", 0, 2.0, 0.08),
    "others_in_view": Quantity(attrgetter("others_in_view"), "people", 0, 0.0),
    "other_distance": Quantity(attrgetter("other_distance_m"), "m", 1, 0.5),
    "alike_differences": Quantity(attrgetter("alike_differences"), "items", 0, 0.0),
    "offset_x": Quantity(attrgetter("offset_x_px"), "px", 0, 5.0, sides=("right", "left", "centred")),
    "offset_y": Quantity(attrgetter("offset_y_px"), "px", 0, 5.0, sides=("below", "above", "centred")),
}
WORDS = ("visibility", "framing", "walking", "box", "target_motion", "drone_motion")
RELATIONS = ("trend", "side", "comparison", "compared")  # aspects that are words
ASPECTS = ("change", "rate", "growth", "mean", "min", "max", *RELATIONS)
RATE_UNITS = {"m": "mps", "deg": "dps"}
_REVERSED = {"increasing": "decreasing", "decreasing": "increasing"}


class Reference(NamedTuple):
    """An address."""

    quantity: str
    aspect: str = ""  # one of ASPECTS, "comparison" or "compared"; "" for the value at a frame
    first: int | None = None  # frame, or first frame of the span; None for the default
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


@lru_cache(maxsize=4096)
def parse_reference(text: str) -> Reference | None:
    """Read a reference; None where it names nothing that can be measured."""
    match = re.fullmatch(r"(?:([a-z]+):)?([a-z_]+)(?:@t(\d{1,2})(?:\s*[-–]\s*t(\d{1,2}))?)?", text.strip())
    if match is None:
        return None
    aspect, name = match[1] or "", match[2]
    first, last = (None if digits is None else int(digits) for digits in (match[3], match[4]))
    if aspect in ("comparison", "compared"):
        return Reference(name, aspect) if name == "speed" else None  # of the whole window
    if last is not None and (not aspect or (first is not None and first > last)):
        return None
    return Reference(name, aspect, first, last) if _has_aspect(name, aspect) else None


def _has_aspect(name: str, aspect: str) -> bool:
    """Return whether a quantity or word is known and has an aspect."""
    quantity = QUANTITIES.get(name)
    if quantity is None:
        return name in WORDS and not aspect
    if aspect == "side":
        return bool(quantity.sides)
    if aspect == "rate":
        return quantity.unit in RATE_UNITS
    return aspect in ("", *ASPECTS)


# --- what is true -----------------------------------------------------------------------------------------------------

_NOW = -1  # the current frame; of a motion, the whole window


def look_up(reference: Reference, facts: Facts) -> Fact | Missing:
    """Return the fact at an address, or why there is none."""
    fact: Fact | Missing | None = facts.found.get(reference)
    if fact is None:
        fact = facts.found[reference] = _measure(reference, facts)
    return fact


def _measure(reference: Reference, facts: Facts) -> Fact | Missing:
    name, aspect, first, last = reference
    if max(first or 0, last or 0) >= len(facts):
        return "unobserved_frame"
    at = _NOW if first is None else first
    if name in WORDS or aspect in RELATIONS:
        word = _relation(reference, facts, at) if aspect else _word(name, facts, at)
        return "unknown_fact" if word is None else Fact(word, "px" if name == "box" else "")
    quantity = QUANTITIES[name]
    unit, digits = quantity.unit, quantity.digits
    if not aspect:
        value = quantity.read(facts)[at]
        return "unknown_fact" if value is None else Fact(value, unit, digits)
    value = _over_span(reference, facts)
    if value is None:
        return "unknown_fact"
    if aspect == "rate":
        unit = RATE_UNITS[unit]
    elif aspect == "growth":
        unit, digits = "percent", 0
    return Fact(round(value, digits) + 0.0, unit, digits)  # + 0.0: no negative zero


def _word(name: str, f: Facts, at: int) -> str | None:
    """Return the word for a frame; `walking`: towards the drone, away from it or across its line of sight."""
    match name:
        case "visibility":
            return f.visibility[at]
        case "framing":
            x, y = f.offset_x_px[at], f.offset_y_px[at]
            if x is None or y is None:
                return None
            return "centred" if max(abs(x), abs(y)) < _centred_px(f) else "off_centre"
        case "box":
            width, height = f.box_width_px[at], f.box_height_px[at]
            return None if width is None or height is None else f"{width} x {height}"
        case "walking":
            course, bearing = f.target_headings_deg[at], f.bearing_deg[at]
            if course is None or bearing is None:
                return None
            from_sight_deg = abs(wrap_deg(course - f.heading_deg[at] - bearing))
            if from_sight_deg < ACROSS_DEG:
                return "away"
            return "towards" if from_sight_deg > 180.0 - ACROSS_DEG else "across"
        case "target_motion":
            speed = f.target_speed_mps if at == _NOW else f.target_speeds_mps[at]
            slow, fast, least_mps = "standing", "walking", STANDING_MPS
        case _:
            speed = f.mean_speed_mps if at == _NOW else f.speed_mps[at]
            slow, fast, least_mps = "hovering", "moving", HOVERING_MPS
    if speed is None:
        return None
    return slow if speed < least_mps else fast


def _relation(reference: Reference, facts: Facts, at: int) -> str | None:
    """Return the word of a comparison, of a side at a frame, or of a turn's side or a trend over a span."""
    name, aspect, *_ = reference
    if aspect in ("comparison", "compared"):
        drone_mps, target_mps = facts.mean_speed_mps, facts.target_speed_mps
        if target_mps is None:
            return None
        if abs(drone_mps - target_mps) <= max(MATCHING_MPS, MATCHING_SHARE * target_mps):
            return "matching"
        return "faster" if (drone_mps > target_mps) != (aspect == "compared") else "slower"
    quantity = QUANTITIES[name]
    values = _span(reference, facts)
    if aspect == "side":
        value = _change(name, values) if name in TURNS else quantity.read(facts)[at]
        dead_band = _centred_px(facts) if name in ("offset_x", "offset_y") else quantity.steady
        return None if value is None else quantity.side_of(value, dead_band)
    if len(values) < 2:
        return None
    trend = trend_of(quantity, values)
    if has_sides(name) and trend in _REVERSED and min(values) < 0:
        # A trend is that of the size: an offset to the left that shrinks is no increase.
        return _REVERSED[trend] if max(values) <= 0 else None
    return trend


def _over_span(reference: Reference, facts: Facts) -> float | None:
    """Return a number over a span, not rounded."""
    name, aspect, first, last = reference
    climb_mps = facts.velocity_mps[2]
    of_whole_window = {  # means of the straight line through all positions, not of its jitter
        "speed": facts.mean_speed_mps, "target_speed": facts.target_speed_mps,
        "climb_rate": climb_mps, "sink_rate": 0.0 - climb_mps,
    }  # fmt: skip
    if aspect == "mean" and name in of_whole_window and first is None and last is None:
        return of_whole_window[name]
    values = _span(reference, facts)
    if values and aspect in ("mean", "min", "max"):
        return {"mean": sum(values) / len(values), "min": min(values), "max": max(values)}[aspect]
    change = _change(name, values)
    if change is None or aspect == "change":
        return change
    if aspect == "rate":
        return change / (facts.step_s * (len(values) - 1))
    return 100.0 * change / abs(values[0]) if values[0] else None


def _span(reference: Reference, facts: Facts) -> list[float]:
    """Return the known values of a reference's span; none where an end that it names, or the last, is not known."""
    series = QUANTITIES[reference.quantity].read(facts)
    start = 0 if reference.first is None else reference.first
    end = len(series) - 1 if reference.last is None else reference.last
    if (reference.first is not None and series[start] is None) or series[end] is None:
        return []
    return [value for value in series[start : end + 1] if value is not None]


def _change(name: str, values: Sequence[float]) -> float | None:
    if len(values) < 2:
        return None
    change = values[-1] - values[0]
    return wrap_deg(change) if name == "target_heading" else change


def _centred_px(facts: Facts) -> float:
    """Return how far from the middle of the picture something still counts as centred."""
    return max(2.0, CENTRED_SHARE * facts.width_px)


def has_sides(name: str) -> bool:
    """Return whether the sign of a quantity says on which side of something it is."""
    return bool(QUANTITIES[name].sides) and name != "target_heading"


def trend_of(quantity: Quantity, values: Sequence[float]) -> str:
    """Return the trend of a series: increasing or decreasing if all steps are, or if the straight line that fits best
    changes by more than the steady band and by more than CLEAR_RATIO times the deviation from it; else steady or mixed."""
    band = max(quantity.steady, quantity.steady_share * max(map(abs, values)))
    if max(values) - min(values) <= band:
        return "steady"
    count = len(values)
    middle, mean = (count - 1) / 2.0, sum(values) / count
    norm = sum((i - middle) ** 2 for i in range(count))
    slope = sum((i - middle) * value for i, value in enumerate(values)) / norm
    deviation = math.sqrt(sum((value - mean - slope * (i - middle)) ** 2 for i, value in enumerate(values)) / count)
    change = values[-1] - values[0]
    change_of_line = slope * (count - 1)
    goes_one_way = all(change * (after - before) >= 0 for before, after in pairwise(values))
    is_clear = abs(change_of_line) >= max(band, CLEAR_RATIO * deviation)
    if change * change_of_line > 0 and (goes_one_way or is_clear):
        return "increasing" if change > 0 else "decreasing"
    return "mixed"
