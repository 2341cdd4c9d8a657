"""Teachers: who answers a `Question`.

`RuleTeacher` is embedded and deterministic. `EndpointTeacher` asks a chat-completions server, `VllmTeacher` (vllm_teacher.py)
an engine in this process; both journal every answer before they hand it on, through `KeptAnswers`.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from caption.schema import BudgetConfig, ImageConfig, Reply
from caption.teachers.answers import AnswerBook
from caption.teachers.budget import Budget
from caption.teachers.images import FrameEncoder
from caption.teachers.prompts import Question, answer_schema, mirror_messages, mirror_schema, question_messages
from caption.teachers.rules import MODEL, write_answers
from cosfly.chance import rng_for
from cosfly.chat.client import KEY_VARIABLE, ChatClient, EndpointConfig, NoAnswer
from cosfly.chat.protocol import answer_key, base_url, shown_url, with_image_ids
from cosfly.frame_views import View
from cosfly.products.captions import Coc
from cosfly.store import dump_json

__all__ = ["KEY_VARIABLE", "EndpointTeacher", "NoAnswer", "RuleTeacher", "Teacher", "base_url", "shown_url"]

ENCODING_THREADS = 4
CHARACTERS_PER_TOKEN = 3  # a low guess: it only bounds the first requests of a limited budget
PIXELS_PER_TOKEN = 28 * 28  # of common vision encoders; the same


class Teacher(Protocol):
    """`ask` answers in English, `mirror` gives the Chinese of an English answer."""

    record: dict[str, Any]

    async def ask(self, question: Question) -> Reply: ...

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply: ...


# --- rules ------------------------------------------------------------------------------------------------------------


class RuleTeacher:
    """Answers from the question's facts alone; see rules.py."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.record: dict[str, Any] = {"kind": "rules", "model": MODEL, "settings": {"seed": seed}}
        self._last: tuple[str, tuple[Coc, Coc]] | None = None

    def _answers(self, question: Question) -> tuple[Coc, Coc]:
        key = f"{question.window.sample_id}/{question.purpose}"
        if self._last is None or self._last[0] != key:
            rng = rng_for(self.seed, "caption", key)
            self._last = (key, write_answers(question.facts, rng, question.decision))
        return self._last[1]

    async def ask(self, question: Question) -> Reply:
        return _native(self._answers(question)[0])

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply:
        return _native(self._answers(question)[1])


def _native(answer: Coc) -> Reply:
    return Reply(dump_json(answer.model_dump()), {}, "native", "stop")


# --- answers that are kept --------------------------------------------------------------------------------------------


class KeptAnswers:
    """Gives an answer from the journal, or has it made, within the budget, and journals it.

    only: sample ids that may be asked about; None: all. Of the others only what the journal holds is given.
    """

    def __init__(self, book: AnswerBook, budget: Budget, where: str) -> None:
        self.book, self.budget, self.where = book, budget, where
        self.only: frozenset[str] | None = None

    async def give(
        self,
        identity: dict[str, str],
        body: dict,
        digests: list[str],
        schema: dict,
        make: Callable[[], Awaitable[dict]],
    ) -> Reply:
        """
        Args:
            identity: sample_id and purpose, for the journal.
            make: gives text, usage, structured and finish_reason.
        Raises:
            NoAnswer: there is none. BudgetSpent: one more request might pass a limit.
        """
        key = answer_key(body, digests, schema)
        known = self.book.get(key)
        if known is None:
            if self.only is not None and identity["sample_id"] not in self.only:
                raise NoAnswer("not_asked", "this run asks about other windows only")
            with self.budget.request():
                start_s = time.monotonic()
                known = {"key": key, **identity, "model": body["model"], **await make()}
                known |= {"latency_s": round(time.monotonic() - start_s, 3), "time": round(time.time(), 3)}
                await self.book.put(known)  # on the disk before anything is derived from it
            self.budget.note(known["usage"], self.where)
        return Reply(known["text"], known["usage"], known["structured"], known["finish_reason"])


class SharedFrames:
    """Encodes frames on threads, each once however many windows wait for it."""

    def __init__(self, cfg: ImageConfig) -> None:
        self.encoder = FrameEncoder(cfg)
        self._threads = ThreadPoolExecutor(min(ENCODING_THREADS, os.cpu_count() or 1), "encode")
        self._underway: dict[tuple[Path, tuple[View, ...]], asyncio.Future] = {}

    async def messages(self, question: Question) -> tuple[list[dict], list[str]]:
        """Give the chat messages of a question and the digests of its pictures.

        Raises:
            InputError, RenderError: a picture cannot be read or encoded.
        """
        if question.views:
            frames = [(folder, question.views) for folder in question.window.frame_folders]
            missing = [frame for frame in frames if not self.encoder.holds(*frame)]
            if missing:
                await asyncio.gather(*(self._encode(frame) for frame in missing))
        return question_messages(question, self.encoder)

    async def _encode(self, frame: tuple[Path, tuple[View, ...]]) -> None:
        underway = self._underway.get(frame)
        if underway is None:
            loop = asyncio.get_running_loop()
            underway = self._underway[frame] = loop.run_in_executor(self._threads, self.encoder.encode, *frame)
            underway.add_done_callback(lambda _: self._underway.pop(frame, None))
        await asyncio.shield(underway)  # a window that is cancelled does not take the frame from the others

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)


def sampling_seed(seed: int, sample_id: str, purpose: str) -> int:
    """Give the seed of one ask: the same in every run, another for every ask of a window."""
    return int(rng_for(seed, "teacher", f"{sample_id}/{purpose}").integers(1 << 31))


def first_budget(cfg: BudgetConfig, endpoint: EndpointConfig, image: ImageConfig, book: AnswerBook) -> Budget:
    """Make the budget of a run; until an answer tells more, a request counts as 16 of the largest pictures and much text."""
    pictures = 16 * image.max_side_px * image.max_side_px * 9 // 16 // PIXELS_PER_TOKEN
    return Budget(
        cfg, book.totals, first_prompt=pictures + 6000 // CHARACTERS_PER_TOKEN, first_completion=endpoint.max_tokens
    )


# --- endpoint ---------------------------------------------------------------------------------------------------------


class EndpointTeacher:
    """Asks a chat-completions server. Use as an async context manager."""

    def __init__(
        self,
        url: str,
        cfg: EndpointConfig,
        image: ImageConfig,
        answers: AnswerBook,
        seed: int,
        budget: Budget | None = None,
    ) -> None:
        self.cfg, self.seed = cfg, seed
        self.record: dict[str, Any] = {}
        self.client = ChatClient(url, cfg)
        self.frames = SharedFrames(image)
        budget = budget or first_budget(BudgetConfig(), cfg, image, answers)
        self.kept = KeptAnswers(answers, budget, self.client.shown)

    async def __aenter__(self) -> EndpointTeacher:
        try:
            model = await self.client.find_model()
        except BaseException:
            await self.__aexit__()
            raise
        c = self.cfg
        settings = {"temperature": c.temperature, "top_p": c.top_p, "max_tokens": c.max_tokens, "seed": self.seed}
        self.record = {"kind": "endpoint", "model": model, "settings": settings | {"extra_body": dict(c.extra_body)}}
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.frames.close()
        await self.client.aclose()

    async def ask(self, question: Question) -> Reply:
        messages, digests = await self.frames.messages(question)
        schema = answer_schema(question.decision)
        return await self.complete(question.window.sample_id, question.purpose, messages, digests, schema)

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply:
        schema = mirror_schema(english.flight_decision)
        return await self.complete(question.window.sample_id, f"mirror/{ask}", mirror_messages(english), [], schema)

    async def complete(
        self, sample_id: str, purpose: str, messages: list[dict], digests: list[str], schema: dict
    ) -> Reply:
        """Give the answer to any chat messages, from the journal or the server."""
        body = self.body(sample_id, purpose, messages)
        sent = body | {"messages": with_image_ids(messages, digests)} if self.cfg.image_uuid else body
        identity = {"sample_id": sample_id, "purpose": purpose}
        return await self.kept.give(identity, body, digests, schema, lambda: self.client.complete(sent, schema))

    def body(self, sample_id: str, purpose: str, messages: list[dict]) -> dict[str, Any]:
        """Give a request without its response format."""
        c = self.cfg
        body = {"model": self.record["model"], "messages": messages, "temperature": c.temperature, "top_p": c.top_p}
        return body | {"max_tokens": c.max_tokens, "seed": sampling_seed(self.seed, sample_id, purpose)} | c.extra_body
