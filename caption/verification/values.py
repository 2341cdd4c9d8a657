"""Values in running text: each number with a unit is compared with the measured facts of its window.

A number that is one of the facts of its unit (a frame's value, a mean, a difference between two frames, a rate) is
matched: it may still be the wrong quantity. Where its clause names one quantity, the facts of this quantity alone
count. A number that matches none is contradicted. Words are not checked, and neither are numbers in words.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

from caption.verification.facts import Facts, Series
from caption.verification.glossary import ends_of_clauses, mentioned, mentions
from caption.verification.numerals import Numeral, read_numerals
from cosfly.formats.captions import Language, ValueCounts
from cosfly.geometry.axes import wrap_deg

MAX_SENTENCE = 500  # characters of a sentence that is read: a model that repeats itself never ends its sentence
MAX_CLAUSE = 80  # characters of a clause in a message
ABOUT_SHARE = 0.08  # by which an approximate number may miss its fact
ABOUT_LEAST = {"m": 0.5, "mps": 0.1, "deg": 2.0, "dps": 1.0, "px": 4.0}
BOUND_SHARE = 0.3  # "more than 20 m" is matched by 20 to 26 m
FOREIGN_SHARE = 0.03  # of a number in another unit than ours, which its writer has converted
DIGITS = {"m": 1, "mps": 2, "deg": 1, "dps": 1, "px": 0}  # with which facts are printed; other units are not compared


class ValueCheck(NamedTuple):
    """The values of one text."""

    counts: ValueCounts
    contradictions: list[str]  # a message for each contradicted value


def check_values(sentences: Sequence[str], facts: Facts, language: Language, filled: int = 0) -> ValueCheck:
    """Compare the numbers of a text with the facts of its window. `filled` slots are not in its sentences any more."""
    matched = 0
    is_hypothetical = mentions("hypothetical", "", language)
    contradictions: list[str] = []
    for sentence in sentences:
        if len(sentence) > MAX_SENTENCE:
            continue
        for numeral in read_numerals(sentence, language):
            clause = _clause_around(sentence, numeral, language)
            if numeral.unit not in DIGITS or is_hypothetical.search(clause):
                continue
            name = named_quantity(clause, numeral, language)
            if _matches_any(numeral, name, facts):
                matched += 1
            else:
                quantity = name.replace("_", " ") if name else "quantity"
                quoted = f'"{numeral.text.strip()}" in "{clause.strip()[:MAX_CLAUSE]}"'
                contradictions.append(f"number: {quoted} is no measured {quantity} of the window")
    counts = ValueCounts(values_filled=filled, values_matched=matched, values_contradicted=len(contradictions))
    return ValueCheck(counts, contradictions)


def _clause_around(sentence: str, numeral: Numeral, language: Language) -> str:
    """Return the clause of a sentence in which a number stands."""
    start, end = 0, len(sentence)
    for match in ends_of_clauses(language).finditer(sentence):
        if match.end() <= numeral.start:
            start = match.end()
        elif match.start() >= numeral.start + len(numeral.text):
            end = match.start()
            break
    return sentence[start:end]


def named_quantity(clause: str, numeral: Numeral, language: Language) -> str:
    """Return the one quantity with which a number is compared, as its clause names it; "" where it is not clear, as for a
    speed after the names of both drone and target, or in a clause that compares."""
    if numeral.unit == "mps":
        subjects = mentioned("subjects", clause, language)
        before = clause[: max(0, clause.find(numeral.text))]
        if len(subjects) != 1 or not mentions("subjects", subjects[0], language).search(before):
            return ""
        compares = mentions("comparatives", "", language).search(clause) or len(read_numerals(clause, language)) > 1
        return "" if compares else subjects[0]
    quantities = mentioned("quantities", clause, language)
    return quantities[0] if len(quantities) == 1 and (numeral.unit, quantities[0]) in _SERIES else ""


# --- what a number may be ---------------------------------------------------------------------------------------------


# (unit, quantity that a clause names) -> its series. "" has the series of its unit that no quantity has.
_SERIES: dict[tuple[str, str], Callable[[Facts], tuple[Series, ...]]] = {
    ("m", "altitude"): lambda f: (f.altitude_m, f.height_over_target_m),
    ("m", "distance"): lambda f: (
        f.distance_m, f.slant_m, f.travelled_m, f.displacement_m, f.target_travelled_m, f.other_distance_m,
        f.place_axis_m(0),
    ),
    ("m", ""): lambda f: (f.place_axis_m(1),),
    ("mps", "drone"): lambda f: (
        f.speed_mps, f.step_speeds_mps, f.climb_mps, (f.mean_speed_mps,), *[(speed,) for speed in f.velocity_mps],
    ),
    ("mps", "target"): lambda f: (
        f.target_speeds_mps, f.target_step_speeds_mps, (f.target_speed_mps,),
        *[(speed,) for speed in f.target_velocity_mps or ()],
    ),
    ("deg", "yaw"): lambda f: (f.yaw_deg, f.heading_deg, f.bearing_deg),
    ("deg", ""): lambda f: (f.pitch_deg, f.depression_deg, f.target_headings_deg, (f.target_turn_deg,)),
    ("dps", ""): lambda f: (f.yaw_rate_dps,),
    ("px", "box"): lambda f: (f.box_width_px, f.box_height_px),
    ("px", "offset"): lambda f: (f.offset_x_px, f.offset_y_px),
}  # fmt: skip
_RATE_OF = {"mps": "m", "dps": "deg"}  # unit -> unit of what changes by it per second


def _series_of(name: str, unit: str, facts: Facts) -> list[Series]:
    """Return the series that a number of a unit may be of, where its clause names a quantity ("": any of the unit)."""
    keys = [key for key in _SERIES if key[0] == unit and name in ("", key[1])]
    return [series for key in keys for series in _SERIES[key](facts)]


class Pool(NamedTuple):
    """The values that a number in a text may have."""

    exact: set[float]  # the facts as printed
    derived: set[float]  # means, differences and rates of them


def _pool_of(name: str, unit: str, facts: Facts) -> Pool:
    """Return the pool of a unit and a quantity; it is computed once per window."""
    key = ("pool", name, unit)
    if key not in facts.found:
        facts.found[key] = _make_pool(name, unit, facts)
    return facts.found[key]  # type: ignore[no-any-return]


def _make_pool(name: str, unit: str, facts: Facts) -> Pool:
    exact: set[float] = set()
    derived: set[float] = set()
    for series in _series_of(name, unit, facts):
        known = [value for value in series if value is not None]
        exact.update(map(abs, known))
        derived.update(abs(b - a) for a, b in combinations(known, 2))
        for i in range(len(known)):  # means from a frame on, and up to it
            derived.add(abs(sum(known[i:]) / len(known[i:])))
            derived.add(abs(sum(known[: i + 1]) / (i + 1)))
    if unit == "deg":
        derived |= {360.0 - angle for angle in derived}
    if unit in _RATE_OF:
        for series in _series_of("", _RATE_OF[unit], facts):
            for (i, a), (j, b) in combinations(enumerate(series), 2):
                if a is not None and b is not None:
                    derived.add(abs(b - a) / ((j - i) * facts.step_s))
    if not name:
        derived.update(_differences(unit, facts))
    return Pool(exact, derived)


def _differences(unit: str, facts: Facts) -> Iterator[float]:
    """Yield by how much the drone and the target differ at the same time, in speed or heading."""
    mean_of_target = (facts.target_speed_mps,) * len(facts)
    pairs: dict[str, tuple[tuple[Series, Series], ...]] = {  # of the drone, of the target
        "mps": (
            (facts.speed_mps, facts.target_speeds_mps),
            (facts.step_speeds_mps, facts.target_step_speeds_mps),
            (facts.step_speeds_mps, mean_of_target),
            ((facts.mean_speed_mps,), mean_of_target[:1]),
            (facts.velocity_mps[:2], facts.target_velocity_mps or (None, None)),
        ),
        "deg": ((facts.heading_deg, facts.target_headings_deg),),
    }
    for of_drone, of_target in pairs.get(unit, ()):
        for a, b in zip(of_drone, of_target, strict=True):
            if a is not None and b is not None:
                yield abs(wrap_deg(b - a)) if unit == "deg" else abs(b - a)


def _matches_any(numeral: Numeral, name: str, facts: Facts) -> bool:
    width_px, height_px = facts.width_px, facts.height_px
    if numeral.unit == "px" and numeral.value in (width_px, height_px, width_px / 2, height_px / 2):
        return True
    last_digit = 10.0 ** -DIGITS[numeral.unit]
    pool = _pool_of(name, numeral.unit, facts)
    is_fact = any(_matches(numeral, fact, 0.5 * last_digit) for fact in pool.exact)
    return is_fact or any(_matches(numeral, fact, last_digit) for fact in pool.derived)


def _matches(numeral: Numeral, fact: float, rounding: float) -> bool:
    """Return whether a number is a fact, to the digits with which it is written; the fact may be off by `rounding`."""
    value = numeral.value
    slack = max(numeral.half, rounding) + 1e-9
    if numeral.factor != 1.0:
        slack += FOREIGN_SHARE * value
    if numeral.is_about:
        slack = max(slack, ABOUT_SHARE * fact, ABOUT_LEAST[numeral.unit])
    if numeral.bound and -slack <= numeral.bound * (fact - value) <= BOUND_SHARE * value + slack:
        return True
    return abs(value - fact) <= slack


def measured_lines(facts: Facts, contradictions: Sequence[str]) -> str:
    """Return the measured values of the quantities that contradictions name, of all quantities if they name none."""
    quantities = {
        "altitude": ("altitude", facts.altitude_m, "m"),
        "distance": ("horizontal distance", facts.distance_m, "m"),
        "drone": ("drone speed", facts.speed_mps, "m/s"),
        "target": ("target speed", facts.target_speeds_mps, "m/s"),
        "yaw": ("yaw against the first frame", facts.yaw_deg, "deg"),
        "box": ("box height", facts.box_height_px, "px"),
        "offset": ("offset to the right of the image centre", facts.offset_x_px, "px"),
    }
    named = [name for name in quantities if any(f"measured {name} " in text for text in contradictions)]
    lines = []
    for label, series, unit in map(quantities.__getitem__, named or quantities):
        values = ", ".join("-" if value is None else f"{value:g}" for value in series)
        lines.append(f"{label}: {values} {unit}")
    return "; ".join(lines)
