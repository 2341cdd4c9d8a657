"""Templates filled: the facts of one window in the places of their slots, in one language."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from caption.answer_formats.contract import DECISION_REASON, Refused
from caption.answer_formats.templates import NEITHER, TURNS, Sentence, Slot, read_sentence, units_behind, words_of
from caption.verification.facts import Facts
from caption.verification.references import QUANTITIES, Fact, Missing, Reference, find_fact, look_up, span_of
from cosfly.formats.captions import ACTIONS, Language

_DIRECTIONS = {
    "increasing": 1, "decreasing": -1, "left": 1, "right": -1, "above": -1, "below": 1, "faster": 1, "slower": -1,
}  # fmt: skip
_DIGITS = ("%.0f", "%.1f", "%.2f")
_VOWEL = re.compile(r"[aeio]|8|1[18]\b")


class Filler:
    """Fills sentences of one language from the facts of one window; `{decision}` stands for the decision."""

    def __init__(self, facts: Facts, decision: str, language: Language) -> None:
        self.facts, self.decision, self.language = facts, decision, language
        self._found, self._units, self._forms = facts.found, units_behind(language), words_of(language)

    def fill(self, sentence: Sentence, *, is_reasoning: bool = False) -> str | Refused:
        """Return the plain text of a sentence."""
        if is_reasoning and self.decision in sentence.opposed:
            complaint = (
                f'it argues against {self.decision}, and "flight_decision" says {self.decision}; let the '
                f"reasoning lead to it"
            )
            return Refused(DECISION_REASON, complaint)
        if sentence.decisions:
            refused = self._check_decisions(sentence)
            if refused is not None:
                return refused
        filled_in, found, facts = [], self._found, self.facts
        for fact_key, slot, read, frame, form, words in sentence.places:
            if read is not None:  # a plain value of a series, which most slots are
                series = read(facts)
                value = series[frame] if series and frame < len(series) else None
                if value is not None:
                    filled_in.append(form % (abs(value) if slot.is_size else value))
                    continue
            elif words:
                fact = found.get(fact_key) or self._look_up(slot)
                if isinstance(fact, Fact) and fact.value in words:
                    filled_in.append(words[fact.value])
                    continue
            printed_word = self._print(slot)
            if isinstance(printed_word, Refused):
                return printed_word
            filled_in.append(printed_word)
        if sentence.sizes:
            for number, directions in sentence.sizes:
                refused = self._check_direction(number, directions)
                if refused is not None:
                    return refused
        filled = sentence.pattern % tuple(filled_in)
        return filled[0].upper() + filled[1:] if sentence.begins_with_slot else filled

    def _check_decisions(self, sentence: Sentence) -> Refused | None:
        """Refuse a sentence that comes to another decision than its answer."""
        own = (self.decision, ACTIONS[self.decision].en)
        other = next((words for words in sentence.decisions if words not in own), None)
        if other is None:
            return None
        complaint = f'it says "{other}" and "flight_decision" says {self.decision}; write {{decision}}'
        return Refused(DECISION_REASON, complaint)

    def _print(self, slot: Slot) -> str | Refused:
        fact = self._look_up(slot)
        if isinstance(fact, str):
            return self._missing(slot, fact)
        value, unit, digits = fact
        if value in NEITHER and (slot.is_size or slot.needs_side):
            value = self._exact_side(slot, fact).value if slot.is_size else value
            if slot.needs_side and value in NEITHER:
                fix = f"it is {value} here, neither side: say it without this slot, or as `is {{{slot.name}}}`"
                return Refused("slots_no_side", f"{{{slot.name}}}: {fix}")
        if not isinstance(value, str):
            word = _DIGITS[digits] % (abs(value) if slot.is_size else value) + self._units[unit]
        elif unit:  # a box
            word = (value if self.language == "en" else value.replace("x", "×")) + self._units[unit]
        else:
            forms = self._forms[value]
            word = forms[min(slot.form, len(forms) - 1)]
        return f"{slot.article}{'n' if _VOWEL.match(word) else ''} {word}" if slot.article else word

    def _look_up(self, slot: Slot) -> Fact | Missing:
        found = self._found.get(slot.fact_key)  # the other language has asked for it
        if found is None:
            if slot.reference is None:
                return self._of_decision(slot)
            found = find_fact(slot.reference, self.facts)
            if slot.is_shaped and isinstance(found, Fact):
                found = self._shaped(slot.reference, found)
            self._found[slot.fact_key] = found
        return found

    def _of_decision(self, slot: Slot) -> Fact | Missing:
        if slot.name == "decision":
            return Fact(self.decision)
        side = next((side for side in ("left", "right") if side in self.decision), None)
        return "unknown_fact" if side is None else Fact(side)

    def _shaped(self, reference: Reference, fact: Fact) -> Fact | Missing:
        """Return a fact as a text takes it: a box as both its sides, a trend as that of the size."""
        if reference.aspect == "trend":
            return self._trend_of_size(reference, fact)
        width = look_up(reference._replace(quantity="box_width"), self.facts)
        return Fact(f"{width.value} x {fact.value}", "px") if isinstance(width, Fact) else width

    def _trend_of_size(self, reference: Reference, trend: Fact) -> Fact | Missing:
        """Return the trend as a reader takes it: an offset to the left that shrinks is no increase."""
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
        """Refuse a size beside directions of its quantity none of which is its own: those of other frames. All have
        been printed."""
        found = self._found
        value = (found.get(number.fact_key) or self._look_up(number))[0]
        assert not isinstance(value, str)
        own = (value > 0) - (value < 0)
        own = -own if number.direction == "side:offset_x" else own  # positive to the right
        if not own:
            return None
        for slot in words:
            word = found.get(slot.fact_key) or self._look_up(slot)
            assert isinstance(word, Fact)
            if _DIRECTIONS.get(str(self._exact_side(slot, word)[0] if slot.is_size else word[0]), 0) != -own:
                return None
        fix = "its own direction is the other one; name the same frames in both slots"
        return Refused("slots_sign_differs", f"{{{number.name}}} beside a direction of other frames: {fix}")

    def _exact_side(self, slot: Slot, side: Fact) -> Fact:
        """Return the side of the very number where "straight" or "centred" would say neither."""
        if side.value not in NEITHER:
            return side
        assert slot.reference is not None
        quantity = slot.reference.quantity
        number = look_up(slot.reference._replace(aspect="change" if quantity in TURNS else ""), self.facts)
        if not isinstance(number, Fact) or isinstance(number.value, str) or not number.value:
            return side
        return Fact(QUANTITIES[quantity].sides[0 if number.value > 0 else 1])


def facts_of(facts: Facts, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Return (name, how it is filled in) of the slots among these whose fact is known."""
    filler = Filler(facts, "", "en")
    for name in names:
        sentence = read_sentence(f"it {{{name}}} it", "en", len(facts), facts.step_s)
        assert isinstance(sentence, Sentence)
        text = filler.fill(sentence)
        if isinstance(text, str):
            yield name, text[3:-3]
