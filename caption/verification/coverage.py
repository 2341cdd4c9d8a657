"""Whether a sentence says what its claims say: numerals, sides, courses, states.

A numeral or an opposite without a claim was compared with nothing: it proves nothing, and is a problem where it is not
true.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from caption.verification.borne_out import bears_out_number, bears_out_own, bears_out_pole
from caption.verification.facts import Facts
from caption.verification.glossary import mentions
from caption.verification.numerals import Numeral
from caption.verification.poles import ACTION_WORDS
from caption.verification.references import QUANTITIES
from caption.verification.said import Said, frames_of
from caption.verification.sizes import may_mean, same_size
from caption.verification.stated import Pole, Stated, lexicon_of, read_stated
from cosfly.formats.captions import Claim, Language

# Words, negated or not, that say that the person is seen, and that not all is.
_SEEN = {
    ("glimpsed", False), ("visible", False), ("full", False), ("partly", False), ("hidden", True), ("gone", True),
    ("partly", True), ("illegible", False),
}  # fmt: skip
_UNSEEN = {("hidden", False), ("gone", False), ("visible", True), ("glimpsed", True)}
_PARTLY = {("partly", False), ("hidden", False), ("visible", False), ("full", True)}
_ILLEGIBLE = _PARTLY - {("visible", False)} | {("illegible", False), ("visible", True)}
_SAID = {"visible": _SEEN, "partly_occluded": _PARTLY, "illegible": _ILLEGIBLE}

_PAIRS = (
    ("increasing", "decreasing"), ("left", "right"), ("faster", "slower"), ("near", "far"), ("visible", "hidden"), ("above", "below"),
)  # fmt: skip
_OPPOSITES = {**dict(_PAIRS), **{other: one for one, other in _PAIRS}}


@dataclass(frozen=True)
class ClaimCoverage:
    """What the claims of a sentence leave over. is_whole: every number and every opposite of it has a claim."""

    problems: tuple[str, ...]
    is_whole: bool


def cover(text: str, claims: Sequence[Claim], facts: Facts, language: Language) -> ClaimCoverage:
    """Return what of a sentence neither a claim covers nor the facts bear out, and which claims it says the opposite
    of.

    A word or a number without a claim is no problem where it is true of the window, unless a claim of its kind is
    missing in the
    sentence: then it stands in the place of what was claimed.

    Args:
        text: a sentence. claims: all of it.
    """
    stated = read_stated(text, language)
    said = Said(claims, facts, language)
    uncovered = [numeral for numeral in stated.numerals if not said.covers_numeral(numeral, stated)]
    problems = [f"uncovered: {text}" for text in _wrong_numerals(stated, said, uncovered)]
    poles = list(_uncovered_poles(stated, said, facts, language))
    problems += [f"uncovered: {pole.word}" for pole, is_problem in poles if is_problem]
    problems += [f"text says otherwise: {name}" for name in _denied_words(stated, said)]
    problems += [f"claims disagree: {name}" for name in said.turned_comparisons()]
    problems += [f"text says otherwise: {words}" for words in _denied_numbers(stated, said)]
    problems += [f"not in the text: scene {number}" for number in said.absent_scenery(stated)]
    return ClaimCoverage(tuple(problems), not uncovered and not poles)


def _wrong_numerals(stated: Stated, said: Said, uncovered: Sequence[Numeral]) -> Iterator[str]:
    """Yield the numerals that stand in the place of a claim's, or that the facts do not bear out."""
    missing = [claim for claim in said.numbers if not said.is_written(claim, stated)]
    for numeral in stated.numerals:
        in_place_of = [claim for claim in missing if _is_of_kind(numeral, claim)]
        if numeral not in uncovered:
            if _is_repeated(numeral, in_place_of, stated, said):
                yield f"{numeral.text} once more"
        elif in_place_of and _is_said_otherwise(numeral, missing, said):
            continue
        elif in_place_of or not bears_out_number(numeral, said.facts):
            yield numeral.text


def _is_repeated(numeral: Numeral, in_place_of: Sequence[Claim], stated: Stated, said: Said) -> bool:
    """Return whether a number stands more often in the text than in the claims, where a value of its kind is missing."""
    if not any(claim.quantity in QUANTITIES for claim in in_place_of):
        return False
    same = [n for n in stated.numerals if (n.value, n.unit, n.kind) == (numeral.value, numeral.unit, "number")]
    return len(same) > max(1, sum(same_size(numeral, claim) for claim in said.numbers))


def _is_said_otherwise(numeral: Numeral, missing: Sequence[Claim], said: Said) -> bool:
    """Return whether a number says what a missing claim says: "from 20.5 to 17 m" where the change is claimed, or the
    other way round."""
    return any(
        same_size(numeral, one)
        for claim in missing
        for one in said.implied_by(claim)
        if not any(other.quantity == one.quantity for other in missing)
    )


def _is_of_kind(numeral: Numeral, claim: Claim) -> bool:
    """Return whether a numeral could stand where a claim's number should."""
    if numeral.kind == "ratio" or numeral.unit in ("percent", "times"):
        return claim.unit in ("percent", "times")
    return not numeral.unit or not claim.unit or numeral.unit == claim.unit or may_mean(numeral.unit, claim.unit)


def _name(claim: Claim) -> str:
    return f"{claim.quantity}{'@' + claim.at if claim.at else ''} {claim.value}"


# --- text against claims ----------------------------------------------------------------------------------------------


def _uncovered_poles(stated: Stated, said: Said, facts: Facts, language: Language) -> Iterator[tuple[Pole, bool]]:
    """Yield the words without a claim, and whether that is a problem."""
    strict = lexicon_of(language).strict
    in_text = {(pole.dimension, pole.value) for pole in stated.poles if not pole.is_negated}
    for pole in stated.poles:
        covers = {value for dimension, value in said.poles if dimension == pole.dimension}
        is_led = _is_led(pole, said, facts)
        if is_led is not None:
            is_covered = is_led
        elif pole.is_negated:
            is_covered = not _denies(pole, covers)
        elif said.denies_frames(pole):
            is_covered = False
        elif pole.dimension == "visibility" and pole.frames and not said.names_frames(pole):
            is_covered = bears_out_pole(pole, facts)
        elif pole.dimension == "pace" and pole.value != "matching":
            is_covered = _covers_pace(pole, said)
        elif pole.dimension == "trend" and (pole.is_than or mentions("comparatives").fullmatch(pole.word)):
            is_covered = pole.value in covers or (said.compares and not covers & {"increasing", "decreasing"})
        else:
            # Mostly what a side is told from.
            is_covered = pole.value in covers or pole.dimension == "centre" or pole.value == "glimpsed"
        if is_covered:
            continue
        lost = {
            value
            for dimension, value in said.worded
            if dimension == pole.dimension and (dimension, value) not in in_text
        }
        is_strict = pole.dimension in strict or f"{pole.dimension}.{pole.value}" in strict
        is_strict = is_strict or (pole.dimension == "level" and bool(covers))
        is_wished = pole.is_plan or (pole.is_after_plan and said.has_plan) or pole.is_scenery
        if is_led is not None:
            yield pole, True
            continue
        lost = set() if pole.is_plan and pole.dimension != "side" else lost
        observed = {value for dimension, value in said.observed if dimension == pole.dimension}
        is_true = bears_out_pole(pole, facts) and (
            pole.dimension == "visibility"
            or pole.value == "mixed"
            or not observed - {pole.value}
            or bears_out_own(pole, facts)
        )
        lost = {value for value in lost if not is_true or _OPPOSITES.get(value) == pole.value}
        is_problem = bool(lost) or (is_strict and not is_wished and not is_true and not said.is_scenery)
        if is_problem or (is_strict and not is_wished):
            yield pole, is_problem


def _is_led(pole: Pole, said: Said, facts: Facts) -> bool | None:
    """Return whether the number that "fell by" or "climbed to" leads bears the word out; None where it is no claim's."""
    if pole.number is None or pole.is_negated or pole.value not in ("increasing", "decreasing", "steady"):
        return None
    claims = [claim for claim in said.numbers if same_size(pole.number, claim)]
    changes = [c for c in claims if c.quantity.partition(":")[0] in ("change", "rate", "growth") and c.value]
    if changes and pole.value != "steady":
        return any(("trend", pole.value) in said.poles_of(claim) for claim in changes)
    if pole.is_than or pole.word.startswith("比") or mentions("comparatives").fullmatch(pole.word):
        return None
    verdicts = [_has_come(pole.value, claim, facts) for claim in claims]
    if True in verdicts:
        return True
    return False if False in verdicts and None not in verdicts else None


def _has_come(word: str, claim: Claim, facts: Facts) -> bool | None:
    """Return whether a quantity came up or down to its value at a frame, from the frame before or from the first; None:
    not known."""
    quantity = QUANTITIES.get(claim.quantity)
    if quantity is None or quantity.sides or claim.modality != "observed":
        return None
    series = quantity.read(facts)
    frame = next(frames_of(claim), len(facts) - 1)
    earlier = [value for value in series[:frame] if value is not None]
    now = series[frame] if frame < len(series) else None
    if now is None or not earlier:
        return None
    if word == "steady":
        return True if abs(now - earlier[-1]) <= quantity.allowed_spread([now, earlier[-1]]) else None
    return any((now > before) == (word == "increasing") and now != before for before in (earlier[0], earlier[-1]))


def _denies(pole: Pole, covers: set[str]) -> bool:
    """Return whether claims say only what a negated word denies."""
    same = {"visible", "full"} if pole.value in ("visible", "full") else {pole.value}
    if pole.dimension in ("side", "centre", "level", "gap", "pace", "bend"):
        return False  # "no turn to the left is needed": claims say why, not what is not
    return bool(covers) and covers <= same


def _covers_pace(pole: Pole, said: Said) -> bool:
    """Return whether claims cover "faster" or "slower": said of the target, a comparison of drone and target is the
    other way round."""
    other = {"faster": "slower", "slower": "faster"}
    if mentions("of_change").search(pole.word):
        return ("paced", pole.value) in said.poles
    if pole.is_compared:
        return ("compared", pole.value if pole.about == "drone" else other[pole.value]) in said.poles
    if ("pace", pole.value) in said.poles and (pole.about != "target" or ("compared", pole.value) not in said.poles):
        return True
    return pole.about != "drone" and ("compared", other[pole.value]) in said.poles


def _denied_words(stated: Stated, said: Said) -> Iterator[str]:
    """Yield the claims in words whose opposite the text says instead."""
    told = [pole for pole in stated.poles if pole.dimension == "visibility"]
    seen = {(pole.value, pole.is_negated) for pole in told}
    mentions = [pole.value for pole in stated.poles if pole.dimension == "side"]
    claimed = [side for claim in said.words for side in ("left", "right") if side in str(claim.value)]
    for side, other in (("left", "right"), ("right", "left")):
        if side in claimed and side not in mentions and mentions.count(other) > claimed.count(other):
            yield side
    seen_claimed = {claim.value for claim in said.words if claim.quantity == "visibility"}
    is_in_other_words = len(told) < len(seen_claimed)  # that the list does not hold
    has_partly = any(claim.value == "partly_occluded" for claim in said.words)
    for claim in said.words:
        if (
            claim.quantity == "visibility"
            and claim.modality == "observed"
            and not (is_in_other_words or all(map(_is_wish, told)))
        ):
            says = _SAID.get(str(claim.value), _UNSEEN)
            if not seen & says and not (("partly", False) in seen and not has_partly):
                yield _name(claim)
        elif claim.quantity in ("side:offset_x", "side:bearing") and claim.value in ("centred", "straight"):
            places = {
                pole.value
                for pole in stated.poles
                if pole.dimension == "centre" and not (pole.is_negated or pole.is_plan)
            }
            if "off_centre" in places and not _is_off_somewhere(said):
                yield _name(claim)
        elif claim.quantity == "decision" and claim.modality == "predicted":
            word = ACTION_WORDS.get(str(claim.value))
            if stated.named and word not in stated.actions:
                yield _name(claim)


def _is_wish(pole: Pole) -> bool:
    return pole.is_plan or pole.is_after_plan


def _is_off_somewhere(said: Said) -> bool:
    """Return whether a claim says that the person is, was or will be out of the middle of the picture."""
    places = [
        claim for claim in said.claims if claim.quantity.rpartition(":")[2] in ("offset_x", "offset_y", "bearing")
    ]
    return any(claim.value not in ("centred", "straight") for claim in places if claim.quantity[:4] != "trend")


# --- words beside a number that turn it round: its side, the order of two values of one quantity -----------------------

# What may stand between a number and its side, and between a value and a later one.
_AFTER = re.compile(r"\s*(?:(?:to|towards?|on|of)(?: the| its| your)?|further|more|的|偏)?\s*", re.IGNORECASE)
_BEFORE = re.compile(r"\s*(?:by|of|at|about|转了?|偏航?|侧|移了?|边|方|了|约|累计)*\s*", re.IGNORECASE)
_LATER = re.compile(
    r"\s*(?:m|px|m/s|°|deg)?\s*(?:(?:up |down |back )?to|->|→|⟶|[^，。；、,;\d]{0,4}[到至成为])\s*", re.IGNORECASE
)


def _denied_numbers(stated: Stated, said: Said) -> Iterator[str]:
    """Yield the numbers whose claims are on the other side, or of frames in the other order, than the words beside them
    say."""
    for numeral in stated.numerals:
        pole = _side_of(numeral, stated)
        if pole is None:
            continue
        signed = [claim for claim in said.numbers if same_size(numeral, claim) and _has_side(claim, pole, said)]
        if signed and not any((pole.dimension, pole.value) in said.poles_of(claim) for claim in signed):
            yield f"{numeral.text} {pole.word}"
    for first, second in pairwise(stated.numerals):
        between = stated.text[first.start + len(first.text) : second.start]
        if first.value != second.value and _LATER.fullmatch(between) and _is_turned(first, second, said):
            yield f"{first.text} {between.strip()} {second.text}"


def _side_of(numeral: Numeral, stated: Stated) -> Pole | None:
    """Return the word of a side that stands directly beside a number, after it or before it."""
    end = numeral.start + len(numeral.text)
    poles = [pole for pole in stated.poles if pole.dimension in ("side", "level") and not pole.is_negated]
    for pole in poles:
        if pole.start >= end and _AFTER.fullmatch(stated.text, end, pole.start):
            return pole
    for pole in poles:
        if _BEFORE.fullmatch(stated.text, pole.start + len(pole.word), numeral.start):
            return pole
    return None


def _has_side(claim: Claim, pole: Pole, said: Said) -> bool:
    return any(dimension == pole.dimension for dimension, _ in said.poles_of(claim))


def _is_turned(first: Numeral, second: Numeral, said: Said) -> bool:
    """Return whether two numbers are values of one quantity at frames in the other order, by every reading of the
    claims."""
    orders = [
        min(frames_of(one), default=0) < min(frames_of(other), default=0)
        for one in said.numbers
        for other in said.numbers
        if one.quantity == other.quantity and one.at != other.at and same_size(first, one) and same_size(second, other)
    ]
    return bool(orders) and not any(orders)
