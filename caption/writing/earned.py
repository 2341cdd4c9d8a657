"""Whether a sentence with slots is proved: its words beside them are on a closed list and fit its slots.

A slot is true by construction; what a sentence says with it is not. So the drone's values must stand behind the drone
and the person's behind the person, a quantity's name beside its own values, a comparison between its two sides in
their order, and "now", a frame's name and "from ... to ..." beside values of these frames. A word that is not listed
leaves the sentence unread.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from caption.truth.glossary import words_beside
from caption.truth.references import TURNING, Reference
from cosfly.products.captions import Language

_OF_DRONE = frozenset(
    ("speed", "altitude", "climb_rate", "yaw", "yaw_rate", "heading", "pitch", "travelled", "displacement",
     "drone_motion")
)  # fmt: skip
_OF_TARGET = frozenset(
    (
        "target_speed", "target_heading", "target_travelled", "target_motion", "visibility", "framing", "walking",
        "box_width", "box_height", "offset_x", "offset_y",
    )
)  # fmt: skip
_STATES = ("visibility", "target_motion", "drone_motion", "framing", "walking")
_SINCE_START = frozenset(("yaw", "travelled", "displacement", "target_travelled"))  # counted from the first frame
_BREAK = re.compile(r"[,;:.!?()，；：。！？（）、—]|\b(?:and|but|while)\b|并且|且|而")
_LINKS = ("of", "for", "by", "的")
_AXES = {"heading": "yaw"}
_SIDED = {"comparison": ("drone", "target"), "compared": ("target", "drone")}


class Token(NamedTuple):
    """A word or a slot of a sentence. kind: as in the glossary, or slot | frame | from | link. clause: its number."""

    kind: str
    clause: int
    names: frozenset[str] = frozenset()
    reference: Reference | None = None
    frame: int = 0


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    words = "|".join(re.escape(word) for word in sorted(words_beside(language), key=len, reverse=True))
    words = rf"(?<![a-z])(?:{words})(?![a-z])(?:'s(?![a-z]))?" if language == "en" else words
    return re.compile(rf"(?P<slot>¤)|(?P<frame>t\d{{1,2}})|(?P<break>{_BREAK.pattern})|(?P<word>{words})|\s+", re.I)


def is_earned(beside: str, references: Sequence[Reference | None], num_frames: int, language: Language) -> bool:
    """Tell whether a sentence is proved by its slots.

    Args:
        beside: its text, a mark in the place of each slot. references: of the slots, in order; None: the decision.
    """
    tokens = _read(beside, references, language)
    return tokens is not None and bool(references) and all(_fits(tokens, i, num_frames) for i in range(len(tokens)))


def _read(beside: str, references: Sequence[Reference | None], language: Language) -> list[Token] | None:
    """Cut a sentence into known words; None where a word is not known."""
    if beside.count("¤") != len(references):  # a text that holds the mark itself
        return None
    listed, tokens, at, clause, slots = words_beside(language), [], 0, 0, iter(references)
    while at < len(beside):
        match = _pattern(language).match(beside, at)
        if match is None:
            return None
        at = match.end()
        if match["slot"]:
            tokens.append(Token("slot", clause, reference=next(slots)))
        elif match["frame"]:
            tokens.append(Token("frame", clause, frame=int(match["frame"][1:])))
        elif match["break"]:
            clause += 1
        elif match["word"]:
            word = match["word"].lower()
            kind, names = listed.get(word) or listed[word.removesuffix("'s")]
            tokens.append(
                Token("link" if word in _LINKS else "from" if word in ("from", "从") else kind, clause, names)
            )
    return tokens


def _fits(tokens: Sequence[Token], i: int, num_frames: int) -> bool:
    token = tokens[i]
    own = [one for one in tokens if one.clause == token.clause]
    slots = [one.reference for one in own if one.kind == "slot" and one.reference is not None]
    if token.kind == "slot":
        if token.reference is None:
            return True
        return (
            _has_owner(tokens, i)
            and _has_name(tokens, i)
            and _has_side_of(tokens, i)
            and _is_end(tokens, i, num_frames)
        )
    if token.kind == "quantity":
        return any(reference.quantity in token.names for reference in slots)
    if token.kind == "now":
        values = [one.reference for one in (*tokens[i:], *reversed(tokens[:i])) if one.reference is not None]
        return not values or _frame(values[0], num_frames) == num_frames - 1
    if token.kind == "frame":
        return any(
            _frame(reference, num_frames) == token.frame or _first(reference) == token.frame for reference in slots
        )
    if token.kind == "whole":
        return all(
            _first(reference) == 0
            for reference in slots
            if reference.aspect not in ("", "comparison") or reference.quantity in _SINCE_START
        )
    if token.kind == "from":
        after = [
            one.reference
            for one in tokens[i:]
            if one.kind == "slot" and one.reference is not None and not one.reference.aspect
        ]
        frames = [_frame(reference, num_frames) for reference in after if reference.quantity == after[0].quantity]
        named = [one.frame for one in own if one.kind == "frame"]
        return frames == sorted(frames) and named == sorted(named)
    return True


def _frame(reference: Reference, num_frames: int) -> int:
    last = reference.first if reference.last is None else reference.last
    return num_frames - 1 if last is None else last


def _first(reference: Reference) -> int | None:
    """Give the frame from which a value is counted, None where it is of one frame alone."""
    if reference.aspect in ("", "comparison") and reference.quantity not in _SINCE_START:
        return None
    return 0 if reference.first is None or not reference.aspect else reference.first


def _has_owner(tokens: Sequence[Token], i: int) -> bool:
    """Tell whether a value stands behind its owner: last in its clause, or before where that names no quantity."""
    reference, clause = tokens[i].reference, tokens[i].clause
    assert reference is not None
    before, after = tokens[:i], [one for one in tokens[i + 1 :] if one.clause == clause]
    inside = [one for one in before if one.clause == clause]
    owners = [one.kind for one in inside if one.kind in ("drone", "target")]
    if not owners and not any(one.kind == "quantity" for one in inside):
        owners = [one.kind for one in before if one.kind in ("drone", "target")]
        if reference.aspect in _SIDED and len(set(owners)) > 1:
            return False
    behind = [one.kind for one in after if one.kind in ("drone", "target")]
    if reference.aspect in _SIDED:
        subject, other = _SIDED[reference.aspect]
        return owners[-1:] == [subject] and behind[:1] in ([], [other])
    wanted = "drone" if reference.quantity in _OF_DRONE else "target" if reference.quantity in _OF_TARGET else ""
    wrong = {"drone": "target", "target": "drone"}.get(wanted, "")
    linked = [one.kind for one in after[:2] if one.kind != "link"] if after and after[0].kind in ("link", wrong) else []
    is_sided = reference.quantity == "walking"  # towards, away from, across the view of: the drone is its object
    return not wrong or (owners[-1:] != [wrong] and (is_sided or linked[:1] != [wrong]))


def _has_name(tokens: Sequence[Token], i: int) -> bool:
    """Tell whether the name of a quantity nearest to a value, before it in its clause or else after it, is its own."""
    reference, clause = tokens[i].reference, tokens[i].clause
    assert reference is not None
    if reference.aspect in _SIDED or reference.quantity in _STATES:
        return True
    before = [one for one in tokens[:i] if one.clause == clause and one.kind == "quantity"]
    after = [one for one in tokens[i + 1 :] if one.clause == clause and one.kind == "quantity"]
    if reference.aspect == "trend":  # a verb: its subject stands before it
        before = before or [one for one in tokens[:i] if one.kind == "quantity"]
        return bool(before) and reference.quantity in before[-1].names
    named = before[-1:] or after[:1]
    return (
        not named or reference.quantity in named[0].names or any(reference.quantity in one.names for one in after[:1])
    )


def _values(tokens: Sequence[Token], i: int) -> list[Reference]:
    """Give the values of the clause of a token, before it."""
    return [one.reference for one in tokens[:i] if one.clause == tokens[i].clause and one.reference is not None]


def _has_side_of(tokens: Sequence[Token], i: int) -> bool:
    """Tell whether a side behind a value is the value's own."""
    reference, before = tokens[i].reference, _values(tokens, i)
    assert reference is not None
    if reference.aspect != "side" or not before or before[-1].aspect not in ("", "change"):
        return True
    axes = {_AXES.get(one.quantity, one.quantity) for one in (reference, before[-1])}
    return len(axes) == 1 or before[-1].quantity not in (*TURNING, "offset_x", "offset_y")


def _is_end(tokens: Sequence[Token], i: int, num_frames: int) -> bool:
    """Tell whether a value beside the trend of its quantity is where that ends, or behind "from" where it begins."""
    token = tokens[i]
    assert token.reference is not None
    own = [one.reference for one in tokens if one.clause == token.clause and one.reference is not None]
    trends = [one for one in own if one.aspect == "trend" and one.quantity == token.reference.quantity]
    if token.reference.aspect or not trends:
        return True
    kinds = [one.kind for one in tokens[:i] if one.clause == token.clause and one.kind in ("from", "slot")]
    end = _first(trends[0]) if kinds[-1:] == ["from"] else _frame(trends[0], num_frames)
    return _frame(token.reference, num_frames) == end
