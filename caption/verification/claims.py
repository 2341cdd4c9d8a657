"""Claims: what a sentence states, in a form that can be compared exactly with the facts.

A claim names a fact by its reference (references.py) and gives its value. A teacher that writes slots claims what it
says in words of its own (caption/answer_formats/slots.py).
"""

from __future__ import annotations

from collections.abc import Sequence

from caption.schema import Judged
from caption.verification.coverage import cover
from caption.verification.facts import Facts
from caption.verification.numerals import Numeral
from caption.verification.references import (
    MOTIONS,
    STEPS,
    TURNING,
    TURNS,
    Fact,
    Missing,
    Reference,
    facts_meant,
    look_up,
    number_holds,
    parse_reference,
    word_holds,
)
from caption.verification.said import SCENE
from caption.verification.sizes import BOUND_SHARE, RATIO_SLACK, about_share, numeral_of, written_digits
from caption.verification.stated import read_stated
from cosfly.formats.captions import Claim, Language, SentenceState
from cosfly.llm.answer_text import normalize_action

TOLERANCES = {"m": 0.3, "mps": 0.15, "px": 3.0}  # of a number that a sentence calls approximate


def judge_sentence(
    name: str,
    text: str,
    claims: Sequence[Claim],
    decision: str,
    facts: Facts,
    language: Language,
) -> Judged:
    """Judge one sentence by its claims.

    Observed claims are compared with the facts, predicted ones with the decision, hypothetical ones with the words
    alone. A numeral or a word of an opposite without a claim must be true of the window, and proves nothing
    (coverage.py).
    """
    is_about = read_stated(text, language).is_approximate
    problems, states = [], []
    for claim in claims:
        numeral = numeral_of(text, claim, language) if isinstance(claim.value, float) else None
        state, problem = _compare(claim, decision, facts, is_about, numeral)
        states.append(state)
        if problem:
            problems.append(problem)
    coverage = cover(text, claims, facts, language)
    problems += coverage.problems
    if problems:
        return Judged(name, text, "contradicted", tuple(dict.fromkeys(problems)))
    is_proved = "proved" in states and "unread" not in states and coverage.is_whole
    return Judged(name, text, "proved" if is_proved else "unread")


def _compare(claim: Claim, decision: str, facts: Facts, is_about: bool, numeral: Numeral | None) -> tuple[str, str]:
    """Return what became of a claim, proved | unread | contradicted | not_compared, and the problem, if it is one."""
    if claim.quantity == SCENE or claim.modality == "hypothetical":
        return "not_compared", ""
    if claim.quantity == "decision" or claim.modality == "predicted":
        is_against = goes_against(claim, decision)
        return (
            ("contradicted", f"decision: {claim_name(claim)}, not {decision}") if is_against else ("not_compared", "")
        )
    state = judge_claim(claim, facts, is_about, numeral)
    if state in ("proved", "unread"):
        return state, ""
    if state == "unknown_fact" and isinstance(claim.value, str):
        return "unread", ""  # a word of what was not measured: neither true nor false
    kind = {"contradicted": "false", "unknown_reference": "unknown quantity"}.get(state, state.replace("_", " "))
    return "contradicted", f"{kind}: {claim_name(claim)}"


def references_of(claim: Claim) -> list[Reference]:
    """Return the addresses that a claim names, [] where it names nothing that can be measured. A value at a span is one
    of each frame."""
    if claim.at is None or not claim.at.strip():
        reference = parse_reference(claim.quantity)
        return [reference] if reference else []
    reference = parse_reference(f"{claim.quantity}@{claim.at}")
    if reference is not None and reference.first and reference.last is None and _is_of_span(reference):
        return [reference._replace(first=0, last=reference.first)]  # "the change at t4": up to it
    if reference is not None:
        return [reference]
    span = parse_reference(f"change:yaw@{claim.at}")  # any quantity: only the frames are read
    if span is None or span.first is None or span.last is None:
        return []
    rate = {"yaw_rate": "yaw", "climb_rate": "altitude"}.get(claim.quantity)
    if rate:
        return [Reference(rate, "rate", span.first, span.last)]
    first = 1 if span.first == 0 and claim.quantity.rpartition(":")[2] in STEPS | set(MOTIONS) else span.first
    found = [parse_reference(f"{claim.quantity}@t{frame}") for frame in range(first, min(span.last, first + 32) + 1)]
    return [one for one in found if one is not None]


def _is_of_span(reference: Reference) -> bool:
    if reference.aspect == "side":
        return reference.quantity in TURNING
    return reference.aspect not in ("", "comparison", "compared")


def judge_claim(
    claim: Claim, facts: Facts, is_about: bool = False, numeral: Numeral | None = None
) -> SentenceState | Missing:
    """Compare an observed claim with the facts, to the digits that it is written with; says why it cannot be compared.

    A value or a word of a span of frames is said of each of them.

    Args:
        is_about: the sentence says that the number is approximate.
        numeral: how the sentence writes the number; None: as the claim has it.
    """
    references = references_of(claim)
    if not references:
        return "unknown_reference"
    states = [_judge_at(reference, claim, facts, is_about, numeral) for reference in references]
    for state in ("contradicted", "unobserved_frame", "unknown_fact", "unread"):
        if state in states:
            return state
    return "proved"


def _judge_at(
    reference: Reference, claim: Claim, facts: Facts, is_about: bool, numeral: Numeral | None
) -> SentenceState | Missing:
    fact = look_up(reference, facts)
    meant = facts_meant(reference, facts)
    if not meant or not isinstance(fact, Fact):
        return fact if not isinstance(fact, Fact) else "unknown_fact"
    if isinstance(fact.value, str) or isinstance(claim.value, str):
        if not (isinstance(fact.value, str) and isinstance(claim.value, str)):
            return "contradicted"  # a number where a word belongs, or the other way round
        word = {"centred": "straight"}.get(claim.value, claim.value) if fact.value in TURNS else claim.value
        holds = word_holds(word, reference, facts)
        return "unread" if holds is None else "proved" if holds else "contradicted"
    if claim.unit is not None and claim.unit != fact.unit:
        return "contradicted"
    digits = written_digits(claim.value) if numeral is None else numeral.digits
    if fact.unit == "times":
        digits = max(1, digits)  # "two times" is not true of 2.4
    slack = _slack(claim.value, fact.unit, is_about)
    if reference.aspect == "change":
        slack = max(slack, 10.0**-fact.digits)  # the difference of two rounded values is off by one of their last digit
    if numeral is not None and numeral.factor != 1.0:  # of feet or knots
        slack = max(slack, numeral.half + 0.5 * 10.0**-fact.digits)
    if numeral is not None and numeral.bound:
        reach = [numeral.bound * (abs(float(one.value)) - abs(claim.value)) for one in meant]
        if any(0.0 <= far <= BOUND_SHARE * abs(claim.value) for far in reach):
            return "proved"
    return "proved" if any(number_holds(claim.value, digits, one, slack) for one in meant) else "contradicted"


def _slack(value: float, unit: str, is_about: bool) -> float:
    """Return how far a number may lie from its fact beyond its own rounding."""
    if unit == "percent":  # of numbers that are rounded themselves
        return 5.0 if is_about else 1.0
    if unit == "times":
        return (RATIO_SLACK if is_about else 0.02) * abs(value)
    if not is_about:
        return 0.0
    size = TOLERANCES.get(unit, 1.0)  # degrees
    return max(min(size, 0.1 * abs(value)), about_share(abs(value)) * abs(value))


# Words of a plan against the decision: quantity, value or sign -> decisions that it contradicts.
_AGAINST: dict[tuple[str, str], tuple[str, ...]] = {
    ("yaw", "left"): ("yaw_right_to_follow",),
    ("yaw", "right"): ("yaw_left_to_follow",),
    ("altitude", "increasing"): ("descend",),
    ("altitude", "decreasing"): ("ascend",),
    ("speed", "increasing"): ("slow_down", "hover"),
    ("speed", "decreasing"): ("speed_up",),
    ("drone_motion", "moving"): ("hover",),
    ("drone_motion", "hovering"): ("speed_up", "move_forward", "move_backward", "strafe_left", "strafe_right"),
}


def goes_against(claim: Claim, decision: str) -> bool:
    """Return whether a predicted claim contradicts the decision."""
    if claim.quantity == "decision":
        return claim.modality != "hypothetical" and normalize_action(str(claim.value)) != decision
    aspect, _, name = claim.quantity.rpartition(":")
    word = claim.value
    if isinstance(word, float):
        if aspect not in ("change", "rate", "growth") or not word:
            return False
        rises = word > 0
        word = ("left" if rises else "right") if name == "yaw" else ("increasing" if rises else "decreasing")
    return decision in _AGAINST.get((name, word), ())


def claim_name(claim: Claim) -> str:
    value = claim.value if isinstance(claim.value, str) else f"{claim.value:g} {claim.unit or ''}".strip()
    return f"{claim.quantity}{'@' + claim.at if claim.at else ''} = {value}"
