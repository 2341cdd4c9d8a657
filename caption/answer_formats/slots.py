"""Slots: the teacher names facts, and cosfly fills in their values from the window, in both languages.

Numbers, units, sides, trends and the mirror are right by construction. What a teacher writes outside slots is free; its
numbers are compared with the facts as those of prose.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache

from caption.answer_formats.contract import INVALID_SLOT, Draft, Refused, WayOfWriting
from caption.answer_formats.templates import SLOT_MARK, TURNS, Sentence, Slot, read_sentence
from caption.verification.facts import Facts
from caption.verification.glossary import load_glossary
from caption.verification.mirror import TEXTS, lacking
from caption.verification.references import QUANTITIES, Fact, Missing, look_up
from caption.verification.values import ValueCheck, check_values
from cosfly.formats.captions import ACTIONS, Coc, Language, Template, Writing
from cosfly.llm.answer_text import Parsed, cut_sentences

MAX_COMPLAINTS = 6  # named at once


class Slots(WayOfWriting):
    """The teacher writes templates."""

    name: Writing = "slots"
    system = "system_slots_en"
    mirror_system = "mirror_slots_system"

    def table(self, facts: Facts) -> str:
        return fact_table(facts)

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        return _fill(answer.coc, Filler(facts, answer.coc.flight_decision, "en"), answer.therefore)

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        assert english.template is not None
        if answer.coc.flight_decision != english.coc.flight_decision:
            return Refused("decision", f'"flight_decision" must stay {english.coc.flight_decision}.')
        problem = _compare(english.template, answer.coc, facts)
        if problem is not None:
            return problem
        draft = _fill(answer.coc, Filler(facts, answer.coc.flight_decision, "zh"))
        if isinstance(draft, Refused):
            return draft
        missing = lacking(_terms(english.template, facts), draft.coc)
        return Refused("glossary", missing, draft) if missing else draft

    def check(self, draft: Draft, facts: Facts, language: Language) -> ValueCheck:
        return check_values(draft.outside, facts, language, draft.num_filled)


@lru_cache(maxsize=64)  # an English text is read again when its mirror is compared with it
def read_text(text: str, language: Language, num_frames: int) -> tuple[Sentence | Refused, ...]:
    """Read the sentences of a text."""
    return tuple([read_sentence(part, language, num_frames) for part in cut_sentences(text)])


def _fill(written: Coc, filler: Filler, therefore: str | None = None) -> Draft | Refused:
    """Fill the templates of an answer, or report all faults of their sentences."""
    problems: list[Refused] = []
    outside: list[str] = []
    texts: dict[str, str] = {}
    num_filled = 0
    for name in TEXTS:
        filled: list[str] = []
        for number, sentence in enumerate(read_text(getattr(written, name), filler.language, len(filler.facts)), 1):
            plain = sentence if isinstance(sentence, Refused) else filler.fill(sentence)
            if isinstance(plain, Refused):
                problems.append(Refused(plain.reason, f"{name}, sentence {number}: {plain.complaint}."))
            elif isinstance(sentence, Sentence):
                filled.append(plain)
                outside.append(sentence.outside)
                num_filled += sentence.num_values
        texts[name] = "".join(filled)
    if problems:
        return Refused(problems[0].reason, " ".join(problem.complaint for problem in problems[:MAX_COMPLAINTS]))
    template = Template(critical_components=written.critical_components, reasoning_trace=written.reasoning_trace)
    coc = Coc(**texts, flight_decision=written.flight_decision)
    return Draft(coc, therefore, template, tuple(outside), num_filled)


def _terms(english: Template, facts: Facts) -> list[tuple[str, str]]:
    """Return the glossary's terms of an English template, slots aside: these are filled in from the glossary."""
    found: list[tuple[str, str]] = []
    for name in TEXTS:
        for sentence in read_text(getattr(english, name), "en", len(facts)):
            assert isinstance(sentence, Sentence)  # else there is no English draft
            found += sentence.terms
    return list(dict.fromkeys(found))  # in their order, so that a complaint is the same in every run


def _compare(english: Template, chinese: Coc, facts: Facts) -> Refused | None:
    """Compare the Chinese template with the English one: the same slots in each sentence, no opposite swapped outside
    them, each in its script."""
    glossary = load_glossary()
    for name in TEXTS:
        sentences_en = read_text(getattr(english, name), "en", len(facts))
        sentences_zh = read_text(getattr(chinese, name), "zh", len(facts))
        if len(sentences_en) != len(sentences_zh):
            counts = f"{len(sentences_en)} sentences in English and {len(sentences_zh)} in Chinese"
            return Refused("sentences", f"{name} has {counts}; write one for each.")
        for number, (mine, other) in enumerate(zip(sentences_en, sentences_zh, strict=True), 1):
            assert isinstance(mine, Sentence)  # else there is no English draft
            if isinstance(other, Refused):
                return Refused(other.reason, f"{name}, sentence {number}: {other.complaint}.")
            if mine.names != other.names:
                names = "; ".join(f"{{{slot}}}" for slot in mine.names) or "none"
                return Refused("slots", f"{name}, sentence {number} must hold these slots and no other: {names}.")
            if not other.is_in_script:
                return Refused("script", f"{name}, sentence {number} is not written in Chinese.")
    texts = ["".join(getattr(text, name) for name in TEXTS) for text in (english, chinese)]
    swapped = glossary.swapped(*[re.sub(r"\{[^{}]*\}", SLOT_MARK, text) for text in texts])
    if swapped:
        return Refused(f"polarity_{swapped}", f"the Chinese text swaps an opposite of the English one ({swapped}).")
    return None


# --- what a teacher is shown ------------------------------------------------------------------------------------------

_SERIES = (
    "ahead", "distance", "bearing", "offset_x", "offset_y", "box_height", "speed", "target_speed", "altitude", "yaw",
)  # fmt: skip
_SPANNED = ("ahead", "distance", "altitude", "yaw", "offset_x")  # shown with change and trend
_NOW = (
    "mean:speed", "forward_speed", "sideways_speed", "climb_rate", "mean:target_speed", "target_forward_speed",
    "target_sideways_speed", "target_heading", "change:target_heading", "rate:distance", "growth:box_height",
    "height_over_target", "depression", "travelled", "target_travelled", "others_in_view", "other_distance",
    "alike_differences",
)  # fmt: skip
_WORDS = (
    "target_motion", "drone_motion", "walking", "comparison:speed", "framing", "side:yaw", "side:target_heading",
    "side:bearing", "trend:bearing", "side:offset_x", "side:offset_y", "side:sideways_speed",
    "side:target_sideways_speed", "box@t0", "box",
)  # fmt: skip


def fact_table(facts: Facts) -> str:
    """Return the facts of a window with the names of their slots, as they are filled in; unknown facts are omitted."""
    last = len(facts) - 1
    lines = []
    for name in _SERIES:
        values = dict(facts_of(facts, [f"{name}@t{i}" for i in range(last + 1)]))
        if not values:
            continue
        unit = " " + load_glossary().written_units["en"][QUANTITIES[name].unit]
        series = ", ".join(values.get(f"{name}@t{i}", "-").removesuffix(unit) for i in range(last + 1))
        more = [f"change:{name}", f"trend:{name}"] if name in _SPANNED else []
        lines.append(f"{{{name}@t0}} to {{{name}@t{last}}}: {series}{unit}{_listed(facts, more, '; ')}")
    seen = ", ".join(text for _, text in facts_of(facts, [f"visibility@t{i}" for i in range(last + 1)]))
    lines.append(f"{{visibility@t0}} to {{visibility@t{last}}}: {seen}")
    lines += [_listed(facts, names) for names in (_NOW, _WORDS)]
    return "Table of facts (- is not known; {decision} is a slot too):\n" + "\n".join(lines)


def _listed(facts: Facts, names: Sequence[str], before: str = "") -> str:
    listed = "; ".join(f"{{{name}}} {text}" for name, text in facts_of(facts, names))
    return before + listed if listed else ""


# --- filling ----------------------------------------------------------------------------------------------------------

_DIGITS = ("%.0f", "%.1f", "%.2f")
_NEITHER = ("straight", "centred")
_VOWEL = re.compile(r"[aeio]|8|1[18]\b")
_MISSING = {
    "unknown_fact": "is not known in this window; leave it out",
    "unobserved_frame": "names a frame that was not observed",
    "unknown_reference": "cannot be measured",
}


class Filler:
    """Fills sentences of one language from the facts of one window; `{decision}` stands for the decision."""

    def __init__(self, facts: Facts, decision: str, language: Language) -> None:
        self.facts, self.decision, self.language = facts, decision, language
        self._forms = _word_forms(language)
        self._units = load_glossary().written_units[language]

    def fill(self, sentence: Sentence) -> str | Refused:
        """Return the plain text of a sentence."""
        values = []
        for slot in sentence.slots:
            value = self._write(slot)
            if isinstance(value, Refused):
                return value
            values.append(value)
        filled = sentence.pattern % tuple(values)
        return filled[0].upper() + filled[1:] if sentence.pattern.startswith("%s") else filled

    def _write(self, slot: Slot) -> str | Refused:
        fact = self._decision(slot) if slot.reference is None else look_up(slot.reference, self.facts)
        if isinstance(fact, str):
            frames = f"; frames are t0 to t{len(self.facts) - 1}" if fact == "unobserved_frame" else ""
            return Refused(INVALID_SLOT, f"{{{slot.name}}} {_MISSING[fact]}{frames}")
        value, unit, digits = fact
        if value in _NEITHER and slot.is_paired:
            value = self._side_of_number(slot) or value
        if value in _NEITHER and slot.needs_side:
            fix = f"it is {value} here, neither side: leave this slot out, or write `is {{{slot.name}}}`"
            return Refused(INVALID_SLOT, f"{{{slot.name}}}: {fix}")
        if not isinstance(value, str):
            word = _DIGITS[digits] % (abs(value) if slot.is_paired else value)
            word += f"{'' if unit == 'percent' else ' '}{self._units[unit]}"
        elif unit:  # a box
            word = f"{value if self.language == 'en' else value.replace('x', '×')} {self._units[unit]}"
        else:
            forms = self._forms[value]
            word = forms[min(slot.form, len(forms) - 1)]
        return f"{slot.article}{'n' if _VOWEL.match(word) else ''} {word}" if slot.article else word

    def _decision(self, slot: Slot) -> Fact | Missing:
        if slot.name == "decision":
            return Fact(self.decision)
        side = next((side for side in ("left", "right") if side in self.decision), None)
        return "unknown_fact" if side is None else Fact(side)

    def _side_of_number(self, slot: Slot) -> str | None:
        """Return the side of the number next to a slot, where "straight" or "centred" says neither."""
        assert slot.reference is not None
        quantity = slot.reference.quantity
        number = look_up(slot.reference._replace(aspect="change" if quantity in TURNS else ""), self.facts)
        if not isinstance(number, Fact) or isinstance(number.value, str) or not number.value:
            return None
        return QUANTITIES[quantity].sides[0 if number.value > 0 else 1]


@cache
def _word_forms(language: Language) -> dict[str, tuple[str, ...]]:
    """Return the forms of every word that fills a slot: those of the glossary, and decisions."""
    decisions = {token: (action.en if language == "en" else action.zh,) for token, action in ACTIONS.items()}
    return decisions | load_glossary().slot_words(language)


def facts_of(facts: Facts, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Return (name, how it is filled in) of the slots among these whose fact is known."""
    filler = Filler(facts, "", "en")
    for name in names:
        sentence = read_sentence(f"it {{{name}}} it", "en", len(facts))
        assert isinstance(sentence, Sentence)
        text = filler.fill(sentence)
        if isinstance(text, str):
            yield name, text[3:-3]
