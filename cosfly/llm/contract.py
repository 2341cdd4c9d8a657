"""The contract of every engine: requests to a language model, its replies, and Ctrl-C while requests are in flight.

An engine knows no captions, journals or budgets: it is started, answers many requests at once, and is closed.
"""

import asyncio
import os
import signal
import threading
import zlib
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeVar

from cosfly.formats.captions import Usage

Result = TypeVar("Result")
CountName = Literal["prompt_tokens", "completion_tokens"]
AT_ONCE = b"error: interrupted at once\n"
AT_ONCE_WITH_WORK = b"error: interrupted at once; recorded answers are kept; run the same command again to continue\n"
REPEATED_SHARE = 0.3  # to which zlib compresses an answer that repeats itself (0.13 to 0.25); a good one: 0.5 to 0.9
MOST_TOKENS = 10_000_000  # of one answer: longer than the context of any model
STOP_AFTER_FAILURES = 20  # consecutive windows or samples without an answer after which a run ends


@dataclass(frozen=True)
class Request:
    """One conversation and its sampling."""

    messages: list[dict]  # chat messages, pictures as data URLs
    digests: list[str]  # sha256 of the pictures' bytes, in order
    schema: dict  # JSON schema of the answer
    sampling: dict[str, Any]  # temperature, max_tokens, seed and further fields of the request


@dataclass(frozen=True)
class Reply:
    text: str
    usage: Usage | None  # None if not reported
    structured: str  # how its form was enforced: json_schema, plain, or native (written by rules)
    finish_reason: str | None = None  # the server's, or CONTEXT_FULL
    num_thoughts: int = field(default=0, compare=False)  # characters of thoughts in a field of their own
    is_kept: bool = field(default=False, compare=False)  # read from the journal

    @property
    def cut_advice(self) -> str:
        """What helps if `max_tokens` has cut the answer; "" if it has not."""
        if self.finish_reason != "length":
            return ""
        text = self.text.encode()
        repeats = len(zlib.compress(text)) < REPEATED_SHARE * len(text)
        return "it repeats itself, so use a larger model" if repeats else "raise this limit"


@dataclass(eq=False)
class NoAnswer(Exception):
    """A request without an answer."""

    cause: str  # as tallies count it
    detail: str  # the server's message
    is_final: bool = False  # the request was refused, so repeating it does not help
    fix: str = ""
    wait_s: float | None = None  # how long the server asks to wait

    def __str__(self) -> str:
        return f"{self.cause}: {self.detail}"


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


def run_until_interrupted(main: Coroutine[Any, Any, Result], *, keeps_work: bool = True) -> Result:
    """Run a coroutine as `asyncio.run` does: Ctrl-C or SIGTERM cancels its tasks in order, a second ends the process.

    After the first one it raises KeyboardInterrupt, or SystemExit as the command line does, when all tasks have ended.
    Otherwise each cancelled task would print a traceback. Journals survive an end at any time.

    Args:
        keeps_work: Whether answers are recorded, for the message.
    """
    if threading.current_thread() is not threading.main_thread():
        return asyncio.run(main)
    received: signal.Signals | None = None
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    async def guarded() -> Result:
        task = asyncio.current_task()
        assert task is not None

        def interrupt(number: signal.Signals) -> None:
            nonlocal received
            if received is not None:
                os.write(2, AT_ONCE_WITH_WORK if keeps_work else AT_ONCE)
                os._exit(128 + number)
            received = number
            task.cancel()

        for number in previous:
            asyncio.get_running_loop().add_signal_handler(number, interrupt, number)
        return await main

    try:
        result = asyncio.run(guarded())
    except asyncio.CancelledError:
        if received is None:
            raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if received is None:
        return result
    # A signal may also come after the end of all tasks, while the loop waits for its threads.
    raise KeyboardInterrupt if received == signal.SIGINT else SystemExit(128 + received)
