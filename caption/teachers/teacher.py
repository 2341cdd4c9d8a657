"""Teachers: who answers a `Question`.

`RuleTeacher` is embedded and deterministic. `AskingTeacher` asks a language model through an engine (cosfly/llm);
every answer is journaled before it is handed on.
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
from typing import Protocol

import numpy as np
from pydantic_core import to_json

from caption.answer_formats.contract import THEREFORE, Draft
from caption.schema import CaptionConfig, ImageConfig
from caption.teachers.foreign import FileTeacher, StudentTeacher, Terms
from caption.teachers.images import FrameEncoder
from caption.teachers.prompts import Question, mirror_messages, question_messages
from caption.teachers.rules import MODEL, write_templates
from caption.teachers.students import TaughtStudent
from cosfly.formats.captions import TeacherRecord, TeacherSettings
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import BYTES_PER_TOKEN, PIXELS_PER_TOKEN, AnswerBook, Budget, KeptAnswers
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import Engine, NoAnswer, Reply, Request, Troubles
from cosfly.llm.student_chat import EncodedImage
from cosfly.llm.vllm_engine import VllmEngine
from cosfly.runtime.seeding import random_bytes, rng_for
from cosfly.viz.frame_views import Pictures

ENCODING_THREADS = 4


class Teacher(Protocol):
    """`ask` answers in English, `mirror` gives the Chinese of an English answer; `complaint`: what was wrong with the
    last one."""

    record: TeacherRecord

    async def ask(self, question: Question) -> Reply: ...

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply: ...


# --- rules ------------------------------------------------------------------------------------------------------------


class RuleTeacher:
    """Answers from the question's facts alone; see rules.py."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        settings = TeacherSettings(seed=seed)
        self.record = TeacherRecord(kind="rules", model=MODEL, settings=settings, structured="native")
        self._last_key = ""
        self._last_answers: tuple[dict[str, str], dict[str, str]] | None = None

    def _answers(self, question: Question) -> tuple[dict[str, str], dict[str, str]]:
        """Return the English and the Chinese answer.

        Raises:
            NoAnswer: no observed fact supports the given decision.
        """
        # Corrections have the same answer: the Chinese of `mirror` is of the question alone.
        key = f"{question.window.sample_id}/{replace(question, correction=None).purpose}"
        if self._last_key != key:
            draws = random_bytes(self.seed, "caption", key)
            self._last_key, self._last_answers = key, write_templates(question.facts, draws, question.decision)
        if self._last_answers is None:
            raise NoAnswer("no_reason", f"no observed fact supports {question.decision}", is_final=True)
        return self._last_answers

    async def ask(self, question: Question) -> Reply:
        english, _ = self._answers(question)
        return _native(english | {"therefore": english["flight_decision"]})

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        _, chinese = self._answers(question)
        return _native(chinese)


def _native(answer: dict[str, str]) -> Reply:
    return Reply(to_json(answer).decode(), None, "native", "stop")  # a tenth of the time of the json module


class SharedFrames:
    """Encodes frames on threads, each once however many windows wait for it."""

    def __init__(self, cfg: ImageConfig, encode: Callable[[np.ndarray], EncodedImage] | None = None) -> None:
        self.encoder = FrameEncoder(cfg, encode)
        self._threads = ThreadPoolExecutor(min(ENCODING_THREADS, os.cpu_count() or 1), "encode")
        self._underway: dict[tuple[Path, Pictures], asyncio.Future] = {}

    async def messages(self, question: Question) -> tuple[list[dict], list[str]]:
        """Return the chat messages of a question and the digests of its pictures.

        Raises:
            InputError, RenderError: a picture cannot be read or encoded.
        """
        await self.pictures(question)
        return question_messages(question, self.encoder)

    async def pictures(self, question: Question) -> list[list[EncodedImage]]:
        """Return the pictures of each frame of a question; raises as `messages`."""
        if not question.pictures.views:
            return [[] for _ in question.window.frame_folders]
        frames = [(folder, question.pictures) for folder in question.window.frame_folders]
        missing = [frame for frame in frames if not self.encoder.holds(*frame)]
        if missing:
            await asyncio.gather(*(self._encode(frame) for frame in missing))
        return [self.encoder.encode(*frame) for frame in frames]

    async def _encode(self, frame: tuple[Path, Pictures]) -> None:
        underway = self._underway.get(frame)
        if underway is None:
            loop = asyncio.get_running_loop()
            underway = self._underway[frame] = loop.run_in_executor(self._threads, self.encoder.encode, *frame)
            underway.add_done_callback(lambda _: self._underway.pop(frame, None))
        await asyncio.shield(underway)  # a window that is cancelled does not take the frame from the others

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)


def sampling_seed(seed: int, sample_id: str, purpose: str) -> int:
    """Return the seed of one ask: the same in every run, another for every ask of a window."""
    return int(rng_for(seed, "teacher", f"{sample_id}/{purpose}").integers(1 << 31))


def first_budget(cfg: CaptionConfig, *counts: Counter[str]) -> Budget:
    """Make the budget of a run; until an answer tells more, a request counts as 16 of the largest pictures and much
    text.

    Args:
        counts: `totals` of each book of answers.
    """
    pictures = 16 * cfg.image.max_side_px * cfg.image.max_side_px * 9 // 16 // PIXELS_PER_TOKEN
    first = pictures + 16_000 // BYTES_PER_TOKEN
    return Budget(cfg.budget, *counts, first_prompt=first, first_completion=cfg.endpoint.max_tokens)


# --- a language model -------------------------------------------------------------------------------------------------


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
        self.all_cfg, self.cfg, self.seed = cfg, cfg.endpoint, seed
        self.engine = make_engine(cfg, troubles)
        self.kept = KeptAnswers(self.engine, book, budget, only)
        self.student = None if cfg.student.folder is None else TaughtStudent(cfg)
        self.frames = SharedFrames(cfg.image, self.student.encode if self.student else None)

    async def __aenter__(self) -> AskingTeacher:
        try:
            await self.engine.start()
        except BaseException:
            await self.__aexit__()
            raise
        sampling = {name: getattr(self.cfg, name) for name in ("temperature", "top_p", "max_tokens", "extra_body")}
        settings = TeacherSettings(**sampling, seed=self.seed)
        kind = "student" if self.student else self.engine.kind
        self.record = TeacherRecord(kind=kind, model=self.engine.model, settings=settings)
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.frames.close()
        await self.engine.close()

    async def ask(self, question: Question) -> Reply:
        return await self._kept_answer(question, await self.request(question), question.purpose)

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        sample_id, purpose = question.window.sample_id, f"mirror/{ask}"
        if self.student is not None:
            frames = await self.frames.pictures(question)
            request = self.student.mirror_request(question, english, frames, ask)
        else:
            schema = answer_schema(english.coc.flight_decision, "zh")
            messages = mirror_messages(english, question.way, complaint)
            request = self.cfg.request(messages, [], schema, sampling_seed(self.seed, sample_id, purpose))
        return await self._kept_answer(question, request, purpose)

    async def _kept_answer(self, question: Question, request: Request, purpose: str) -> Reply:
        sample_id = question.window.sample_id
        return await self.kept.ask(request, flight_of(sample_id), sample_id, purpose)

    async def request(self, question: Question) -> Request:
        """Return what is asked of the engine.

        Raises:
            InputError, RenderError: a picture cannot be read or encoded.
        """
        if self.student is not None:
            self.student.check(question)
            return self.student.request(question, await self.frames.pictures(question), question.ask)
        messages, digests = await self.frames.messages(question)
        seed = sampling_seed(self.seed, question.window.sample_id, question.purpose)
        schema = answer_schema(question.decision, more=THEREFORE)
        return self.cfg.request(messages, digests, schema, seed)


EMBEDDED = ("rules", "file", "student")  # kinds that answer at once, in the process


def embedded_teacher(cfg: CaptionConfig, seed: int) -> Teacher:
    """Make a teacher that asks nobody."""
    path = cfg.caption_file
    if path is None:
        return RuleTeacher(seed)
    return StudentTeacher(path, cfg.student.run, seed) if cfg.teacher_kind == "student" else FileTeacher(path, seed)


def make_engine(cfg: CaptionConfig, troubles: Troubles | None = None) -> Engine:
    """Make the engine that the settings name.

    Args:
        troubles: where a server notes tries that fail.
    """
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
    """Make the teacher that the settings name; it is ready inside `async with`."""
    if cfg.teacher_kind in EMBEDDED:
        return nullcontext(embedded_teacher(cfg, seed))
    return AskingTeacher(cfg, book, seed, budget, only, troubles)


def terms_of(teacher: Teacher, sample_id: str, cfg: CaptionConfig) -> Terms:
    """Return the terms under which a teacher answers for a window."""
    if isinstance(teacher, FileTeacher | StudentTeacher):
        return teacher.terms(sample_id)
    if isinstance(teacher, AskingTeacher) and teacher.student is not None:
        return teacher.student.terms
    return Terms(cfg.writing, tuple(THEREFORE))
