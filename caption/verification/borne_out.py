"""Whether the facts of a window bear out what a text says without a claim: then it is only not proved.

Wide on purpose: nobody said of which quantity or frame it is meant, so any of its kind will do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations, pairwise

from caption.verification.facts import Facts, wrapped
from caption.verification.glossary import mentions
from caption.verification.numerals import Numeral
from caption.verification.references import QUANTITIES, Fact, Quantity, Reference, look_up, word_holds
from caption.verification.sizes import about_share, both_ways
from caption.verification.stated import Pole

_RATES = {"mps": "m", "dps": "deg", "px": "px"}  # pixels per second are written as pixels
_SHARE_SLACK = 0.02
_TRENDS = ("increasing", "decreasing", "steady")
_GAPS = {"near": "decreasing", "far": "increasing"}
_SIDED = ("yaw", "bearing", "offset_x", "target_heading")


def bears_out_number(numeral: Numeral, facts: Facts) -> bool:
    """Return whether any value, change or rate of the window has a numeral's size and unit."""
    if numeral.kind == "clock":
        return _is_at_hour(numeral.value, facts)
    if numeral.value == 1.0 and not any(map(str.isdigit, numeral.text)):
        return True  # "by a single pixel" is no measurement
    if numeral.kind == "ratio" or numeral.unit in ("percent", "times"):
        share = numeral.value / 100.0 if numeral.unit == "percent" else numeral.value
        slack = max(_SHARE_SLACK, (0.1 if numeral.kind == "ratio" or numeral.is_about else _SHARE_SLACK) * share)
        return any(abs(share - ratio) <= slack for ratio in _ratios(facts))
    # A difference of two rounded values is off by one of their last digit.
    slack = max(1.1 * numeral.half, about_share(numeral.value) * numeral.value if numeral.is_about else 0.0) + 1e-9
    least = 0.4 * numeral.value if numeral.bound < 0 else numeral.value  # "less than ten degrees" is not said of one
    most = 1.5 * numeral.value if numeral.bound > 0 else numeral.value
    return any(
        least - slack <= abs(size) <= most + slack
        for size in (*_sizes(numeral.unit, facts), *_between(numeral.unit, facts))
    )


def _sizes(unit: str, facts: Facts) -> Iterator[float]:
    for quantity in QUANTITIES.values():
        known = _known(quantity, facts)
        if unit in (quantity.unit, ""):
            yield from (value for _, value in known)
        if unit in (quantity.unit, ""):
            yield from (b - a for (_, a), (_, b) in combinations(known, 2))
        if unit == quantity.unit and known:
            yield sum(value for _, value in known) / len(known)
        if _RATES.get(unit) == quantity.unit:
            yield from ((b - a) / ((j - i) * facts.step_s) for (i, a), (j, b) in combinations(known, 2))


def _between(unit: str, facts: Facts) -> Iterator[float]:
    """Yield what lies between two quantities: the angle of the two headings, the ways, the two speeds."""
    if unit in ("mps", "") and facts.target_speed_mps is not None:
        yield facts.target_speed_mps
        yield (facts.speed_mps[-1] or 0.0) - facts.target_speed_mps
    if unit == "deg":
        yield facts.target_turn_deg or 0.0
        pairs = zip(facts.heading_deg, facts.target_headings_deg, strict=False)
        yield from (wrapped(theirs - ours) for ours, theirs in pairs if theirs is not None)
        walked = [heading for heading in facts.target_headings_deg if heading is not None]
        yield from (wrapped(b - a) for a, b in combinations(walked, 2))
    if unit == "m" and facts.travelled_m and facts.target_travelled_m and facts.target_travelled_m[-1] is not None:
        yield facts.travelled_m[-1] - facts.target_travelled_m[-1]


def _is_at_hour(hour: float, facts: Facts) -> bool:
    """Return whether the person was at an hour of the clock, by bearing or, where that is not known, by the side in the
    picture."""
    angle = wrapped(-30.0 * (hour % 12))
    bearings = [bearing for bearing in facts.bearing_deg if bearing is not None]
    if bearings:
        return any(abs(wrapped(angle - bearing)) <= 20.0 for bearing in bearings)
    return angle == 0.0


def _ratios(facts: Facts) -> Iterator[float]:
    """Yield the shares and multiples between values of one quantity now and before, and between the two speeds."""
    for quantity in QUANTITIES.values():
        known = _known(quantity, facts)
        if quantity.unit in ("m", "mps", "px") and known:
            last = known[-1][1]
            for _, value in known[:-1]:
                if value and last:
                    yield from both_ways(abs(last / value))
    if facts.displacement_m and facts.travelled_m and facts.travelled_m[-1]:
        yield facts.displacement_m[-1] / facts.travelled_m[-1]
    sizes = (facts.box_width_px, facts.box_height_px, facts.offset_x_px, facts.offset_y_px)
    for series, whole in zip(sizes, (facts.width_px, facts.height_px) * 2, strict=True):
        if series and series[-1] is not None:
            yield abs(series[-1]) / whole  # "one percent of the picture's width"
    step = facts.target_speeds_mps[-1] if facts.target_speeds_mps else None
    walked = facts.target_travelled_m[-1] if facts.target_travelled_m else None
    way = facts.travelled_m[-1] if facts.travelled_m else None
    ours = facts.speed_mps[-1]
    for one, other in ((ours, facts.target_speed_mps), (ours, step), (way, walked)):
        if one and other:
            yield from both_ways(one / other)


def _known(quantity: Quantity, facts: Facts) -> list[tuple[int, float]]:
    return [(i, value) for i, value in enumerate(quantity.read(facts)) if value is not None]


def bears_out_pole(pole: Pole, facts: Facts) -> bool:
    """Return whether a word of side, course, state ... is true of the window in a way that its sentence could mean."""
    match pole.dimension, pole.value:
        case "visibility", _:
            return _is_seen(pole, facts)
        case "motion", "standing":
            return _holds_any("standing", ["target_motion"], facts) or _holds_any("hovering", ["drone_motion"], facts)
        case "motion", _:
            return _holds_any("walking", ["target_motion"], facts) or _holds_any("moving", ["drone_motion"], facts)
        case "trend", "mixed":
            return _holds_any("mixed", QUANTITIES, facts, "trend")
        case "trend", value:
            return _has_trend(value, [name for name, q in QUANTITIES.items() if not q.sides], facts)
        case "gap", value:
            return _has_trend(_GAPS[value], ["distance", "slant"], facts)
        case "pace", value:
            return _is_pace(pole, value, facts)
        case "side", value:
            return any(_holds_any(value, [name], facts, "side") for name in _SIDED) or _was_at_side(value, facts)
        case "level", value:
            return _holds_any(value, ["offset_y"], facts, "side") or value == "below"
    return True  # bends and centres: words that nothing here measures closely


def bears_out_own(pole: Pole, facts: Facts) -> bool:
    """Return whether a word that names its quantity ("lost altitude") is true of just that."""
    return (
        pole.value in _TRENDS
        and bool(mentions("of_height").search(pole.word))
        and _has_trend(pole.value, ["altitude"], facts)
    )


def _holds_any(word: str, names: Iterable[str], facts: Facts, aspect: str = "") -> bool:
    return any(word_holds(word, Reference(name, aspect), facts) is True for name in names)


def _was_at_side(side: str, facts: Facts) -> bool:
    """Return whether in a frame or a step something was on a side, or turned to it."""
    sign = 1 if side == "left" else -1
    places = [-value for value in facts.offset_x_px if value is not None]
    turns = [b - a for a, b in pairwise(facts.yaw_deg)]
    return any(sign * value > 0 for value in (*places, *facts.yaw_deg, *turns))


def _is_seen(pole: Pole, facts: Facts) -> bool:
    meant = {
        "full": ("visible",),
        "visible": ("visible", "partly_occluded"),
        "glimpsed": ("visible", "partly_occluded"),
        "illegible": ("illegible", "partly_occluded", "visible"),  # how well somebody sees is told mildly
        "partly": ("partly_occluded", "illegible"),  # of less than LEGIBLE_SHARE nobody makes anything out
        "hidden": ("occluded", "out_of_view", "partly_occluded", "illegible"),
        "gone": ("occluded", "out_of_view"),
    }[pole.value]
    frames = [frame for frame in pole.frames if frame < len(facts)]
    if frames:
        return all(facts.visibility[frame] in meant for frame in frames)
    return any(word in meant for word in facts.visibility)


def _has_trend(word: str, names: Iterable[str], facts: Facts) -> bool:
    """Return whether a quantity goes so over the whole window or in a step of it."""
    for name in names:
        fact = look_up(Reference(name, "trend"), facts)
        if isinstance(fact, Fact) and fact.value == word:
            return True
        steps = [b - a for (_, a), (_, b) in pairwise(_known(QUANTITIES[name], facts))]
        if any((word == "increasing" and step > 0) or (word == "decreasing" and step < 0) for step in steps):
            return True
    return False


def _is_pace(pole: Pole, word: str, facts: Facts) -> bool:
    if pole.is_compared and word != "matching":
        ours = word if pole.about == "drone" else {"faster": "slower", "slower": "faster"}[word]
        return _holds_any(ours, ["speed"], facts, "comparison")
    course = {"faster": "increasing", "slower": "decreasing", "matching": "steady"}[word]
    names = {"drone": ["speed"], "target": ["target_speed"]}.get(pole.about, ["speed", "target_speed"])
    if pole.about != "target" and _holds_any(word, ["speed"], facts, "comparison"):
        return True
    return _has_trend(course, names, facts)
