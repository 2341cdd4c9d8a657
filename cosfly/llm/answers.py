"""The journal of answers: each is written before anything is derived from it, and nothing is asked twice.

A folder has one journal per track, `answers/<track>.jsonl`, written by one process. An answer is handed to the
system as
it arrives, so a killed process loses none; a thread waits for the disk, once for all answers that arrived meanwhile.
Only tracks in progress are in memory.
"""

from __future__ import annotations

import asyncio
import contextlib
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


class Answer(BaseModel):
    """A line of a journal. usage: empty if the server reports none."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    key: str
    sample_id: str
    purpose: str
    model: str = ""
    text: str
    usage: dict[CountName, Annotated[int, Field(strict=True, ge=0, le=MOST_TOKENS)]]
    structured: str = ""
    finish_reason: str | None = None
    latency_s: float = Field(0.0, ge=0)
    time: float = 0.0

    @property
    def reply(self) -> Reply:
        """The reply that was recorded."""
        usage = Usage(**self.usage) if self.usage else None
        return Reply(self.text, usage, self.structured, self.finish_reason, is_kept=True)


def answer_key(model: str, request: Request) -> str:
    """Return the digest of what an answer depends on: image bytes, prompt, model and sampling."""
    texts = [
        message
        if isinstance(message["content"], str)
        else message | {"content": [part.get("text", "image") for part in message["content"]]}
        for message in request.messages
    ]
    sampling = {"model": model, **request.sampling}
    return sha256_bytes(dump_json([texts, request.digests, sampling, request.schema]).encode())


def read_answers(journal: Journal) -> Iterator[Answer]:
    """Yield the answers of a journal; raises InputError for an unusable line."""
    return journal.read_as(Answer.model_validate)


def journal_name(track: str) -> str:
    """Return the file name of a track's journal: the track's name if it is a plain file name, else its digest."""
    is_plain = _PLAIN_NAME.fullmatch(track) is not None and len(track.encode()) <= 200
    return f"{track if is_plain else f'flight-{sha256_bytes(track.encode())}'}.jsonl"


@dataclass
class _TrackAnswers:
    """The journal of one track, and its answers by key."""

    journal: Journal
    answers: dict[str, Answer]


class AnswerBook:
    """The journals of one folder, a context manager. All methods run on one event loop."""

    def __init__(self, folder: Path) -> None:
        """Count the answers of earlier runs."""
        self.folder = folder
        self.totals: Counter[str] = Counter()  # answers, prompt_tokens, completion_tokens of all runs into this folder
        for path in sorted(folder.glob("*.jsonl")):
            for answer in read_answers(Journal(path)):
                self._count(answer)
        self._tracks: dict[str, _TrackAnswers] = {}
        self._disk, self._disk_lock = ThreadPoolExecutor(1, "journal"), asyncio.Lock()
        self._unsynced = set[Journal]()
        self._disk_error: CosflyError | OSError | None = None

    def get(self, track: str, key: str) -> Answer | None:
        """Return the recorded answer of a key."""
        return self._open(track).answers.get(key)

    def latency_s(self, track: str, sample_id: str) -> float:
        """Return the total time of the answers about one window."""
        return sum(one.latency_s for one in self._open(track).answers.values() if one.sample_id == sample_id)

    async def put(self, track: str, answer: Answer) -> None:
        """Write an answer, and wait until it is on the disk; raises StorageError if the disk is full or not
        writable."""
        opened = self._open(track)
        opened.journal.append(answer.model_dump(mode="json"), sync=False)
        opened.answers[answer.key] = answer
        self._count(answer)
        self._unsynced.add(opened.journal)
        async with self._disk_lock:
            if self._disk_error is not None:  # a later sync may succeed without the lost lines
                raise self._disk_error
            if opened.journal in self._unsynced:  # else synced by another answer that waited
                await self._sync()

    async def _sync(self) -> None:
        batch, self._unsynced = self._unsynced, set()
        try:
            await asyncio.get_running_loop().run_in_executor(self._disk, _sync_all, batch)
        except asyncio.CancelledError:
            self._unsynced |= batch
            raise
        except (CosflyError, OSError) as error:
            self._disk_error = error
            raise
        if len(self._tracks) > MOST_OPEN_FILES:  # the next line opens its file again
            for journal in batch - self._unsynced:
                journal.close()

    def forget(self, track: str) -> None:
        """Remove a finished track from memory; its journal stays on the disk."""
        if (opened := self._tracks.pop(track, None)) is not None:
            opened.journal.close()

    def _open(self, track: str) -> _TrackAnswers:
        if track not in self._tracks:
            journal = Journal(self.folder / journal_name(track))
            self._tracks[track] = _TrackAnswers(journal, {answer.key: answer for answer in read_answers(journal)})
            if journal.num_damaged:
                log.warning("%s: %d damaged lines are skipped", journal.path, journal.num_damaged)
        return self._tracks[track]

    def _count(self, answer: Answer) -> None:
        self.totals["answers"] += 1
        self.totals.update(answer.usage)

    def __enter__(self) -> AnswerBook:
        return self

    def __exit__(self, *_: object) -> None:
        self._disk.shutdown(wait=True)
        for track in list(self._tracks):
            self.forget(track)


def _sync_all(journals: set[Journal]) -> None:
    for journal in journals:
        journal.sync()


class KeptAnswers:
    """An engine with a journal and a budget: recorded answers are reused, new ones are recorded."""

    def __init__(
        self, engine: Engine, book: AnswerBook | None, budget: Budget | None = None, only: frozenset[str] | None = None
    ) -> None:
        """
        Args:
            book: None records nothing. budget: None sets no limit.
            only: sample ids about which the engine may be asked; None: all. Others get recorded answers only.
        """
        self.engine, self.book, self.budget, self.only = engine, book, budget, only
        self._asking: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()  # key -> held while it is asked

    async def ask(self, request: Request, track: str, sample_id: str, purpose: str) -> Reply:
        """Return the recorded answer, or ask the engine.

        Raises:
            NoAnswer: This request gets no answer.
            BudgetSpent: The request might exceed a limit.
            TeacherError: No request will be answered.
        """
        key = answer_key(self.engine.model, request)
        lock = self._asking.setdefault(key, asyncio.Lock())
        async with lock:  # of two equal requests the second takes the answer of the first
            known = None if self.book is None else self.book.get(track, key)
            is_retried = self.only is not None and sample_id in self.only  # perhaps by a server with a larger context
            if known is not None and not (is_retried and known.finish_reason == CONTEXT_FULL):
                return known.reply
            if self.only is not None and not is_retried:
                raise NoAnswer("not_asked", "this run asks about other windows only")
            num_pictures = len(request.digests)
            async with self.budget.request(num_pictures) if self.budget else contextlib.nullcontext():
                start_s = time.monotonic()
                reply = await self.engine.answer(request)
                latency_s = round(time.monotonic() - start_s, 3)
                if self.book is not None:
                    answer = Answer(
                        key=key, sample_id=sample_id, purpose=purpose, model=self.engine.model, text=reply.text,
                        usage=reply.usage.model_dump() if reply.usage else {}, structured=reply.structured,
                        finish_reason=reply.finish_reason, latency_s=latency_s, time=round(time.time(), 3),
                    )  # fmt: skip
                    await self.book.put(track, answer)  # on the disk before anything is derived from it
            if self.budget is not None:
                self.budget.note(reply.usage, self.engine.where, num_pictures)
            return reply
