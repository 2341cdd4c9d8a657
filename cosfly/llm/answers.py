"""Every answer, kept before anything is derived from it; nothing answered is asked twice.

One folder keeps the answers of one asker, in one journal a flight: `answers/<flight>.jsonl`. One process writes it. An
answer is handed to the system as it arrives, so a killed process loses none; a thread waits for the disk, once for all
answers that arrived meanwhile. In memory are only flights that are being worked on.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from weakref import WeakValueDictionary

from pydantic import BaseModel, ConfigDict, Field

from cosfly.formats.captions import Usage
from cosfly.llm.budget import Budget
from cosfly.llm.contract import MOST_TOKENS, CountName, Engine, NoAnswer, Reply, Request
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL

log = logging.getLogger(__name__)

MOST_OPEN_FILES = 64
_PLAIN_NAME = re.compile(r"\w[\w.+-]*")


def journal_name(flight: str) -> str:
    """Return the file name of a flight's journal: its own name where that is a plain one, else one made from its
    digest."""
    is_plain = _PLAIN_NAME.fullmatch(flight) is not None and len(flight.encode()) <= 200
    return f"{flight if is_plain else f'flight-{sha256_bytes(flight.encode())}'}.jsonl"


Count = Annotated[int, Field(strict=True, ge=0, le=10**15)]  # of all runs into a folder


class Answer(BaseModel):
    """A line of a journal: what an engine answered.

    usage: empty where a server does not count.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    key: str
    sample_id: str
    purpose: str
    model: str = ""
    text: str
    usage: dict[CountName, Annotated[Count, Field(le=MOST_TOKENS)]]
    structured: str = ""
    finish_reason: str | None = None
    latency_s: float = Field(0.0, ge=0)
    time: float = 0.0

    @property
    def reply(self) -> Reply:
        usage = Usage(**self.usage) if self.usage else None
        return Reply(self.text, usage, self.structured, self.finish_reason, is_kept=True)


def answer_key(model: str, request: Request) -> str:
    """Hash image bytes, prompt, model and sampling: what an answer depends on."""
    texts = [
        message
        if isinstance(message["content"], str)
        else message | {"content": [part.get("text", "image") for part in message["content"]]}
        for message in request.messages
    ]
    sampling = {"model": model, **request.sampling}
    return sha256_bytes(dump_json([texts, request.digests, sampling, request.schema]).encode())


def read_answers(journal: Journal) -> Iterator[Answer]:
    """Yield the answers of a journal; InputError where a line cannot be used."""
    return journal.read_as(Answer.model_validate)


@dataclass
class _Flight:
    """One flight's journal and its answers by key."""

    journal: Journal
    answers: dict[str, Answer]


class AnswerBook:
    """The journals of one folder. Use as a context manager; all methods run on one event loop."""

    def __init__(self, folder: Path) -> None:
        """Count what the journals of earlier runs hold."""
        self.folder = folder
        self.totals: Counter[str] = Counter()  # answers, prompt_tokens, completion_tokens: of all runs into this folder
        for path in sorted(folder.glob("*.jsonl")):
            for answer in read_answers(Journal(path)):
                self._count(answer)
        self._flights: dict[str, _Flight] = {}
        self._waiting: list[tuple[Journal, asyncio.Future]] = []  # for the disk
        self._disk = ThreadPoolExecutor(1, "journal")
        self._syncing: asyncio.Task | None = None

    def get(self, flight: str, key: str) -> Answer | None:
        return self._open(flight).answers.get(key)

    def latency_s(self, flight: str, sample_id: str) -> float:
        """Return the time that the answers about one window took, one after the other."""
        kept = self._open(flight).answers.values()
        return sum(answer.latency_s for answer in kept if answer.sample_id == sample_id)

    async def put(self, flight: str, answer: Answer) -> None:
        """Write an answer to the disk; it is there when this returns.

        Raises:
            StorageError: the disk is full or not writable.
        """
        opened = self._open(flight)
        opened.journal.append(answer.model_dump(mode="json"), sync=False)
        opened.answers[answer.key] = answer
        self._count(answer)
        on_disk = asyncio.get_running_loop().create_future()
        self._waiting.append((opened.journal, on_disk))
        if self._syncing is None or self._syncing.done():
            self._syncing = asyncio.create_task(self._sync())
        await on_disk

    def forget(self, flight: str) -> None:
        """Drop a flight that was worked on from memory; its journal stays."""
        if (opened := self._flights.pop(flight, None)) is not None:
            opened.journal.close()

    def _open(self, flight: str) -> _Flight:
        if flight not in self._flights:
            journal = Journal(self.folder / journal_name(flight))
            self._flights[flight] = _Flight(journal, {answer.key: answer for answer in read_answers(journal)})
            if journal.num_damaged:
                log.warning("%s: %d damaged lines are left out", journal.path, journal.num_damaged)
        return self._flights[flight]

    def _count(self, answer: Answer) -> None:
        self.totals["answers"] += 1
        self.totals.update(answer.usage)

    async def _sync(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            batch, self._waiting = self._waiting, []
            journals = {journal for journal, _ in batch}
            error: CosflyError | OSError | None = None
            try:
                await loop.run_in_executor(self._disk, _sync_all, journals)
            except (CosflyError, OSError) as found:  # a disk that is full or gone: every window that waits is told
                error = found
            for _, on_disk in batch:
                if on_disk.done():
                    continue
                if error is None:
                    on_disk.set_result(None)
                else:
                    on_disk.set_exception(error)
            if len(self._flights) > MOST_OPEN_FILES:  # the next line opens its file again
                for journal in journals - {journal for journal, _ in self._waiting}:
                    journal.close()

    def __enter__(self) -> AnswerBook:
        return self

    def __exit__(self, *_: object) -> None:
        self._disk.shutdown(wait=True)
        for flight in list(self._flights):
            self.forget(flight)


def _sync_all(journals: set[Journal]) -> None:
    for journal in journals:
        journal.sync()


class KeptAnswers:
    """Gives an answer from the book, or has the engine make it, within the budget, and keeps it."""

    def __init__(
        self, engine: Engine, book: AnswerBook | None, budget: Budget | None = None, only: frozenset[str] | None = None
    ) -> None:
        """
        Args:
            book: None keeps nothing. budget: None sets no limit.
            only: sample ids that may be asked about; None: all. Of the others only what the book holds is given.
        """
        self.engine, self.book, self.budget, self.only = engine, book, budget, only
        self._asking: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()  # key -> held while it is asked

    async def ask(self, request: Request, flight: str, sample_id: str, purpose: str) -> Reply:
        """
        Raises:
            NoAnswer: there is none. BudgetSpent: one more request might pass a limit. TeacherError: none will be
            answered.
        """
        key = answer_key(self.engine.model, request)
        lock = self._asking.setdefault(key, asyncio.Lock())
        async with lock:  # two windows may ask the same: the second takes the answer of the first
            known = None if self.book is None else self.book.get(flight, key)
            is_again = self.only is not None and sample_id in self.only  # perhaps by a server with a larger context
            if known is not None and not (is_again and known.finish_reason == CONTEXT_FULL):
                return known.reply
            if self.only is not None and sample_id not in self.only:
                raise NoAnswer("not_asked", "this run asks about other windows only")
            if self.budget is None:
                return await self._make(key, request, flight, sample_id, purpose)
            async with self.budget.request(len(request.digests)):
                reply = await self._make(key, request, flight, sample_id, purpose)
            self.budget.note(reply.usage, self.engine.where, len(request.digests))
            return reply

    async def _make(self, key: str, request: Request, flight: str, sample_id: str, purpose: str) -> Reply:
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
            await self.book.put(flight, answer)  # on the disk before anything is derived from it
        return reply
