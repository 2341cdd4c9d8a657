"""Words that stand beside a number and turn it round: the side that it is on, the order of two values of one
quantity."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise

from caption.truth.numerals import Numeral
from caption.truth.poles import poles_of
from caption.truth.said import Said, frames_of
from caption.truth.sizes import same_size
from caption.truth.stated import Pole, Stated
from cosfly.products.captions import Claim

# What may stand between a number and its side, and between a value and a later one.
_AFTER = re.compile(r"\s*(?:(?:to|towards?|on|of)(?: the| its| your)?|further|more|的|偏)?\s*", re.IGNORECASE)
_BEFORE = re.compile(r"\s*(?:by|of|at|about|转了?|偏航?|侧|移了?|边|方|了|约|累计)*\s*", re.IGNORECASE)
_LATER = re.compile(
    r"\s*(?:m|px|m/s|°|deg)?\s*(?:(?:up |down |back )?to|->|→|⟶|[^，。；、,;\d]{0,4}[到至成为])\s*", re.IGNORECASE
)


def denied_numbers(stated: Stated, said: Said) -> Iterator[str]:
    """Yield the numbers whose claims are on the other side, or of frames in the other order, than the words beside them
    say."""
    for numeral in stated.numerals:
        pole = _side_of(numeral, stated)
        if pole is None:
            continue
        signed = [claim for claim in said.numbers if same_size(numeral, claim) and _has_side(claim, pole)]
        if signed and not any((pole.dimension, pole.value) in poles_of(claim) for claim in signed):
            yield f"{numeral.text} {pole.word}"
    for first, second in pairwise(stated.numerals):
        between = stated.text[first.start + len(first.text) : second.start]
        if first.value != second.value and _LATER.fullmatch(between) and _is_turned(first, second, said):
            yield f"{first.text} {between.strip()} {second.text}"


def _side_of(numeral: Numeral, stated: Stated) -> Pole | None:
    """Give the word of a side that stands directly beside a number, after it or before it."""
    end = numeral.start + len(numeral.text)
    poles = [pole for pole in stated.poles if pole.dimension in ("side", "level") and not pole.is_negated]
    for pole in poles:
        if pole.start >= end and _AFTER.fullmatch(stated.text, end, pole.start):
            return pole
    for pole in poles:
        if _BEFORE.fullmatch(stated.text, pole.start + len(pole.word), numeral.start):
            return pole
    return None


def _has_side(claim: Claim, pole: Pole) -> bool:
    return any(dimension == pole.dimension for dimension, _ in poles_of(claim))


def _is_turned(first: Numeral, second: Numeral, said: Said) -> bool:
    """Tell whether two numbers are values of one quantity at frames in the other order, by every reading of the
    claims."""
    orders = [
        min(frames_of(one), default=0) < min(frames_of(other), default=0)
        for one in said.numbers
        for other in said.numbers
        if one.quantity == other.quantity and one.at != other.at and same_size(first, one) and same_size(second, other)
    ]
    return bool(orders) and not any(orders)
