"""What an answer format is: how a teacher writes its reasons so that their values can be compared with the facts.

The window loop asks, reads and records; what differs between slots and prose is in `WayOfWriting`, and WAYS names them.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

from caption.verification.facts import Facts
from caption.verification.values import ValueCheck
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import TOKENS, Coc, Language, Template, Writing
from cosfly.llm.answer_text import Parsed

WAYS: dict[Writing, str] = {
    "slots": "caption.answer_formats.slots:Slots",
    "prose": "caption.answer_formats.prose:Prose",
}
INVALID_SLOT, DECISION_MISMATCH = "invalid_slot", "decision_mismatch"  # reasons
# Asked for between the texts and the decision. It is free even where the decision is given.
THEREFORE = {"therefore": {"type": "string", "enum": list(TOKENS)}}


@dataclass(frozen=True)
class Draft:
    """A caption in one language.

    Args:
        coc: its plain text. therefore: the decision to which the reasoning leads, of the English alone.
        template: what the text was filled from. outside: the sentences without their slots.
        num_filled: slots that were filled with a value.
    """

    coc: Coc
    therefore: str | None = None
    template: Template | None = None
    outside: tuple[str, ...] = ()
    num_filled: int = 0

    @property
    def written(self) -> dict[str, Any]:
        """The answer as the teacher wrote it: the template where there is one."""
        return self.coc.model_dump() | (self.template.model_dump() if self.template else {})


@dataclass(frozen=True)
class Refused:
    """An answer of the right structure that is not taken.

    Args:
        reason: a code that is counted. complaint: the fault and what is allowed, for the teacher. draft: what could be
            read of the answer.
    """

    reason: str
    complaint: str
    draft: Draft | None = None


class WayOfWriting(Protocol):
    """One answer format. name: among WAYS. system, mirror_system: prompt files (`system` is asked in English)."""

    name: Writing
    system: str
    mirror_system: str
    vocabulary: Vocabulary

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.vocabulary = vocabulary

    def table(self, facts: Facts) -> str:
        """Return what the question shows after the measured state; "" for nothing."""

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        """Make an English draft of an answer of the right structure."""

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        """Make the Chinese draft, and compare it with the English one."""

    def check(self, draft: Draft, facts: Facts, language: Language) -> ValueCheck:
        """Count the values of a draft: filled, matched and contradicted."""


@lru_cache
def way_of(name: Writing, vocabulary: Vocabulary) -> WayOfWriting:
    """Return an answer format by its name."""
    module, _, attribute = WAYS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)(vocabulary)


def refuse_decision(answer: Parsed) -> Refused | None:
    """Refuse an answer whose decision is not the one that its reasoning leads to."""
    assert answer.coc is not None
    decision, therefore = answer.coc.flight_decision, answer.therefore
    if decision == therefore:
        return None
    complaint = (
        f'"therefore" says {therefore} and "flight_decision" says {decision}: both name the one action that your '
        f"reasoning leads to. Let the reasoning lead to the decision."
    )
    return Refused(DECISION_MISMATCH, complaint)
