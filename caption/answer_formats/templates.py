"""Templates: sentences with slots in place of facts, read once; formats.py fills them for each window.

    The gap {trend:distance} from {distance@t0} to {distance}.     a reference of verification/references.py in braces
    {decision}  {side:decision}                                    the decision in words, and its side

A number is filled in with its unit, in the digits of the table of quantities. Next to a side, a trend or a comparison
of the same quantity and frames it is written without its sign. A word takes the form that the words before it ask for
("is increasing", "has increased"). Text outside slots is free; a number with a unit is compared with the facts
(verification/values.py).
"""

import re
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import NamedTuple

from caption.verification.glossary import form_after, is_negated, spellings, written_unit
from caption.verification.references import (
    QUANTITIES,
    RATE_UNITS,
    RELATIONS,
    TURNS,
    WORDS,
    Reference,
    has_sides,
    parse_reference,
)  # fmt: skip
from cosfly.formats.captions import Language
from cosfly.llm.answer_text import is_in_script
from cosfly.runtime.errors import nearest

SLOT_MARK = "\ufffc"  # replaces a slot in the text without slots
_BRACES = re.compile(r"\{([^{}]*)\}")
_ARTICLE = re.compile(r"\b([Aa])n?\s+$")
# Words before a change, a rate or a climb: of an amount, which is not negative, or of a direction, which is its sign.
_AMOUNT = {"en": r"\bby\s+$", "zh": r"了\s*$"}
_DIRECTIONS: dict[Language, str] = {
    "en": r"(?:(?P<rises>increas|grow|ris[ei]|rose|climb|ascend|widen|reced)|(?P<falls>decreas|shr[iu]nk|descend|sink"
    r"|(?:f[ae]ll|drop)(?!\w*\s+b(?:ack|ehind))|narrow|approach))\w*(?:\s+\w+){0,3}\s+$",
    "zh": "(?:(?P<rises>增|升|变大|扩大|远离)|(?P<falls>减|降|缩|变小|靠近|接近))[^，。；,;]{0,6}$",
}
_CHANGES = ("change", "rate", "growth")
_VERBS = ("target_motion", "drone_motion", "walking")
_ALIASES = {  # what prompts call a slot -> its reference; "compared" is the comparison seen from the target
    "compare:drone_speed,target_speed": "comparison:speed",
    "compare:target_speed,drone_speed": "compared:speed",
    "side:target": "side:offset_x",
}


class InvalidSlot(ValueError):
    """A sentence that cannot be filled: the fault and what is allowed, for its writer."""


@dataclass(frozen=True)
class Slot:
    """One slot of a sentence."""

    name: str  # what is looked up, the same for every form of a word
    reference: Reference | None  # None for the decision
    form: int = 0  # of the glossary's slot words: 0 verb, 1 after "is", 2 after "has", 3 after "to"
    needs_side: bool = False  # "straight" or "centred" does not fit here
    # Another slot of the sentence has the same direction: a number is written without its sign, and a side is that of
    # the number, however small.
    is_paired: bool = False
    is_amount: bool = False  # because of the words before it, which ask for a number that is not negative
    direction: int = 0  # 1 or -1 if the words before it ask for this sign
    article: str = ""  # "a" before the slot, which becomes "an" if the value needs it; "" if there is none

    @property
    def is_word(self) -> bool:
        return self.reference is None or self.reference.aspect in RELATIONS or self.reference.quantity in WORDS


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence that may be filled."""

    pattern: str  # its text for the operator %, with %s for each slot
    outside: str  # its text, with SLOT_MARK for each slot
    slots: tuple[Slot, ...]
    names: tuple[str, ...]  # of the slots, sorted
    is_in_script: bool
    num_values: int  # slots that are filled with a value: all but those of the decision


@lru_cache(maxsize=32768)  # neighbouring windows share most sentences
def read_sentence(text: str, language: Language, num_frames: int) -> Sentence:
    """Read a sentence; InvalidSlot: it cannot be filled in any window of so many frames."""
    parts = _BRACES.split(text)
    texts, names = parts[::2], parts[1::2]  # slot i stands between texts i and i + 1
    if any("{" in part or "}" in part for part in texts):
        raise InvalidSlot("a brace is not closed or not opened")
    slots = list[Slot]()
    for i, name in enumerate(names):
        before, after = "".join(texts[: i + 1]), texts[i + 1]
        if is_negated(before.lower(), len(before), language):
            raise InvalidSlot(f"{{{name}}}: a slot is a fact and always true: do not negate it")
        slot = read_slot(name, texts[i], after, language)
        texts[i + 1] = _without_repetition(slot, after, language)
        slots.append(slot)
    slots = _paired(slots, num_frames)
    slots = [_with_bounds(slot, before, language) for slot, before in zip(slots, texts, strict=False)]
    outside = SLOT_MARK.join(texts)  # with the spaces and articles that the writer chose
    if language == "zh":  # a space before a number, none behind its unit
        texts[1:] = [re.sub(r"^ +(?=[\u4e00-\u9fff])", "", part) for part in texts[1:]]
    else:
        for i, slot in enumerate(slots):
            if match := _ARTICLE.search(texts[i]):
                texts[i] = texts[i][: match.start()]
                slots[i] = replace(slot, article=match[1])
    return Sentence(
        pattern="%s".join(part.replace("%", "%%") for part in texts),
        outside=outside,
        slots=tuple(slots),
        names=tuple(sorted(slot.name for slot in slots)),
        is_in_script=is_in_script(outside, language),
        num_values=sum(slot.reference is not None for slot in slots),
    )


def read_slot(written: str, before: str, after: str, language: Language) -> Slot:
    """Read a slot between these texts; InvalidSlot: it names nothing."""
    name = re.sub(r"\s+", "", written.lower()).replace("–", "-")
    name = _ALIASES.get(name, name)
    if name in ("decision", "side:decision"):
        return Slot(name, None, needs_side=name == "side:decision")
    reference = parse_reference(name)
    if reference is None:
        bare = (written.partition(":")[2] or written).partition("@")[0].strip()
        near = nearest(bare, [*QUANTITIES, *WORDS, "decision", "comparison:speed"])
        raise InvalidSlot(f"there is no slot {{{written}}}{near}; use the names of the table of facts")
    form = 0
    aspect = reference.aspect
    if aspect in ("comparison", "compared"):
        form = 0 if _is_compared_with(after, language) else 1
    elif aspect == "trend" or reference.quantity in _VERBS:
        form = form_after(before)
    elif aspect == "side" and reference.quantity == "yaw" and reference.first is not None and reference.last is None:
        reference = reference._replace(first=0, last=reference.first)  # a yaw is counted from t0, and so its side
    return Slot(str(reference), reference, form, aspect == "side" and _needs_side(before, after, language))


# --- numbers and words of one direction -------------------------------------------------------------------------------


class Direction(NamedTuple):
    """What a word states, or the sign of a number means, with the frames for which it does: `{yaw@t2}` has the
    direction side:yaw of the frames 0 to 2."""

    name: str
    first: int
    last: int


def _paired(slots: list[Slot], num_frames: int) -> list[Slot]:
    """Return the slots, marked if a number and a word state the same direction: the word gives the sign. A number next
    to a direction of other frames is refused, since it could be the opposite one."""
    directions = [_direction_of(slot, num_frames) for slot in slots]
    pairs = list(zip(slots, directions, strict=True))
    of_words = {direction for slot, direction in pairs if direction and slot.is_word}
    of_numbers = {direction for slot, direction in pairs if direction and not slot.is_word}
    names_of_words = {direction.name for direction in of_words}
    paired = []
    for slot, direction in pairs:
        if direction and not slot.is_word and direction.name in names_of_words and direction not in of_words:
            fix = "a side or a trend in its sentence is of other frames; name the same frames in both slots"
            raise InvalidSlot(f"{{{slot.name}}}: {fix}")
        partners = of_numbers if slot.is_word else of_words
        paired.append(replace(slot, is_paired=direction in partners))
    return paired


def _direction_of(slot: Slot, num_frames: int) -> Direction | None:
    """Return the direction of a slot; None without one, as of a distance at a frame."""
    if slot.reference is None or slot.reference.quantity in WORDS:
        return None
    name, aspect, first, last = slot.reference
    current = num_frames - 1
    start = 0 if first is None else first  # of a span
    end = current if last is None else last
    frame = current if first is None else first  # of a value at one frame
    if aspect == "comparison":
        return Direction("comparison", 0, current)
    if name == "yaw" and not aspect:  # a yaw is counted from t0
        return Direction("side:yaw", 0, frame)
    if name in TURNS and aspect in (*_CHANGES, "side"):
        return Direction(f"side:{name}", start, end)
    if not QUANTITIES[name].sides and aspect in (*_CHANGES, "trend"):
        return Direction(f"trend:{name}", start, end)
    if aspect == "side" or (not aspect and has_sides(name)):
        return Direction(f"side:{name}", frame, frame)
    return None


def _with_bounds(slot: Slot, before: str, language: Language) -> Slot:
    """Return a slot with what the words before it say of its sign: "has fallen by {change:distance}"."""
    reference = slot.reference
    if reference is None or slot.is_paired or not (slot.name == "climb_rate" or reference.aspect in _CHANGES):
        return slot
    is_amount = re.search(_AMOUNT[language], before, re.IGNORECASE) is not None
    match = None if QUANTITIES[reference.quantity].sides else re.search(_DIRECTIONS[language], before, re.IGNORECASE)
    if match is None or is_negated(before.lower(), match.start(), language):
        return replace(slot, is_amount=is_amount)
    return replace(slot, is_amount=is_amount, direction=1 if match["rises"] else -1)


# --- words around a slot ----------------------------------------------------------------------------------------------

# Words with which the other side of a comparison begins: target, pedestrian, it, he, she, that one, drone.
_ZH_COMPARED = ("目标", "行人", "其", "它", "他", "她", "对方", "该", "被", "人", "步行", "无人机", "本机")


def _needs_side(before: str, after: str, language: Language) -> bool:
    """Return whether only a side fits between these texts: "to the {}", "{} of", "向{}转"."""
    if language == "zh":
        is_led = re.search(r"(?:(?<![方航])向|[朝往偏])\s*$", before)
        return bool(is_led) or after.startswith(("侧", "方", "边", "转", "偏", "拐"))
    is_led = re.search(r"\b(?:the|its|their|our)\s*$", before, re.IGNORECASE)
    return bool(is_led or re.match(r"\s+of\b|\s*-|\s+(?:side|half|edge|part|third)\b", after))


def _is_compared_with(after: str, language: Language) -> bool:
    """Return whether the other side of a comparison stands behind the slot."""
    after = after.lstrip()
    return after.startswith(_ZH_COMPARED) if language == "zh" else bool(after) and after[0] not in ",.;:)!?"


def _without_repetition(slot: Slot, after: str, language: Language) -> str:
    """Return the text after a slot without what the slot itself brings: a number its unit, a comparison its "than"."""
    reference = slot.reference
    if reference is None or reference.aspect in ("side", "trend") or reference.quantity in WORDS:
        return after
    if reference.aspect in ("comparison", "compared"):
        return re.sub(r"^\s+(?:than|as)\b", "", after) if language == "en" else after
    match = _unit_pattern(language).match(after)
    if match is None:
        return after
    unit = QUANTITIES[reference.quantity].unit
    unit = {"growth": "percent", "rate": RATE_UNITS.get(unit, unit)}.get(reference.aspect, unit)
    if spellings(language)[match[1].lower()] != unit:
        fix = f"its unit is {written_unit(unit, language)} and stands in the slot"
        raise InvalidSlot(f"{{{slot.name}}}{match[0]}: {fix}")
    return after[match.end() :]


@cache
def _unit_pattern(language: Language) -> re.Pattern[str]:
    """Return the pattern of a unit behind a slot, such as " m/s" or "米"."""
    known = sorted(spellings(language), key=len, reverse=True)
    options = "|".join(re.escape(s) + (r"(?![A-Za-z/])" if s[-1].isalpha() and s.isascii() else "") for s in known)
    return re.compile(rf"[\s-]*({options})", re.IGNORECASE)
