"""Templates: sentences with slots in place of facts, read once; filling.py fills them for each window.

    The gap {trend:distance} from {distance@t0} to {distance}.     a reference of verification/references.py in braces
    {trending:distance}  {box@t4}  {decision}  {side:decision}     and what texts need beyond references

A number is filled in with its unit, in the digits of the table of quantities. Where a slot of its sentence says what
its sign means (a side, a trend) it is the size that is written. A word takes the form that the words before it ask for
("is increasing", "has increased").
What may stand beside slots: outside.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Literal, NamedTuple

from caption.answer_formats.contract import Refused
from caption.answer_formats.earned import is_earned
from caption.answer_formats.outside import SLOT_MARK, check_outside, decisions_named, decisions_opposed, states_beside
from caption.verification.facts import Facts
from caption.verification.glossary import load_glossary
from caption.verification.references import ANGLES, MOTIONS, QUANTITIES, Quantity, Reference, Series, parse_reference
from caption.verification.vocabulary import terms_in
from cosfly.formats.captions import ACTIONS, Language, SentenceState
from cosfly.llm.answer_text import is_in_script
from cosfly.runtime.errors import nearest

_BRACES = re.compile(r"\{([^{}]*)\}")
_ARTICLE = re.compile(r"\b([Aa])n?\s+$")
TURNS = {"yaw": "yaw", "heading": "yaw", "target_heading": "target_heading"}
_WORDS = ("trend", "side", "comparison", "compared")
# Other names of slots.
_ALIASES = {
    "compare:drone_speed,target_speed": "comparison:speed", "compare:speed,target_speed": "comparison:speed",
    "compare:target_speed,drone_speed": "compared:speed", "compare:target_speed,speed": "compared:speed",
    "side:target": "side:offset_x",
}  # fmt: skip
NEITHER = ("straight", "centred")
_WITHOUT = ("visibility", "framing", "walking", *MOTIONS)  # a direction

Form = Literal[0, 1, 2, 3]  # of the glossary's slot_words: verb, after "is", after "has", after "to"


@dataclass(frozen=True)
class Slot:
    """One slot. name: what is looked up, the same for every form of a word. needs_side: "straight" would not fit here.

    is_size: a number whose direction another slot of its sentence says, so that it is written without its sign; or that
    other slot where it is a side, which then is that of the number, however small. article: "a" before it, which
    becomes "an" by what is filled in; "" where none stands there.
    """

    name: str
    reference: Reference | None  # None: decision
    form: Form = 0
    needs_side: bool = False
    is_size: bool = False
    article: str = ""

    @cached_property
    def fact_key(self) -> str:
        """Name its fact among those that were looked up: one that is written otherwise is another."""
        return f"shaped {self.name}" if self.is_shaped else self.name

    @cached_property
    def quantity(self) -> Quantity | None:
        """Return the series of which it is a plain value, None where it is something else."""
        reference = self.reference
        if reference is None or reference.aspect or self.is_shaped:
            return None
        return QUANTITIES.get(reference.quantity)

    @cached_property
    def is_word(self) -> bool:
        return self.reference is None or self.reference.aspect in _WORDS or self.reference.quantity not in QUANTITIES

    @cached_property
    def is_shaped(self) -> bool:
        """Return whether it is written otherwise than the fact at its reference: a box, a trend of what has sides."""
        if self.reference is not None and self.reference.aspect == "trend":
            return has_sides(self.reference.quantity)
        return self.name.partition("@")[0] == "box"

    @cached_property
    def direction(self) -> str | None:
        """Name the direction that this word states, or that the sign of this number means: in a sentence they must
        agree."""
        if self.reference is None or self.reference.quantity in _WITHOUT:
            return None
        aspect, quantity = self.reference.aspect, self.reference.quantity
        if aspect == "compared":
            return None
        if aspect == "comparison" or quantity == "speed_difference":
            return "comparison"
        is_turn = quantity in TURNS
        if aspect in ("change", "rate", "growth", "trend"):
            if is_turn:  # whose side is that of a change
                return None if aspect == "trend" else f"side:{TURNS[quantity]}"
            # A shift in the picture is no place in it.
            return None if QUANTITIES[quantity].sides else f"trend:{quantity}"
        if aspect == "side" or (not aspect and has_sides(quantity)):
            return f"side:{TURNS.get(quantity, quantity)}"
        return None


def has_sides(quantity: str) -> bool:
    return bool(QUANTITIES[quantity].sides) and quantity not in ANGLES


class SlotPlace(NamedTuple):
    """A slot where it stands, and what is needed to fill it at a glance.

    fact_key: what it is looked up by. read, frame, form: the series of which it is a plain value,
    its frame, and how that is written with its unit; None where it is something else. words: how each word that may be
    true is written, but for those that ask for a closer look.
    """

    fact_key: str
    slot: Slot
    read: Callable[[Facts], Series] | None = None
    frame: int = -1
    form: str = ""
    words: Mapping[float | str, str] = {}


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence that may be filled.

    pattern: its text for `%`, with a place for each of the slots. beside: its text, a mark for each of them. names: of
    the slots, sorted. sizes: the numbers without a sign, each with the words that state its direction. state: proved or
    unread (earned.py); doubtful: its words for what a slot could say. decisions: that its words come to, as they stand
    there. opposed: those that it argues against, were it of the reasoning.
    """

    pattern: str
    beside: str
    places: tuple[SlotPlace, ...]
    names: tuple[str, ...]
    sizes: tuple[tuple[Slot, tuple[Slot, ...]], ...]
    begins_with_slot: bool
    is_in_script: bool
    state: SentenceState
    doubtful: tuple[str, ...]
    decisions: tuple[str, ...]
    opposed: tuple[str, ...]
    terms: tuple[tuple[str, str], ...]  # of the glossary, in English, with their translations


# --- reading ----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=32768)  # neighbouring windows share most sentences
def read_sentence(text: str, language: Language, num_frames: int, step_s: float) -> Sentence | Refused:
    """Read a sentence, or say why it cannot be filled in any window of so many frames."""
    parts = _BRACES.split(text)
    texts, names = parts[::2], parts[1::2]
    if any("{" in part or "}" in part for part in texts):
        return Refused("slots_unbalanced_braces", "a brace is not closed or not opened")
    slots: list[Slot] = []
    for number, written in enumerate(names):
        before, after = "".join(texts[: number + 1]), texts[number + 1]
        slot = _read_slot(written, texts[number], after, language)
        if slot is None:
            return _unknown(written)
        if load_glossary().is_negated(before.lower(), len(before), language):
            text = "a slot is a fact and always true: do not negate it"
            return Refused("slots_negated", f"{{{written}}}: {text}")
        remainder = _without_repetition(slot, after, language)
        if isinstance(remainder, Refused):
            return remainder
        texts[number + 1] = remainder
        slots.append(slot)
    beside = SLOT_MARK.join(texts)
    refused = check_outside(beside, language, num_frames, step_s)
    if refused is not None:
        return refused
    slots, begins_with_slot = _related(slots, num_frames - 1), not texts[0]
    if language == "zh":  # a space before a number, none behind its unit
        texts[1:] = [_SPACE.sub("", part) for part in texts[1:]]
    else:
        slots = [_with_article(slot, texts, number) for number, slot in enumerate(slots)]
    return Sentence(
        pattern="%s".join(part.replace("%", "%%") for part in texts),
        beside=beside,
        places=tuple(_place(slot, language) for slot in slots),
        names=tuple(sorted(slot.name for slot in slots)),
        sizes=tuple((slot, _words_of(slot, slots)) for slot in slots if slot.is_size and not slot.is_word),
        begins_with_slot=begins_with_slot,
        is_in_script=is_in_script(beside, language),
        state="proved" if is_earned(beside, [slot.reference for slot in slots], num_frames, language) else "unread",
        doubtful=states_beside(beside, language),
        decisions=decisions_named(beside) if language == "en" else (),
        opposed=decisions_opposed(beside) if language == "en" else (),
        terms=terms_in(beside) if language == "en" else (),
    )


def _with_article(slot: Slot, texts: list[str], number: int) -> Slot:
    """Move an article before a slot from its text into the slot."""
    match = _ARTICLE.search(texts[number])
    if match is None:
        return slot
    texts[number] = texts[number][: match.start()]
    return replace(slot, article=match[1])


def _place(slot: Slot, language: Language) -> SlotPlace:
    quantity = slot.quantity
    if slot.article:
        return SlotPlace(slot.fact_key, slot)
    if quantity is None:
        if not slot.is_word:
            return SlotPlace(slot.fact_key, slot)
        words = _words_written(language, slot.form, not (slot.is_size or slot.needs_side))
        return SlotPlace(slot.fact_key, slot, words=words)
    assert slot.reference is not None
    frame = -1 if slot.reference.first is None else slot.reference.first
    form = f"%.{quantity.digits}f{units_behind(language)[quantity.unit]}"
    return SlotPlace(slot.fact_key, slot, quantity.read, frame, form)


@lru_cache
def _words_written(language: Language, form: Form, with_neither: bool) -> dict[float | str, str]:
    """Return how words are written in a form; without those that are neither side where a side may be needed."""
    left_out = () if with_neither else NEITHER
    words = {word: forms for word, forms in words_of(language).items() if word not in left_out}
    return {word: forms[min(form, len(forms) - 1)] for word, forms in words.items()}


@lru_cache
def words_of(language: Language) -> dict[str, tuple[str, ...]]:
    """Return the forms of every word that is true somewhere: slot words, kinds of visibility, decisions."""
    glossary = load_glossary()
    seen = {name: (pair[language],) for name, pair in glossary.visibility.items()}
    names = {token: (action.en if language == "en" else action.zh,) for token, action in ACTIONS.items()}
    return seen | names | {name: forms[language] for name, forms in glossary.slot_words.items()}


@cache
def units_behind(language: Language) -> dict[str, str]:
    """Return what stands behind a number: its unit, a space before it where one belongs there."""
    units = load_glossary().written_units[language]
    return {unit: f"{'' if unit == 'percent' else ' '}{written}" for unit, written in units.items()}


def _words_of(number: Slot, slots: list[Slot]) -> tuple[Slot, ...]:
    return tuple(slot for slot in slots if slot.is_word and slot.direction == number.direction)


def _related(slots: list[Slot], last: int) -> list[Slot]:
    """Mark numbers and sides of one direction, so that one says what the other leaves out.

    A comparison is of the current speeds, or, beside the target's mean speed, with that.
    """
    has_mean = any(slot.name == "mean:target_speed" for slot in slots)
    words = {slot.direction for slot in slots if slot.is_word} - {None}
    numbers = {slot.direction for slot in slots if not slot.is_word}
    found = []
    for slot in slots:
        is_size = slot.direction in (numbers if slot.name.startswith("side:") else () if slot.is_word else words)
        if slot.name == "comparison:speed" and slot.reference is not None and not has_mean:
            now = slot.reference._replace(first=last)
            slot = replace(slot, name=str(now), reference=now)
        found.append(replace(slot, is_size=is_size))
    return found


def _unknown(written: str) -> Refused:
    names = [*QUANTITIES, *MOTIONS, "visibility", "framing", "walking", "box", "decision", "comparison:speed"]
    bare = written.partition(":")[2] or written
    near = nearest(bare.partition("@")[0].strip(), names)
    return Refused(
        "slots_unknown_reference", f"there is no slot {{{written}}}{near}; use the names of the table of facts"
    )


def _read_slot(written: str, before: str, after: str, language: Language) -> Slot | None:
    name = re.sub(r"\s+", "", written.lower()).replace("–", "-")
    name = _ALIASES.get(name, name)
    kind, _, rest = name.partition(":")
    if name in ("decision", "side:decision", "box") or re.fullmatch(r"box@t\d{1,2}", name):
        return Slot(name, parse_reference(name.replace("box", "box_height")), 0, name == "side:decision")
    is_participle = kind == "trending"
    reference = parse_reference(f"trend:{rest}" if is_participle else name)
    if reference is None:
        return None
    if reference.aspect in ("comparison", "compared"):
        return Slot(str(reference), reference, 0 if _compares(after, language) else 1)
    if reference.aspect == "side":
        if reference.quantity == "yaw" and reference.first is not None and reference.last is None:
            reference = reference._replace(first=0, last=reference.first)  # a yaw is counted from t0, and so its side
        return Slot(str(reference), reference, 0, _needs_side(before, after, language))
    if reference.aspect == "trend" or reference.quantity in MOTIONS:
        return Slot(str(reference), reference, 1 if is_participle else _form_after(before))
    return Slot(str(reference), reference)


_SPACE = re.compile(r"^ +(?=[\u4e00-\u9fff])")
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


def _form_after(before: str) -> Form:
    """Return the form of an English verb after these words; Chinese has one."""
    for pattern, form in ((_HAS, 2), (_TO, 3), (_BE, 1)):
        if pattern.search(before):
            return form  # type: ignore[return-value]
    return 0


def _needs_side(before: str, after: str, language: Language) -> bool:
    if language == "zh":
        return bool(re.search(r"(?:(?<![方航])向|[朝往偏])\s*$", before)) or after.startswith(
            ("侧", "方", "边", "转", "偏", "拐")
        )
    return bool(re.search(r"\b(?:the|its|their|our)\s*$", before, re.IGNORECASE)) or bool(
        re.match(r"\s+of\b|\s*-|\s+(?:side|half|edge|part|third)\b", after)
    )


def _compares(after: str, language: Language) -> bool:
    """Return whether what the drone is compared with stands behind the slot."""
    after = after.lstrip()
    if language == "zh":
        return after.startswith(
            ("目标", "行人", "其", "它", "他", "她", "对方", "该", "被", "人", "步行", "无人机", "本机")
        )
    return bool(after) and after[0] not in ",.;:)!?"


def _without_repetition(slot: Slot, after: str, language: Language) -> str | Refused:
    """Take off what a slot brings itself: the unit of a number, the "than" of a comparison."""
    if slot.reference is None or slot.name.startswith("side:"):
        return after
    if slot.reference.aspect in ("comparison", "compared"):
        return re.sub(r"^\s+(?:than|as)\b", "", after) if language == "en" else after
    unit = _unit_of(slot)
    match = _unit_pattern(language).match(after) if unit else None
    if match is None:
        return after
    if load_glossary().spellings(language)[match[1].lower()] != unit:
        fix = f"its unit is {load_glossary().written_units[language][unit]} and stands in the slot"
        return Refused("slots_unit_outside", f"{{{slot.name}}}{match[0]}: {fix}")
    return after[match.end() :]


@lru_cache
def _unit_pattern(language: Language) -> re.Pattern[str]:
    spellings = sorted(load_glossary().spellings(language), key=len, reverse=True)
    options = "|".join(re.escape(s) + (r"(?![A-Za-z/])" if s[-1].isalpha() and s.isascii() else "") for s in spellings)
    return re.compile(rf"[\s-]*({options})", re.IGNORECASE)


def _unit_of(slot: Slot) -> str:
    reference = slot.reference
    assert reference is not None
    if reference.quantity not in QUANTITIES or reference.aspect in _WORDS:
        return ""
    unit = QUANTITIES[reference.quantity].unit
    if reference.aspect == "growth":
        return "percent"
    return {"m": "mps", "deg": "dps"}.get(unit, "") if reference.aspect == "rate" else unit
