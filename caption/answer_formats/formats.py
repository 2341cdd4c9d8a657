"""The answer formats: how a teacher writes its reasons so that their values can be compared with the facts.

Slots: the teacher names facts, and cosfly fills in their values from the window, in both languages. Prose: the paper's
three plain fields, for teachers that write better freely, and for texts by somebody else. Numbers with a unit outside
slots are compared with the facts.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from caption.answer_formats.templates import InvalidSlot, Sentence, Slot, read_sentence, read_slot
from caption.verification.facts import Facts
from caption.verification.glossary import form_of, swapped_opposite, written_unit
from caption.verification.mirror import TEXTS, check_mirror, check_translation, lacking
from caption.verification.references import QUANTITIES, TURNS, Fact, Missing, look_up
from cosfly.formats.captions import ACTIONS, TOKENS, Coc, Language, Template, Writing
from cosfly.llm.answer_text import cut_sentences, sentences_of

INVALID_SLOT = "invalid_slot"  # a reason
MAX_COMPLAINTS = 6  # named at once
# Asked for between the texts and the decision. It is free even where the decision is given.
THEREFORE = {"therefore": {"type": "string", "enum": list(TOKENS)}}


@dataclass(frozen=True)
class Draft:
    """A caption in one language."""

    coc: Coc  # its plain text
    outside: tuple[str, ...]  # the sentences without their slots
    template: Template | None = None  # what the text was filled from
    num_filled: int = 0  # slots that were filled with a value
    therefore: str | None = None  # the decision to which the reasoning leads; only in English

    @property
    def written(self) -> dict[str, Any]:
        """The answer as the teacher wrote it: the template where there is one."""
        return self.coc.model_dump() | (self.template.model_dump() if self.template else {})


@dataclass(frozen=True)
class Refused:
    """An answer of the right structure that is not accepted."""

    reason: str  # a code that is counted
    complaint: str  # the fault and what is allowed, for the teacher
    draft: Draft | None = None  # what could be read of the answer


def fill_answer(written: Coc, facts: Facts, language: Language = "en") -> Draft | Refused:
    """Fill the templates of an answer, or report the faults of their sentences, each once."""
    filler = Filler(facts, written.flight_decision, language)
    problems: dict[str, str] = {}  # the first place of each
    sentences: list[Sentence] = []
    texts = dict.fromkeys(TEXTS, "")
    for name in TEXTS:
        for number, part in enumerate(cut_sentences(getattr(written, name)), 1):
            try:
                sentence = read_sentence(part, language, len(facts))
                texts[name] += filler.fill(sentence)
                sentences.append(sentence)
            except InvalidSlot as error:
                problems.setdefault(str(error), f"{name}, sentence {number}")
    if problems:
        complaints = [f"{place}: {problem}." for problem, place in problems.items()]
        return Refused(INVALID_SLOT, " ".join(complaints[:MAX_COMPLAINTS]))
    template = Template(critical_components=written.critical_components, reasoning_trace=written.reasoning_trace)
    coc = Coc(**texts, flight_decision=written.flight_decision)
    outside = tuple([sentence.outside for sentence in sentences])
    return Draft(coc, outside, template, sum([sentence.num_values for sentence in sentences]))


def fill_mirror(written: Coc, english: Draft, facts: Facts, is_translated: bool = True) -> Draft | Refused:
    """Make the Chinese draft, and compare it with the English one; with slots it is always a translation of that."""
    assert english.template is not None
    if written.flight_decision != english.coc.flight_decision:
        return Refused("decision", f'"flight_decision" must stay {english.coc.flight_decision}.')
    draft = _compare(english.template, written, facts) or fill_answer(written, facts, "zh")
    if isinstance(draft, Refused):
        return draft
    swapped = swapped_opposite("".join(english.outside), "".join(draft.outside))
    if swapped:
        return Refused(f"polarity_{swapped}", f"the Chinese text swaps an opposite of the English one ({swapped}).")
    missing = lacking("".join(english.outside), draft.coc)
    return Refused("glossary", missing, draft) if missing else draft


def _compare(english: Template, chinese: Coc, facts: Facts) -> Refused | None:
    """Compare the Chinese template with the English one: the same slots in each sentence, each in its script."""
    for name in TEXTS:
        parts_en = cut_sentences(getattr(english, name))
        parts_zh = cut_sentences(getattr(chinese, name))
        if len(parts_en) != len(parts_zh):
            counts = f"{len(parts_en)} sentences in English and {len(parts_zh)} in Chinese"
            return Refused("sentences", f"{name} has {counts}; write one for each.")
        for number, (part_en, part_zh) in enumerate(zip(parts_en, parts_zh, strict=True), 1):
            place = f"{name}, sentence {number}"
            slots_en = read_sentence(part_en, "en", len(facts)).names
            try:
                sentence = read_sentence(part_zh, "zh", len(facts))
            except InvalidSlot as error:
                return Refused(INVALID_SLOT, f"{place}: {error}.")
            if slots_en != sentence.names:
                listed = "; ".join(f"{{{slot}}}" for slot in slots_en) or "none"
                return Refused("slots", f"{place} must hold these slots and no other: {listed}.")
            if not sentence.is_in_script:
                return Refused("script", f"{place} is not written in Chinese.")
    return None


# --- what a teacher is shown ------------------------------------------------------------------------------------------

_SERIES = (
    "ahead", "distance", "bearing", "offset_x", "offset_y", "box_height", "speed", "target_speed", "altitude", "yaw",
)  # fmt: skip
_SPANNED = ("ahead", "distance", "altitude", "yaw", "offset_x")  # shown with change and trend
_NOW = (
    "yaw_rate", "mean:speed", "forward_speed", "sideways_speed", "climb_rate", "mean:target_speed",
    "target_forward_speed", "target_sideways_speed", "target_heading", "change:target_heading", "rate:distance",
    "growth:box_height", "height_over_target", "depression", "travelled", "target_travelled", "others_in_view",
    "other_distance", "alike_differences",
)  # fmt: skip
_WORDS = (
    "target_motion", "drone_motion", "walking", "comparison:speed", "framing", "side:yaw", "side:yaw_rate",
    "side:target_heading", "side:bearing", "trend:bearing", "side:offset_x", "side:offset_y", "side:sideways_speed",
    "side:target_sideways_speed", "box@t0", "box",
)  # fmt: skip


def fact_table(facts: Facts) -> str:
    """Return the facts of a window with the names of their slots, as they are filled in; unknown facts are omitted."""
    filler = Filler(facts, "", "en")
    last = len(facts) - 1

    def listed(names: Iterable[str]) -> str:
        texts = {name: filler.text_of(name) for name in names}
        return "; ".join(f"{{{name}}} {text}" for name, text in texts.items() if text)

    lines = []
    for name in _SERIES:
        values = [filler.text_of(f"{name}@t{i}") for i in range(last + 1)]
        if not any(values):
            continue
        unit = f" {written_unit(QUANTITIES[name].unit, 'en')}"
        series = ", ".join([(value or "-").removesuffix(unit) for value in values])
        line = f"{{{name}@t0}} to {{{name}@t{last}}}: {series}{unit}"
        if name in _SPANNED and (change := listed([f"change:{name}", f"trend:{name}"])):
            line += f"; {change}"
        lines.append(line)
    words = ", ".join([filler.text_of(f"visibility@t{i}") for i in range(last + 1)])
    lines += [f"{{visibility@t0}} to {{visibility@t{last}}}: {words}", listed(_NOW), listed(_WORDS)]
    return "Table of facts (- is not known; {decision} is a slot too):\n" + "\n".join(lines)


# --- filling ----------------------------------------------------------------------------------------------------------

_DIGITS = ("%.0f", "%.1f", "%.2f")  # by the number of digits after the point
_NEITHER = ("straight", "centred")  # words of a side that say neither side
# A side of these is a reason to turn to it; when the drone itself moves to the left, it may have to turn to the right.
# With a first frame it may be a side of an earlier time.
_TURN_REASONS = [(name, "side", None) for name in ("yaw", "offset_x", "bearing", "target_sideways_speed")]
STEADY = 0.5  # smaller turns, deg or deg/s, are none; both are compared, because a track may jitter
# What a sentence says of the side of the decision: that the line of sight, or the drone, turns to it.
_SIGHT_TURNS = re.compile(r"line of sight(?: to \w+ \w+)?(?: (?:has|is|keeps|clearly))* turn|[视连]线\w{0,6}向%s")
_TURN_GOES_ON = re.compile(r"turn\b.* has to go on|继续向%s转")
_VOWEL = re.compile(r"[aeio]|8|1[18]\b")  # what begins with a vowel when it is spoken: eight, eleven, eighteen


class Filler:
    """Fills sentences of one language from the facts of one window; `{decision}` stands for the decision."""

    def __init__(self, facts: Facts, decision: str, language: Language) -> None:
        self.facts, self.decision, self.language = facts, decision, language

    def fill(self, sentence: Sentence) -> str:
        """Return the plain text of a sentence; InvalidSlot: a fact is not known or does not fit."""
        if self.decision.startswith("yaw_") and any(slot.name == "side:decision" for slot in sentence.slots):
            self._check_reason(sentence)
        filled = sentence.pattern % tuple([self._write(slot) for slot in sentence.slots])
        return filled[0].upper() + filled[1:] if sentence.pattern.startswith("%s") else filled

    def _check_reason(self, sentence: Sentence) -> None:
        """Raise InvalidSlot if a sentence gives a fact or a turn to one side as the reason for a turn to the other."""
        other, sign = ("left", -1) if "right" in self.decision else ("right", 1)
        turn = max(sign * self.facts.yaw_deg[-1], sign * (self.facts.yaw_rate_dps[-1] or 0.0))
        for words, moved in ((_SIGHT_TURNS, sign * self.facts.sight_rate_dps), (_TURN_GOES_ON, turn)):
            if moved < -STEADY and (match := words.search(sentence.pattern)):
                raise InvalidSlot(f"{match[0]!r}: the turn is to the {other} here, no reason for {self.decision}")
        for slot in sentence.slots:
            if slot.reference and slot.reference[:3] in _TURN_REASONS:
                fact = look_up(slot.reference, self.facts)
                if isinstance(fact, Fact) and fact.value == other:
                    raise InvalidSlot(f"{{{slot.name}}} is {other} here, which is no reason for {self.decision}")

    def text_of(self, name: str) -> str:
        """Return how a slot with this name is filled in as a verb, or before what is compared; "" if not known."""
        try:
            return self._write(read_slot(name, "it ", " it", self.language))
        except InvalidSlot:
            return ""

    def _write(self, slot: Slot) -> str:
        """Return the text of a slot; InvalidSlot: its fact is not known or does not fit."""
        fact = self._decision(slot) if slot.reference is None else look_up(slot.reference, self.facts)
        if isinstance(fact, str):
            fault = "is not known in this window; leave it out"
            if fact == "unobserved_frame":
                fault = f"names a frame that was not observed; frames are t0 to t{len(self.facts) - 1}"
            raise InvalidSlot(f"{{{slot.name}}} {fault}")
        value, unit, digits = fact
        if value in _NEITHER and slot.is_paired:
            value = self._side_of_number(slot) or value
        if value in _NEITHER and slot.needs_side:
            fix = f"it is {value} here, neither side: leave this slot out, or write `is {{{slot.name}}}`"
            raise InvalidSlot(f"{{{slot.name}}}: {fix}")
        sign = 0 if isinstance(value, str) else (value > 0) - (value < 0)
        if (slot.is_amount and sign < 0) or (slot.direction and sign != slot.direction):
            fix = "name its direction by a slot for a side or a trend"
            raise InvalidSlot(f"{{{slot.name}}} is {value} here, which does not fit the words before it: {fix}")
        if not isinstance(value, str):
            text = _DIGITS[digits] % (abs(value) if slot.is_paired else value)
        elif unit:  # a box
            text = value if self.language == "en" else value.replace("x", "×")
        else:
            text = form_of(value, slot.form, self.language)
        if unit:
            text += f"{'' if unit == 'percent' else ' '}{written_unit(unit, self.language)}"
        if not slot.article:
            return text
        return f"{slot.article}{'n' if _VOWEL.match(text) else ''} {text}"

    def _decision(self, slot: Slot) -> Fact | Missing:
        if slot.name == "decision":
            action = ACTIONS[self.decision]
            return Fact(action.en if self.language == "en" else action.zh)
        for side in ("left", "right"):
            if side in self.decision:
                return Fact(side)
        return "unknown_fact"

    def _side_of_number(self, slot: Slot) -> str | None:
        """Return the side that the sign of the number next to a slot says, however small the number is; None for 0."""
        assert slot.reference is not None
        quantity = slot.reference.quantity
        fact = look_up(slot.reference._replace(aspect="change" if quantity in TURNS else ""), self.facts)
        if not isinstance(fact, Fact) or isinstance(fact.value, str) or not fact.value:
            return None
        return QUANTITIES[quantity].side_of(fact.value, 0.0)


# --- the formats ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AnswerFormat:
    """One answer format."""

    system: str  # name of the prompt that asks for an English answer
    mirror_system: str  # name of the prompt that asks for the Chinese mirror
    table: Callable[[Facts], str]  # returns what the question shows after the measured state; "" for nothing
    read: Callable[[Coc, Facts], Draft | Refused]  # makes the English draft of an answer of the right structure
    # Makes the Chinese draft and compares it with the English one; the flag says whether it is a translation of that.
    read_mirror: Callable[[Coc, Draft, Facts, bool], Draft | Refused]


def _read_prose(written: Coc, facts: Facts) -> Draft:
    return Draft(written, tuple(sentences_of(written)))


def _read_prose_mirror(written: Coc, english: Draft, facts: Facts, is_translated: bool) -> Draft | Refused:
    draft = _read_prose(written, facts)
    problem = check_mirror(english.coc, written, facts)
    if problem is not None:
        return Refused(problem, f"The Chinese text does not say the same as the English one: {problem}.", draft)
    missing = check_translation(english.coc, written) if is_translated else None
    return Refused(*missing, draft) if missing else draft


FORMATS: dict[Writing, AnswerFormat] = {
    "slots": AnswerFormat("system_slots_en", "mirror_slots_system", fact_table, fill_answer, fill_mirror),
    "prose": AnswerFormat("system_prose_en", "mirror_system", lambda facts: "", _read_prose, _read_prose_mirror),
}
