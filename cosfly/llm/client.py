"""Engine `endpoint`: a client for one server of chat completions.

The key comes from the environment variable COSFLY_API_KEY and is sent in the request header only.
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
from cosfly.llm.wire import KEY_VARIABLE, Connections, Response, base_url, check_url
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.model_json import CONTEXT_FULL

log = logging.getLogger(__name__)

TOTAL_TIMEOUT_S = 900.0  # limit of one answer with all its tries
STOP_AFTER_FAILURES = 20  # unanswered windows or samples in a row that end a run
BUSY_STATUS = frozenset({429, 503, 529})
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # after a failure: the pause doubles, with jitter
MOST_REPLY_MB = 4.0  # of one answer, uncompressed
MOST_ERROR_TEXT = 300  # characters of a server's error text that are kept


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
        default_factory=dict, description="further request fields, such as chat_template_kwargs; null removes a field"
    )

    def request(self, messages: list[dict], digests: list[str], schema: dict, seed: int) -> Request:
        """Return a request with these sampling settings."""
        sampling = {"temperature": self.temperature, "top_p": self.top_p, "max_tokens": self.max_tokens, "seed": seed}
        return Request(messages, digests, schema, self.with_extra(sampling))

    def with_extra(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of a request merged with `extra_body`; a null there removes a field."""
        return {name: value for name, value in (fields | self.extra_body).items() if value is not None}


class ConcurrencyLimit:
    """A limit on requests in flight: halved when the server is busy, raised by one per round of answers.

    A Retry-After holds back all requests, not only the one that received it.
    """

    def __init__(self, ceiling: int) -> None:
        self.ceiling, self.limit, self.num_active = ceiling, float(ceiling), 0
        self._held_until_s, self._decreased_s = 0.0, float("-inf")
        self._changed = asyncio.Condition()

    @contextlib.asynccontextmanager
    async def slot(self) -> AsyncIterator[None]:
        """Wait until one more request may be in flight, and hold its slot."""
        async with self._changed:
            while (hold_s := self._held_until_s - time.monotonic()) > 0 or self.num_active >= int(self.limit):
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(hold_s if hold_s > 0 else None):
                        await self._changed.wait()
            self.num_active += 1
        try:
            yield
        finally:
            async with self._changed:
                self.num_active -= 1
                self._changed.notify(max(int(self.limit) - self.num_active, 0))

    def succeeded(self) -> None:
        """Record an answer."""
        self.limit = min(float(self.ceiling), self.limit + 1.0 / self.limit)

    def was_busy(self, sent_s: float, retry_after_s: float | None) -> None:
        """Record that the server is overloaded. Requests sent before the last decrease do not count again."""
        now_s = time.monotonic()
        if sent_s >= self._decreased_s:
            self.limit, self._decreased_s = max(1.0, self.limit / 2.0), now_s
        if retry_after_s is not None:
            self._held_until_s = max(self._held_until_s, now_s + retry_after_s)


@dataclass(frozen=True)
class Failure:
    """A failed try that may be repeated. wait_s: the server's Retry-After; None: the client's own backoff applies."""

    cause: str
    detail: str
    wait_s: float | None = None


class ChatClient:
    """The engine `endpoint`: sends requests to one server, with retries and a limit on concurrency."""

    kind: Literal["endpoint"] = "endpoint"

    def __init__(self, url: str, cfg: EndpointConfig, troubles: Troubles | None = None) -> None:
        """
        Raises:
            TeacherError: The URL is invalid or contains a secret.
        """
        try:
            check_url(url)
        except ValueError as error:
            raise TeacherError(str(error)) from None
        self.url = self.where = base_url(url)
        self.cfg, self.model, self.troubles = cfg, "", troubles or Troubles()
        self.concurrency = ConcurrencyLimit(cfg.concurrency)
        self.model_entry: dict[str, Any] = {}  # the model's entry in the server's list of models
        self._is_schema_refused = not cfg.json_schema
        self._has_warned_of_context = False
        self._key = os.environ.get(KEY_VARIABLE, "")
        self._connections = Connections(self._key, timeout_s=cfg.timeout_s, most_bytes=int(MOST_REPLY_MB * 1e6))
        self._jitter = random.Random()  # of retry pauses only: no product depends on it

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        await self._connections.close()

    # --- one answer ---

    async def answer(self, request: Request) -> Reply:
        """Send a request until it is answered.

        Raises:
            NoAnswer: The tries or the time of the settings are used up, or the server refuses this request.
            TeacherError: No request will be answered.
        """
        attempt, deadline_s = 0, float("inf")
        while True:
            async with self.concurrency.slot():
                sent_s = time.monotonic()
                deadline_s = min(deadline_s, sent_s + TOTAL_TIMEOUT_S)
                found = await self._attempt(request, sent_s)
            if isinstance(found, Reply):
                self.troubles.answered()
                return found
            longest_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(attempt, 60))
            attempt += 1
            pause_s = self._jitter.uniform(0.5, 1.0) * longest_s if found.wait_s is None else found.wait_s
            is_last = attempt >= self.cfg.max_tries
            is_late = not is_last and time.monotonic() + pause_s >= deadline_s
            if self.troubles.failed(found.detail):
                action = "giving up" if is_last or is_late else "trying again"
                log.warning("%s: %s; %s, failed tries so far: %d", self.where, found.detail, action, self.troubles.num)
            if is_late:
                detail = f"no answer within {TOTAL_TIMEOUT_S:g} s; the last error: {found.detail}"
                raise NoAnswer("total_timeout", detail)
            if is_last:
                raise NoAnswer(found.cause, found.detail)
            await asyncio.sleep(pause_s)

    async def send(self, payload: dict) -> Response:
        """Send one request once; raises as `Connections.exchange`."""
        return await self._connections.exchange(f"{self.url}/chat/completions", encode_body(payload))

    async def _attempt(self, request: Request, sent_s: float) -> Reply | Failure:
        """Send a request once, and again without its schema if the server refuses the schema."""
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
            return Failure("timeout", f"no answer within {self.cfg.timeout_s:g} s")
        except httpx.RequestError as error:  # also a compressed body
            return Failure("connection", self.clean(f"{type(error).__name__} {error}"))
        if isinstance(found, str):
            return Failure("bad_reply", found)
        if isinstance(found, Refusal):
            return self._refused(found, sent_s, response.retry_after_s)
        self.concurrency.succeeded()
        if suspect is not None and not self._is_schema_refused:
            log.warning("%s: refuses a JSON schema (%s); asking without one", self.where, suspect.summary)
            self._is_schema_refused = True
        return self._with_full_context(found, request)

    def _refused(self, refusal: Refusal, sent_s: float, wait_s: float | None) -> Failure:
        """Return a refusal that may pass; raise NoAnswer for this request's, and TeacherError for every request's."""
        if refusal.meaning.ends_run:
            raise self._error(refusal.meaning.what, got=refusal.summary, fix=refusal.meaning.fix)
        if refusal.may_pass:
            is_long = wait_s is not None and wait_s > TOTAL_TIMEOUT_S  # gives up this request, holds no other
            if refusal.status in BUSY_STATUS:
                self.concurrency.was_busy(sent_s, None if is_long else wait_s)
            asked = f" (asks to wait {wait_s:.0f} s)" if is_long else ""
            return Failure(f"http_{refusal.status}", refusal.summary + asked, wait_s)
        if refusal.kind != "content":
            self._stop_if_fatal(refusal)
        raise NoAnswer(refusal.code, refusal.summary, fix=refusal.meaning.fix, is_final=True)

    def _with_full_context(self, reply: Reply, request: Request) -> Reply:
        """Mark an answer that the server cut before `max_tokens` because its context is full.

        vLLM shortens `max_tokens` to the rest of the context and reports only "length".
        """
        most, usage = request.sampling.get("max_tokens"), reply.usage
        if reply.finish_reason != "length" or usage is None or type(most) is not int:
            return reply
        if not 0 < usage.completion_tokens < most or (self.context and usage.total < self.context - 1):
            return reply
        if not self._has_warned_of_context:
            self._has_warned_of_context = True
            cut, meaning = f"an answer was cut after {usage.completion_tokens} of {most} tokens", MEANINGS["too_long"]
            log.warning("%s: %s: %s; %s", self.where, cut, meaning.what, meaning.fix)
        return replace(reply, finish_reason=CONTEXT_FULL)

    @property
    def context(self) -> int | None:
        """The most tokens of prompt and answer together, if the server's list of models gives it."""
        length = self.model_entry.get("max_model_len")
        return length if type(length) is int else None

    async def start(self) -> None:
        """Read the server's list of models and choose the one of the settings.

        Raises:
            TeacherError: The server does not answer, refuses the key, is no chat endpoint, or lacks the model.
        """
        wanted = self.cfg.model
        try:
            response = await self._connections.exchange(f"{self.url}/models")
        except (TimeoutError, httpx.RequestError) as error:
            is_late = isinstance(error, TimeoutError | httpx.TimeoutException)
            why = f"no answer within {self.cfg.timeout_s:g} s" if is_late else f"{type(error).__name__} {error}"
            fix = "start the server or check its address"
            raise self._error("cannot reach the teacher", got=self.clean(why), fix=fix) from None
        if response.status in (401, 403):
            self._stop_if_fatal(self.refusal(response))
        entries = None if response.is_cut else read_models(response)
        if entries is None:
            if wanted:
                self.model = wanted  # some hosts list no models; the first request shows whether it exists
                return
            what = "the server returns no list of models, so it may not be an OpenAI-compatible endpoint"
            raise self._error(what, got=self.refusal(response).summary, fix="check the URL, or set --model")
        names = [entry["id"] for entry in entries]
        if wanted in names or (wanted is None and len(names) == 1):
            self.model = wanted or names[0]
            self.model_entry = entries[names.index(self.model)]
            return
        if not names:
            raise self._error("the endpoint lists no model with a usable name", fix="set --model")
        raise self._error(
            "the endpoint does not have this model" if wanted else "the endpoint has several models",
            got=wanted or f"{len(names)} models",
            expected=f"one of {', '.join(names[:8])}",
            fix="set --model",
        )

    # --- responses ---

    def read(self, response: Response, *, is_structured: bool) -> Reply | Refusal | str:
        """Return the reply of a response, the refusal in it (some servers send it with status 200), or what is wrong
        with it."""
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
        """Return the refusal in a response whose status is not 200."""
        text = response.body.decode("utf-8", "replace")  # whatever charset it claims
        try:
            message = error_words(read_body(response.body))
        except ValueError:
            message = text
        return Refusal(response.status, kind_of(response.status, text), self.clean(message))

    def _stop_if_fatal(self, refusal: Refusal) -> None:
        """Raise for a status that every request would get."""
        status, got = refusal.status, refusal.summary
        if status in (401, 403):
            raise self._error("the teacher refuses the key", got=got, fix=f"set {KEY_VARIABLE}")
        if status == 404:
            raise self._error("no such model or not a chat endpoint", got=got, fix="check URL and model")
        if 300 <= status < 400 or status == 405:
            raise self._error("not a chat endpoint", got=got, fix="check the URL")

    def _error(self, what: str, **parts: Any) -> TeacherError:
        return TeacherError(what, where=self.where, **parts)

    def clean(self, text: str) -> str:
        """Return a server's text in one short printable line, without the key if the server echoes it."""
        text = " ".join(text.split())
        if self._key:
            text = text.replace(self._key, "***")
        return "".join(character if character.isprintable() else "?" for character in text[:MOST_ERROR_TEXT])
