"""Prose: plain texts, read afterwards. For text that somebody else wrote, and as a comparison."""

from __future__ import annotations

from collections.abc import Mapping

from caption.schema import Judged
from caption.truth.facts import Facts
from caption.truth.mirror import check_mirror, flight_numbers
from caption.truth.prose import judge_prose
from caption.writing.contract import Draft, Refused, WayOfWriting
from cosfly.products.answer_text import Parsed
from cosfly.products.captions import Language, Writing


class Prose(WayOfWriting):
    """The teacher writes as it likes; its sentences are unread, but for what is plainly false."""

    name: Writing = "prose"
    system = "system_prose_en"
    mirror_system = "mirror_system"
    fields: Mapping[str, dict] = {}
    optional: Mapping[str, dict] = {}

    def table(self, facts: Facts) -> str:
        return ""

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        return Draft(answer.coc, answer.therefore)

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        draft = Draft(answer.coc)
        problem = check_mirror(english.coc, answer.coc, flight_numbers(facts))
        if problem is None:
            return draft
        return Refused(problem, f"The Chinese text is not that of the English one: {problem}.", draft)

    def judge(self, draft: Draft, facts: Facts, language: Language) -> list[Judged]:
        return judge_prose(draft.coc, facts, language)
