"""The answer formats: how a teacher writes its reasons so that their values can be compared with the facts.

Slots: it names facts, and their values are filled in (slots.py). Prose: the paper's three plain fields, for teachers
that write better freely, and for texts by somebody else; the numbers with a unit are compared with the facts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from caption.answer_formats.contract import Draft, Refused
from caption.answer_formats.slots import fact_table, fill_answer, fill_mirror
from caption.verification.facts import Facts
from caption.verification.mirror import check_mirror, check_translation
from cosfly.formats.captions import Coc, Writing
from cosfly.llm.answer_text import sentences_of


@dataclass(frozen=True)
class AnswerFormat:
    """One answer format.

    Args:
        system, mirror_system: names of the prompts that ask for it, in English.
        table: what the question shows after the measured state; "" for nothing.
        read: makes the English draft of an answer of the right structure.
        read_mirror: makes the Chinese draft, and compares it with the English one, from which it is translated or not.
    """

    system: str
    mirror_system: str
    table: Callable[[Facts], str]
    read: Callable[[Coc, Facts], Draft | Refused]
    read_mirror: Callable[[Coc, Draft, Facts, bool], Draft | Refused]


def _read_prose(written: Coc, facts: Facts) -> Draft:
    return Draft(written, tuple([text for _, text in sentences_of(written)]))


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
