"""The bounded ask-verify loop of one window.

Every window ends in one outcome: accepted, dropped for a reason, or failed because the teacher did not answer. A
decision that the flight contradicts is asked for again, by default anchored to the true one; the record says so for
ever.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from caption.answer_formats.contract import Draft, Refused, refuse_decision
from caption.schema import CaptionConfig, Strategy, Window
from caption.stage.reasons import REASONS
from caption.teachers.foreign import Terms
from caption.teachers.judge import Case, Judge
from caption.teachers.prompts import Correction, Question, make_question, prompt_hash
from caption.teachers.teacher import Teacher, terms_of
from caption.verification.actions import TABLE, Motion, measure
from caption.verification.facts import Facts
from caption.verification.mirror import check_translation
from caption.verification.values import ValueCheck, measured_lines
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import (
    ACTIONS,
    Caption,
    Checks,
    Coc,
    JudgeRecord,
    Language,
    RepairRecord,
    Usage,
    Verdict,
)
from cosfly.llm.answer_text import Parsed, parse_answer
from cosfly.llm.contract import NoAnswer, Reply
from cosfly.runtime.errors import InputError, RenderError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL

MAX_COMPLAINTS = 8  # named at once
CONTRADICTED = "contradicted_value"


class Prepared(NamedTuple):
    """A window, what is asked about it, and what its answer is held against."""

    window: Window
    terms: Terms
    question: Question
    prompt_hash: str
    motion: Motion
    label: str | None
    contradicted: list[str]


def prepare(windows: Sequence[Window], teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary) -> list[Prepared]:
    """Measure windows and write their questions: each step for all of them, while the processor's caches hold its
    code."""
    terms = [terms_of(teacher, window.observed.sample_id, cfg) for window in windows]
    questions = [
        make_question(w.observed, cfg.image, t.writing, vocabulary) for w, t in zip(windows, terms, strict=True)
    ]
    hashes = [prompt_hash(question) for question in questions]
    motions = [measure(window.future) for window in windows]
    labels = [TABLE.label_of(motion) for motion in motions]
    contradicted = [TABLE.contradicted_by(m, label) for m, label in zip(motions, labels, strict=True)]
    return list(map(Prepared, windows, terms, questions, hashes, motions, labels, contradicted))


async def caption_window(
    window: Window,
    teacher: Teacher,
    cfg: CaptionConfig,
    vocabulary: Vocabulary,
    judge: Judge | None = None,
) -> Caption:
    """Caption one window.

    Args:
        judge: asked about conflicts; None: none is.
    Raises:
        NoAnswer: the teacher gave none, and asking again later may help.
        TeacherError: no window will get one.
    """
    [prepared] = prepare([window], teacher, cfg, vocabulary)
    return await caption_prepared(prepared, teacher, cfg, judge)


async def caption_prepared(
    prepared: Prepared, teacher: Teacher, cfg: CaptionConfig, judge: Judge | None = None
) -> Caption:
    """Caption a window that is prepared; as `caption_window`."""
    window, question = prepared.window, prepared.question
    loop = _Loop(teacher, cfg, prepared, judge)
    loop.checks["keyframe"] = window.keyframe
    loop.checks["contradicted"] = prepared.contradicted
    reason = window.problem
    if reason is None:
        try:
            reason = await loop.run(question)
        except NoAnswer as error:
            if not error.is_final:
                raise
            reason = error.cause
            if reason not in REASONS:
                reason, loop.checks["refusal"] = "refused", str(error)
        except (InputError, RenderError) as error:  # a picture that cannot be read or encoded
            reason = "unusable_frame"
            loop.checks["frame"] = error.what
    return _record(prepared, teacher, loop, reason)


def _record(prepared: Prepared, teacher: Teacher, loop: _Loop, reason: str | None) -> Caption:
    """Return what is kept of a window. reason: to drop it."""
    window, question = prepared.window, prepared.question
    observed, pictures, answered = window.observed, question.pictures, teacher.record
    if answered.structured != loop.structured:
        answered = answered.model_copy(update={"structured": loop.structured})
    return Caption(
        sample_id=observed.sample_id,
        town=observed.town,
        trajectory=observed.trajectory,
        variant=observed.variant,
        frame_index=observed.indices[-1],
        window=list(observed.indices),
        future=list(window.future.indices),
        prompt={"en": question.prompts["en"], "zh": question.prompts["zh"]},
        prompt_hash=prepared.prompt_hash,
        picture_px=pictures.size_px,
        depth_range_m=pictures.depth_range_m if "depth" in pictures.views else None,
        teacher=answered,
        usage=loop.usage,
        attempts=loop.asks,
        **loop.drafts(),
        label_from=window.future.label_from,
        label=loop.label,
        verdict=loop.verdict,
        judge=loop.judgement,
        repair=loop.repair,
        checks=Checks(**loop.checks),
        status="accepted" if reason is None else "dropped",
        drop_reason=reason,
    )


@dataclass(frozen=True)
class Trial:
    """One conflict and what a strategy made of it; `last` is None where it did not repair it. Mirror not included."""

    first: Coc
    last: Coc | None
    verdict: Verdict | None
    asks: int
    tokens: int


async def try_strategy(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, strategy: Strategy
) -> Trial | None:
    """Repair a window's first answer by a strategy; None where that answer is none or is not rejected.

    Raises:
        NoAnswer: the teacher gave none, and asking again later may help.
    """
    repair = cfg.repair.model_copy(update={"strategy": strategy})
    [prepared] = prepare([window], teacher, cfg, vocabulary)
    question = prepared.question
    loop = _Loop(teacher, cfg.model_copy(update={"repair": repair}), prepared)
    if await loop.ask_freely(question) is not None or repair.treatment_of(loop.verdict) == "keep" or loop.label is None:
        return None
    assert loop.english is not None
    first, asked, tokens = loop.english.coc, loop.asks, loop.usage.total
    try:
        reason = await loop.regenerate(question)
    except NoAnswer as error:  # a teacher without a reason for the label has not repaired the conflict
        if not error.is_final:
            raise
        reason = error.cause
    last = loop.english.coc if reason is None else None
    return Trial(first, last, loop.verdict, loop.asks - asked, loop.usage.total - tokens)


def _rungs(strategy: Strategy, max_asks: int) -> list[str]:
    """Return the kind of each ask: a cascade climbs from the freest to the surest."""
    if strategy == "cascade":
        return ["hint", "multi_sample", *["anchored"] * max(0, max_asks - 2)][:max_asks]
    return [strategy] * max_asks


class _Loop:
    """The asks of one window and what came of them."""

    def __init__(self, teacher: Teacher, cfg: CaptionConfig, prepared: Prepared, judge: Judge | None = None) -> None:
        terms = prepared.terms
        once = {"structure_asks": 1, "correction_asks": 0, "mirror_asks": 1}
        self.cfg = cfg.model_copy(update=once) if terms.is_given else cfg
        self.teacher, self.terms, self.judge = teacher, terms, judge
        self.motion, self.label = prepared.motion, prepared.label
        self.way = prepared.question.way
        self.english: Draft | None = None
        self.chinese: Draft | None = None
        self.answered: Question | None = None  # the one that `english` answers
        self.verdict: Verdict | None = None
        self.judgement: JudgeRecord | None = None
        self.repair: RepairRecord | None = None
        self.checks: dict[str, Any] = {}
        self.usage = Usage()
        self.asks = 0
        self.structured: str | None = None
        self._recovered: set[str] = set()
        self._refused: list[str] = []

    async def run(self, question: Question) -> str | None:
        """Ask, verify, repair, mirror; gives the reason to drop the window, None to accept it."""
        reason = await self._attempt(question)
        if reason == CONTRADICTED and self.cfg.correction_asks:  # once more, with what was measured
            assert self.english is not None
            assert self.answered is not None  # anchored, perhaps
            self._refused.append(reason)
            complaint = self._complaint(question.facts)
            correction = Correction(dump_json(self.english.written), complaint, self.cfg.correction_asks + 1)
            self.english = self.chinese = None
            reason = await self._attempt(replace(self.answered, correction=correction))
        if self._recovered:
            self.checks["recovered"] = sorted(self._recovered)
        if self._refused:
            self.checks["refused"] = self._refused
        return reason

    async def _attempt(self, question: Question) -> str | None:
        reason = await self.ask_freely(question)
        if reason is None:
            reason = await self._treat(question)
        if reason is None and self.terms.has_mirror:
            reason = await self._mirror()
        elif reason is None:
            self.checks["bilingual"] = "no_chinese"
        if reason is None or (self.terms.is_given and self.english is not None):
            contradicted = self._check_values(question)  # given captions are checked even where they are dropped
            reason = reason or contradicted
        return reason

    def _complaint(self, facts: Facts) -> str:
        """Return the contradicted values of a text with the measured ones."""
        problems = self.checks["contradictions"][:MAX_COMPLAINTS]
        return f"It contradicts the measured facts: {'; '.join(problems)}. Measured: {measured_lines(facts, problems)}."

    def drafts(self) -> dict[str, Any]:
        """Return what was written, as fields of the record."""
        english, chinese = self.english, self.chinese
        if english is None:
            return {"writing": self.terms.writing}
        drafts: dict[Language, Draft] = {"en": english} if chinese is None else {"en": english, "zh": chinese}
        return {
            "writing": self.terms.writing,
            "therefore": english.therefore,
            **{language: draft.coc for language, draft in drafts.items()},
            "slots": {language: draft.template for language, draft in drafts.items() if draft.template} or None,
        }

    async def ask_freely(self, question: Question) -> str | None:
        answer = Refused("", "")
        for ask in range(self.cfg.structure_asks):
            asked = replace(question, ask=ask) if ask else question
            found = await self._answer(asked)
            if isinstance(found, Draft):
                self._accept(found, asked)
                self.checks["structure"] = "ok"
                return None
            answer = found
            if answer.complaint or answer.reason == CONTEXT_FULL:
                break  # of the right structure, and corrected in vain; or there is no room for one
        self.checks["structure"] = "ok" if answer.complaint else answer.reason
        if answer.complaint or answer.reason == CONTEXT_FULL:
            return answer.reason
        return "structure"

    async def _answer(self, question: Question) -> Draft | Refused:
        """Ask, and ask for a correction while the content of the answer is refused. A wrong structure has no
        complaint."""
        earlier = question.correction.number if question.correction else 0
        for number in range(self.cfg.correction_asks + 1):
            reply = await self.teacher.ask(question)
            answer = self._draft(reply, question)
            if isinstance(answer, Draft) or not answer.complaint:
                break
            self._refused.append(answer.reason)
            question = replace(question, correction=Correction(reply.text, answer.complaint, earlier + number + 1))
        return answer

    def _draft(self, reply: Reply, question: Question) -> Draft | Refused:
        parsed = self._read(reply, "en")
        if parsed.coc is None:
            return Refused(parsed.reason or "", "")
        if "therefore" in self.terms.fields and (refused := refuse_decision(parsed)):
            return refused
        return self.way.read(parsed, question.facts)

    async def _treat(self, question: Question) -> str | None:
        """Keep, repair or drop the answer for its verdict; gives the reason to drop the window."""
        treatment = self.cfg.repair.treatment_of(self.verdict)
        if self.judge is not None and self.verdict in ("HARD_CONFLICT", "SOFT_CONFLICT"):
            treatment = "repair" if await self._is_rejected(question) else "keep"
        if treatment == "drop" or (treatment == "repair" and self.terms.is_given):
            return "conflict"
        return await self.regenerate(question) if treatment == "repair" else None

    async def _is_rejected(self, question: Question) -> bool:
        """Ask the judge whether an answer in conflict must be asked for again.

        A hard conflict stays one whatever the judge says. A soft one is kept only where the judge accepts it: what it
        rejects or what cannot be read as a judgement is asked for again. A label that the judge would put in the
        decision's place is put there only where the text does not state another decision.
        """
        assert self.english is not None
        assert self.judge is not None
        english = self.english.coc
        flight = question.prompts["en"].told(replace(question.pictures, views=()).sentence("en"))  # it sees none
        case = Case(question.window.sample_id, flight.user, english, self.label)
        self.judgement = await self.judge.judge(case)
        verdict = self.judgement.verdict
        if verdict == "ACCEPT_ALTERNATIVE" and self.verdict == "HARD_CONFLICT":
            self.judgement.overruled_by = "geometry"
        if verdict == "FIX_LABEL" and self.label is not None:
            fixed = replace(self.english, coc=english.model_copy(update={"flight_decision": self.label}))
            if ACTIONS[english.flight_decision].en not in english.reasoning_trace.lower():
                self.repair = self._repair("fix_label")
                self.repair.outcome, self.repair.rung = "repaired", "fix_label"
                self._accept(fixed, question)
                return False
            self.judgement.overruled_by = "text"
        return verdict != "ACCEPT_ALTERNATIVE" or self.verdict == "HARD_CONFLICT"

    def _repair(self, strategy: str) -> RepairRecord:
        assert self.english is not None
        decision = self.english.coc.flight_decision
        return RepairRecord(strategy=strategy, first_decision=decision, first_verdict=self.verdict)

    async def regenerate(self, question: Question) -> str | None:
        """Ask again by the chosen strategy until an answer is no longer rejected (sec:appendix_e, four strategies)."""
        assert self.english is not None
        rejected = self.english.coc.flight_decision
        self.repair = self._repair(self.cfg.repair.strategy)
        rungs = _rungs(self.cfg.repair.strategy, self.cfg.repair.max_asks)
        if self.label is None and "anchored" in rungs:
            return "no_label"
        self.repair.outcome = "failed"  # until an answer is taken
        for ask, rung in enumerate(rungs):
            self.repair.asks = ask + 1
            asked = self._reworked(question, rung, rejected, ask)
            answer = await self._answer(asked)
            if isinstance(answer, Refused) and answer.reason == CONTEXT_FULL:
                return CONTEXT_FULL  # not a failure of the teacher
            if isinstance(answer, Refused) or (asked.decision and answer.coc.flight_decision != asked.decision):
                continue
            decision = answer.coc.flight_decision
            verdict = TABLE.verdict_of(decision, self.motion, self.label)
            is_enough = (
                verdict == "CONSISTENT" or self.cfg.repair.strategy != "cascade"
            )  # which has surer rungs to come
            if self.cfg.repair.treatment_of(verdict) == "keep" and decision != rejected and is_enough:
                self._accept(answer, asked)
                self.repair.outcome, self.repair.rung = "repaired", rung
                return None
        return "regeneration_failed"

    def _reworked(self, question: Question, rung: str, rejected: str, ask: int) -> Question:
        if rung == "anchored":
            return replace(question, decision=self.label, ask=ask)
        if rung == "hint":
            return replace(question, rejected=rejected, ask=ask)
        return replace(question, ask=self.cfg.structure_asks + ask)  # the same question under another sampling seed

    async def _mirror(self) -> str | None:
        assert self.english is not None
        assert self.answered is not None
        problem: str | None = None
        complaint: str | None = None
        for ask in range(self.cfg.mirror_asks):
            reply = await self.teacher.mirror(self.answered, self.english, ask, complaint)
            parsed = self._read(reply, "zh")
            if parsed.coc is None:
                problem, complaint = f"structure_{parsed.reason}", None
                if parsed.reason == CONTEXT_FULL:
                    break
                continue
            answer = self.way.read_mirror(parsed, self.english, self.answered.facts)
            if isinstance(answer, Draft):
                answer = self._translated(self.english, answer)
            if isinstance(answer, Draft):
                self.chinese, problem = answer, None
                break
            self.chinese, problem, complaint = answer.draft, answer.reason, answer.complaint
        self.checks["bilingual"] = problem or "ok"
        return None if problem is None else "bilingual"

    def _translated(self, english: Draft, chinese: Draft) -> Draft | Refused:
        """Hold what was asked for as a translation against its source; templates have been, and what was given is
        nobody's translation."""
        if self.terms.is_given or not self.terms.is_translated or chinese.template is not None:
            return chinese
        found = check_translation(english.coc, chinese.coc)
        return Refused(*found, chinese) if found else chinese

    def _check_values(self, question: Question) -> str | None:
        """Record the values of both languages; return the reason to drop the window."""
        assert self.english is not None
        drafts: dict[Language, Draft] = {"en": self.english}
        if self.chinese is not None:
            drafts["zh"] = self.chinese
        checks: dict[Language, ValueCheck] = {
            language: self.way.check(draft, question.facts, language) for language, draft in drafts.items()
        }
        self.checks["values"] = {language: check.counts for language, check in checks.items()}
        contradictions = [f"{language} {text}" for language, check in checks.items() for text in check.contradictions]
        self.checks["contradictions"] = contradictions or None
        return CONTRADICTED if contradictions and self.cfg.contradicted_values == "drop" else None

    def _read(self, reply: Reply, language: Language) -> Parsed:
        self.asks += 1
        if reply.usage is not None:
            self.usage += reply.usage
        self.structured = reply.structured
        more = self.terms.fields if language == "en" else ()
        parsed = parse_answer(reply.text, language, more, reply.finish_reason)
        if parsed.reason == CONTEXT_FULL:
            usage = reply.usage or Usage()
            asked, answered = usage.prompt_tokens, usage.completion_tokens
            self.checks["refusal"] = f"{CONTEXT_FULL}: {asked} tokens asked and {answered} answered fill the context"
        self._recovered.update(parsed.recovered)
        return parsed

    def _accept(self, draft: Draft, question: Question) -> None:
        self.english, self.answered = draft, question
        self.verdict = TABLE.verdict_of(draft.coc.flight_decision, self.motion, self.label)
