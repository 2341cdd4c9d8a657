"""References: one address for every fact of a window, by which slots, claims and the reader of prose name it.

    distance@t4            the value at a frame; without `@` at the current one
    change:distance@t0-t4  last less first of a span; without `@` of the whole window. So too
    rate: (per second)  growth: (percent)  mean:  min:  max:  trend:  side:  comparison:
    visibility@t2          a word instead of a number; framing: in the picture; walking: towards the drone, away or
    across

`look_up` gives the fact, `number_holds` and `word_holds` whether somebody's value is true of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import Literal, NamedTuple

from caption.verification.facts import STANDING_MPS, Facts, wrapped

Series = Sequence[float | None]
Missing = Literal["unknown_reference", "unobserved_frame", "unknown_fact"]
HOVERING_MPS = 0.3  # slower than this the drone hovers
CENTRED_SHARE = 0.02  # of the picture's width: nearer than this to the middle counts as centred
OFF_CENTRE_SHARE = 0.05  # and farther than this certainly not
MATCHING_MPS, MATCHING_SHARE = 0.1, 0.1  # speeds that differ by less match


# --- what can be named ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A measured series. unit: a key of the glossary's units. digits: after the point, as printed.

    steady: the widest spread over a span that counts as no change; a share of the value where it is a percentage of it.
    positive, negative: words for the sides of its sign; () where the sign says nothing about a side.
    """

    read: Callable[[Facts], Series]
    unit: str
    digits: int
    steady: float
    steady_share: float = 0.0
    sides: tuple[str, str, str] | tuple[()] = ()  # positive, negative, between

    def allowed_spread(self, values: Sequence[float]) -> float:
        return max(self.steady, self.steady_share * max(map(abs, values))) if self.steady_share else self.steady


TURNING = ("yaw", "heading", "target_heading")  # whose side is that of a change
TURNS = ("left", "right", "straight")


def _steps(values: Series, step_s: float, digits: int) -> Series:
    """Return the change per second from each frame to the next."""
    rates = [None if a is None or b is None else round((b - a) / step_s, digits) + 0.0 for a, b in pairwise(values)]
    return (None, *rates)


def _difference(f: Facts) -> Series:
    targets = f.target_speeds_mps or (None,) * len(f)
    return [
        None if a is None or b is None else round(a - b, 2) + 0.0 for a, b in zip(f.speed_mps, targets, strict=True)
    ]


def _speed_ratio(f: Facts) -> Series:
    mean = f.target_speed_mps
    return [None if v is None or not mean else round(v / mean, 2) for v in f.speed_mps]


QUANTITIES: dict[str, Quantity] = {
    "speed": Quantity(attrgetter("speed_mps"), "mps", 2, 0.3),
    "climb_rate": Quantity(lambda f: _steps(f.altitude_m, f.step_s, 2), "mps", 2, 0.3),
    "altitude": Quantity(attrgetter("altitude_m"), "m", 1, 0.5),
    "yaw": Quantity(attrgetter("yaw_deg"), "deg", 1, 1.0, sides=TURNS),
    "heading": Quantity(attrgetter("heading_deg"), "deg", 1, 1.0, sides=TURNS),
    "yaw_rate": Quantity(lambda f: _steps(f.yaw_deg, f.step_s, 1), "dps", 1, 2.0, sides=TURNS),
    "pitch": Quantity(attrgetter("pitch_deg"), "deg", 1, 1.0),
    "travelled": Quantity(attrgetter("travelled_m"), "m", 1, 0.5),
    "displacement": Quantity(attrgetter("displacement_m"), "m", 1, 0.5),
    "distance": Quantity(attrgetter("distance_m"), "m", 1, 0.5),
    "slant": Quantity(attrgetter("slant_m"), "m", 1, 0.5),
    "height_over_target": Quantity(attrgetter("height_over_target_m"), "m", 1, 0.5),
    "target_speed": Quantity(attrgetter("target_speeds_mps"), "mps", 2, 0.3),
    "target_heading": Quantity(attrgetter("target_headings_deg"), "deg", 1, 10.0, sides=TURNS),
    "target_travelled": Quantity(attrgetter("target_travelled_m"), "m", 1, 0.5),
    "speed_difference": Quantity(_difference, "mps", 2, 0.3),
    "speed_ratio": Quantity(_speed_ratio, "times", 2, 0.1, 0.1),
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
TRENDS = ("increasing", "decreasing", "steady", "mixed")
COMPARISONS = ("faster", "slower", "matching")
STILL_MPS = {"target_motion": STANDING_MPS, "drone_motion": HOVERING_MPS}
MOTIONS = {"target_motion": ("standing", "walking"), "drone_motion": ("hovering", "moving")}
ASPECTS = ("change", "rate", "growth", "mean", "min", "max", "trend", "side", "comparison", "compared")
TURNED = {"faster": "slower", "slower": "faster"}  # of the target against the drone
ANGLES = frozenset({"heading", "target_heading"})  # whose differences are turns
# Known between two frames only: the oldest frame has no value, and a span from it begins with the first step.
STEPS = frozenset(
    {"speed", "climb_rate", "yaw_rate", "target_speed", "target_heading", "speed_difference", "speed_ratio"}
)


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
_WORDS_ONLY = {"visibility", "framing", "walking", *MOTIONS}
ACROSS_DEG = 45.0  # nearer than this to the line of sight a walk is towards or away


@lru_cache(maxsize=4096)
def parse_reference(text: str) -> Reference | None:
    """Read a reference; None where it names nothing that can be measured."""
    match = _REFERENCE.fullmatch(text.strip())
    if match is None:
        return None
    aspect, quantity = match[1] or "", match[2]
    first, last = (None if digits is None else int(digits) for digits in (match[3], match[4]))
    if quantity in _WORDS_ONLY:
        is_known = not aspect and last is None
    elif aspect in ("comparison", "compared"):
        is_known = quantity == "speed" and last is None
    elif quantity not in QUANTITIES or (aspect and aspect not in ASPECTS):
        return None
    else:
        is_known = bool(aspect) or last is None
        is_known = is_known and (aspect != "side" or bool(QUANTITIES[quantity].sides))
    if not is_known or (first is not None and last is not None and first > last):
        return None
    return Reference(quantity, aspect, first, last)


# --- what is true -----------------------------------------------------------------------------------------------------


def look_up(reference: Reference, facts: Facts) -> Fact | Missing:
    """Return the fact at an address, or why there is none."""
    if not reference.aspect and reference.quantity in QUANTITIES:  # as quick to read as to remember
        return find_fact(reference, facts)
    found = facts.found.get(reference)
    if found is None:
        found = facts.found[reference] = find_fact(reference, facts)
    return found


def _value_at(frame: int | None, quantity: Quantity, facts: Facts) -> Fact | Missing:
    if frame is not None and frame >= len(facts.yaw_deg):
        return "unobserved_frame"
    value = _at(quantity.read(facts), -1 if frame is None else frame)
    return "unknown_fact" if value is None else Fact(value, quantity.unit, quantity.digits)


def find_fact(reference: Reference, facts: Facts) -> Fact | Missing:
    """Look a fact up without remembering it, for who remembers it under a name."""
    name, aspect, first, last = reference
    if not aspect and name in QUANTITIES:
        return _value_at(first, QUANTITIES[name], facts)
    count = len(facts.yaw_deg)
    if (first is not None and first >= count) or (last is not None and last >= count):
        return "unobserved_frame"
    if name == "visibility":
        return Fact(facts.visibility[count - 1 if first is None else first])
    if name in MOTIONS:
        return _motion(name, facts, first)
    if name in ("framing", "walking"):
        return _framing(facts, first) if name == "framing" else _walking(facts, first)
    if aspect not in ("comparison", "compared"):
        return _over_span(reference, facts)
    fact = _comparison(facts, first)
    return (
        fact if aspect == "comparison" or not isinstance(fact, Fact) else Fact(TURNED.get(str(fact.value), fact.value))
    )


def _at(series: Series, frame: int) -> float | None:
    return series[frame] if series else None


def span_of(reference: Reference, facts: Facts) -> list[float] | None:
    """Return the known values of a reference's span; None where an end that it names is not known."""
    name, _, first, last = reference
    series = QUANTITIES[name].read(facts)
    if not series:
        return None
    start, end = (0 if first is None else first), (len(series) - 1 if last is None else last)
    if first == 0 and name in STEPS:
        first = None
    if (first is not None and series[start] is None) or series[end] is None:
        return None
    return [value for value in series[start : end + 1] if value is not None]


def _over_span(reference: Reference, facts: Facts) -> Fact | Missing:
    quantity, aspect = QUANTITIES[reference.quantity], reference.aspect
    if aspect == "side" and reference.quantity not in TURNING:
        frame = len(facts) - 1 if reference.first is None else reference.first
        value = _at(quantity.read(facts), frame)
        return "unknown_fact" if value is None else Fact(_side(quantity, value, dead_band_of(reference, facts)))
    if reference.quantity == "target_heading" and not facts.target_headings_deg:
        turn = facts.target_turn_deg if reference.first in (None, 0) else None  # all that older facts know
        if turn is None or aspect not in ("change", "side"):
            return "unknown_fact"
        return Fact(_side(quantity, turn, quantity.steady)) if aspect == "side" else Fact(turn, "deg", 1)
    if (reference.quantity, aspect) == ("target_speed", "mean") and reference.first in (None, 0):
        mean = facts.target_speed_mps
        return "unknown_fact" if mean is None else Fact(mean, "mps", 2)
    values = span_of(reference, facts)
    if not values or (len(values) < 2 and aspect not in ("mean", "min", "max")):
        return "unknown_fact"
    if aspect == "trend":
        return Fact(trend_of(quantity, values))
    if aspect == "side":
        change = _change(reference.quantity, values)
        return Fact(_side(quantity, change, quantity.steady))
    return _number(reference, quantity, values, facts)


def _number(reference: Reference, quantity: Quantity, values: list[float], facts: Facts) -> Fact | Missing:
    change, unit, digits = _change(reference.quantity, values), quantity.unit, quantity.digits
    match reference.aspect:
        case "mean":
            number = sum(values) / len(values)
        case "min":
            number = min(values)
        case "max":
            number = max(values)
        case "growth":
            if not values[0]:
                return "unknown_fact"
            number, unit, digits = 100.0 * change / abs(values[0]), "percent", 0
        case "rate":
            unit = {"m": "mps", "deg": "dps"}.get(unit, "")
            if not unit:
                return "unknown_reference"
            number = change / (facts.step_s * (len(values) - 1))
        case _:
            number = change
    return Fact(round(number, digits) + 0.0, unit, digits)


def _change(name: str, values: Sequence[float]) -> float:
    change = values[-1] - values[0]
    return (change + 180.0) % 360.0 - 180.0 if name in ANGLES else change


def trend_of(quantity: Quantity, values: Sequence[float]) -> str:
    """Name the course of a series: one of TRENDS. A trend goes one way all along, or ends a steady band from where it
    began."""
    spread, change, band = max(values) - min(values), values[-1] - values[0], quantity.allowed_spread(values)
    if spread <= band:
        return "steady"
    if abs(change) > band or (change and all(change * (b - a) >= 0 for a, b in pairwise(values))):
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


def _framing(facts: Facts, frame: int | None) -> Fact | Missing:
    offsets = [_at(series, -1 if frame is None else frame) for series in (facts.offset_x_px, facts.offset_y_px)]
    if None in offsets:
        return "unknown_fact"
    is_centred = max(abs(offset) for offset in offsets if offset is not None) < max(2.0, CENTRED_SHARE * facts.width_px)
    return Fact("centred" if is_centred else "off_centre")


def _walking(facts: Facts, frame: int | None) -> Fact | Missing:
    """Return whether the target walks towards the drone, away from it or across its line of sight."""
    at = -1 if frame is None else frame
    course, heading, bearing = (
        _at(series, at) for series in (facts.target_headings_deg, facts.heading_deg, facts.bearing_deg)
    )
    if course is None or heading is None or bearing is None:
        return "unknown_fact"
    off_deg = abs(wrapped(course - heading - bearing))
    return Fact("away" if off_deg < ACROSS_DEG else "towards" if off_deg > 180.0 - ACROSS_DEG else "across")


def _motion(name: str, facts: Facts, frame: int | None) -> Fact | Missing:
    speeds = motion_speeds_of(name, facts, frame)
    still, moving = MOTIONS[name]
    return Fact(still if speeds[0] < STILL_MPS[name] else moving) if speeds else "unknown_fact"


def motion_speeds_of(name: str, facts: Facts, frame: int | None) -> list[float]:
    """Return the speeds by which something moves or not."""
    if name == "drone_motion":
        speed = facts.speed_mps[-1 if frame is None else frame]
        return [] if speed is None else [speed]
    step, mean = _at(facts.target_speeds_mps, -1 if frame is None else frame), facts.target_speed_mps
    speeds = [mean, step] if frame is None else [mean if step is None else step]
    return [speed for speed in speeds if speed is not None]


def _comparison(facts: Facts, frame: int | None) -> Fact | Missing:
    pairs = speeds_of(facts, frame)
    if not pairs:
        return "unknown_fact"
    ours, theirs = pairs[0]
    if abs(ours - theirs) <= max(MATCHING_MPS, MATCHING_SHARE * theirs):
        return Fact("matching")
    return Fact("faster" if ours > theirs else "slower")


def speeds_of(facts: Facts, frame: int | None) -> list[tuple[float, float]]:
    """Speeds of drone and target at a frame: the target's mean of the window, as the prompt gives it, or its step's,
    the likelier first."""
    ours = facts.speed_mps[-1 if frame is None else frame]
    step = _at(facts.target_speeds_mps, -1 if frame is None else frame)
    means = [facts.target_speed_mps, step] if frame is None else [step, facts.target_speed_mps]
    return [] if ours is None else [(ours, theirs) for theirs in means if theirs is not None]


def facts_meant(reference: Reference, facts: Facts) -> list[Fact]:
    """Return the facts that a writer may mean by an address: where the target's speed is in it, that of the step and of
    the window."""
    fact = look_up(reference, facts)
    found = [fact] if isinstance(fact, Fact) else []
    name = reference.quantity
    if reference.aspect or name not in ("target_speed", "speed_ratio", "speed_difference"):
        return found
    unit, digits = QUANTITIES[name].unit, QUANTITIES[name].digits
    for ours, theirs in speeds_of(facts, reference.first):
        if name == "speed_difference":
            found.append(Fact(round(ours - theirs, digits) + 0.0, unit, digits))
        elif name == "speed_ratio" and theirs:
            found.append(Fact(round(ours / theirs, digits), unit, digits))
    is_now = reference.first in (None, len(facts) - 1)
    if name == "target_speed" and is_now and facts.target_speed_mps is not None:
        found.append(Fact(facts.target_speed_mps, unit, digits))
    return found


# --- whether somebody's value is true: numbers to the digits they are written with, words with wide borders ------------

_VOCABULARY = {"trend": TRENDS, "comparison": COMPARISONS, "compared": COMPARISONS}  # another word is true of nothing


def number_holds(value: float, digits: int, fact: Fact, slack: float = 0.0) -> bool:
    """Return whether a number written with so many digits is a fact's, or within `slack` of it."""
    assert not isinstance(fact.value, str)
    # Half a unit of the coarser print: "24 m" is true of 23.7, "23.70" of a fact that is printed as 23.7.
    rounding = 0.5 * 10.0 ** -min(digits, fact.digits)
    return abs(value - fact.value) <= max(rounding, slack) + 1e-9


def word_holds(word: str, reference: Reference, facts: Facts) -> bool | None:
    """Return whether a word is true at an address; None between true and false, or where the fact is not known.

    Borders are wide: "steady" is false only of twice the spread that counts as steady, "left" only of what lies right.
    """
    fact = look_up(reference, facts)
    if not isinstance(fact, Fact):
        return None
    if fact.value == word:
        return True
    if word not in _VOCABULARY.get(reference.aspect, (word,)):
        return False
    if reference.quantity == "visibility":
        return word == "visible" and fact.value == "partly_occluded"
    if reference.quantity in MOTIONS:
        return _motion_holds(word, reference, facts)
    if reference.quantity in ("framing", "walking"):
        return None if reference.quantity == "walking" and "across" in (word, fact.value) else False
    if reference.aspect == "compared":
        return _comparison_holds(TURNED.get(word, word), facts, reference.first)
    if reference.aspect == "comparison":
        return _comparison_holds(word, facts, reference.first)
    if reference.aspect == "trend":
        return _trend_holds(word, reference, facts)
    return _side_holds(word, reference, facts)


def _motion_holds(word: str, reference: Reference, facts: Facts) -> bool | None:
    speeds = motion_speeds_of(reference.quantity, facts, reference.first)
    still, moving = MOTIONS[reference.quantity]
    border = STILL_MPS[reference.quantity]
    if word == still:
        return True if min(speeds) < border else None if min(speeds) < 2.0 * border else False
    if word == moving:
        return True if max(speeds) >= border else None if max(speeds) >= 0.9 * border else False
    return False


def _comparison_holds(word: str, facts: Facts, frame: int | None) -> bool | None:
    pairs = speeds_of(facts, frame)
    differences = [ours - theirs for ours, theirs in pairs]
    if word == "matching":
        bands = [max(MATCHING_MPS, MATCHING_SHARE * theirs) for _, theirs in pairs]
        close = [abs(d) / band for d, band in zip(differences, bands, strict=True)]
        return True if min(close) <= 1.0 else None if min(close) <= 2.0 else False
    return any(d > 0 if word == "faster" else d < 0 for d in differences)


def _trend_holds(word: str, reference: Reference, facts: Facts) -> bool | None:
    values = span_of(reference, facts)
    assert values
    spread, change = max(values) - min(values), values[-1] - values[0]
    band = QUANTITIES[reference.quantity].allowed_spread(values)
    if word == "steady":
        return None if spread <= 2.0 * band else False
    if word == "mixed":
        turns = {b > a for a, b in pairwise(values) if a != b}
        return True if len(turns) == 2 and spread > 0.5 * band else False if len(turns) < 2 else None
    return change > 0 if word == "increasing" else change < 0


def _side_holds(word: str, reference: Reference, facts: Facts) -> bool | None:
    quantity = QUANTITIES[reference.quantity]
    bare = Reference(reference.quantity, "", reference.first)
    if reference.quantity in TURNING:
        bare = Reference(reference.quantity, "change", reference.first, reference.last)
    fact = look_up(bare, facts)
    if not isinstance(fact, Fact) or isinstance(fact.value, str) or not quantity.sides:
        return None
    positive, negative, between = quantity.sides
    band = dead_band_of(reference, facts)
    if word == between:
        return None if abs(fact.value) <= band * OFF_CENTRE_SHARE / CENTRED_SHARE else False
    if word not in (positive, negative):
        return False
    value = fact.value if word == positive else -fact.value
    return True if value > 0 else None if value > -0.5 * band and value != 0 else False


def measured_series(facts: Facts) -> list[str]:
    """Return a line for each quantity that was measured: its values at the frames."""
    return [
        f"{name}: {series} {quantity.unit}"
        for name, quantity in QUANTITIES.items()
        if (series := _series(quantity.read(facts), quantity.digits))
    ]


def _series(values: Sequence[float | None], digits: int) -> str:
    """Return a series as text, "" where nothing of it is known."""
    known = any(value is not None for value in values)
    return ", ".join("-" if value is None else f"{value:.{digits}f}" for value in values) if known else ""
