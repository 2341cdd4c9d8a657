"""The contract of every engine: requests to a language model, and its replies.

An engine knows no captions, journals or budgets: it is started, answers many requests at once, and is closed.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from cosfly.formats.captions import Usage

CountName = Literal["prompt_tokens", "completion_tokens"]
MOST_TOKENS = 10_000_000  # of one answer: longer than the context of any model


@dataclass(frozen=True)
class Request:
    """One conversation and its sampling.

    messages: chat messages, pictures as data URLs. digests: sha256 of the pictures' bytes, in order. schema: JSON
    schema of the answer. sampling: temperature, max_tokens, seed and further fields of the request.
    """

    messages: list[dict]
    digests: list[str]
    schema: dict
    sampling: dict[str, Any]


@dataclass(frozen=True)
class Reply:
    """One answer.

    structured: how its form was enforced, json_schema, plain, or native (written by rules). usage: None if not
    reported. finish_reason: the server's, or CONTEXT_FULL. is_kept: read from the journal.
    """

    text: str
    usage: Usage | None
    structured: str
    finish_reason: str | None = None
    is_kept: bool = field(default=False, compare=False)


class NoAnswer(Exception):
    """A request without an answer. cause: as tallies count it. detail: the server's message. is_final: the request was
    refused, so repeating it does not help. fix: what helps."""

    def __init__(self, cause: str, detail: str, *, is_final: bool = False, fix: str = "") -> None:
        super().__init__(f"{cause}: {detail}")
        self.cause, self.detail, self.is_final, self.fix = cause, detail, is_final, fix


SECONDS_BETWEEN_WARNINGS = 10.0


class Troubles:
    """Failed tries, for the progress display. last: the last error; None after an answer."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.num = 0
        self.last: str | None = None
        self.answered_s = clock()  # time of the last answer
        self._clock, self._warned_s = clock, float("-inf")

    def answered(self) -> None:
        """Record an answer."""
        self.last, self.answered_s = None, self._clock()

    def failed(self, detail: str) -> bool:
        """Record a failed try; return whether it is time for a line in the log."""
        self.num, self.last = self.num + 1, detail
        if self._clock() - self._warned_s < SECONDS_BETWEEN_WARNINGS:
            return False
        self._warned_s = self._clock()
        return True

    @property
    def silent_s(self) -> float:
        """Seconds since the last answer."""
        return self._clock() - self.answered_s


class Engine(Protocol):
    """A server, or a model in this process. `close` is called even if `start` failed."""

    @property
    def kind(self) -> Literal["endpoint", "vllm"]: ...

    where: str  # address for messages, without secrets
    model: str  # the model's name; known after `start`

    async def start(self) -> None:
        """Start; raises TeacherError, EnvironmentMissing or ConfigError if the engine cannot be used."""

    async def answer(self, request: Request) -> Reply:
        """Answer one request; raises NoAnswer for this request, and TeacherError if none will be answered."""

    async def close(self) -> None: ...


@asynccontextmanager
async def started(engine: Engine) -> AsyncIterator[None]:
    """Start an engine, and close it at the end."""
    try:
        await engine.start()
        yield
    finally:
        await engine.close()
