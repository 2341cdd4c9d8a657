"""Free prose against its window: a state for every sentence, and what contradicts the measurements."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from caption.schema import EvidenceConfig
from caption.truth.facts import Facts
from caption.truth.prose.against_itself import compares_wrongly, goes_wrongly
from caption.truth.prose.deciding import argues_against
from caption.truth.prose.judging_numbers import NumberJudge
from caption.truth.prose.judging_strong import StrongJudge
from caption.truth.prose.judging_words import WordJudge
from caption.truth.prose.measured import Measured
from caption.truth.prose.numerals import masked
from caption.truth.prose.pool import Pool
from caption.truth.prose.reading import read_form
from caption.truth.prose.statements import Form, Statement
from caption.truth.prose.wording import cites, is_met
from caption.truth.sentences import Judged
from cosfly.products.captions import Coc, Language, SentenceState
from cosfly.products.sentences import sentences_of

_NUMBERS = ("number", "list", "range", "course", "pair", "percent", "ratio", "clock", "speeds", "extreme", "unit")
_PROBLEM = {
    "pair": "box",
    "list": "number",
    "range": "number",
    "course": "number",
    "steady": "trend",
    "mixed": "trend",
    "changing": "trend",
    "percent": "number",
    "speeds": "number",
    "extreme": "number",
    "unit": "number",
    "record": "comparison",
    "course_side": "side",
    "motion": "state",
    "extent": "trend",
    "framing": "centre",
    "lies": "side",
    "sight": "visibility",
    "faster": "comparison",
}
_STRONG = ("motion", "extent", "framing", "lies", "sight", "faster")
_SAID_OUTRIGHT = (*_NUMBERS, "lies", "sight", "faster")  # of which no word beside them makes another sense
_NEVER_MISREAD = (*_STRONG, "state", "course", "pair", "centre", "record", "course_side")
_SELDOM_MISREAD = ("comparison", "visibility", "clock", "list", "range", "extreme")
_SHOWN = 120  # characters of a sentence in a message
_LONGEST = 500  # characters of a sentence that is read; the longest of 6,000 in free prose has 325, and a model that repeats itself ends none


def check_evidence(coc: Coc, facts: Facts, cfg: EvidenceConfig, language: Language) -> list[str]:
    """Give the contradictions between a text and the measurements, each as "kind: clause"; empty where none was found."""
    return [problem for judged in judge_sentences(coc, facts, cfg, language) for problem in judged.problems]


@lru_cache(maxsize=2)  # both languages of a window
def _measured(facts: Facts) -> Measured:
    return Measured(facts)


def judge_sentences(coc: Coc, facts: Facts, cfg: EvidenceConfig, language: Language) -> list[Judged]:
    """Read every sentence of both texts and compare what it states with the window.

    The decision against its own text is a problem of the last sentence that argues for another one.
    """
    measured = _measured(facts)
    pool, words, strong = Pool(measured), WordJudge(measured), StrongJudge(measured)
    judged: list[Judged] = []
    forms: list[Form] = []
    subject, letter = "", ""
    for name, text in sentences_of(coc):
        if name[0] != letter:
            letter, subject = name[0], ""
        if len(text) > _LONGEST:
            subject = ""
            forms.append(Form("", (), (), True, ""))
            judged.append(Judged(name, text, "unread", ()))
            continue
        hidden, runs = masked(text, language)
        form = read_form(hidden, language, subject, letter == "R")
        if forms and forms[-1].asks_of_past:
            form = replace(form, statements=_after_answer(form.statements), left_out=True)
        subject = form.subject
        forms.append(form)
        numbers = NumberJudge(measured, pool, cfg, form, runs)
        judged.append(_judge(name, text, language, form, numbers, words, strong))
    return _against_decision(judged, forms, coc.flight_decision, language)


def _after_answer(statements: tuple[Statement, ...]) -> tuple[Statement, ...]:
    """Leave out what answers a question: it is told of the moment that was asked for."""
    first = min((s.clause for s in statements), default=None)
    return tuple([s for s in statements if s.clause != first])


def _judge(
    name: str, text: str, language: Language, form: Form, numbers: NumberJudge, words: WordJudge, strong: StrongJudge
) -> Judged:
    problems: list[str] = []
    is_proved, is_open = False, form.left_out
    for statement in form.statements:
        judge = numbers if statement.kind in _NUMBERS else strong if statement.kind in _STRONG else words
        holds = judge.holds(statement)
        if compares_wrongly(statement, form, numbers) or goes_wrongly(statement, form, numbers):
            holds = False
        elif holds is False and statement.kind not in _SAID_OUTRIGHT and not statement.is_sure:
            holds = False if statement.is_asserted and words.is_never(statement) else None
        if holds is False and not (
            (statement.is_sure and words.is_ever_against(statement))
            or _is_worded_as_met(statement, form, numbers, language)
        ):
            holds = None
        if holds is None:
            is_open = True
        elif holds:
            is_proved = True
        else:
            kind = "trend" if numbers.runs_against_itself(statement) else _PROBLEM.get(statement.kind, statement.kind)
            problems.append(f"{kind}: {text[:_SHOWN]}")
    state: SentenceState = "contradicted" if problems else "proved" if is_proved and not is_open else "unread"
    return Judged(name, text, state, tuple(dict.fromkeys(problems)))


def _is_worded_as_met(s: Statement, form: Form, numbers: NumberJudge, language: Language) -> bool:
    """Tell whether a clause is worded so that what it says wrongly is a contradiction.

    Nothing is asked of what is seldom misread: what the window gives for nothing, speeds and lengths that are surely named, trends of what
    their clause names, set words, a wrong unit or side.
    """
    is_nothing = s.kind in _NUMBERS and s.kind != "clock" and not numbers.is_of_the_window(s)
    is_speed = (
        s.kind == "number"
        and s.sure_mode == "value"
        and bool(s.sure_names)
        and s.is_named
        and form.numerals[s.numbers[0]].unit == "mps"
    )
    is_plain_trend = s.kind == "trend" and s.is_sure and s.is_named
    is_length = s.is_single and form.numerals[s.numbers[0]].unit == "m"
    if is_nothing or s.is_per_step or is_speed or is_plain_trend or is_length or s.kind in _NEVER_MISREAD:
        return not cites(form.text)
    if s.kind in _NUMBERS and (numbers.is_on_wrong_side(s) or numbers.is_in_wrong_unit(s)):
        return not cites(form.text)
    return is_met(
        form.text, language, s.clause, loosely=s.kind in _SELDOM_MISREAD, alone=s.kind in ("number", "visibility")
    )


def _against_decision(judged: list[Judged], forms: list[Form], decision: str, language: Language) -> list[Judged]:
    """Compare the decision with what the texts argue for: their plans, or where they name none the last sentence."""
    said = [one for form in forms for one in form.actions]
    opposites = argues_against(decision, said, list(forms[-1].actions) if forms else [])
    if not any(not cites(form.text) for form in forms for one in form.actions if one in opposites):
        return judged
    last = judged[-1]
    problems = (*last.problems, f"decision: {decision} against {last.text[:_SHOWN]}")
    return [*judged[:-1], Judged(last.name, last.text, "contradicted", problems)]
