"""Whether a sentence with slots is proved: its words beside them are on a closed list and fit its slots.

A slot is true by construction; what a sentence says with it is not. So each kind of word of the list has a rule here:
the drone's values stand behind the drone and the person's behind the person, a value beside its name, a change or a
mean beside a word that says so, what is not of now beside the name of its frame, a comparison between its two sides in
their order, and nothing measured behind "should". A word that is not listed, or that does not fit, leaves the sentence
unread.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import NamedTuple

from caption.verification.glossary import words_beside
from caption.verification.references import ANGLES, QUANTITIES, STEPS, TURNING, Reference
from cosfly.formats.captions import Language

_PLACES = ("offset_x", "offset_y")
_IN_PICTURE = ("visibility", "framing", "box_width", "box_height", "others_in_view", "alike_differences", *_PLACES)
_MOTIONS = ("target_motion", "drone_motion", "walking")
_STATES = ("visibility", "framing", *_MOTIONS)
_OF_TARGET = ("target_speed", "target_heading", "target_travelled", "target_motion", "walking", *_IN_PICTURE)
_OF_DRONE = (
    "speed", "altitude", "climb_rate", "yaw", "yaw_rate", "heading", "pitch", "travelled", "displacement",
    "drone_motion",
)  # fmt: skip
_NAMELESS = ("speed", "target_speed", *_STATES, *_IN_PICTURE)  # their unit tells what they are
_SINCE_START = ("yaw", "travelled", "displacement", "target_travelled")  # counted from the first frame
_BREAK = re.compile(r"[,;:.!?()，；：。！？（）、—]|\b(?:and|but|while)\b|并且|且|而")
_SIDED = {"comparison": ("drone", "target"), "compared": ("target", "drone")}
_OTHER = {"drone": "target", "target": "drone"}


class Token(NamedTuple):
    """A word or a slot of a sentence. kind: as in the glossary, or slot | frame | claimed. clause: its number. frame:
    t0 is 0. claimed: where a claim proves it, the series whose trend that states, else ""."""

    kind: str
    clause: int
    names: frozenset[str] = frozenset()
    reference: Reference | None = None
    frame: int = 0
    claimed: str | None = None


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    words = "|".join(re.escape(word) for word in sorted(words_beside(language), key=len, reverse=True))
    words = rf"(?<![a-z])(?:{words})(?![a-z])(?:'s(?![a-z]))?" if language == "en" else words
    return re.compile(rf"(?P<slot>¤)|(?P<frame>t\d{{1,2}})|(?P<break>{_BREAK.pattern})|(?P<word>{words})|\s+", re.I)


def is_earned(
    beside: str,
    references: Sequence[Reference | None],
    num_frames: int,
    language: Language,
    claimed: Mapping[int, str] = MappingProxyType({}),
) -> bool:
    """Return whether a sentence is proved by its slots, and by claims of the words that they leave over.

    Args:
        beside: its text, a mark in the place of each slot. references: of the slots, in order; None: the decision.
        claimed: characters of words that claims have proved, each with the series whose trend they state, else "".
            Such words may be any, and stand beside the others.
    """
    tokens = _read(beside, references, language, claimed)
    if tokens is None or not (references or claimed):
        return False
    return all(_Word(tokens, i, num_frames - 1).fits() for i in range(len(tokens)))


def _read(
    beside: str, references: Sequence[Reference | None], language: Language, claimed: Mapping[int, str]
) -> list[Token] | None:
    """Cut a sentence into known words; None where a word is not known. claimed: places of words that may be any."""
    if beside.count("¤") != len(references):  # a text that holds the mark itself
        return None
    listed, tokens, at, clause, slots = words_beside(language), [], 0, 0, iter(references)
    while at < len(beside):
        match = _pattern(language).match(beside, at)
        if match is None and at not in claimed:
            return None
        if match is None:
            tokens.append(Token("claimed", clause, claimed=claimed[at]))
            at += 1
            continue
        claim, at = claimed.get(at), match.end()
        if match["slot"]:
            tokens.append(Token("slot", clause, reference=next(slots)))
        elif match["frame"]:
            tokens.append(Token("frame", clause, frame=int(match["frame"][1:]), claimed=claim))
        elif match["break"]:
            clause += 1
        elif match["word"]:
            word = match["word"].lower()
            kind, names = listed.get(word) or listed[word.removesuffix("'s")]
            tokens.append(Token(kind, clause, names, claimed=claim))
    return tokens


class _Word:
    """A token among the others, and whether it fits them."""

    def __init__(self, tokens: Sequence[Token], i: int, now: int) -> None:
        self.token, self.earlier, self.later, self.now = tokens[i], tokens[:i], tokens[i + 1 :], now
        self.before = [one for one in self.earlier if one.clause == self.token.clause]
        self.after = [one for one in self.later if one.clause == self.token.clause]
        self.beside = [*self.before, *self.after]
        self.references = [
            one.reference for one in (*self.before, self.token, *self.after) if one.reference is not None
        ]
        self.last = next((one for one in reversed(self.before) if one.kind not in ("neutral", "approx")), Token("", 0))
        self.next = next((one for one in self.after if one.kind not in ("neutral", "approx")), Token("", 0))
        self.spoken_of = self.references or [one.reference for one in self.later if one.reference is not None][:1]

    def fits(self) -> bool:
        """Ask the rule of its kind; a kind without one states nothing."""
        if self.token.claimed and not self._has_series(self.token.claimed):
            return False
        if self.token.claimed is not None and self.token.kind not in ("motion", "claimed"):
            return True
        rule = getattr(self, f"_{self.token.kind}", None)
        return rule is None or rule()

    def _slot(self) -> bool:
        reference = self.token.reference
        if reference is None:
            return True
        if any(one.kind == "plan" or (one.kind == "slot" and one.reference is None) for one in self.before):
            return False  # what should be was not measured
        rules = (self._has_owner, self._has_name, self._has_date, self._has_aspect, self._has_side)
        return all(rule(reference) for rule in rules)

    def _has_series(self, series: str) -> bool:
        """Return whether the series of a claimed trend is named, and no other in its clause or else before it."""

        def names(tokens: Sequence[Token]) -> list[bool]:
            named = [one.names for one in tokens if one.kind == "quantity"]
            slots = [frozenset({one.reference.quantity}) for one in tokens if one.reference is not None]
            return [series in name for name in (*named, *slots)]

        found = names((self.token, *self.beside)) or names(self.earlier)
        return bool(found) and all(found)

    # --- words ------------------------------------------------------------------------------------------------------

    def _quantity(self) -> bool:
        is_claimed = any(one.claimed in self.token.names for one in self.beside if one.claimed)
        return is_claimed or any(reference.quantity in self.token.names for reference in self.references)

    def _middle(self) -> bool:
        """Return whether the image centre is that from which something is measured, not where it is."""
        is_followed = self.next.reference is not None and self.next.reference.quantity in _PLACES
        is_off = not set(_PLACES).isdisjoint(self.last.names | self.next.names)
        return self._quantity() and (is_followed or is_off or self.last.kind in ("of", "from"))

    def _aspect(self) -> bool:
        return any(reference.aspect in self.token.names for reference in self.references)

    def _away(self) -> bool:
        return self.last.reference is not None and self.last.reference.quantity in ("distance", "other_distance")

    def _approx(self) -> bool:
        return self.next.reference is not None and self.next.reference.quantity in QUANTITIES

    def _sight(self) -> bool:
        """Return whether sight is a purpose, or a slot says it."""
        is_purpose = any(one.kind == "plan" for one in self.before)
        return is_purpose or any(reference.quantity in _IN_PICTURE for reference in self.references)

    def _pursuit(self) -> bool:
        return [one.kind for one in self.before if one.kind in _OTHER][-1:] != ["target"]

    def _motion(self) -> bool:
        """Return whether nothing says where a motion goes but a turn."""
        return self._is_turn() or not any(reference.aspect == "side" for reference in self.references)

    _claimed = _motion

    def _to(self) -> bool:
        """Return whether it leads to a value, or is of a distance to somebody; "turned to the walker" is neither."""
        return self.next.kind not in _OTHER or any(
            "distance" in one.names or "slant" in one.names for one in self.before
        )

    def _from(self) -> bool:
        """Return whether the earliest value of a quantity follows, the others in their order; or a distance to
        somebody."""
        if self.next.kind in _OTHER:
            last = self.last.reference
            return self.last.kind == "away" or (last is not None and last.quantity in ("distance", "walking"))
        if self.next.reference is not None and not self.next.reference.aspect:
            name = self.next.reference.quantity
            before, after = (
                [
                    self._end(one.reference)
                    for one in part
                    if one.reference is not None and one.reference[:2] == (name, "")
                ]
                for part in (self.before, self.after)
            )
            if after != sorted(after) or any(frame <= after[0] for frame in before):
                return False
        frames = [one.frame for one in self.beside if one.kind == "frame"]
        return frames == sorted(frames)

    def _now(self) -> bool:
        tokens = (*self.after, *reversed(self.before), *self.later, *reversed(self.earlier))
        nearest = [one.reference for one in tokens if one.reference is not None][:1]
        return all(self._end(one) == self.now and one.aspect not in ("mean", "min", "max") for one in nearest)

    def _moment(self) -> bool:
        return self._now() and all(_start(reference) is None for reference in self.spoken_of)

    def _frame(self) -> bool:
        """Return whether a value of this frame stands beside, or behind "from" and "since" one that is counted from
        it."""
        if self.last.kind in ("from", "since"):
            return any(_start(reference) == self.token.frame for reference in self.spoken_of)
        is_end = self.last.kind == "to"
        return any(
            self._end(reference) == self.token.frame and (is_end or reference.aspect in ("", "side", *_SIDED))
            for reference in self.spoken_of
        )

    def _whole(self) -> bool:
        """Return whether something is counted from the first frame on, and no state is of one frame."""
        starts = [_start(reference) for reference in self.spoken_of]
        is_counted = any(start is not None for start in starts) and all(start in (0, None) for start in starts)
        return is_counted and not any(reference.quantity in _STATES for reference in self.spoken_of)

    # --- whether a slot stands with its own -------------------------------------------------------------------------

    def _end(self, reference: Reference) -> int:
        last = reference.first if reference.last is None else reference.last
        return self.now if last is None else last

    def _is_turn(self) -> bool:
        return any("turned" in one.names for one in self.beside)

    def _has_owner(self, reference: Reference) -> bool:
        """Return whether it stands behind its owner: last in its clause, else, where its name is anybody's, in the
        sentence."""
        names = [one.names for one in self.beside if one.kind == "quantity" and reference.quantity in one.names]
        is_anybodys = not names or any(
            not name.isdisjoint(_OF_DRONE) and not name.isdisjoint(_OF_TARGET) for name in names
        )
        owners, behind = ([one.kind for one in part if one.kind in _OTHER] for part in (self.before, self.after))
        earlier = [one.kind for one in self.earlier if one.kind in _OTHER]
        if reference.aspect in _SIDED:
            subject, other = _SIDED[reference.aspect]
            owners = owners or (earlier if len(set(earlier)) < 2 else [])
            return owners[-1:] == [subject] and behind[:1] in ([], [other])
        is_turned = reference.aspect == "side" and reference.quantity in TURNING
        if (is_turned or reference.quantity in _PLACES) and behind:  # "left of the drone"
            return False
        wanted = "drone" if reference.quantity in _OF_DRONE else "target" if reference.quantity in _OF_TARGET else ""
        if not wanted:
            return True
        wrong = _OTHER[wanted]
        if reference.quantity == "walking":
            return behind[:1] == ["drone"] and owners[-1:] != [wrong]
        if self.next.kind in ("of", wrong) and behind[:1] == [wrong]:  # "{speed} of the walker"
            return False
        if not owners and is_anybodys:
            owners = earlier or [one.kind for one in self.later if one.kind in _OTHER][:1]
            if not owners and names and wanted == "target":
                return False  # "the speed" is the drone's
        return owners[-1:] != [wrong]

    def _has_name(self, reference: Reference) -> bool:
        """Return whether the name nearest to a value, before it in its clause or else after it, is its own."""
        if reference.aspect in _SIDED or reference.quantity in _STATES:
            return True
        named = ("quantity", "away", "middle")
        before, after, earlier = (
            [one.names for one in part if one.kind in named] for part in (self.before, self.after, self.earlier)
        )
        if reference.aspect == "trend":  # a verb: its subject stands before it
            return bool(earlier) and reference.quantity in (before or earlier)[-1]
        if before or after:
            return any(reference.quantity in names for names in ((before or after[:1])[-1], *after[:1]))
        is_at = self.last.kind == "at" and reference.quantity in ("altitude", "distance")
        is_from = self.next.kind == "from" and reference.quantity == "distance"
        is_named = is_at or is_from or reference.quantity in _NAMELESS or reference.aspect == "side"
        return is_named or (bool(earlier) and reference.quantity in earlier[-1])

    def _has_date(self, reference: Reference) -> bool:
        """Return whether the frames of a value stand in its sentence where they are not the current one or the whole
        window."""
        frames = {one.frame for one in (*self.earlier, *self.later) if one.kind == "frame"}
        end, start = self._end(reference), _start(reference)
        is_dated = end in (self.now, *frames) or (self.last.kind == "from" and not reference.aspect)
        return is_dated and (start in (None, 0, *frames))

    def _has_aspect(self, reference: Reference) -> bool:
        """Return whether a word says what a number is of its quantity; and beside a trend, where that ends or
        begins."""
        aspect, end, start = reference.aspect, self._end(reference), _start(reference)
        trends = [one for one in self.references if one[:2] == (reference.quantity, "trend")]
        is_change = self.last.kind == "by" or (
            self.last.reference is not None and self.last.reference.aspect == "trend"
        )
        if aspect in ("mean", "min", "max"):
            is_named = any(one.kind == "aspect" and aspect in one.names for one in self.beside)
            return is_named or (aspect, reference.quantity) == ("mean", "target_speed")
        if aspect in ("change", "growth"):
            is_same = all((_start(one), self._end(one)) == (start, end) for one in trends)
            return is_same and (is_change or self.last.kind == "aspect" or self._is_turn())
        if aspect or reference.quantity not in QUANTITIES:
            return True
        if (is_change and reference.quantity not in _SINCE_START) or (reference.quantity in ANGLES and self._is_turn()):
            return False
        is_start = [one.kind for one in self.before if one.kind in ("from", "slot")][-1:] == ["from"]
        first = 1 if reference.quantity in STEPS else 0
        return all(end in (_start(one), _start(one) or first) if is_start else end == self._end(one) for one in trends)

    def _has_side(self, reference: Reference) -> bool:
        """Return whether a side is no way of a motion, of a turn that is named, and that of the value before it."""
        if reference.aspect != "side":
            return True
        own = [one.names for one in self.beside if one.kind == "quantity" and reference.quantity in one.names]
        is_going = any(one.quantity in _MOTIONS for one in self.references)
        if (reference.quantity in TURNING and not own) or (is_going and not self._is_turn()):
            return False
        values = [
            one.reference for one in self.before if one.reference is not None and one.reference.quantity not in _STATES
        ]
        if not values or values[-1].aspect not in ("", "change"):
            return True
        value, axis = ("yaw" if one.quantity == "heading" else one.quantity for one in (values[-1], reference))
        return value == axis or (self.last.reference is not values[-1] and value not in (*TURNING, *_PLACES))


def _start(reference: Reference) -> int | None:
    """Return the frame from which a value is counted, None where it is of one frame alone."""
    is_of_frame = reference.aspect in ("", *_SIDED) and reference.quantity not in _SINCE_START
    if is_of_frame or (reference.aspect == "side" and reference.quantity not in TURNING):
        return None
    return 0 if reference.first is None or not reference.aspect else reference.first
