"""What is asked of a language model and what it gives: the contract of every engine.

An engine knows no captions, journals or budgets: it is started, answers requests, many at once, and is closed.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from cosfly.formats.captions import Usage

CountName = Literal["prompt_tokens", "completion_tokens"]
MOST_TOKENS = 10_000_000  # of one answer: the longest context of any model that is served


@dataclass(frozen=True)
class Request:
    """One conversation and how it is sampled, in plain values.

    messages: chat messages, pictures as data URLs. digests: sha256 of the pictures' bytes, in their order. schema: of
    the answer. sampling: temperature, max_tokens, seed and whatever else stands in a request beside model and messages.
    """

    messages: list[dict]
    digests: list[str]
    schema: dict
    sampling: dict[str, Any]


@dataclass(frozen=True)
class Reply:
    """One answer. `structured` says how its shape was enforced: json_schema, plain, or native (written by rules).

    usage: None where the server does not tell. finish_reason: the server's word, or CONTEXT_FULL. is_kept: it was given
    before, and kept.
    """

    text: str
    usage: Usage | None
    structured: str
    finish_reason: str | None = None
    is_kept: bool = field(default=False, compare=False)


class NoAnswer(Exception):
    """A request got no answer; `cause` is a word for the tally, `detail` what was said. `is_final`: it was refused, so
    asking the same again would not help. `fix`: what would."""

    def __init__(self, cause: str, detail: str, *, is_final: bool = False, fix: str = "") -> None:
        super().__init__(f"{cause}: {detail}")
        self.cause, self.detail, self.is_final, self.fix = cause, detail, is_final, fix


SECONDS_BETWEEN_WARNINGS = 10.0


class Troubles:
    """Tries that failed, for those who watch a run. `last`: what was said; None once an answer came after it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.num = 0
        self.last: str | None = None
        self.answered_s = clock()  # the last answer's time
        self._clock, self._warned_s = clock, float("-inf")

    def answered(self) -> None:
        self.last, self.answered_s = None, self._clock()

    def failed(self, detail: str) -> bool:
        """Note a try; tells whether it is time for a line in the log."""
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
    """What answers requests: a server, or a model in this process. `close` is called whatever came of `start`."""

    @property
    def kind(self) -> Literal["endpoint", "vllm"]: ...

    where: str  # its address, for messages; holds no secret
    model: str  # the model's name; known once it is started

    async def start(self) -> None:
        """Get ready.

        Raises:
            TeacherError, EnvironmentMissing, ConfigError: it cannot be used.
        """

    async def answer(self, request: Request) -> Reply:
        """Answer one request.

        Raises:
            NoAnswer: this one gets none. TeacherError: none will.
        """

    async def close(self) -> None: ...


@asynccontextmanager
async def started(engine: Engine) -> AsyncIterator[None]:
    """Start an engine and close it at the end."""
    try:
        await engine.start()
        yield
    finally:
        await engine.close()
