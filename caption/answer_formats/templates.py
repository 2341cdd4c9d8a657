"""Templates: sentences with slots in place of facts, read once; slots.py fills them for each window.

    The gap {trend:distance} from {distance@t0} to {distance}.     a reference of verification/references.py in braces
    {decision}  {side:decision}                                    the decision in words, and its side

A number is filled in with its unit, in the digits of the table of quantities. Next to a side, a trend or a comparison
of the same quantity and frames it is written without its sign. A word takes the form that the words before it ask for
("is increasing", "has increased"). Text outside slots is free; a number with a unit is compared with the facts
(verification/values.py).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Literal

from caption.answer_formats.contract import INVALID_SLOT, Refused
from caption.verification.glossary import load_glossary
from caption.verification.references import (
    MOTIONS,
    NO_ASPECT,
    QUANTITIES,
    RATE_UNITS,
    Reference,
    has_sides,
    parse_reference,
)
from caption.verification.vocabulary import terms_in
from cosfly.formats.captions import Language
from cosfly.llm.answer_text import is_in_script
from cosfly.runtime.errors import nearest

SLOT_MARK = "\ufffc"  # replaces a slot in the text without slots
TURNS = {"yaw": "yaw", "heading": "yaw", "target_heading": "target_heading"}  # quantity -> whose side a change has
_BRACES = re.compile(r"\{([^{}]*)\}")
_ARTICLE = re.compile(r"\b([Aa])n?\s+$")
_WORD_ASPECTS = ("trend", "side", "comparison", "compared")
_ALIASES = {
    "compare:drone_speed,target_speed": "comparison:speed",
    "compare:target_speed,drone_speed": "compared:speed",
    "side:target": "side:offset_x",
}

Form = Literal[0, 1, 2, 3]  # of the glossary's slot words: verb, after "is", after "has", after "to"


@dataclass(frozen=True)
class Slot:
    """One slot of a sentence.

    Args:
        name: what is looked up, the same for every form of a word. reference: None for the decision.
        needs_side: "straight" or "centred" does not fit here.
        is_paired: another slot of the sentence has the same direction: a number is written without its sign, and a side
            is that of the number, however small.
        article: "a" before the slot, which becomes "an" by the value; "" where none stands there.
    """

    name: str
    reference: Reference | None
    form: Form = 0
    needs_side: bool = False
    is_paired: bool = False
    article: str = ""

    @property
    def is_word(self) -> bool:
        return self.reference is None or self.reference.aspect in _WORD_ASPECTS or self.reference.quantity in NO_ASPECT


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence that may be filled.

    Args:
        pattern: its text for `%`, with a place for each slot. outside: its text, with SLOT_MARK for each slot.
        names: of the slots, sorted. num_values: slots that are filled with a value, the decision aside.
        terms: of the glossary, in English, with their translations.
    """

    pattern: str
    outside: str
    slots: tuple[Slot, ...]
    names: tuple[str, ...]
    is_in_script: bool
    num_values: int
    terms: tuple[tuple[str, str], ...]


@lru_cache(maxsize=32768)  # neighbouring windows share most sentences
def read_sentence(text: str, language: Language, num_frames: int) -> Sentence | Refused:
    """Read a sentence, or return why it cannot be filled in any window of so many frames."""
    parts = _BRACES.split(text)
    texts, names = parts[::2], parts[1::2]
    if any("{" in part or "}" in part for part in texts):
        return Refused(INVALID_SLOT, "a brace is not closed or not opened")
    slots: list[Slot] = []
    for number, written in enumerate(names):
        before, after = "".join(texts[: number + 1]), texts[number + 1]
        slot = _read_slot(written, texts[number], after, language)
        if slot is None:
            return _unknown(written)
        if load_glossary().is_negated(before.lower(), len(before), language):
            return Refused(INVALID_SLOT, f"{{{written}}}: a slot is a fact and always true: do not negate it")
        remainder = _without_repetition(slot, after, language)
        if isinstance(remainder, Refused):
            return remainder
        texts[number + 1] = remainder
        slots.append(slot)
    outside = SLOT_MARK.join(texts)
    paired = _paired(slots, num_frames)
    if isinstance(paired, Refused):
        return paired
    if language == "zh":  # a space before a number, none behind its unit
        texts[1:] = [re.sub(r"^ +(?=[\u4e00-\u9fff])", "", part) for part in texts[1:]]
    else:
        paired = [_with_article(slot, texts, number) for number, slot in enumerate(paired)]
    return Sentence(
        pattern="%s".join(part.replace("%", "%%") for part in texts),
        outside=outside,
        slots=tuple(paired),
        names=tuple(sorted(slot.name for slot in slots)),
        is_in_script=is_in_script(outside, language),
        num_values=sum(slot.reference is not None for slot in slots),
        terms=terms_in(outside) if language == "en" else (),
    )


def _read_slot(written: str, before: str, after: str, language: Language) -> Slot | None:
    name = re.sub(r"\s+", "", written.lower()).replace("–", "-")
    name = _ALIASES.get(name, name)
    if name in ("decision", "side:decision"):
        return Slot(name, None, needs_side=name == "side:decision")
    reference = parse_reference(name)
    if reference is None:
        return None
    if reference.aspect in ("comparison", "compared"):
        return Slot(str(reference), reference, 0 if _is_compared_with(after, language) else 1)
    if reference.aspect == "side":
        if reference.quantity == "yaw" and reference.first is not None and reference.last is None:
            reference = reference._replace(first=0, last=reference.first)  # a yaw is counted from t0, and so its side
        return Slot(str(reference), reference, needs_side=_needs_side(before, after, language))
    if reference.aspect == "trend" or reference.quantity in (*MOTIONS, "walking"):
        return Slot(str(reference), reference, _form_after(before))
    return Slot(str(reference), reference)


def _unknown(written: str) -> Refused:
    bare = written.partition(":")[2] or written
    near = nearest(bare.partition("@")[0].strip(), [*QUANTITIES, *NO_ASPECT, "decision", "comparison:speed"])
    return Refused(INVALID_SLOT, f"there is no slot {{{written}}}{near}; use the names of the table of facts")


def _with_article(slot: Slot, texts: list[str], number: int) -> Slot:
    """Move an article before a slot from its text into the slot."""
    match = _ARTICLE.search(texts[number])
    if match is None:
        return slot
    texts[number] = texts[number][: match.start()]
    return replace(slot, article=match[1])


# --- numbers and words of one direction -------------------------------------------------------------------------------


def _paired(slots: list[Slot], num_frames: int) -> list[Slot] | Refused:
    """Mark numbers and words that state one direction, so that one says what the other leaves out.

    A number next to a direction of other frames is refused, since it could be the opposite one.
    """
    directions = [_direction_of(slot, num_frames) for slot in slots]
    words = {direction for slot, direction in zip(slots, directions, strict=True) if slot.is_word and direction}
    numbers = {direction for slot, direction in zip(slots, directions, strict=True) if not slot.is_word and direction}
    paired = []
    for slot, direction in zip(slots, directions, strict=True):
        is_named = direction is not None and direction[0] in {name for name, _ in words}
        if not slot.is_word and is_named and direction not in words:
            fix = "a side or a trend in its sentence is of other frames; name the same frames in both slots"
            return Refused(INVALID_SLOT, f"{{{slot.name}}}: {fix}")
        is_paired = direction in (numbers if slot.is_word else words)
        paired.append(replace(slot, is_paired=is_paired))
    return paired


def _direction_of(slot: Slot, num_frames: int) -> tuple[str, tuple[int, int]] | None:
    """Return the direction that a word states, or that the sign of a number means, and its frames; None without one."""
    reference = slot.reference
    if reference is None or reference.quantity in NO_ASPECT:
        return None
    name, aspect, first, last = reference
    end = num_frames - 1
    span = (0 if first is None else first, end if last is None else last)
    if aspect == "comparison" or name == "speed_difference":
        return "comparison", (0, end)
    if aspect in ("change", "rate", "growth") and (name in TURNS or not QUANTITIES[name].sides):
        return f"side:{TURNS[name]}" if name in TURNS else f"trend:{name}", span
    if aspect == "trend" and not QUANTITIES[name].sides:
        return f"trend:{name}", span
    if aspect == "side" and name in TURNS:
        return f"side:{TURNS[name]}", span
    if name == "yaw" and not aspect:
        return "side:yaw", (0, end if first is None else first)
    if aspect == "side" or (not aspect and has_sides(name)):
        at = end if first is None else first
        return f"side:{name}", (at, at)
    return None


# --- words around a slot ----------------------------------------------------------------------------------------------

_ADVERBS = (
    r"(?:\s+(?:now|still|also|currently|clearly|slowly|steadily|slightly|gently|only|just|already|both|gradually"
    r"|again))*\s*$"
)
_BE = re.compile(
    r"(?:\b(?:is|are|was|were|be|been|being|keeps?|kept|remains?|stays?|seems?|appears?|looks?|an?|the|its|their|by|of)"
    r"|'s)" + _ADVERBS + r"|\bwith\b[^,;.]*$|^\s*$",
    re.IGNORECASE,
)
_HAS = re.compile(r"\b(?:has|have|had|having)" + _ADVERBS, re.IGNORECASE)
_TO = re.compile(r"\b(?:to|will|would|should|must|can|could|may|might|does|did|do)" + _ADVERBS, re.IGNORECASE)
_ZH_COMPARED = ("目标", "行人", "其", "它", "他", "她", "对方", "该", "被", "人", "步行", "无人机", "本机")


def _form_after(before: str) -> Form:
    """Return the form of an English verb after these words; Chinese has one."""
    if _HAS.search(before):
        return 2
    if _TO.search(before):
        return 3
    return 1 if _BE.search(before) else 0


def _needs_side(before: str, after: str, language: Language) -> bool:
    if language == "zh":
        is_led = re.search(r"(?:(?<![方航])向|[朝往偏])\s*$", before)
        return bool(is_led) or after.startswith(("侧", "方", "边", "转", "偏", "拐"))
    is_led = re.search(r"\b(?:the|its|their|our)\s*$", before, re.IGNORECASE)
    return bool(is_led or re.match(r"\s+of\b|\s*-|\s+(?:side|half|edge|part|third)\b", after))


def _is_compared_with(after: str, language: Language) -> bool:
    """Return whether the other side of a comparison stands behind the slot."""
    after = after.lstrip()
    return after.startswith(_ZH_COMPARED) if language == "zh" else bool(after) and after[0] not in ",.;:)!?"


def _without_repetition(slot: Slot, after: str, language: Language) -> str | Refused:
    """Remove what a slot brings itself: the unit of a number, the "than" of a comparison."""
    reference = slot.reference
    if reference is None or reference.aspect in ("side", "trend") or reference.quantity in NO_ASPECT:
        return after
    if reference.aspect in ("comparison", "compared"):
        return re.sub(r"^\s+(?:than|as)\b", "", after) if language == "en" else after
    match = _unit_pattern(language).match(after)
    if match is None:
        return after
    unit = QUANTITIES[reference.quantity].unit
    unit = {"growth": "percent", "rate": RATE_UNITS.get(unit, unit)}.get(reference.aspect, unit)
    if load_glossary().spellings(language)[match[1].lower()] != unit:
        fix = f"its unit is {load_glossary().written_units[language][unit]} and stands in the slot"
        return Refused(INVALID_SLOT, f"{{{slot.name}}}{match[0]}: {fix}")
    return after[match.end() :]


@cache
def _unit_pattern(language: Language) -> re.Pattern[str]:
    spellings = sorted(load_glossary().spellings(language), key=len, reverse=True)
    options = "|".join(re.escape(s) + (r"(?![A-Za-z/])" if s[-1].isalpha() and s.isascii() else "") for s in spellings)
    return re.compile(rf"[\s-]*({options})", re.IGNORECASE)
