"""Prose: plain texts, read afterwards. For text that somebody else wrote, and as a comparison."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache

from caption.answer_formats.contract import Draft, Refused, WayOfWriting
from caption.schema import Judged
from caption.verification.borne_out import bears_out_number
from caption.verification.facts import Facts
from caption.verification.glossary import listed, mentions
from caption.verification.mirror import check_mirror, flight_numbers
from caption.verification.numerals import Numeral
from caption.verification.stated import Pole, Stated, read_stated, subject_before
from cosfly.formats.captions import Coc, Language, Writing
from cosfly.llm.answer_text import Parsed, sentences_of

LONGEST = 500  # characters of a sentence that is read; a model that repeats itself ends none
SHOWN = 120  # characters of a sentence in a problem
MEASURED = ("m", "mps", "deg", "dps", "px")
_RISES = {"increasing": 1, "decreasing": -1}
_ENDS = {"en": re.compile(r"\bfrom\b[^,;.]{0,24}$", re.I), "zh": re.compile(r"[从由自][^，；。]{0,12}$")}
_TO = {
    "en": re.compile(r"[^,;]{0,12}\b(?:to|down to|up to)\b[^,;\d]{0,16}", re.I),
    "zh": re.compile(r"[^，；\d]{0,10}[到至为][^，；\d]{0,6}"),
}
_ASKED_WITHIN: dict[Language, str] = {"en": r"[^.;]{0,40}?", "zh": r"[^。；]{0,16}?"}


@cache
def _asks(language: Language) -> re.Pattern[str]:
    return re.compile(f"{listed('asked', language)}{_ASKED_WITHIN[language]}{listed('sideways', language)}", re.I)


def judge_prose(coc: Coc, facts: Facts, language: Language) -> list[Judged]:
    """Return the state of every sentence of both texts, contradicted or unread, in order."""
    judged = []
    for name, text in sentences_of(coc):
        problems: tuple[str, ...] = ()
        if len(text) <= LONGEST:
            stated = read_stated(text, language)
            kinds = dict.fromkeys(_problems(stated, facts, language, coc.flight_decision if name[0] == "R" else ""))
            problems = tuple(f"{kind}: {text[:SHOWN]}" for kind in kinds)
        judged.append(Judged(name, text, "contradicted" if problems else "unread", problems))
    return judged


def _problems(stated: Stated, facts: Facts, language: Language, decision: str) -> Iterator[str]:
    if not mentions("elsewhere", language).search(stated.text):
        if any(_is_of_nothing(numeral, facts) for numeral in stated.numerals):
            yield "number"
        if any(_runs_against(pole, stated, language) for pole in stated.poles):
            yield "trend"
        if any(_compares_against(pole, stated, language) for pole in stated.poles):
            yield "comparison"
    if _plans_other_side(stated, language, decision):
        yield "decision"


def _is_of_nothing(numeral: Numeral, facts: Facts) -> bool:
    is_of_picture = numeral.unit == "px" and numeral.value in (facts.width_px, facts.height_px)
    is_measured = numeral.kind == "number" and numeral.unit in MEASURED and not is_of_picture
    return is_measured and not bears_out_number(numeral, facts)


def _runs_against(pole: Pole, stated: Stated, language: Language) -> bool:
    """Return whether "decreases from 20 m to 21 m" contradicts itself."""
    sign = _RISES.get(pole.value, 0) if pole.dimension == "trend" and not pole.is_negated else 0
    pairs = list(zip(stated.numerals, stated.numerals[1:], strict=False))
    if not sign or len(pairs) != 1:
        return False
    (first, last) = pairs[0]
    is_way = _ENDS[language].search(stated.text, 0, first.start) and _TO[language].fullmatch(
        stated.text, first.start + len(first.text), last.start
    )
    return bool(is_way) and last.unit in ("m", "mps") and sign * (last.value - first.value) < 0


def _compares_against(pole: Pole, stated: Stated, language: Language) -> bool:
    """Return whether "faster" stands beside two speeds, the drone's and the target's, of which the other is larger."""
    if pole.dimension != "pace" or pole.value not in ("faster", "slower") or pole.is_negated or not pole.is_compared:
        return False
    speeds = [numeral for numeral in stated.numerals if numeral.unit == "mps" and numeral.kind == "number"]
    if len(speeds) != 2 or len(stated.numerals) != 2 or stated.frames:
        return False
    owners = [subject_before(stated.text, numeral.start, language) for numeral in speeds]
    if sorted(owners) != ["drone", "target"] or not pole.about:
        return False
    own, other = speeds if owners[0] == pole.about else speeds[::-1]
    return (own.value - other.value) * (1 if pole.value == "faster" else -1) < 0


def _plans_other_side(stated: Stated, language: Language, decision: str) -> bool:
    """Return whether a sentence plainly asks for the other side than the decision, and never names the decision's
    own."""
    side = next((side for side in ("left", "right") if side in decision), None)
    sides = {pole.value for pole in stated.poles if pole.dimension == "side"}
    is_plain = not any(pole.is_negated for pole in stated.poles if pole.dimension == "side")
    return (
        side is not None
        and is_plain
        and len(sides) == 1
        and side not in sides
        and bool(_asks(language).search(stated.text))
    )


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
