"""Captions for tests: the rule teacher's texts, filled."""

from __future__ import annotations

import numpy as np

from caption.teachers.rules import write_templates
from caption.truth.facts import Facts
from caption.writing.contract import Draft
from caption.writing.slots import Slots
from cosfly.products.answer_text import Parsed
from cosfly.products.captions import Coc


def write_answers(facts: Facts, rng: np.random.Generator, decision: str | None = None) -> tuple[Coc, Coc]:
    """Give the rule teacher's English and Chinese answer as plain text."""
    english, chinese = (Coc(**answer) for answer in write_templates(facts, rng.bytes(32), decision))
    first = Slots().read(Parsed(english, therefore=english.flight_decision), facts)
    assert isinstance(first, Draft), first
    second = Slots().read_mirror(Parsed(chinese), first, facts)
    assert isinstance(second, Draft), second
    return first.coc, second.coc
