"""The bounded ask-verify loop of one window.

Every window has one outcome: accepted, dropped for a reason, or failed because the teacher did not answer. A decision
that the trajectory contradicts is asked for again, by default anchored to the label; the record says so.
"""

from dataclasses import replace

from caption.answer_formats.formats import THEREFORE, Draft, Refused
from caption.schema import CaptionConfig, Window
from caption.stage.ledger import REASONS
from caption.teachers.judge import Conflict, Judge
from caption.teachers.prompt_files import Vocabulary
from caption.teachers.prompts import Correction, Question, make_question, prompt_hash
from caption.teachers.teacher import Teacher
from caption.verification.actions import TABLE, measure
from caption.verification.values import check_values, measured_lines
from cosfly.formats.captions import ACTIONS, Caption, Checks, Language, RepairRecord, Usage, verdict_on
from cosfly.llm.answer_text import Parsed, parse_answer
from cosfly.llm.contract import NoAnswer, Reply
from cosfly.runtime.errors import InputError, RenderError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL, DECLINED

# Most requests for one text, of a teacher that does not give the same answer again.
STRUCTURE_ASKS = 3  # until an answer has the right structure
CORRECTION_ASKS = 1  # that name what was wrong with an answer of the right structure
MIRROR_ASKS = 2  # for the Chinese mirror, until the pair is consistent
MOST_ASKS = STRUCTURE_ASKS * (1 + CORRECTION_ASKS) + MIRROR_ASKS  # of a window without a conflict
MAX_COMPLAINTS = 8  # named at once
MOST_REFUSAL_TEXT = 300  # characters of a refusal in the record
CONTRADICTED = "contradicted_value"


async def caption_window(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, judge: Judge | None = None
) -> Caption:
    """Make the caption of one window. NoAnswer: The teacher gave none, but may later. TeacherError: No window will get
    an answer."""
    loop = WindowLoop(window, teacher, cfg, vocabulary, judge)
    reason = window.problem
    if reason is None:
        try:
            reason = await loop.run()
        except NoAnswer as error:
            if not error.is_final:
                raise
            reason = error.cause
            if reason not in REASONS:
                reason = "refused"
                loop.checks.refusal = str(error)
        except (InputError, RenderError) as error:  # a picture that cannot be read or encoded
            reason = "unusable_frame"
            loop.checks.frame = error.what
    return loop.finish(reason)


class WindowLoop:
    """The asks of one window and their results."""

    def __init__(
        self, window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, judge: Judge | None = None
    ) -> None:
        self.teacher = teacher
        self.cfg = cfg
        self.judge = judge
        self.terms = teacher.terms(window.observed.sample_id)
        # The question that the accepted English answer answers; at first the free one.
        self.answered = make_question(window.observed, cfg.image, self.terms.writing, vocabulary)
        self.format = self.answered.format
        motion = measure(window.future)
        self.label = TABLE.label_of(motion)
        self.contradicted = TABLE.contradicted_by(motion, self.label)
        is_fixed = self.terms.is_fixed
        self.fields = () if is_fixed else tuple(THEREFORE)  # of an English answer, beyond the paper's three
        self.structure_asks = 1 if is_fixed else STRUCTURE_ASKS
        self.correction_asks = 0 if is_fixed else CORRECTION_ASKS
        self.mirror_asks = 1 if is_fixed else MIRROR_ASKS
        self.drafts: dict[Language, Draft] = {}  # the accepted answers; a Chinese one may have been refused
        self._structured: str | None = None  # how the last answer got its structure
        self._recovered: set[str] = set()  # corrections of the syntax of answers
        self._refused: list[str] = []  # why answers of the right structure were refused
        self.checks = Checks(contradicted=self.contradicted)
        observed, pictures = window.observed, self.answered.pictures
        self.caption = Caption(
            sample_id=observed.sample_id, town=observed.town, trajectory=observed.trajectory, variant=observed.variant,
            frame_index=observed.indices[-1], window=list(observed.indices), future=list(window.future.indices),
            prompt=self.answered.prompts, prompt_hash=prompt_hash(self.answered), picture_px=pictures.size_px,
            depth_range_m=pictures.depth_range_m if "depth" in pictures.views else None, teacher=teacher.record,
            usage=Usage(), attempts=0, writing=self.terms.writing, label_from=window.future.label_from,
            label=self.label, checks=self.checks, status="dropped",
        )  # fmt: skip

    @property
    def english(self) -> Draft:
        return self.drafts["en"]

    def finish(self, reason: str | None) -> Caption:
        """Return the record of the window, which is dropped if there is a reason."""
        caption = self.caption
        caption.teacher = caption.teacher.model_copy(update={"structured": self._structured})
        if english := self.drafts.get("en"):
            caption.en = english.coc
            caption.therefore = english.therefore
        if chinese := self.drafts.get("zh"):
            caption.zh = chinese.coc
        caption.slots = {language: draft.template for language, draft in self.drafts.items() if draft.template} or None
        caption.status = "accepted" if reason is None else "dropped"
        caption.drop_reason = reason
        return caption

    async def run(self) -> str | None:
        """Ask, verify, regenerate and translate; return the reason to drop the window, None to accept it."""
        question, checks = self.answered, self.checks
        reason = await self._attempt(question)
        if reason == CONTRADICTED and self.correction_asks:  # once more, with the measured values
            self._refused.append(reason)
            problems = (checks.contradictions or [])[:MAX_COMPLAINTS]
            measured = measured_lines(question.facts, problems)
            complaint = f"It contradicts the measured facts: {'; '.join(problems)}. Measured: {measured}."
            correction = Correction(dump_json(self.english.written), complaint, self.correction_asks + 1)
            self.drafts.clear()  # and what is recorded of the refused answer
            self.caption.verdict = None
            checks.values = None
            checks.contradictions = None
            reason = await self._attempt(replace(self.answered, correction=correction))  # anchored, perhaps
        checks.recovered = sorted(self._recovered) or None
        checks.refused = self._refused or None
        return reason

    async def _attempt(self, question: Question) -> str | None:
        """Ask a question, treat the verdict on its answer, and ask for the mirror; return the reason to drop it."""
        reason = await self.ask_freely(question)
        if reason is None:
            reason = await self._treat_verdict(question)
        if reason is None and self.terms.has_mirror:
            reason = await self._mirror()
        elif reason is None:
            self.checks.bilingual = "no_chinese"
        if reason is None or (self.terms.is_given and self.drafts):
            contradicted = self._check_values(question)  # given captions are checked even if they are dropped
            reason = reason or contradicted
        return reason

    # --- the English answer ---

    async def ask_freely(self, question: Question) -> str | None:
        """Ask until an answer is accepted; return the reason to drop the window if none is."""
        refused = Refused("", "")
        for ask in range(self.structure_asks):
            asked = replace(question, ask=ask) if ask else question
            answer = await self._answer(asked)
            if isinstance(answer, Draft):
                self._accept(answer, asked)
                self.checks.structure = "ok"
                return None
            refused = answer
            if refused.complaint or refused.reason == CONTEXT_FULL:
                self.checks.structure = "ok" if refused.complaint else refused.reason
                return refused.reason  # the corrections did not help, or there is no room for an answer
        self.checks.structure = refused.reason
        return DECLINED if refused.reason == DECLINED else "structure"

    async def _answer(self, question: Question) -> Draft | Refused:
        """Ask, and ask for a correction while the content is refused. A wrong structure has no complaint."""
        first = 1 + (question.correction.number if question.correction else 0)
        for number in range(first, first + self.correction_asks + 1):
            reply = await self.teacher.ask(question)
            answer = self._draft(reply, question)
            if isinstance(answer, Draft) or not answer.complaint:
                break
            self._refused.append(f"{answer.reason}: {answer.complaint}"[:MOST_REFUSAL_TEXT])
            question = replace(question, correction=Correction(reply.text, answer.complaint, number))
        return answer

    def _draft(self, reply: Reply, question: Question) -> Draft | Refused:
        """Return the English draft of a reply, or why it is refused."""
        parsed = self._read(reply, "en")
        if parsed.coc is None:
            return Refused(parsed.reason or "", "")
        decision, therefore = parsed.coc.flight_decision, parsed.therefore
        if self.fields and decision != therefore:
            complaint = (
                f'"therefore" says {therefore} and "flight_decision" says {decision}: both name the one action that '
                "your reasoning leads to. Let the reasoning lead to the decision."
            )
            return Refused("decision_mismatch", complaint)
        draft = self.format.read(parsed.coc, question.facts)
        return replace(draft, therefore=therefore) if isinstance(draft, Draft) else draft

    def _read(self, reply: Reply, language: Language) -> Parsed:
        """Parse a reply, and record its use of tokens and why it is no answer."""
        usage = reply.usage or Usage()
        self.caption.attempts += 1
        self.caption.usage += usage
        self._structured = reply.structured
        fields = self.fields if language == "en" else ()
        parsed = parse_answer(reply.text, language, fields, reply.finish_reason)
        self.checks.refusal = None  # of an earlier answer
        if parsed.reason == DECLINED:
            self.checks.refusal = f"{DECLINED}: {' '.join(reply.text.split())[:MOST_REFUSAL_TEXT]}"
        if parsed.reason == CONTEXT_FULL:
            tokens = f"a prompt of {usage.prompt_tokens} and an answer of {usage.completion_tokens} tokens"
            self.checks.refusal = f"{CONTEXT_FULL}: {tokens} fill the context"
        self._recovered.update(parsed.recovered)
        return parsed

    def _accept(self, draft: Draft, question: Question) -> None:
        self.drafts["en"], self.answered = draft, question
        self.caption.verdict = verdict_on(draft.coc.flight_decision, self.label, self.contradicted)

    # --- regeneration ---

    async def _treat_verdict(self, question: Question) -> str | None:
        """Keep, regenerate or drop the answer according to its verdict; return the reason to drop the window."""
        treatment = self.cfg.repair.treatment_of(self.caption.verdict)
        if self.judge is not None and self.caption.verdict in ("HARD_CONFLICT", "SOFT_CONFLICT"):
            treatment = "repair" if await self._is_rejected(question, self.judge) else "keep"
        if treatment == "keep":
            return None
        if treatment == "drop" or self.terms.is_given:
            return "conflict"
        return await self.regenerate(question)

    async def _is_rejected(self, question: Question, judge: Judge) -> bool:
        """Ask the judge whether an answer in conflict must be asked for again; it never excuses a hard one. Its label
        replaces the decision only if the text does not state another one."""
        english = self.english.coc
        flight_data = question.prompts["en"].filled(replace(question.pictures, views=()).sentence("en")).user
        conflict = Conflict(sample_id=self.caption.sample_id, flight_data=flight_data, answer=english, label=self.label)
        self.caption.judge = judgement = await judge.judge(conflict)
        if judgement.verdict == "ACCEPT_ALTERNATIVE":
            is_hard = self.caption.verdict == "HARD_CONFLICT"
            if is_hard:
                judgement.overruled_by = "geometry"
            return is_hard
        if judgement.verdict != "FIX_LABEL" or self.label is None:
            return True
        if ACTIONS[english.flight_decision].en in english.reasoning_trace.lower():
            judgement.overruled_by = "text"
            return True
        repair = self._begin_repair("fix_label")
        repair.outcome = "repaired"
        repair.rung = "fix_label"
        fixed = english.model_copy(update={"flight_decision": self.label})
        self._accept(replace(self.english, coc=fixed), question)
        return False

    def _begin_repair(self, strategy: str) -> RepairRecord:
        first, verdict = self.english.coc.flight_decision, self.caption.verdict
        self.caption.repair = repair = RepairRecord(strategy=strategy, first_decision=first, first_verdict=verdict)
        return repair

    async def regenerate(self, question: Question) -> str | None:
        """Ask again by the chosen strategy until an answer is no longer rejected (sec:appendix_e, four strategies)."""
        rejected, cfg = self.english.coc.flight_decision, self.cfg.repair
        repair = self._begin_repair(cfg.strategy)
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
                asked = replace(question, ask=self.structure_asks + ask)  # the same under another sampling seed
            answer = await self._answer(asked)
            if isinstance(answer, Draft) and self._is_repaired(answer.coc.flight_decision, rejected, asked.decision):
                self._accept(answer, asked)
                repair.outcome = "repaired"
                repair.rung = rung
                return None
            if isinstance(answer, Refused) and answer.reason == CONTEXT_FULL:
                return CONTEXT_FULL  # not a failure of the teacher
            if isinstance(answer, Draft):
                self._refused.append(f"conflict: the decision {answer.coc.flight_decision}")
            elif not answer.complaint:
                self._refused.append(f"structure: {answer.reason}")
        return "regeneration_failed"

    def _is_repaired(self, decision: str, rejected: str, anchor: str | None) -> bool:
        """Return whether a new decision replaces the rejected one. anchor: The decision that was asked for, if any."""
        verdict = verdict_on(decision, self.label, self.contradicted)
        if decision == rejected or self.cfg.repair.treatment_of(verdict) != "keep":
            return False
        if anchor is not None and decision != anchor:
            return False
        return self.cfg.repair.strategy != "cascade" or verdict == "CONSISTENT"  # else surer rungs follow

    # --- the Chinese mirror and the values ---

    async def _mirror(self) -> str | None:
        """Ask for the Chinese text until the pair is consistent; return the reason to drop the window."""
        complaint: str | None = None
        for ask in range(self.mirror_asks):
            reply = await self.teacher.mirror(self.answered, self.english, ask, complaint)
            parsed = self._read(reply, "zh")
            answer: Draft | Refused = Refused(f"structure_{parsed.reason}", "", self.drafts.get("zh"))
            if parsed.coc is not None:
                facts, is_translated = self.answered.facts, not self.terms.is_fixed
                answer = self.format.read_mirror(parsed.coc, self.english, facts, is_translated)
            draft = answer if isinstance(answer, Draft) else answer.draft
            self.drafts.pop("zh", None)
            if draft is not None:
                self.drafts["zh"] = draft
            if isinstance(answer, Draft):
                self.checks.bilingual = "ok"
                return None
            self.checks.bilingual = answer.reason
            complaint = answer.complaint
            if complaint:
                self._refused.append(f"bilingual: {complaint}"[:MOST_REFUSAL_TEXT])
            if parsed.reason == CONTEXT_FULL:
                break
        return "bilingual"

    def _check_values(self, question: Question) -> str | None:
        """Record the values of both languages; return the reason to drop the window."""
        checks = {
            language: check_values(draft.outside, question.facts, language, draft.num_filled)
            for language, draft in self.drafts.items()
        }
        contradictions = [f"{language} {text}" for language, check in checks.items() for text in check.contradictions]
        self.checks.values = {language: check.counts for language, check in checks.items()}
        self.checks.contradictions = contradictions or None
        return CONTRADICTED if contradictions and self.cfg.contradicted_values == "drop" else None
