"""Whether somebody's value is true at an address: numbers to the digits they are written with, words with wide
borders."""

from __future__ import annotations

from itertools import pairwise

from caption.truth.facts import Facts
from caption.truth.references import (
    CENTRED_SHARE,
    COMPARISONS,
    MATCHING_MPS,
    MATCHING_SHARE,
    MOTIONS,
    OFF_CENTRE_SHARE,
    QUANTITIES,
    STILL_MPS,
    TRENDS,
    TURNED,
    TURNING,
    Fact,
    Reference,
    dead_band_of,
    look_up,
    motion_speeds_of,
    span_of,
    speeds_of,
)

_VOCABULARY = {"trend": TRENDS, "comparison": COMPARISONS, "compared": COMPARISONS}  # another word is true of nothing


def number_holds(value: float, digits: int, fact: Fact, slack: float = 0.0) -> bool:
    """Tell whether a number written with so many digits is a fact's, or within `slack` of it."""
    assert not isinstance(fact.value, str)
    # Half a unit of the coarser print: "24 m" is true of 23.7, "23.70" of a fact that is printed as 23.7.
    rounding = 0.5 * 10.0 ** -min(digits, fact.digits)
    return abs(value - fact.value) <= max(rounding, slack) + 1e-9


def word_holds(word: str, reference: Reference, facts: Facts) -> bool | None:
    """Tell whether a word is true at an address; None between true and false, or where the fact is not known.

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
