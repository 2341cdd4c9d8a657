"""Engine `endpoint`: one server of chat completions, what is sent to it, and what its answers mean.

The key comes from the environment variable COSFLY_API_KEY and goes into the request header only.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import httpx
from pydantic import Field

from cosfly.llm.contract import NoAnswer, Reply, Request, Troubles
from cosfly.llm.protocol import (
    ERROR_INSTEAD,
    encode_body,
    error_words,
    read_body,
    read_completion,
    read_models,
    request_body,
    response_format,
)
from cosfly.llm.refusals import MEANINGS, Refusal, kind_of
from cosfly.llm.throttle import Throttle
from cosfly.llm.wire import KEY_VARIABLE, Connections, Response, base_url, check_url
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.model_json import CONTEXT_FULL

log = logging.getLogger(__name__)

TOTAL_TIMEOUT_S = 900.0  # limit of one answer with all its tries
STOP_AFTER_FAILURES = 20  # unanswered windows or samples in a row that end a run
BUSY_STATUS = frozenset({429, 503, 529})
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # after a failure: the pause doubles, with jitter
MOST_REPLY_MB = 4.0  # of one answer, unpacked
MOST_SAID = 300  # characters of a server's words that are kept


class EndpointConfig(Config):
    model: str | None = Field(None, description="model name; empty takes the endpoint's only model")
    temperature: float = Field(0.6, ge=0, le=2, description="sampling temperature; 0 is greedy")
    top_p: ClassVar[float] = 0.95  # nucleus sampling; extra_body may set another
    max_tokens: int = Field(1024, ge=64, description="longest answer, tokens")
    concurrency: MayDiffer[int] = Field(
        16, ge=1, le=4096, description="most requests in flight; fewer while it says it is busy"
    )
    timeout_s: MayDiffer[float] = Field(
        120.0, gt=0, description="limit of one request, from its first byte to its last"
    )
    max_tries: MayDiffer[int] = Field(6, ge=1, description="tries of one request when the server is busy or fails")
    json_schema: bool = Field(True, description="ask the server to enforce the answer's JSON schema")
    extra_body: dict[str, Any] = Field(
        default_factory=dict,
        description="further fields of the request, for instance chat_template_kwargs; null leaves one of the others "
        "out",
    )

    def request(self, messages: list[dict], digests: list[str], schema: dict, seed: int) -> Request:
        """Return a conversation as these settings sample it."""
        sampling = {"temperature": self.temperature, "top_p": self.top_p, "max_tokens": self.max_tokens, "seed": seed}
        return Request(messages, digests, schema, self.with_extra(sampling))

    def with_extra(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return fields of a request with `extra_body`; a null there leaves one out."""
        return {name: value for name, value in (fields | self.extra_body).items() if value is not None}


@dataclass(frozen=True)
class Failure:
    """A try that may go better next time; wait_s: as the server says, None: as the settings do."""

    cause: str
    detail: str
    wait_s: float | None = None


class ChatClient:
    """Has requests answered by one server."""

    kind: Literal["endpoint"] = "endpoint"

    def __init__(self, url: str, cfg: EndpointConfig, troubles: Troubles | None = None) -> None:
        """
        Raises:
            TeacherError: it is no URL that can be asked, or holds a secret.
        """
        try:
            check_url(url)
        except ValueError as error:
            raise TeacherError(str(error)) from None
        self.url = self.where = base_url(url)
        self.cfg, self.model, self.troubles = cfg, "", troubles or Troubles()
        self.throttle = Throttle(cfg.concurrency)
        self.model_entry: dict[str, Any] = {}  # what the server's list says about the model
        self._is_schema_refused = not cfg.json_schema
        self._is_cut_told = False
        self._key = os.environ.get(KEY_VARIABLE, "")
        self._connections = Connections(self._key, timeout_s=cfg.timeout_s, most_bytes=int(MOST_REPLY_MB * 1e6))
        self._changed = asyncio.Condition()  # of the requests in flight
        self._jitter = random.Random()  # times of retries only: no product depends on it

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        await self._connections.close()

    # --- one answer ---

    async def answer(self, request: Request) -> Reply:
        """Send a request until it is answered.

        Raises:
            NoAnswer: not within the tries and the time that the settings allow, or the server refuses it.
            TeacherError: no request will get an answer.
        """
        attempt, deadline_s = 0, float("inf")
        while True:
            async with self._slot():
                given_s = time.monotonic()
                deadline_s = min(deadline_s, given_s + TOTAL_TIMEOUT_S)
                found = await self._attempt(request, given_s)
            if isinstance(found, Reply):
                self.troubles.answered()
                log.debug("%s: answered at try %d", self.where, attempt + 1)
                return found
            attempt += 1
            is_last = attempt >= self.cfg.max_tries
            pause_s = self._backoff_s(attempt - 1) if found.wait_s is None else found.wait_s
            is_late = not is_last and time.monotonic() + pause_s >= deadline_s
            if self.troubles.failed(found.detail):
                what = "given up" if is_last or is_late else "trying again"
                log.warning("%s: %s; %s, failed tries so far: %d", self.where, found.detail, what, self.troubles.num)
            if is_late:
                words = f"no answer within {TOTAL_TIMEOUT_S:g} s; the last: {found.detail}"
                raise NoAnswer("total_timeout", words)
            if is_last:
                raise NoAnswer(found.cause, found.detail)
            await asyncio.sleep(pause_s)

    @contextlib.asynccontextmanager
    async def _slot(self) -> AsyncIterator[None]:
        """Wait until one more request may be in flight, and hold its place."""
        async with self._changed:
            while not self.throttle.has_room():
                soonest_s = self.throttle.room_in_s()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(None if soonest_s == float("inf") else soonest_s):
                        await self._changed.wait()
            self.throttle.num_active += 1
        try:
            yield
        finally:
            async with self._changed:
                self.throttle.num_active -= 1
                self._changed.notify(max(int(self.throttle.limit) - self.throttle.num_active, 0))

    def _backoff_s(self, attempt: int) -> float:
        longest = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(attempt, 60))
        return self._jitter.uniform(0.5, 1.0) * longest

    async def send(self, payload: dict) -> Response:
        """Send one request once.

        Raises:
            TimeoutError, httpx.RequestError: as `exchange`.
        """
        return await self._connections.exchange(f"{self.url}/chat/completions", encode_body(payload))

    async def _attempt(self, request: Request, given_s: float) -> Reply | Failure:
        """Send a request once; where its schema is what the server refuses, at once again without it."""
        body = request_body(self.model, request)
        suspect: Refusal | None = None
        try:
            is_structured = not self._is_schema_refused
            shaped = {"response_format": response_format(request.schema)} if is_structured else {}
            response = await self.send(body | shaped)
            found = self.read(response, is_structured=is_structured)
            if is_structured and isinstance(found, Refusal) and found.kind == "schema":
                suspect = found
                response = await self.send(body)
                found = self.read(response, is_structured=False)
        except (TimeoutError, httpx.TimeoutException):
            self.throttle.failed()
            return Failure("timeout", f"no answer within {self.cfg.timeout_s:g} s")
        except httpx.RequestError as error:  # also a body that is not compressed as it claims
            self.throttle.failed()
            return Failure("connection", self.clean(f"{type(error).__name__} {error}"))
        if isinstance(found, str):
            return Failure("bad_reply", found)
        if isinstance(found, Refusal):
            return self._refused(found, given_s, response.retry_after_s)
        self.throttle.succeeded()
        if suspect is not None and not self._is_schema_refused:
            log.warning("%s: refuses a JSON schema (%s); asking without one", self.where, suspect.said)
            self._is_schema_refused = True
        return self._with_full_context(found, request)

    def _refused(self, refusal: Refusal, given_s: float, wait_s: float | None) -> Failure:
        """Return what a refusal is to the request: a failure of now, NoAnswer, or TeacherError where it is to all."""
        status = refusal.status
        if refusal.meaning.ends_run:
            raise self.error(refusal.meaning.what, got=refusal.said, fix=refusal.meaning.fix)
        if refusal.may_pass:
            # Where nobody can wait as long as that, this request is given up and the others are not held.
            is_long = wait_s is not None and wait_s > TOTAL_TIMEOUT_S
            if status in BUSY_STATUS:
                self.throttle.was_busy(given_s, None if is_long else wait_s)
            else:
                self.throttle.failed()
            asked = f" (asks to wait {wait_s:.0f} s)" if is_long else ""
            return Failure(f"http_{status}", refusal.said + asked, wait_s)
        if refusal.kind != "content":
            self.stop_if_fatal(refusal)
        raise NoAnswer(refusal.code, refusal.said, fix=refusal.meaning.fix, is_final=True)

    def _with_full_context(self, reply: Reply, request: Request) -> Reply:
        """Name an answer that was cut before `max_tokens`: prompt and answer fill the server's context.

        vLLM shortens `max_tokens` to what is left of the context, and says no more than "length".
        """
        most, usage = request.sampling.get("max_tokens"), reply.usage
        if reply.finish_reason != "length" or usage is None or type(most) is not int:
            return reply
        if not 0 < usage.completion_tokens < most or (self.context and usage.total < self.context - 1):
            return reply
        if not self._is_cut_told:
            self._is_cut_told = True
            what = f"an answer was cut after {usage.completion_tokens} of {most} tokens"
            log.warning("%s: %s: %s; %s", self.where, what, MEANINGS["too_long"].what, MEANINGS["too_long"].fix)
        return replace(reply, finish_reason=CONTEXT_FULL)

    @property
    def context(self) -> int | None:
        """Tokens that prompt and answer may have together, where the server's list of models says so."""
        length = self.model_entry.get("max_model_len")
        return length if type(length) is int else None

    # --- errors ---

    async def start(self) -> None:
        """Ask which models there are and find that of the settings among them.

        Raises:
            TeacherError: nobody answers; it refuses the key, does not speak the protocol, or lacks the model.
        """
        wanted = self.cfg.model
        try:
            response = await self._connections.exchange(f"{self.url}/models")
        except (TimeoutError, httpx.RequestError) as error:
            is_late = isinstance(error, TimeoutError | httpx.TimeoutException)
            why = f"no answer within {self.cfg.timeout_s:g} s" if is_late else f"{type(error).__name__} {error}"
            fix = "start the server or check its address"
            raise self.error("cannot reach the teacher", got=self.clean(why), fix=fix) from None
        if response.status in (401, 403):
            self.stop_if_fatal(self.refusal(response))
        entries = None if response.is_cut else read_models(response)
        if entries is None:
            if wanted:
                self.model = wanted  # some hosts list no models; the first request will tell
                return
            what = "no list of models here, so it may not be an OpenAI-compatible endpoint"
            raise self.error(what, got=self.refusal(response).said, fix="check the URL, or give --model")
        names = [entry["id"] for entry in entries]
        if wanted in names or (wanted is None and len(names) == 1):
            self.model = wanted or names[0]
            self.model_entry = entries[names.index(self.model)]
            return
        if not names:
            raise self.error("the endpoint lists no model by a name that can be asked for", fix="give --model")
        listed = ", ".join(names[:8])
        raise self.error(
            "the endpoint does not have this model" if wanted else "the endpoint has several models",
            got=wanted or f"{len(names)} models",
            expected=f"one of {listed}",
            fix="give --model",
        )

    def read(self, response: Response, *, is_structured: bool) -> Reply | Refusal | str:
        """Return what a response says: a reply, what it refuses (some servers do so with status 200), or a word on what
        is wrong with it."""
        if response.status != 200:
            return self.refusal(response)
        if response.is_cut:
            return f"longer than {MOST_REPLY_MB:g} MB"
        found = read_completion(response, "json_schema" if is_structured else "plain")
        if isinstance(found, Reply):
            return found
        kind = kind_of(200, found) if found.startswith(ERROR_INSTEAD) else "unknown"
        return self.clean(found) if kind == "unknown" else Refusal(200, kind, self.clean(found))

    def refusal(self, response: Response) -> Refusal:
        """Read what a response of another status than 200 refuses."""
        text = response.body.decode("utf-8", "replace")
        return Refusal(response.status, kind_of(response.status, text), self.detail(response))

    def stop_if_fatal(self, refusal: Refusal) -> None:
        """Raise for a status that would be every window's."""
        status, said = refusal.status, refusal.said
        if status in (401, 403):
            raise self.error("the teacher refuses the key", got=said, fix=f"set {KEY_VARIABLE}")
        if status == 404:
            raise self.error("no such model or not a chat endpoint", got=said, fix="check URL and model")
        if 300 <= status < 400 or status == 405:
            raise self.error("not a chat endpoint", got=said, fix="check the URL")

    def error(self, what: str, **parts: Any) -> TeacherError:
        return TeacherError(what, where=self.where, **parts)

    def detail(self, response: Response) -> str:
        """Return a server's error text, short and without the key."""
        try:
            text = error_words(read_body(response.body))
        except ValueError:
            text = response.body.decode("utf-8", "replace")  # whatever charset it claims
        return self.clean(text)

    def clean(self, text: str) -> str:
        """Cut a server's text short and take out what no line can hold, and the key, should the server echo it."""
        text = " ".join(text.split())
        if self._key:
            text = text.replace(self._key, "***")
        return "".join(character if character.isprintable() else "?" for character in text[:MOST_SAID])
