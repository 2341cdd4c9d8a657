"""Teachers, which answer a `Question`.

`RuleTeacher` is built in and deterministic, `GivenTeacher` reads a file. `AskingTeacher` asks a language model through
an engine (cosfly/llm); every answer is journaled before it is used. `ask` answers in English, `mirror` gives the
Chinese of an English answer; its complaint says what was wrong with the last one.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic_core import to_json

from caption.answer_formats.formats import THEREFORE, Draft
from caption.schema import CaptionConfig
from caption.teachers.foreign import GivenTeacher, Terms
from caption.teachers.prompts import Question, mirror_messages, question_messages
from caption.teachers.rules import MODEL, write_templates
from caption.teachers.students import TrainedStudent
from cosfly.formats.captions import TeacherRecord, TeacherSettings
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import AnswerBook, Budget, KeptAnswers
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import Engine, NoAnswer, Reply, Request, started
from cosfly.llm.student_chat import EncodedImage, encoded_image
from cosfly.llm.vllm_engine import VllmEngine
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.seeding import random_bytes, rng_for
from cosfly.viz.frame_views import Pictures

ENCODING_THREADS = 4
CACHE_FRAMES = 256  # encoded frames in memory, for the windows that share them
EMBEDDED = ("rules", "file", "student")  # kinds of teacher that answer at once, in the process


class RuleTeacher:
    """Answers from the facts of the question alone; see rules.py."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        settings = TeacherSettings(seed=seed)
        self.record = TeacherRecord(kind="rules", model=MODEL, settings=settings, structured="native")

    def terms(self, sample_id: str) -> Terms:
        return Terms("slots")

    def _answers(self, question: Question) -> tuple[dict[str, str], dict[str, str]]:
        """Return the English and the Chinese answer; a correction does not change them."""
        key = f"{question.window.sample_id}/{replace(question, correction=None).purpose}"
        cache = question.facts.found
        if key not in cache:
            draws = random_bytes(self.seed, "caption", key)
            cache[key] = write_templates(question.facts, draws, question.decision)
        if cache[key] is None:
            raise NoAnswer("no_reason", f"no observed fact supports {question.decision or 'a decision'}", is_final=True)
        return cache[key]  # type: ignore[no-any-return]

    async def ask(self, question: Question) -> Reply:
        english, _ = self._answers(question)
        return _native(english | {"therefore": english["flight_decision"]})

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        _, chinese = self._answers(question)
        return _native(chinese)


def _native(answer: dict[str, str]) -> Reply:
    return Reply(to_json(answer).decode(), None, "native", "stop")  # a tenth of the time of the json module


def encode_frame(
    frame: Path, pictures: Pictures, encode: Callable[[np.ndarray], EncodedImage] = encoded_image
) -> list[EncodedImage]:
    """Return the pictures of one frame, one per view or a tiled one; InputError if a file cannot be read."""
    return [encode(picture) for picture in pictures.read(frame)]


class AskingTeacher:
    """Asks a language model; threads read and encode its pictures. Made by `open_teacher`."""

    def __init__(self, cfg: CaptionConfig, seed: int, kept: KeptAnswers, threads: Executor) -> None:
        self.cfg = cfg
        self.seed = seed
        self.kept = kept
        self._threads = threads
        self.student = None if cfg.student.folder is None else TrainedStudent(cfg)
        self._encode = self.student.encode if self.student else encoded_image
        self._frames: dict[tuple[Path, Pictures], asyncio.Future[list[EncodedImage]]] = {}
        names = ("temperature", "top_p", "max_tokens", "extra_body")
        settings = TeacherSettings(**{name: getattr(cfg.endpoint, name) for name in names}, seed=seed)
        kind = "student" if self.student else kept.engine.kind
        self.record = TeacherRecord(kind=kind, model=kept.engine.model, settings=settings)

    def terms(self, sample_id: str) -> Terms:
        return self.student.terms if self.student else Terms(self.cfg.writing)

    async def ask(self, question: Question) -> Reply:
        frames = await self._encoded(question)
        if self.student is not None:
            request = self.student.request(question, "en", question.decision, frames, question.ask)
        else:
            messages, digests = question_messages(question, frames)
            schema = answer_schema(question.decision, more=THEREFORE)
            request = self.cfg.endpoint.request(messages, digests, schema, self._seed_of(question, question.purpose))
        return await self._kept_answer(question, question.purpose, request)

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        purpose, decision = f"mirror/{ask}", english.coc.flight_decision
        if self.student is not None:  # answers about the window again, freely unless the English decision was given
            given = decision if question.decision else None
            request = self.student.request(question, "zh", given, await self._encoded(question), ask)
        else:
            messages = mirror_messages(question, english, complaint)
            schema = answer_schema(decision, "zh")
            request = self.cfg.endpoint.request(messages, [], schema, self._seed_of(question, purpose))
        return await self._kept_answer(question, purpose, request)

    def _seed_of(self, question: Question, purpose: str) -> int:
        """Return a sampling seed that is the same in every run, and another for every ask of a window."""
        return int(rng_for(self.seed, "teacher", f"{question.window.sample_id}/{purpose}").integers(1 << 31))

    async def _encoded(self, question: Question) -> list[list[EncodedImage]]:
        """Return the pictures of each frame; threads read and encode a frame once for the windows that share it."""
        loop = asyncio.get_running_loop()
        frames = []
        for folder in question.window.frame_folders:
            key = (folder, question.pictures)
            if key not in self._frames:
                self._frames[key] = loop.run_in_executor(self._threads, encode_frame, *key, self._encode)
            frames.append(asyncio.shield(self._frames[key]))
        while len(self._frames) > CACHE_FRAMES:
            del self._frames[next(iter(self._frames))]
        return await asyncio.gather(*frames)

    async def _kept_answer(self, question: Question, purpose: str, request: Request) -> Reply:
        sample_id = question.window.sample_id
        return await self.kept.ask(request, flight_of(sample_id), sample_id, purpose)


Teacher = RuleTeacher | GivenTeacher | AskingTeacher


def embedded_teacher(cfg: CaptionConfig, seed: int) -> Teacher:
    """Return a teacher that asks no model."""
    return RuleTeacher(seed) if cfg.teacher_kind == "rules" else GivenTeacher(cfg, seed)


def make_engine(cfg: CaptionConfig) -> Engine:
    """Return the engine that the settings name."""
    if cfg.teacher_kind == "endpoint":
        return ChatClient(cfg.teacher, cfg.endpoint)
    folder = Path(cfg.teacher.removeprefix("vllm:"))
    return VllmEngine(folder, cfg.vllm, cfg.endpoint, num_images=cfg.num_images, settings="caption")


@asynccontextmanager
async def open_teacher(
    cfg: CaptionConfig, book: AnswerBook, seed: int, budget: Budget, retried: frozenset[str] = frozenset()
) -> AsyncIterator[Teacher]:
    """Connect to the teacher that the settings name."""
    if cfg.teacher_kind in EMBEDDED:
        yield embedded_teacher(cfg, seed)
        return
    engine = make_engine(cfg)
    async with started(engine):
        threads = ThreadPoolExecutor(min(ENCODING_THREADS, num_cpus()), "encode")
        try:
            yield AskingTeacher(cfg, seed, KeptAnswers(engine, book, budget, retried), threads)
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
