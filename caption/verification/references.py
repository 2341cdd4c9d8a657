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

    def side_of(self, value: float, dead_band: float) -> str:
        positive, negative, between = self.sides or ("", "", "")
        return between if abs(value) < dead_band else positive if value > 0 else negative


LEFT_RIGHT = ("left", "right", "straight")
TURNS = ("yaw", "target_heading")  # whose side is that of a change


def _now(read: Callable[[Facts], float | None]) -> Callable[[Facts], Series]:
    """Return the series of what is known for the whole window: its value stands at the current frame."""
    return lambda f: (*(None,) * (len(f) - 1), read(f))


_UNKNOWN = (None, None)

QUANTITIES: dict[str, Quantity] = {
    "speed": Quantity(attrgetter("speed_mps"), "mps", 2, 0.3),
    "forward_speed": Quantity(_now(lambda f: f.velocity_mps[0]), "mps", 2, 0.3),
    "backward_speed": Quantity(_now(lambda f: 0.0 - f.velocity_mps[0]), "mps", 2, 0.3),
    "sideways_speed": Quantity(_now(lambda f: f.velocity_mps[1]), "mps", 2, 0.3, sides=LEFT_RIGHT),
    "climb_rate": Quantity(attrgetter("climb_mps"), "mps", 2, 0.3),
    "sink_rate": Quantity(lambda f: [climb and -climb for climb in f.climb_mps], "mps", 2, 0.3),
    "altitude": Quantity(attrgetter("altitude_m"), "m", 1, 0.5),
    "yaw": Quantity(attrgetter("yaw_deg"), "deg", 1, 1.0, sides=LEFT_RIGHT),
    "yaw_rate": Quantity(attrgetter("yaw_rate_dps"), "dps", 1, 2.0, sides=LEFT_RIGHT),
    "pitch": Quantity(attrgetter("pitch_deg"), "deg", 1, 1.0),
    "travelled": Quantity(attrgetter("travelled_m"), "m", 1, 0.5),
    "ahead": Quantity(lambda f: [place and place[0] for place in f.place_m], "m", 1, 0.5),
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
    quantity = QUANTITIES.get(name)
    if quantity is None:
        is_known = name in WORDS and not aspect
    elif aspect in ("side", "rate"):
        is_known = bool(quantity.sides) if aspect == "side" else quantity.unit in RATE_UNITS
    else:
        is_known = aspect in ("", *ASPECTS)
    return Reference(name, aspect, first, last) if is_known else None


# --- what is true -----------------------------------------------------------------------------------------------------

_NOW = -1  # the current frame; of a motion, the whole window


def look_up(reference: Reference, facts: Facts) -> Fact | Missing:
    """Return the fact at an address, or why there is none."""
    found: Fact | Missing | None = facts.found.get(reference)
    if found is None:
        found = facts.found[reference] = _find(reference, facts)
    return found


def _find(reference: Reference, facts: Facts) -> Fact | Missing:
    name, aspect, first, last = reference
    if max(first or 0, last or 0) >= len(facts):
        return "unobserved_frame"
    at = _NOW if first is None else first
    value: float | str | None
    if name in WORDS or aspect in RELATIONS:
        value = _relation(reference, facts, at) if aspect else _word(name, facts, at)
        return "unknown_fact" if value is None else Fact(value, "px" if name == "box" else "")
    quantity = QUANTITIES[name]
    unit, digits = quantity.unit, quantity.digits
    value = _over_span(reference, facts) if aspect else quantity.read(facts)[at]
    if value is None:
        return "unknown_fact"
    if aspect == "rate":
        unit = RATE_UNITS[unit]
    elif aspect == "growth":
        unit, digits = "percent", 0
    return Fact(round(value, digits) + 0.0 if aspect else value, unit, digits)


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
            off_deg = abs(wrap_deg(course - f.heading_deg[at] - bearing))
            return "away" if off_deg < ACROSS_DEG else "towards" if off_deg > 180.0 - ACROSS_DEG else "across"
        case "target_motion":
            speed = f.target_speed_mps if at == _NOW else f.target_speeds_mps[at]
            return None if speed is None else "standing" if speed < STANDING_MPS else "walking"
        case _:
            speed = f.mean_speed_mps if at == _NOW else f.speed_mps[at]
            return None if speed is None else "hovering" if speed < HOVERING_MPS else "moving"


def _relation(reference: Reference, facts: Facts, at: int) -> str | None:
    """Return the word of a comparison, of a side at a frame, or of a turn's side or a trend over a span."""
    name, aspect, *_ = reference
    quantity, ours, theirs = QUANTITIES[name], facts.mean_speed_mps, facts.target_speed_mps
    if aspect in ("comparison", "compared"):
        if theirs is None or abs(ours - theirs) <= max(MATCHING_MPS, MATCHING_SHARE * theirs):
            return None if theirs is None else "matching"
        return "faster" if (ours > theirs) == (aspect == "comparison") else "slower"
    values = _span(reference, facts)
    if aspect == "side":
        is_offset = name in ("offset_x", "offset_y")
        value = _change(name, values) if name in TURNS else quantity.read(facts)[at]
        return None if value is None else quantity.side_of(value, _centred_px(facts) if is_offset else quantity.steady)
    if len(values) < 2:
        return None
    trend = trend_of(quantity, values)
    if has_sides(name) and trend in _REVERSED and min(values) < 0:
        # Of the size: an offset to the left that shrinks is no increase.
        return _REVERSED[trend] if max(values) <= 0 else None
    return trend


def _over_span(reference: Reference, facts: Facts) -> float | None:
    """Return a number over a span, not rounded."""
    name, aspect, first, last = reference
    climb_mps = facts.velocity_mps[2]
    whole = {
        "speed": facts.mean_speed_mps, "target_speed": facts.target_speed_mps,
        "climb_rate": climb_mps, "sink_rate": 0.0 - climb_mps,
    }  # fmt: skip
    if aspect == "mean" and name in whole and first is last is None:
        return whole[name]  # of the straight line through all positions, not of its jitter
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
    """Name the course of a series: increasing, decreasing, steady or mixed.

    A course is a trend where the straight line that fits it best changes by more than the steady band and by
    CLEAR_RATIO times the deviation from it.
    """
    band = max(quantity.steady, quantity.steady_share * max(map(abs, values)))
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
