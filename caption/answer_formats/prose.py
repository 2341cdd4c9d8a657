"""Prose: the paper's three plain fields. For teachers that write better freely, and for texts by somebody else."""

from __future__ import annotations

from caption.answer_formats.contract import Draft, Refused, WayOfWriting
from caption.verification.facts import Facts
from caption.verification.mirror import check_mirror, track_numbers
from caption.verification.values import ValueCheck, check_values
from cosfly.formats.captions import Coc, Language, Writing
from cosfly.llm.answer_text import Parsed, sentences_of


class Prose(WayOfWriting):
    """The teacher writes plain text; its numbers with a unit are compared with the facts."""

    name: Writing = "prose"
    system = "system_prose_en"
    mirror_system = "mirror_system"

    def table(self, facts: Facts) -> str:
        return ""

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        return Draft(answer.coc, answer.therefore, outside=_sentences(answer.coc))

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        draft = Draft(answer.coc, outside=_sentences(answer.coc))
        problem = check_mirror(english.coc, answer.coc, track_numbers(facts))
        if problem is None:
            return draft
        return Refused(problem, f"The Chinese text does not say the same as the English one: {problem}.", draft)

    def check(self, draft: Draft, facts: Facts, language: Language) -> ValueCheck:
        return check_values(draft.outside, facts, language)


def _sentences(coc: Coc) -> tuple[str, ...]:
    return tuple(text for _, text in sentences_of(coc))
