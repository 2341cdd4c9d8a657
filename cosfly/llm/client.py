"""Engine `endpoint`: a client for one server of chat completions, with bounds on the time and memory of each request.

The key comes from the environment variable COSFLY_API_KEY and is sent in the request header only.
"""

import asyncio
import contextlib
import functools
import logging
import math
import os
import random
import re
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import replace
from typing import Any, ClassVar, Literal

import httpx
from pydantic import Field

from cosfly.llm import protocol
from cosfly.llm.contract import NoAnswer, Reply, Request
from cosfly.llm.protocol import KEY_VARIABLE, MEANINGS, BadReply, Kind, Meaning, Refusal, Response
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.model_json import CONTEXT_FULL

log = logging.getLogger(__name__)

SECONDS_BETWEEN_WARNINGS = 10.0
TOTAL_TIMEOUT_S = 900.0  # limit of one answer with all its tries
BUSY_STATUS = frozenset({429, 503, 529})
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # the pause after a failed try doubles in this range, with jitter
LOADING, LOADING_PAUSE_S = "loading", 5.0  # a server that loads its model is waited for; this is no failed try
FIRST_LIMIT = 2  # requests in flight until the first answer: a small server answers one after the other
HEADROOM = 1 / 3  # more requests are sent while answers take less than this share of the time limit
# A server cuts prompts if NUM_EQUAL_PROMPTS token counts in a row are equal, though the texts differ by LEAST_SPREAD
# characters. A few digits may differ: many tokenizers make one token of up to three digits.
NUM_EQUAL_PROMPTS, LEAST_SPREAD = 8, 50
MOST_REPLY_MB = 4.0  # of one answer, uncompressed
MOST_ERROR_TEXT = 300  # characters of a server's error text; the rest is dropped
HEADERS = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
RETRY_AFTER = re.compile(r"[0-9]{1,20}(\.[0-9]*)?(e[0-9]{1,2})?")  # in seconds
LEFT_OUT: dict[Kind, str] = {
    "schema": "the server refuses a JSON schema (%s); requests are sent without one",
    "no_system": "the server has no system role (%s); the instructions are sent with the question",
}
_tls = functools.cache(httpx.create_ssl_context)  # certificates are read once: it takes longer than a request


class EndpointConfig(Config):
    """Sampling and limits of requests to a server."""

    # Messages name the settings of `caption.endpoint`. A subclass lists the names of its own settings for them.
    own_names: ClassVar[dict[str, str]] = {" or distill.prepare.modalities=[]": ""}
    model: str | None = Field(None, description="name of the model; empty: the endpoint's only model")
    temperature: float = Field(0.6, ge=0, le=2, description="sampling temperature; 0 is greedy")
    top_p: ClassVar[float] = 0.95  # nucleus sampling; extra_body may set another
    max_tokens: int = Field(1024, ge=64, description="longest answer, tokens")
    concurrency: MayDiffer[int] = Field(
        16, ge=1, le=4096, description="most requests in flight; fewer while the server is busy"
    )
    timeout_s: MayDiffer[float] = Field(
        120.0, gt=0, description="time limit of one request, from first to last byte, s"
    )
    max_tries: MayDiffer[int] = Field(
        6, ge=1, description="most attempts at one request if the server is busy or fails"
    )
    json_schema: bool = Field(True, description="ask the server to enforce the answer's JSON schema")
    extra_body: dict[str, Any] = Field(
        {}, description="further fields of a request, such as chat_template_kwargs; a null value removes one"
    )

    def request(self, messages: list[dict], digests: list[str], schema: dict, seed: int) -> Request:
        """Return a request with these sampling settings; a null in `extra_body` removes a field."""
        sampling = {"temperature": self.temperature, "top_p": self.top_p, "max_tokens": self.max_tokens, "seed": seed}
        fields = {name: value for name, value in (sampling | self.extra_body).items() if value is not None}
        return Request(messages, digests, schema, fields)


class ConcurrencyLimit:
    """A limit on requests in flight, which finds what a server can take.

    - It begins low and is raised by one per answer, so that it doubles per round of answers, until the server is busy
      for the first time. Then it is halved, and raised by one per round. A server that is busy at FIRST_LIMIT is
      starting, so this does not count as the first time.
    - It is not raised while answers are slow: a server with one slot answers no sooner if more requests wait in its
      queue, and they would time out there.
    - A Retry-After holds back all requests, not only the one that received it.
    """

    def __init__(self, ceiling: int) -> None:
        self.ceiling = ceiling
        self.limit = float(min(ceiling, FIRST_LIMIT))
        self.num_active = 0
        self._doubles = True
        self._held_until_s = 0.0  # of a Retry-After
        self._decreased_s = -math.inf  # time of the last decrease
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

    def succeeded(self, is_quick: bool) -> None:
        """Record an answer; a slow one does not raise the limit."""
        if is_quick:
            increase = 1.0 if self._doubles else 1.0 / self.limit
            self.limit = min(float(self.ceiling), self.limit + increase)

    def was_busy(self, sent_s: float, retry_after_s: float | None) -> None:
        """Record that the server is overloaded. Requests sent before the last decrease do not count again."""
        now_s = time.monotonic()
        if sent_s >= self._decreased_s:
            self._doubles = self._doubles and self.limit <= FIRST_LIMIT
            self.limit = max(1.0, self.limit / 2.0)
            self._decreased_s = now_s
        if retry_after_s is not None:
            self._held_until_s = max(self._held_until_s, now_s + retry_after_s)


class ChatClient:
    """The engine `endpoint`: sends requests to one server, with retries and a limit on concurrency."""

    kind: Literal["endpoint"] = "endpoint"

    def __init__(self, url: str, cfg: EndpointConfig) -> None:
        """Raise TeacherError if the URL is invalid or contains a secret, or the key or the proxy cannot be used."""
        try:
            protocol.check_url(url)
        except ValueError as error:
            raise TeacherError(str(error)) from None
        self.url = protocol.base_url(url)
        self.where = self.url  # for messages
        self.cfg = cfg
        self.model = ""  # known after `start`
        self.num_failed = 0  # tries
        self._warned_s = -math.inf  # time of the last report of a failed try
        self.concurrency = ConcurrencyLimit(cfg.concurrency)
        self.context: int | None = None  # most tokens of prompt and answer together, if the server reports it
        self.left_out: dict[Kind, Refusal] = {}  # what requests are sent without, and the refusals that say why
        self._logged_topics = set[str]()  # by `_log_once`
        self._prompt_sizes: dict[int, deque[tuple[int, int]]] = {}  # by pictures: (tokens, characters) of the last
        self._key = os.environ.get(KEY_VARIABLE, "")
        if not (self._key.isascii() and self._key.isprintable()):  # an error of httpx would quote it
            what = "the API key contains a character that an HTTP header must not contain, such as a line break"
            raise TeacherError(what, where=KEY_VARIABLE, fix="set this environment variable to the key alone")
        self._free = [self._connect()]
        self._jitter = random.Random()  # for retry pauses only: no product depends on it

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        for connection in self._free:
            await connection.aclose()

    # --- one answer ---

    async def answer(self, request: Request) -> Reply:
        """Send a request until it is answered.

        NoAnswer: The tries or the time are used up, or the server refuses it. TeacherError: All requests will fail.
        """
        num_tries = 0
        longest_pause_s = FIRST_PAUSE_S
        deadline_s = math.inf  # set when the first try has a slot
        while True:
            try:
                async with self.concurrency.slot():
                    sent_s = time.monotonic()
                    deadline_s = min(deadline_s, sent_s + TOTAL_TIMEOUT_S)
                    return await self._try(request, sent_s)
            except NoAnswer as error:
                if error.is_final:
                    raise
                failure = error
            pause_s = self._jitter.uniform(0.5, 1.0) * longest_pause_s if failure.wait_s is None else failure.wait_s
            if failure.cause != LOADING:
                num_tries += 1
                longest_pause_s = min(LONGEST_PAUSE_S, 2.0 * longest_pause_s)
            is_last = num_tries >= self.cfg.max_tries
            is_late = time.monotonic() + pause_s >= deadline_s
            self._warn(failure.detail, "giving up" if is_last or is_late else "trying again")
            if is_last:
                raise failure
            if is_late:
                detail = f"no answer within {TOTAL_TIMEOUT_S:g} s; the last error: {failure.detail}"
                raise NoAnswer("total_timeout", detail)
            await asyncio.sleep(pause_s)

    async def _try(self, request: Request, sent_s: float) -> Reply:
        """Try once to get the answer of a request; NoAnswer fails this try, TeacherError all requests."""
        self._log_once("sent", logging.INFO, f"the first request is sent, with a limit of {self.cfg.timeout_s:g} s")
        try:
            reply = await self.ask(request)
        except (TimeoutError, httpx.RequestError) as error:  # also a compressed body
            is_late = isinstance(error, TimeoutError | httpx.TimeoutException)
            if is_late:  # requests that wait in the server's queue time out, and would wait behind themselves
                self.concurrency.was_busy(sent_s, None)
            raise NoAnswer("timeout" if is_late else "connection", self.message_of(error)) from None
        except BadReply as error:
            raise NoAnswer("bad_reply", str(error)) from None
        except Refusal as refusal:
            raise self._refused(refusal, sent_s) from None
        self._adapt_limit(time.monotonic() - sent_s)
        self._watch_prompts(reply, request)
        return self._with_full_context(reply, request)

    def _adapt_limit(self, seconds: float) -> None:
        """Raise the limit on requests in flight after an answer, unless it took long."""
        is_quick = seconds < HEADROOM * self.cfg.timeout_s
        self.concurrency.succeeded(is_quick)
        num_at_once = int(self.concurrency.limit)
        if not is_quick and num_at_once < self.cfg.concurrency:
            limit = f"at most {num_at_once} requests are sent at once until answers take less than a third of "
            limit += self._named("caption.endpoint.timeout_s; raise it if the server can answer more requests at once")
            self._log_once("slow", logging.INFO, f"an answer took {seconds:.0f} s, so {limit}")

    async def ask(self, request: Request, on_send: Callable[[], None] = lambda: None) -> Reply:
        """Send a request once, and again without what the server refuses of it: a schema, a system role.

        Args:
            on_send: Called before each of them is sent.

        Raises:
            Refusal: The server refuses the request.
            BadReply: The response holds no reply.
            TimeoutError, httpx.TimeoutException: The response was not complete in time.
            httpx.RequestError: The connection failed, or the body is compressed.
        """
        refused: dict[Kind, Refusal] = {}  # of this request; a filter that echoes it may read as a refused schema
        while True:
            left_out = self.left_out | refused
            with_schema = self.cfg.json_schema and bool(request.schema) and "schema" not in left_out
            with_system = "no_system" not in left_out
            body = protocol.request_body(self.model, request, with_schema=with_schema, with_system=with_system)
            on_send()
            response = await self._exchange("chat/completions", body)
            try:
                reply = protocol.read_completion(response, "json_schema" if with_schema else "plain")
            except BadReply as error:
                raise BadReply(self._clean(str(error))) from None
            except Refusal as refusal:
                refusal.message = self._clean(refusal.message)
                has_system = with_system and request.messages[0]["role"] == "system"
                may_omit = {"schema": with_schema, "no_system": has_system}.get(refusal.kind, False)
                if not may_omit:
                    if refusal.kind == "pictures":
                        refusal.message += f" (the request has {len(body) / 1e6:.1f} MB)"
                    raise
                refused[refusal.kind] = refusal
            else:
                for kind, cause in refused.items():  # the answer shows that the server refuses it of all requests
                    self.left_out[kind] = cause
                    self._log_once(kind, logging.WARNING, LEFT_OUT[kind] % cause)
                return reply

    def _log_once(self, topic: str, level: int, message: str) -> None:
        """Write the first line about a topic to the log."""
        if topic not in self._logged_topics:
            self._logged_topics.add(topic)
            log.log(level, "%s: %s", self.where, message)

    def _warn(self, detail: str, action: str) -> None:
        """Write a line about a failed try to the log, unless the last one is younger than SECONDS_BETWEEN_WARNINGS."""
        self.num_failed += 1
        if time.monotonic() - self._warned_s >= SECONDS_BETWEEN_WARNINGS:
            self._warned_s = time.monotonic()
            log.warning("%s: %s; %s, failed attempts so far: %d", self.where, detail, action, self.num_failed)

    def _refused(self, refusal: Refusal, sent_s: float) -> NoAnswer | TeacherError:
        """Return the error of a refused request: NoAnswer for this try or this request, TeacherError for all."""
        if refusal.meaning.ends_run:
            return self._error(refusal.meaning.what, got=str(refusal), fix=self.fix_of(refusal.meaning))
        if not refusal.may_pass:
            return NoAnswer(refusal.code, str(refusal), fix=self.fix_of(refusal.meaning), is_final=True)
        if refusal.is_loading:
            return NoAnswer(LOADING, str(refusal), wait_s=LOADING_PAUSE_S)
        wait_s = refusal.wait_s
        is_long = wait_s is not None and wait_s > TOTAL_TIMEOUT_S  # ends this request, but does not delay the others
        if refusal.status in BUSY_STATUS:
            self.concurrency.was_busy(sent_s, None if is_long else wait_s)
        asked = f" (the server asks to wait {wait_s:.0f} s)" if is_long else ""
        return NoAnswer(f"http_{refusal.status}", f"{refusal}{asked}", wait_s=wait_s)

    def _with_full_context(self, reply: Reply, request: Request) -> Reply:
        """Mark an answer that the server cut before `max_tokens` because its context is full.

        vLLM shortens `max_tokens` to the rest of the context and reports only "length".
        """
        most = request.sampling.get("max_tokens")
        usage = reply.usage
        if reply.finish_reason != "length" or type(most) is not int or usage is None:
            return reply
        is_short = 0 < usage.completion_tokens < most
        if not is_short or (self.context and usage.total < self.context - 1):
            return reply
        problem = f"an answer was cut after {usage.completion_tokens} of {most} tokens"
        meaning = MEANINGS["too_long"]
        self._log_once("context", logging.WARNING, f"{problem}: {meaning.what}; {self.fix_of(meaning)}")
        return replace(reply, finish_reason=CONTEXT_FULL)

    def _watch_prompts(self, reply: Reply, request: Request) -> None:
        """Warn once if prompts of different lengths all count the same tokens: the server cuts them."""
        if reply.usage is None:
            return
        texts: list[str] = []
        for message in request.messages:
            content = message["content"]
            texts += [content] if isinstance(content, str) else [part.get("text", "") for part in content]
        sizes = self._prompt_sizes.setdefault(len(request.digests), deque(maxlen=NUM_EQUAL_PROMPTS))
        sizes.append((reply.usage.prompt_tokens, sum(map(len, texts))))
        token_counts, lengths = zip(*sizes, strict=True)
        are_equal = len(sizes) == NUM_EQUAL_PROMPTS and len(set(token_counts)) == 1
        if are_equal and max(lengths) - min(lengths) >= LEAST_SPREAD:
            count = reply.usage.prompt_tokens
            problem = f"{len(sizes)} prompts of different lengths all count {count} tokens: the server drops the rest"
            self._log_once("cuts", logging.WARNING, f"{problem}; {self.fix_of(MEANINGS['too_long'])}")

    # --- the model ---

    async def start(self) -> None:
        """Read the server's list of models and choose the one of the settings; TeacherError if that fails."""
        response, refusal = await self._list_models()
        if response.status in (401, 403):
            meaning = refusal.meaning if refusal.meaning.ends_run else protocol.KEY
            raise self._error(meaning.what, got=str(refusal), fix=self.fix_of(meaning))
        models = protocol.read_models(response)
        if models == {}:
            raise self._error("the endpoint lists no model with a usable name", fix="pass --model")
        if self.cfg.model:
            if models is not None and self.cfg.model not in models:
                raise self._no_choice("the endpoint does not have this model", self.cfg.model, models)
            self.model = self.cfg.model  # of a host without a list, the first request shows whether it exists
        elif models is None:
            what = "the server does not return a list of models, so it may not be an OpenAI-compatible endpoint"
            raise self._error(what, got=str(refusal), fix="correct the URL, or pass --model")
        elif len(models) > 1:
            raise self._no_choice("the endpoint has several models", f"{len(models)} models", models)
        else:
            [self.model] = models
        if models is not None:
            self.context = models[self.model]

    def _no_choice(self, what: str, got: str, models: Iterable[str]) -> TeacherError:
        return self._error(what, got=got, expected=f"one of {', '.join(list(models)[:8])}", fix="pass --model")

    async def _list_models(self) -> tuple[Response, Refusal]:
        """Return the response with the models, once the server has loaded one, and the refusal that it may be."""
        deadline_s = time.monotonic() + TOTAL_TIMEOUT_S
        while True:
            try:
                response = await self._exchange("models")
            except (TimeoutError, httpx.RequestError) as error:
                fix = "start the server, or correct its address"
                raise self._error("cannot reach the server", got=self.message_of(error), fix=fix) from None
            refusal = protocol.read_refusal(response)
            refusal.message = self._clean(refusal.message)
            if response.status == 200 or not refusal.is_loading or time.monotonic() > deadline_s:
                return response, refusal
            self._warn(str(refusal), "waiting for the server")
            await asyncio.sleep(LOADING_PAUSE_S)

    # --- messages ---

    def fix_of(self, meaning: Meaning) -> str:
        """Return the fix of a refusal, with the names of the settings of this client."""
        return self._named(meaning.fix)

    def _named(self, text: str) -> str:
        """Return a message with the names of the settings of this client."""
        for name, own_name in self.cfg.own_names.items():
            text = text.replace(name, own_name)
        return text

    def _error(self, what: str, **parts: Any) -> TeacherError:
        return TeacherError(what, where=self.where, **parts)

    def message_of(self, error: Exception) -> str:
        """Return the message of an exchange that failed."""
        if isinstance(error, TimeoutError | httpx.TimeoutException):
            limit = self._named(f"caption.endpoint.timeout_s={2 * self.cfg.timeout_s:g}")
            fix = f"raise the limit, such as {limit}, or use a faster server, a smaller model or shorter prompts"
            return f"no answer within {self.cfg.timeout_s:g} s; {fix}"
        return self._clean(f"{type(error).__name__} {error}")

    def _clean(self, text: str) -> str:
        """Return a server's text in one short printable line, without the key if the server echoes it."""
        text = " ".join(text.split())
        if self._key:
            text = text.replace(self._key, "***")
        return "".join(character if character.isprintable() else "?" for character in text[:MOST_ERROR_TEXT])

    # --- connections ---
    # Each request in flight has a client of its own with one connection: for every request httpx searches its pool, and
    # with 64 connections that takes longer than sending fifteen pictures.

    async def _exchange(self, path: str, content: bytes | None = None) -> Response:
        """Send one request, a POST if it has content, and read the response. Redirects are not followed."""
        method = "GET" if content is None else "POST"
        body = bytearray()
        most_bytes = int(MOST_REPLY_MB * 1e6)
        connection = self._free.pop() if self._free else self._connect()
        try:
            async with (
                asyncio.timeout(self.cfg.timeout_s) as limit,
                connection.stream(method, f"{self.url}/{path}", content=content, headers=HEADERS) as response,
            ):
                encoding = response.headers.get("content-encoding", "identity")
                if encoding.strip().lower() not in ("", "identity"):
                    raise httpx.DecodingError(
                        f"the response is compressed ({encoding[:40]!r}); turn compression off in the server or proxy"
                    )
                if response.headers.get("content-type", "").startswith("text/event-stream"):
                    # The time limit is for the answer, which begins now.
                    limit.reschedule(asyncio.get_running_loop().time() + self.cfg.timeout_s)
                async for piece in response.aiter_raw():
                    body += piece
                    if len(body) > most_bytes:  # the rest stays unread, and the connection is closed
                        break
                wait = response.headers.get("retry-after", "").strip()
                wait_s = float(wait) if RETRY_AFTER.fullmatch(wait) else None
                return Response(response.status_code, bytes(body[:most_bytes]), len(body) > most_bytes, wait_s)
        except (httpx.InvalidURL, UnicodeError) as error:  # also for the address of a redirect
            raise httpx.UnsupportedProtocol(f"invalid address: {type(error).__name__}") from None
        finally:
            self._free.append(connection)

    def _connect(self) -> httpx.AsyncClient:
        headers = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        limits = httpx.Limits(max_connections=1, max_keepalive_connections=1)
        try:
            return httpx.AsyncClient(headers=headers, timeout=self.cfg.timeout_s, limits=limits, verify=_tls())
        except (httpx.InvalidURL, ValueError, ImportError, OSError) as error:
            raise TeacherError(
                "the proxy or the TLS certificates in the environment variables cannot be used",
                where="HTTPS_PROXY, ALL_PROXY, SSL_CERT_FILE",
                got=type(error).__name__,
                fix="correct these environment variables, or unset them",
            ) from None
