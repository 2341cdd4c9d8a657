"""The bounded ask-verify loop of one window.

Every window has one outcome: accepted, dropped for a reason, or failed because the teacher did not answer. A decision
that the trajectory contradicts is asked for again, by default anchored to the label; the record says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from caption.answer_formats.contract import Draft, Refused, refuse_decision
from caption.schema import CaptionConfig, Strategy, Window
from caption.stage.ledger import REASONS
from caption.teachers.foreign import Terms
from caption.teachers.judge import Conflict, Judge
from caption.teachers.prompts import Correction, Question, make_question, prompt_hash
from caption.teachers.teacher import Teacher
from caption.verification.actions import TABLE, Motion, measure
from caption.verification.mirror import check_translation
from caption.verification.values import measured_lines
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


class PreparedWindow(NamedTuple):
    """A window, its question, and the measurements that verify the answer."""

    window: Window
    terms: Terms
    question: Question
    prompt_hash: str
    motion: Motion
    label: str | None
    contradicted: list[str]


def prepare(
    windows: Sequence[Window], teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary
) -> list[PreparedWindow]:
    """Measure windows and write their questions: step by step for all, so that the code stays in the CPU's caches."""
    terms = [teacher.terms(window.observed.sample_id) for window in windows]
    questions = [
        make_question(w.observed, cfg.image, t.writing, vocabulary) for w, t in zip(windows, terms, strict=True)
    ]
    hashes = [prompt_hash(question) for question in questions]
    motions = [measure(window.future) for window in windows]
    labels = [TABLE.label_of(motion) for motion in motions]
    contradicted = [TABLE.contradicted_by(m, label) for m, label in zip(motions, labels, strict=True)]
    return list(map(PreparedWindow, windows, terms, questions, hashes, motions, labels, contradicted))


async def caption_window(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, judge: Judge | None = None
) -> Caption:
    """Make the caption of one window.

    Raises:
        NoAnswer: The teacher gave none, but may later. TeacherError: No window will get an answer.
    """
    [prepared] = prepare([window], teacher, cfg, vocabulary)
    return await caption_prepared(prepared, teacher, cfg, judge)


async def caption_prepared(
    prepared: PreparedWindow, teacher: Teacher, cfg: CaptionConfig, judge: Judge | None = None
) -> Caption:
    """Make the caption of a prepared window; raises like `caption_window`."""
    loop = _WindowLoop(teacher, cfg, prepared, judge)
    reason = prepared.window.problem
    if reason is None:
        try:
            reason = await loop.run(prepared.question)
        except NoAnswer as error:
            if not error.is_final:
                raise
            reason = error.cause
            if reason not in REASONS:
                reason = "refused"
                loop.checks["refusal"] = str(error)
        except (InputError, RenderError) as error:  # a picture that cannot be read or encoded
            reason = "unusable_frame"
            loop.checks["frame"] = error.what
    return loop.record(reason)


@dataclass(frozen=True)
class Trial:
    """One conflict and its regeneration by a strategy, without the mirror. last: None if it failed."""

    first: Coc
    last: Coc | None
    verdict: Verdict | None
    asks: int
    tokens: int


async def try_strategy(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, strategy: Strategy
) -> Trial | None:
    """Repair the first answer of a window by a strategy; None if it is not rejected. NoAnswer: There is none."""
    repair = cfg.repair.model_copy(update={"strategy": strategy})
    [prepared] = prepare([window], teacher, cfg, vocabulary)
    loop = _WindowLoop(teacher, cfg.model_copy(update={"repair": repair}), prepared)
    reason = await loop.ask_freely(prepared.question)
    if reason is not None or repair.treatment_of(loop.verdict) == "keep" or loop.label is None:
        return None
    assert loop.english is not None
    first, num_asks, tokens = loop.english.coc, loop.asks, loop.usage.total
    try:
        reason = await loop.regenerate(prepared.question)
    except NoAnswer as error:  # a teacher without a reason for the label has not repaired the conflict
        if not error.is_final:
            raise
        reason = error.cause
    last = loop.english.coc if reason is None else None
    return Trial(first, last, loop.verdict, loop.asks - num_asks, loop.usage.total - tokens)


class _WindowLoop:
    """The asks of one window and their results."""

    def __init__(
        self, teacher: Teacher, cfg: CaptionConfig, prepared: PreparedWindow, judge: Judge | None = None
    ) -> None:
        once = {"structure_asks": 1, "correction_asks": 0, "mirror_asks": 1}
        self.terms = prepared.terms
        self.cfg = cfg.model_copy(update=once) if self.terms.is_given else cfg
        self.teacher, self.prepared, self.judge = teacher, prepared, judge
        self.label, self.way = prepared.label, prepared.question.way
        self.english: Draft | None = None
        self.chinese: Draft | None = None
        self.answered: Question | None = None  # the question that `english` answers
        self.verdict: Verdict | None = None
        self.judgement: JudgeRecord | None = None
        self.repair: RepairRecord | None = None
        self.checks: dict[str, Any] = {"keyframe": prepared.window.keyframe, "contradicted": prepared.contradicted}
        self.usage = Usage()
        self.asks = 0
        self.structured: str | None = None
        self._recovered: set[str] = set()
        self._refused: list[str] = []

    def record(self, reason: str | None) -> Caption:
        """Return the record of the window. reason: To drop it."""
        window, question = self.prepared.window, self.prepared.question
        observed, pictures, teacher = window.observed, question.pictures, self.teacher.record
        if teacher.structured != self.structured:
            teacher = teacher.model_copy(update={"structured": self.structured})
        drafts = self._drafts()
        return Caption(
            sample_id=observed.sample_id,
            town=observed.town,
            trajectory=observed.trajectory,
            variant=observed.variant,
            frame_index=observed.indices[-1],
            window=list(observed.indices),
            future=list(window.future.indices),
            prompt={"en": question.prompts["en"], "zh": question.prompts["zh"]},
            prompt_hash=self.prepared.prompt_hash,
            picture_px=pictures.size_px,
            depth_range_m=pictures.depth_range_m if "depth" in pictures.views else None,
            teacher=teacher,
            usage=self.usage,
            attempts=self.asks,
            writing=self.terms.writing,
            therefore=self.english.therefore if self.english else None,
            en=self.english.coc if self.english else None,
            zh=self.chinese.coc if self.chinese else None,
            slots={language: draft.template for language, draft in drafts.items() if draft.template} or None,
            label_from=window.future.label_from,
            label=self.label,
            verdict=self.verdict,
            judge=self.judgement,
            repair=self.repair,
            checks=Checks(**self.checks),
            status="accepted" if reason is None else "dropped",
            drop_reason=reason,
        )

    def _drafts(self) -> dict[Language, Draft]:
        drafts: dict[Language, Draft | None] = {"en": self.english, "zh": self.chinese}
        return {language: draft for language, draft in drafts.items() if draft is not None}

    async def run(self, question: Question) -> str | None:
        """Ask, verify, regenerate and translate; return the reason to drop the window, None to accept it."""
        reason = await self._attempt(question)
        if reason == CONTRADICTED and self.cfg.correction_asks:  # once more, with the measured values
            assert self.english is not None
            assert self.answered is not None  # anchored, perhaps
            self._refused.append(reason)
            problems = self.checks["contradictions"][:MAX_COMPLAINTS]
            measured = measured_lines(question.facts, problems)
            complaint = f"It contradicts the measured facts: {'; '.join(problems)}. Measured: {measured}."
            correction = Correction(dump_json(self.english.written), complaint, self.cfg.correction_asks + 1)
            self.english = self.chinese = self.verdict = None
            for name in ("values", "contradictions"):  # they are of the refused answer
                self.checks.pop(name, None)
            reason = await self._attempt(replace(self.answered, correction=correction))
        if self._recovered:
            self.checks["recovered"] = sorted(self._recovered)
        if self._refused:
            self.checks["refused"] = self._refused
        return reason

    async def _attempt(self, question: Question) -> str | None:
        reason = await self.ask_freely(question) or await self._treat_verdict(question)
        if reason is None and self.terms.has_mirror:
            reason = await self._mirror()
        elif reason is None:
            self.checks["bilingual"] = "no_chinese"
        if reason is None or (self.terms.is_given and self.english is not None):
            contradicted = self._check_values(question)  # given captions are checked even if they are dropped
            reason = reason or contradicted
        return reason

    # --- the English answer ---

    async def ask_freely(self, question: Question) -> str | None:
        """Ask until an answer is accepted; return the reason to drop the window if none is."""
        refused = Refused("", "")
        for ask in range(self.cfg.structure_asks):
            asked = replace(question, ask=ask) if ask else question
            answer = await self._answer(asked)
            if isinstance(answer, Draft):
                self._accept(answer, asked)
                self.checks["structure"] = "ok"
                return None
            refused = answer
            if refused.complaint or refused.reason == CONTEXT_FULL:
                self.checks["structure"] = "ok" if refused.complaint else refused.reason
                return refused.reason  # the corrections did not help, or there is no room for an answer
        self.checks["structure"] = refused.reason
        return "structure"

    async def _answer(self, question: Question) -> Draft | Refused:
        """Ask, and ask for a correction while the content is refused. A wrong structure has no complaint."""
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
        refused = refuse_decision(parsed) if "therefore" in self.terms.fields else None
        return refused or self.way.read(parsed, question.facts)

    def _read(self, reply: Reply, language: Language) -> Parsed:
        self.asks += 1
        usage = reply.usage or Usage()
        self.usage += usage
        self.structured = reply.structured
        fields = self.terms.fields if language == "en" else ()
        parsed = parse_answer(reply.text, language, fields, reply.finish_reason)
        if parsed.reason == CONTEXT_FULL:
            asked, answered = usage.prompt_tokens, usage.completion_tokens
            self.checks["refusal"] = (
                f"{CONTEXT_FULL}: a prompt of {asked} and an answer of {answered} tokens fill the context"
            )
        self._recovered.update(parsed.recovered)
        return parsed

    def _accept(self, draft: Draft, question: Question) -> None:
        self.english, self.answered = draft, question
        self.verdict = self._verdict_of(draft)

    def _verdict_of(self, draft: Draft) -> Verdict:
        return TABLE.verdict_of(draft.coc.flight_decision, self.prepared.motion, self.label)

    # --- regeneration ---

    async def _treat_verdict(self, question: Question) -> str | None:
        """Keep, regenerate or drop the answer according to its verdict; return the reason to drop the window."""
        treatment = self.cfg.repair.treatment_of(self.verdict)
        if self.judge is not None and self.verdict in ("HARD_CONFLICT", "SOFT_CONFLICT"):
            treatment = "repair" if await self._is_rejected(question, self.judge) else "keep"
        if treatment == "keep":
            return None
        if treatment == "drop" or self.terms.is_given:
            return "conflict"
        return await self.regenerate(question)

    async def _is_rejected(self, question: Question, judge: Judge) -> bool:
        """Ask the judge whether an answer in conflict must be asked for again.

        A hard conflict stays one whatever the judge says. A soft one is kept only if the judge accepts it. A label that
        the judge would put in place of the decision replaces it only if the text does not state another decision.
        """
        assert self.english is not None
        english = self.english.coc
        flight_data = question.prompts["en"].told(replace(question.pictures, views=()).sentence("en")).user
        self.judgement = await judge.judge(
            Conflict(sample_id=question.window.sample_id, flight_data=flight_data, answer=english, label=self.label)
        )
        verdict = self.judgement.verdict
        if verdict == "ACCEPT_ALTERNATIVE":
            if self.verdict == "HARD_CONFLICT":
                self.judgement.overruled_by = "geometry"
            return self.verdict == "HARD_CONFLICT"
        if verdict != "FIX_LABEL" or self.label is None:
            return True
        if ACTIONS[english.flight_decision].en in english.reasoning_trace.lower():
            self.judgement.overruled_by = "text"
            return True
        self.repair = self._begin_repair("fix_label", self.english)
        self.repair.outcome = "repaired"
        self.repair.rung = "fix_label"
        fixed = english.model_copy(update={"flight_decision": self.label})
        self._accept(replace(self.english, coc=fixed), question)
        return False

    def _begin_repair(self, strategy: str, english: Draft) -> RepairRecord:
        decision = english.coc.flight_decision
        return RepairRecord(strategy=strategy, first_decision=decision, first_verdict=self.verdict)

    async def regenerate(self, question: Question) -> str | None:
        """Ask again by the chosen strategy until an answer is no longer rejected (sec:appendix_e, four strategies)."""
        assert self.english is not None
        rejected = self.english.coc.flight_decision
        cfg = self.cfg.repair
        self.repair = repair = self._begin_repair(cfg.strategy, self.english)
        rungs: list[str] = [cfg.strategy] * cfg.max_asks
        if cfg.strategy == "cascade":  # from the freest to the surest
            rungs = ["hint", "multi_sample", *["anchored"] * cfg.max_asks][: cfg.max_asks]
        if self.label is None and "anchored" in rungs:
            return "no_label"
        repair.outcome = "failed"
        for ask, rung in enumerate(rungs):
            repair.asks = ask + 1
            if rung == "anchored":
                asked = replace(question, decision=self.label, ask=ask)
            elif rung == "hint":
                asked = replace(question, rejected=rejected, ask=ask)
            else:
                asked = replace(question, ask=self.cfg.structure_asks + ask)  # the same under another sampling seed
            answer = await self._answer(asked)
            if isinstance(answer, Refused):
                if answer.reason == CONTEXT_FULL:
                    return CONTEXT_FULL  # not a failure of the teacher
                continue
            verdict, decision = self._verdict_of(answer), answer.coc.flight_decision
            is_accepted = cfg.treatment_of(verdict) == "keep" and decision != rejected
            if asked.decision is not None:
                is_accepted = is_accepted and decision == asked.decision
            if cfg.strategy == "cascade":  # surer rungs follow
                is_accepted = is_accepted and verdict == "CONSISTENT"
            if is_accepted:
                self._accept(answer, asked)
                repair.outcome = "repaired"
                repair.rung = rung
                return None
        return "regeneration_failed"

    # --- the Chinese mirror and the values ---

    async def _mirror(self) -> str | None:
        """Ask for the Chinese text until the pair is consistent; return the reason to drop the window."""
        assert self.english is not None
        assert self.answered is not None
        complaint: str | None = None
        for ask in range(self.cfg.mirror_asks):
            reply = await self.teacher.mirror(self.answered, self.english, ask, complaint)
            parsed = self._read(reply, "zh")
            answer: Draft | Refused = Refused(f"structure_{parsed.reason}", "", self.chinese)
            if parsed.coc is not None:
                answer = self._compare(self.english, self.way.read_mirror(parsed, self.english, self.answered.facts))
            if isinstance(answer, Draft):
                self.chinese = answer
                self.checks["bilingual"] = "ok"
                return None
            self.chinese = answer.draft
            self.checks["bilingual"] = answer.reason
            complaint = answer.complaint
            if parsed.reason == CONTEXT_FULL:
                break
        return "bilingual"

    def _compare(self, english: Draft, chinese: Draft | Refused) -> Draft | Refused:
        """Compare a translation with its source. Templates are compared already; a given text translates nothing."""
        is_translated = self.terms.is_translated and not self.terms.is_given
        if isinstance(chinese, Refused) or chinese.template is not None or not is_translated:
            return chinese
        found = check_translation(english.coc, chinese.coc)
        return Refused(*found, chinese) if found else chinese

    def _check_values(self, question: Question) -> str | None:
        """Record the values of both languages; return the reason to drop the window."""
        checks = {
            language: self.way.check(draft, question.facts, language) for language, draft in self._drafts().items()
        }
        contradictions = [f"{language} {text}" for language, check in checks.items() for text in check.contradictions]
        self.checks["values"] = {language: check.counts for language, check in checks.items()}
        self.checks["contradictions"] = contradictions or None
        return CONTRADICTED if contradictions and self.cfg.contradicted_values == "drop" else None
