"""Teachers: what answers a `Question`.

`RuleTeacher` is embedded and deterministic. `AskingTeacher` asks a language model through an engine (cosfly/llm); every
answer is journaled before it is used.
"""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pydantic_core import to_json

from caption.answer_formats.contract import THEREFORE, Draft
from caption.schema import CaptionConfig
from caption.teachers.foreign import GivenTeacher, Terms
from caption.teachers.images import FrameEncoder
from caption.teachers.prompts import Question, mirror_messages, question_messages
from caption.teachers.rules import MODEL, write_templates
from caption.teachers.students import TrainedStudent
from cosfly.formats.captions import TeacherRecord, TeacherSettings
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import BYTES_PER_TOKEN, PIXELS_PER_TOKEN, AnswerBook, Budget, KeptAnswers
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import Engine, NoAnswer, Reply, Request, Troubles
from cosfly.llm.vllm_engine import VllmEngine
from cosfly.runtime.seeding import random_bytes, rng_for

ENCODING_THREADS = 4
Result = TypeVar("Result")
EMBEDDED = ("rules", "file", "student")  # kinds of teacher that answer at once, in the process


class Teacher(Protocol):
    """What answers. `ask` answers in English, `mirror` gives the Chinese of an English answer.

    complaint: What was wrong with the last Chinese answer.
    """

    record: TeacherRecord

    def terms(self, sample_id: str) -> Terms: ...

    async def ask(self, question: Question) -> Reply: ...

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply: ...


class RuleTeacher:
    """Answers from the facts of the question alone; see rules.py."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        settings = TeacherSettings(seed=seed)
        self.record = TeacherRecord(kind="rules", model=MODEL, settings=settings, structured="native")
        self._last_key = ""
        self._last: tuple[dict[str, str], dict[str, str]] | None = None

    def terms(self, sample_id: str) -> Terms:
        return Terms("slots", tuple(THEREFORE))

    def _answers(self, question: Question) -> tuple[dict[str, str], dict[str, str]]:
        """Return the English and the Chinese answer; a correction does not change them."""
        key = f"{question.window.sample_id}/{replace(question, correction=None).purpose}"
        if key != self._last_key:
            draws = random_bytes(self.seed, "caption", key)
            self._last = write_templates(question.facts, draws, question.decision)
            self._last_key = key
        if self._last is None:
            raise NoAnswer("no_reason", f"no observed fact supports {question.decision}", is_final=True)
        return self._last

    async def ask(self, question: Question) -> Reply:
        english, _ = self._answers(question)
        return _native(english | {"therefore": english["flight_decision"]})

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        _, chinese = self._answers(question)
        return _native(chinese)


def _native(answer: dict[str, str]) -> Reply:
    return Reply(to_json(answer).decode(), None, "native", "stop")  # a tenth of the time of the json module


class AskingTeacher:
    """Asks a language model. Use as an async context manager; its engine is started on entry."""

    def __init__(
        self,
        cfg: CaptionConfig,
        book: AnswerBook,
        seed: int,
        budget: Budget,
        only: frozenset[str] | None = None,
        troubles: Troubles | None = None,
    ) -> None:
        self.cfg, self.seed = cfg, seed
        self.engine = make_engine(cfg, troubles)
        self.kept = KeptAnswers(self.engine, book, budget, only)
        self.student = None if cfg.student.folder is None else TrainedStudent(cfg)
        self.encoder = FrameEncoder(cfg.image, self.student.encode if self.student else None)
        self._threads = ThreadPoolExecutor(min(ENCODING_THREADS, os.cpu_count() or 1), "encode")

    async def __aenter__(self) -> AskingTeacher:
        try:
            await self.engine.start()
        except BaseException:
            await self.__aexit__()
            raise
        names = ("temperature", "top_p", "max_tokens", "extra_body")
        sampling = {name: getattr(self.cfg.endpoint, name) for name in names}
        settings = TeacherSettings(**sampling, seed=self.seed)
        kind = "student" if self.student else self.engine.kind
        self.record = TeacherRecord(kind=kind, model=self.engine.model, settings=settings)
        return self

    async def __aexit__(self, *exc: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        await self.engine.close()

    def terms(self, sample_id: str) -> Terms:
        return self.student.terms if self.student else Terms(self.cfg.writing, tuple(THEREFORE))

    async def ask(self, question: Question) -> Reply:
        if self.student is not None:
            self.student.check(question)
            frames = await self._in_thread(self.encoder.encode_window, question.window, question.pictures)
            request = self.student.request(question, frames, question.ask)
        else:
            messages, digests = await self._in_thread(question_messages, question, self.encoder)
            schema = answer_schema(question.decision, more=THEREFORE)
            request = self._request(question, question.purpose, messages, digests, schema)
        return await self._kept_answer(question, request, question.purpose)

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        purpose = f"mirror/{ask}"
        if self.student is not None:
            frames = await self._in_thread(self.encoder.encode_window, question.window, question.pictures)
            request = self.student.mirror_request(question, english, frames, ask)
        else:
            messages = mirror_messages(english, question.way, complaint)
            schema = answer_schema(english.coc.flight_decision, "zh")
            request = self._request(question, purpose, messages, [], schema)
        return await self._kept_answer(question, request, purpose)

    async def _in_thread(self, function: Callable[..., Result], *args: Any) -> Result:
        """Call a function that reads and encodes pictures without blocking the other windows."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *args)

    def _request(
        self, question: Question, purpose: str, messages: list[dict], digests: list[str], schema: dict
    ) -> Request:
        """Return a request; its sampling seed is the same in every run, and another for every ask of a window."""
        item = f"{question.window.sample_id}/{purpose}"
        seed = int(rng_for(self.seed, "teacher", item).integers(1 << 31))
        return self.cfg.endpoint.request(messages, digests, schema, seed)

    async def _kept_answer(self, question: Question, request: Request, purpose: str) -> Reply:
        sample_id = question.window.sample_id
        return await self.kept.ask(request, flight_of(sample_id), sample_id, purpose)


def first_budget(cfg: CaptionConfig, *counts: Counter[str]) -> Budget:
    """Return the budget of a run. Until the first answer, a request counts as 16 of the largest pictures and much text.

    Args:
        counts: `totals` of each answer journal.
    """
    pictures = 16 * cfg.image.max_side_px * cfg.image.max_side_px * 9 // 16 // PIXELS_PER_TOKEN
    first = pictures + 16_000 // BYTES_PER_TOKEN
    return Budget(cfg.budget, *counts, first_prompt=first, first_completion=cfg.endpoint.max_tokens)


def embedded_teacher(cfg: CaptionConfig, seed: int) -> Teacher:
    """Return a teacher that asks no model."""
    return RuleTeacher(seed) if cfg.teacher_kind == "rules" else GivenTeacher(cfg, seed)


def make_engine(cfg: CaptionConfig, troubles: Troubles | None = None) -> Engine:
    """Return the engine that the settings name. troubles: Records the failed tries of a server."""
    if cfg.teacher_kind == "endpoint":
        return ChatClient(cfg.teacher, cfg.endpoint, troubles)
    folder = Path(cfg.teacher.removeprefix("vllm:"))
    return VllmEngine(folder, cfg.vllm, cfg.endpoint, num_images=cfg.num_images, settings="caption")


def open_teacher(
    cfg: CaptionConfig,
    book: AnswerBook,
    seed: int,
    budget: Budget,
    only: frozenset[str] | None = None,
    troubles: Troubles | None = None,
) -> AbstractAsyncContextManager[Teacher]:
    """Return the teacher that the settings name; it is ready inside `async with`."""
    if cfg.teacher_kind in EMBEDDED:
        return nullcontext(embedded_teacher(cfg, seed))
    return AskingTeacher(cfg, book, seed, budget, only, troubles)
