"""What a way of writing is: how a teacher states its reasons so that they can be held against the facts.

The window loop asks, reads and records; what differs between slots and prose is in `WayOfWriting`, and WAYS names them.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

from caption.schema import Judged
from caption.verification.facts import Facts
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import TOKENS, Coc, Language, Template, Writing
from cosfly.llm.answer_text import Parsed

WAYS: dict[Writing, str] = {
    "slots": "caption.answer_formats.slots:Slots",
    "prose": "caption.answer_formats.prose:Prose",
}
DECISION_REASON = "decision_against_reasoning"


@dataclass(frozen=True)
class Draft:
    """A caption in one language: its plain text, and what that came from. therefore: of the English alone.

    judged: its sentences, where making the text has told their states. doubt: what its writer is asked to mend once,
    though it is taken as it stands.
    """

    coc: Coc
    therefore: str | None = None
    template: Template | None = None
    judged: tuple[Judged, ...] = ()
    doubt: str = ""

    @property
    def written(self) -> dict[str, Any]:
        """What was written, as the teacher's answer had it: the template where there is one."""
        return self.coc.model_dump() | (self.template.model_dump() if self.template else {})


@dataclass(frozen=True)
class Refused:
    """An answer of the right structure that is not taken.

    reason: a word that is counted. complaint: what is wrong and what is allowed, for who wrote it. draft: what could be
    read of it.
    """

    reason: str
    complaint: str
    draft: Draft | None = None


class WayOfWriting(Protocol):
    """One way of writing, in a vocabulary; nothing else stays in it.

    name: among WAYS. system, mirror_system: prompt files (`system` is asked in English). fields: further fields of an
    answer, name -> JSON schema, in the order in which they stand between the texts and `therefore`. optional: more of
    them, which an answer in either language may leave out.
    """

    name: Writing
    system: str
    mirror_system: str
    fields: Mapping[str, dict]
    optional: Mapping[str, dict]
    vocabulary: Vocabulary

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.vocabulary = vocabulary

    def table(self, facts: Facts) -> str:
        """Return what the question shows beside the flight data; "" for nothing."""

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        """Make an English draft of an answer of the right structure."""

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        """Make the Chinese draft, and hold it against the English one."""

    def judge(self, draft: Draft, facts: Facts, language: Language) -> list[Judged]:
        """Return the state of every sentence of both texts, in order."""


@lru_cache
def way_of(name: Writing, vocabulary: Vocabulary) -> WayOfWriting:
    module, _, attribute = WAYS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)(vocabulary)


def more_fields(way: WayOfWriting) -> dict[str, dict]:
    """Return the fields of an answer beyond the paper's three. `therefore` is free even where the decision is given."""
    return {**way.fields, **way.optional, "therefore": {"type": "string", "enum": list(TOKENS)}}


def refuse_decision(answer: Parsed) -> Refused | None:
    """Refuse an answer whose decision is not the one that its reasoning came to."""
    assert answer.coc is not None
    decision, therefore = answer.coc.flight_decision, answer.therefore
    if decision == therefore:
        return None
    complaint = (
        f'"therefore" says {therefore} and "flight_decision" says {decision}: both name the one action that your '
        f"reasoning leads to. Let the reasoning lead to the decision."
    )
    return Refused(DECISION_REASON, complaint)
