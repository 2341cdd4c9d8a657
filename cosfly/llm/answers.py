"""The journal of answers, which no run requests twice, and the budget of tokens and money.

A folder has one journal per track, `answers/<track>.jsonl`, written by a thread of one process. Each answer is on the
disk before anything is derived from it, so a killed process loses none. Only tracks in progress are in memory. The
budget counts the answers in the journals of all runs into one folder, so repeating a command does not spend it twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections import Counter, deque
from collections.abc import AsyncIterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Self
from weakref import WeakValueDictionary

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cosfly.formats.captions import Usage
from cosfly.llm.contract import MOST_TOKENS, CountName, Engine, Reply, Request
from cosfly.runtime.config import Config
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL, DECLINED

log = logging.getLogger(__name__)

MOST_NAME_BYTES = 200  # of a file name without its ending; file systems allow 255 with it
_PLAIN_NAME = re.compile(r"\w[\w.+-]*")


class Answer(BaseModel):
    """A line of a journal."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    key: str
    sample_id: str
    purpose: str
    model: str = ""
    text: str
    usage: dict[CountName, Annotated[int, Field(strict=True, ge=0, le=MOST_TOKENS)]]  # empty if none is reported
    structured: str = ""
    finish_reason: str | None = None
    latency_s: float = Field(0.0, ge=0)
    time: float = 0.0  # seconds since 1970

    @property
    def reply(self) -> Reply:
        """The reply that was recorded."""
        usage = Usage(**self.usage) if self.usage else None
        return Reply(self.text, usage, self.structured, self.finish_reason, is_kept=True)


def answer_key(model: str, request: Request) -> str:
    """Return the digest of all that determines an answer: image bytes, prompt, model, sampling and schema."""
    messages = []  # without the pictures
    for message in request.messages:
        content = message["content"]
        if not isinstance(content, str):
            content = [part.get("text", "image") for part in content]
        messages.append(message | {"content": content})
    parts = [messages, request.digests, {"model": model, **request.sampling}, request.schema]
    return sha256_bytes(dump_json(parts).encode())


def journal_of(folder: Path, track: str) -> Journal:
    """Return the journal of a track's answers; a name that no file can have is replaced by its digest."""
    is_plain = _PLAIN_NAME.fullmatch(track) is not None and len(track.encode()) <= MOST_NAME_BYTES
    name = track if is_plain else f"flight-{sha256_bytes(track.encode())}"
    return Journal(folder / f"{name}.jsonl")


class AnswerBook:
    """The journals of one folder, a context manager. All methods run on one event loop."""

    def __init__(self, folder: Path) -> None:
        """Count the answers of earlier runs."""
        self.folder = folder
        self.totals: Counter[str] = Counter()  # answers, prompt_tokens, completion_tokens of all runs into this folder
        self.latency_s = 0.0  # of all these answers
        for path in sorted(folder.glob("*.jsonl")):
            for answer in Journal(path).read_as(Answer.model_validate):
                self._count(answer)
        self._tracks: dict[str, tuple[Journal, dict[str, Answer]]] = {}  # a track's journal, and its answers by key
        self._waiting: deque[tuple[Journal, Answer, Future[None]]] = deque()  # answers that are not on the disk
        self._disk = ThreadPoolExecutor(1, "journal")

    def get(self, track: str, key: str) -> Answer | None:
        """Return the recorded answer of a key."""
        _, answers = self._open(track)
        return answers.get(key)

    async def put(self, track: str, answer: Answer) -> None:
        """Write an answer, and wait until it is on the disk; StorageError if the disk is full or not writable."""
        journal, answers = self._open(track)
        written: Future[None] = Future()
        self._waiting.append((journal, answer, written))
        self._disk.submit(self._write_waiting)

        def keep(done: asyncio.Future[None]) -> None:
            if done.exception() is None:
                answers[answer.key] = answer
                self._count(answer)

        on_disk = asyncio.wrap_future(written)
        on_disk.add_done_callback(keep)
        await asyncio.shield(on_disk)  # an answer is written though its window is cancelled

    def _write_waiting(self) -> None:
        """Write all waiting answers, and wait for the disk once for each journal."""
        batches: dict[Journal, list[tuple[Answer, Future[None]]]] = {}
        while self._waiting:
            journal, answer, written = self._waiting.popleft()
            batches.setdefault(journal, []).append((answer, written))
        for journal, batch in batches.items():
            try:
                with journal:  # closed again, so that many tracks in progress take no more files than one
                    for answer, _ in batch:
                        journal.append(answer.model_dump(mode="json"), sync=False)
                    journal.sync()
            except Exception as error:
                for _, written in batch:
                    written.set_exception(error)
            else:
                for _, written in batch:
                    written.set_result(None)

    def forget(self, track: str) -> None:
        """Remove a finished track from memory; its journal stays on the disk."""
        self._tracks.pop(track, None)

    def _open(self, track: str) -> tuple[Journal, dict[str, Answer]]:
        if track not in self._tracks:
            journal = journal_of(self.folder, track)
            self._tracks[track] = journal, {answer.key: answer for answer in journal.read_as(Answer.model_validate)}
            if journal.num_damaged:
                log.warning("%s: %d damaged lines are skipped", journal.path, journal.num_damaged)
        return self._tracks[track]

    def _count(self, answer: Answer) -> None:
        self.totals["answers"] += 1
        self.latency_s += answer.latency_s
        if answer.finish_reason == "length":
            self.totals["cut"] += 1
        self.totals.update(answer.usage)

    def __enter__(self) -> AnswerBook:
        return self

    def __exit__(self, *_: object) -> None:
        self._disk.shutdown(wait=True)


# --- the budget -------------------------------------------------------------------------------------------------------


class BudgetConfig(Config):
    """Limits over all runs into one folder, including the tokens of a judge."""

    price_prompt: float = Field(0.0, ge=0, description="price of one million prompt tokens, in your currency")
    price_completion: float = Field(0.0, ge=0, description="price of one million answer tokens, in your currency")
    max_cost: float | None = Field(None, gt=0, description="stop at this cost; empty: no limit")
    max_tokens: int | None = Field(None, ge=1, description="stop at this number of tokens; empty: no limit")

    @model_validator(mode="after")
    def _priced(self) -> Self:
        if self.max_cost is not None and self.price_prompt == self.price_completion == 0:
            raise ValueError(
                "max_cost requires `price_prompt` or `price_completion`, because without a price the cost is always 0"
            )
        return self

    def cost(self, prompt_tokens: float, completion_tokens: float) -> float:
        """Return the price of some tokens."""
        return (prompt_tokens * self.price_prompt + completion_tokens * self.price_completion) / 1e6


class BudgetSpent(TeacherError):
    """A limit is reached; `what` says which."""


class Budget:
    """The shared budget of several journals of answers. It is spent when their sum reaches a limit.

    Requests in flight are then finished, so their answers may pass the limit.
    """

    def __init__(self, cfg: BudgetConfig, most_in_flight: int, *counts: Counter[str]) -> None:
        """
        Args:
            most_in_flight: Number of requests that may pass a limit.
            counts: `AnswerBook.totals` of each journal.
        """
        self.cfg = cfg
        self._counts = counts
        self._slots = asyncio.Semaphore(most_in_flight)

    @property
    def totals(self) -> Counter[str]:
        """Answers, prompt_tokens and completion_tokens of all journals."""
        return sum(self._counts, Counter())

    @contextlib.asynccontextmanager
    async def request(self) -> AsyncIterator[None]:
        """Wait for a slot; raises BudgetSpent if a limit is reached."""
        async with self._slots:
            self._check_limits()
            yield

    def _check_limits(self) -> None:
        cfg = self.cfg
        totals = self.totals
        tokens = totals["prompt_tokens"] + totals["completion_tokens"]
        cost = cfg.cost(totals["prompt_tokens"], totals["completion_tokens"])
        fix = "raise it and run the same command again"
        if cfg.max_tokens is not None and tokens >= cfg.max_tokens:
            what = f"the limit is reached: {tokens:,} of {cfg.max_tokens:,} tokens are used"
            raise BudgetSpent(what, where="caption.budget.max_tokens", fix=fix)
        if cfg.max_cost is not None and cost >= cfg.max_cost:
            what = f"the limit is reached: {cost:.4f} of {cfg.max_cost:g} is spent"
            raise BudgetSpent(what, where="caption.budget.max_cost", fix=fix)

    def check(self, usage: Usage | None, where: str) -> None:
        """Raise TeacherError if a limit is set and an answer has no usage."""
        if usage is None and (self.cfg.max_cost is not None or self.cfg.max_tokens is not None):
            what = "the endpoint does not report token usage, so a limit on tokens or cost cannot be applied"
            fix = "remove --max-cost and --max-tokens, and limit the number of windows with --limit"
            raise TeacherError(what, where=where, fix=fix)


@dataclass
class KeptAnswers:
    """An engine with a journal and a budget: recorded answers are reused, new ones are recorded."""

    engine: Engine
    book: AnswerBook | None  # None records nothing
    budget: Budget | None = None  # None sets no limit
    retried: frozenset[str] = frozenset()  # samples to ask again if the recorded answer filled the context or declined
    _asking: WeakValueDictionary[str, asyncio.Lock] = field(default_factory=WeakValueDictionary)  # by key

    async def ask(self, request: Request, track: str, sample_id: str, purpose: str) -> Reply:
        """Return the recorded answer, or ask the engine; NoAnswer fails this request, TeacherError all requests."""
        key = answer_key(self.engine.model, request)
        # Equal requests wait for each other, so that the second takes the answer of the first.
        async with self._asking.setdefault(key, asyncio.Lock()):
            recorded = None if self.book is None else self.book.get(track, key)
            is_retried = sample_id in self.retried  # the context may be larger now
            if recorded is not None and not (is_retried and recorded.finish_reason in (CONTEXT_FULL, DECLINED)):
                return recorded.reply
            return await self._ask_engine(request, track, key, sample_id, purpose)

    async def _ask_engine(self, request: Request, track: str, key: str, sample_id: str, purpose: str) -> Reply:
        """Ask the engine within the budget, and record its answer before anything is derived from it."""
        async with self.budget.request() if self.budget else contextlib.nullcontext():
            start_s = time.monotonic()
            reply = await self.engine.answer(request)
            if self.book is not None:
                answer = Answer(
                    key=key,
                    sample_id=sample_id,
                    purpose=purpose,
                    model=self.engine.model,
                    text=reply.text,
                    usage=reply.usage.model_dump() if reply.usage else {},
                    structured=reply.structured,
                    finish_reason=reply.finish_reason,
                    latency_s=round(time.monotonic() - start_s, 3),
                    time=round(time.time(), 3),
                )
                await self.book.put(track, answer)
        if self.budget is not None:
            self.budget.check(reply.usage, self.engine.where)
        return reply
