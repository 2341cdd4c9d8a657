"""Templates filled: the facts of one window in the places of their slots, in one language."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache

from caption.truth.facts import Facts
from caption.truth.glossary import load_glossary
from caption.truth.references import QUANTITIES, Fact, Missing, Reference, look_up, span_of
from caption.writing.contract import DECISION_REASON, Refused
from caption.writing.templates import TURNS, Sentence, Slot, read_sentence
from cosfly.products.captions import Language

_DIRECTIONS = {
    "increasing": 1, "decreasing": -1, "left": 1, "right": -1, "above": -1, "below": 1, "faster": 1, "slower": -1,
}  # fmt: skip
_NEITHER = ("straight", "centred")
_DIGITS = ("%.0f", "%.1f", "%.2f")
_VOWEL = re.compile(r"[aeio]|8|1[18]\b")


class Filler:
    """Fills sentences of one language from the facts of one window; `{decision}` stands for the decision."""

    def __init__(self, facts: Facts, decision: str, language: Language) -> None:
        self.facts, self.decision, self.language = facts, decision, language
        self._found, self._units, self._forms = facts.found, _units(language), _words(language)
        self._printed: dict[str, str] = {}

    def fill(self, sentence: Sentence, *, is_reasoning: bool = False) -> str | Refused:
        """Give the plain text of a sentence."""
        if is_reasoning and self.decision in sentence.opposed:
            complaint = f'it argues against {self.decision}, and "flight_decision" says {self.decision}; let the reasoning lead to it'
            return Refused(DECISION_REASON, complaint)
        if sentence.decisions:
            refused = self._check_decisions(sentence)
            if refused is not None:
                return refused
        words = []
        for slot in sentence.slots:
            word = self._printed.get(slot.key) or self._print(slot)
            if isinstance(word, Refused):
                return word
            words.append(word)
        for number, directions in sentence.sizes:
            refused = self._check_direction(number, directions)
            if refused is not None:
                return refused
        filled = sentence.pattern % tuple(words)
        return filled[0].upper() + filled[1:] if sentence.begins_with_slot else filled

    def _check_decisions(self, sentence: Sentence) -> Refused | None:
        """Refuse a sentence that comes to another decision than its answer."""
        own = (self.decision, load_glossary().actions[self.decision]["en"])
        other = next((words for words in sentence.decisions if words not in own), None)
        if other is None:
            return None
        complaint = f'it says "{other}" and "flight_decision" says {self.decision}; write {{decision}}'
        return Refused(DECISION_REASON, complaint)

    def _print(self, slot: Slot) -> str | Refused:
        word = self._plain_value(slot)
        if word is None:
            fact = self._fitting(slot)
            if isinstance(fact, Refused):
                return fact
            word = self._written(slot, fact)
        if slot.article:
            word = f"{slot.article}{'n' if _VOWEL.match(word) else ''} {word}"
        self._printed[slot.key] = word
        return word

    def _plain_value(self, slot: Slot) -> str | None:
        """Write a value of a series, which most slots are; None where it is something else, or not known."""
        quantity = slot.quantity
        if quantity is None:
            return None
        assert slot.reference is not None
        series, frame = quantity.read(self.facts), slot.reference.first
        if not series or (frame is not None and frame >= len(series)):
            return None
        value = series[-1 if frame is None else frame]
        if value is None:
            return None
        return _DIGITS[quantity.digits] % (abs(value) if slot.is_size else value) + self._units[quantity.unit]

    def _fitting(self, slot: Slot) -> Fact | Refused:
        """Give the fact of a slot, with the side that its sentence needs."""
        fact = self._look_up(slot)
        if isinstance(fact, str):
            return self._missing(slot, fact)
        if fact.value in _NEITHER:
            fact = self._exact_side(slot, fact) if slot.is_size else fact
            if slot.needs_side and fact.value in _NEITHER:
                fix = f"it is {fact.value} here, neither side: say it without this slot, or as `is {{{slot.name}}}`"
                return Refused("slots_no_side", f"{{{slot.name}}}: {fix}")
        return fact

    def _written(self, slot: Slot, fact: Fact) -> str:
        value, unit, digits = fact
        if not isinstance(value, str):
            return _DIGITS[digits] % (abs(value) if slot.is_size else value) + self._units[unit]
        if unit:  # a box
            return (value if self.language == "en" else value.replace("x", "×")) + self._units[unit]
        forms = self._forms[value]
        return forms[min(slot.form, len(forms) - 1)]

    def _look_up(self, slot: Slot) -> Fact | Missing:
        found = self._found.get(slot.name)  # the other language has asked for it
        if found is None:
            if slot.reference is None:
                return self._of_decision(slot)
            found = look_up(slot.reference, self.facts)
            if slot.is_shaped and isinstance(found, Fact):
                found = self._shaped(slot.reference, found)
            self._found[slot.name] = found
        return found

    def _of_decision(self, slot: Slot) -> Fact | Missing:
        if slot.name == "decision":
            return Fact(self.decision)
        side = next((side for side in ("left", "right") if side in self.decision), None)
        return "unknown_fact" if side is None else Fact(side)

    def _shaped(self, reference: Reference, fact: Fact) -> Fact | Missing:
        """Give a fact as a text takes it: a box as both its sides, a trend as that of the size."""
        if reference.aspect == "trend":
            return self._trend_of_size(reference, fact)
        width = look_up(reference._replace(quantity="box_width"), self.facts)
        return Fact(f"{width.value} x {fact.value}", "px") if isinstance(width, Fact) else width

    def _trend_of_size(self, reference: Reference, trend: Fact) -> Fact | Missing:
        """Give the trend as a reader takes it: an offset to the left that shrinks is no increase."""
        values = span_of(reference, self.facts)
        assert values
        if trend.value not in _DIRECTIONS or min(values) >= 0:
            return trend
        if max(values) > 0:
            return "unknown_fact"
        return Fact("decreasing" if trend.value == "increasing" else "increasing")

    def _missing(self, slot: Slot, why: Missing) -> Refused:
        if slot.name == "side:decision":
            return Refused("slots_no_side", f"{{{slot.name}}}: the decision {self.decision} has no side")
        words = {
            "unknown_fact": "is not known in this window; leave it out",
            "unobserved_frame": f"names a frame that was not observed; frames are t0 to t{len(self.facts) - 1}",
            "unknown_reference": "cannot be measured",
        }
        return Refused(f"slots_{why}", f"{{{slot.name}}} {words[why]}")

    def _check_direction(self, number: Slot, words: Sequence[Slot]) -> Refused | None:
        """Refuse a size beside directions of its quantity none of which is its own: those of other frames."""
        value = self._value(number)
        assert not isinstance(value, str)
        own = (value > 0) - (value < 0)
        own = -own if number.direction == "side:offset_x" else own  # positive to the right
        if not own:
            return None
        for slot in words:
            if _DIRECTIONS.get(self._word(slot), 0) != -own:
                return None
        fix = "its own direction is the other one; name the same frames in both slots"
        return Refused("slots_sign_differs", f"{{{number.name}}} beside a direction of other frames: {fix}")

    def _word(self, slot: Slot) -> str:
        found = self._look_up(slot)
        assert isinstance(found, Fact)  # it has been printed
        return str(self._exact_side(slot, found).value if slot.is_size else found.value)

    def _value(self, slot: Slot) -> float | str:
        found = self._look_up(slot)
        assert isinstance(found, Fact)  # it has been printed
        return found.value

    def _exact_side(self, slot: Slot, side: Fact) -> Fact:
        """Give the side of the very number where "straight" or "centred" would say neither."""
        if side.value not in _NEITHER:
            return side
        assert slot.reference is not None
        quantity = slot.reference.quantity
        number = look_up(slot.reference._replace(aspect="change" if quantity in TURNS else ""), self.facts)
        if not isinstance(number, Fact) or isinstance(number.value, str) or not number.value:
            return side
        return Fact(QUANTITIES[quantity].sides[0 if number.value > 0 else 1])


@cache
def _units(language: Language) -> dict[str, str]:
    """Give what stands behind a number: its unit, a space before it where one belongs there."""
    units = load_glossary().written_units[language]
    return {unit: f"{'' if unit == 'percent' else ' '}{written}" for unit, written in units.items()}


@cache
def _words(language: Language) -> dict[str, tuple[str, ...]]:
    """Give the forms of every word that is true somewhere: slot words, kinds of visibility, decisions."""
    glossary = load_glossary()
    names = {name: (pair[language],) for name, pair in (glossary.visibility | glossary.actions).items()}
    return names | {name: forms[language] for name, forms in glossary.slot_words.items()}


def facts_of(facts: Facts, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Give (name, how it is filled in) of the slots among these whose fact is known."""
    filler = Filler(facts, "", "en")
    for name in names:
        sentence = read_sentence(f"it {{{name}}} it", "en", len(facts), facts.step_s)
        assert isinstance(sentence, Sentence)
        text = filler.fill(sentence)
        if isinstance(text, str):
            yield name, text[3:-3]
