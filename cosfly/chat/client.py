"""One chat-completions server: what is sent to it, and what its answers mean. `servers` asks it, and others beside it.

The key comes from the environment variable COSFLY_API_KEY and goes into the request header only.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from typing import Any

import httpx
from pydantic import Field

from cosfly.chat.contract import NoAnswer, Reply, Request
from cosfly.chat.protocol import (
    ERROR_INSTEAD,
    base_url,
    check_url,
    encode_body,
    error_words,
    read_body,
    read_completion,
    read_models,
    request_body,
    response_format,
)
from cosfly.chat.refusals import MEANINGS, Refusal, kind_of
from cosfly.chat.throttle import Throttle
from cosfly.chat.wire import KEY_VARIABLE, Connections, Response
from cosfly.errors import TeacherError
from cosfly.reading.objects import CONTEXT_FULL
from cosfly.work.config import Config, MayDiffer

log = logging.getLogger(__name__)

BUSY_STATUS = frozenset({429, 503, 529})
MOST_SAID = 300  # characters of a server's words that are kept
SCHEMA_DOUBTS = 3  # refusals in words that the table does not know
POISONED = "after a prompt that was too long vLLM answers so to any with the same pictures, its issue 43941: restart it"


class EndpointConfig(Config):
    model: str | None = Field(None, description="model name; empty takes the endpoint's only model")
    temperature: float = Field(0.6, ge=0, le=2, description="sampling temperature; 0 is greedy")
    top_p: float = Field(0.95, gt=0, le=1, description="nucleus sampling")
    max_tokens: int = Field(1024, ge=64, description="longest answer, tokens")
    concurrency: MayDiffer[int] = Field(
        16, ge=1, le=4096, description="most requests in flight at each server; fewer while it says it is busy"
    )
    timeout_s: MayDiffer[float] = Field(
        120.0, gt=0, description="limit of one request, from its first byte to its last"
    )
    total_timeout_s: MayDiffer[float] = Field(
        900.0, gt=0, description="limit of one answer with all its tries, from the first request on"
    )
    max_tries: MayDiffer[int] = Field(6, ge=1, description="tries of one request when the server is busy or fails")
    backoff_s: MayDiffer[float] = Field(1.0, gt=0, description="first wait after a failure; doubles, with jitter")
    max_backoff_s: MayDiffer[float] = Field(60.0, gt=0, description="longest wait between two tries")
    max_reply_mb: MayDiffer[float] = Field(
        4.0, gt=0, le=1000, description="longest answer of the server as it is read, unpacked, megabytes"
    )
    stop_after_failures: MayDiffer[int] = Field(
        20, ge=1, description="windows in a row without an answer that end the run"
    )
    json_schema: bool = Field(True, description="ask the server to enforce the answer's JSON schema")
    image_uuid: MayDiffer[bool] = Field(
        False, description="send a digest as `uuid` with each image, for servers (vLLM) that cache images by it"
    )
    extra_body: dict[str, Any] = Field(
        default_factory=dict,
        description="further fields of the request, for instance chat_template_kwargs; null leaves one of the others "
        "out",
    )

    def request(self, messages: list[dict], digests: list[str], schema: dict, seed: int) -> Request:
        """Give a conversation as these settings sample it."""
        sampling = {"temperature": self.temperature, "top_p": self.top_p, "max_tokens": self.max_tokens, "seed": seed}
        return Request(messages, digests, schema, self.with_extra(sampling))

    def with_extra(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Give fields of a request with `extra_body`; a null there leaves one out."""
        return {name: value for name, value in (fields | self.extra_body).items() if value is not None}


@dataclass(frozen=True)
class Failure:
    """A try that may go better next time; wait_s: as the server says, None: as the settings do."""

    cause: str
    detail: str
    wait_s: float | None = None


@dataclass
class Ask:
    """A request and what its tries have shown. suspect: the refusal that its schema may be the cause of."""

    request: Request
    body: dict[str, Any]
    suspect: Refusal | None = None
    is_structured: bool = False

    @property
    def payload(self) -> dict[str, Any]:
        return self.body | ({"response_format": response_format(self.request.schema)} if self.is_structured else {})


class Unreachable(TeacherError):
    """Nobody answers at an address."""


class ChatServer:
    """Sends requests to one server, each once."""

    def __init__(self, url: str, cfg: EndpointConfig) -> None:
        """"""
        try:
            check_url(url)
        except ValueError as error:
            raise TeacherError(str(error)) from None
        self.url = self.where = base_url(url)
        self.cfg, self.model = cfg, ""
        self.throttle = Throttle(cfg.concurrency)
        self.model_entry: dict[str, Any] = {}  # what the server's list says about the model
        self._is_schema_refused = not cfg.json_schema
        self._num_doubts = 0  # refusals in a row that went away without the schema
        self._was_too_long = False
        self._warned: set[str] = set()
        self._key = os.environ.get(KEY_VARIABLE, "")
        most_bytes = int(cfg.max_reply_mb * 1e6)
        self._connections = Connections(self._key, timeout_s=cfg.timeout_s, most_bytes=most_bytes)

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        await self._connections.close()

    # --- one answer ---

    async def send(self, payload: dict) -> Response:
        """Send one request once.

        Raises:
            TimeoutError, httpx.RequestError: as `exchange`.
        """
        return await self._connections.exchange(f"{self.url}/chat/completions", encode_body(payload))

    def ask_of(self, request: Request) -> Ask:
        """Give a request as it is sent to this server."""
        return Ask(request, request_body(self.model, request, with_ids=self.cfg.image_uuid))

    async def attempt(self, ask: Ask, given_s: float) -> Reply | Failure:
        """Send a request once; where its schema may be what the server refuses, at once again without it.

        Args:
            given_s: when it was let through, by the throttle's clock.
        Raises:
            NoAnswer: the server refuses this request. TeacherError: it would refuse any.
        """
        try:
            # Another answer may have told meanwhile.
            ask.is_structured = not (self._is_schema_refused or ask.suspect)
            response = await self.send(ask.payload)
            found = self.read(response, ask.request, is_structured=ask.is_structured)
            if ask.is_structured and isinstance(found, Refusal) and found.may_be_schema:
                ask.suspect, ask.is_structured = found, False
                response = await self.send(ask.payload)
                found = self.read(response, ask.request, is_structured=False)
        except (TimeoutError, httpx.TimeoutException):
            self.throttle.failed()
            return Failure("timeout", f"no answer within {self.cfg.timeout_s:g} s")
        except httpx.RequestError as error:  # also a body that is not compressed as it claims
            self.throttle.failed()
            return Failure("connection", self.clean(f"{type(error).__name__} {error}"))
        if isinstance(found, str):
            return Failure("bad_reply", found)
        if isinstance(found, Refusal):
            return self._refused(found, ask, given_s, response.retry_after_s)
        self.throttle.succeeded()
        self._judge_schema(ask)
        self._warn_of_oddities(found)
        return self._with_full_context(found, ask.request)

    def _refused(self, refusal: Refusal, ask: Ask, given_s: float, wait_s: float | None = None) -> Failure:
        """Tell what a refusal means; wait_s: as the server says."""
        status = refusal.status
        if refusal.meaning.ends_run:
            raise self.error(refusal.meaning.what, got=refusal.said, fix=refusal.meaning.fix)
        if refusal.may_pass:
            # Where nobody can wait as long as that, this request is given up and the others are not held.
            is_long = wait_s is not None and wait_s > self.cfg.total_timeout_s
            if status in BUSY_STATUS:
                self.throttle.was_busy(given_s, None if is_long else wait_s)
            else:
                self.throttle.failed()
            poisoned = f" ({POISONED})" if status == 500 and self._was_too_long and ask.request.digests else ""
            asked = f" (asks to wait {wait_s:.0f} s)" if is_long else ""
            return Failure(f"http_{status}", refusal.said + asked + poisoned, wait_s)
        if refusal.kind != "content":
            self.stop_if_fatal(refusal)
        self._was_too_long |= refusal.kind == "too_long"
        raise NoAnswer(refusal.code, refusal.said, fix=refusal.meaning.fix, is_final=True)

    def _judge_schema(self, ask: Ask) -> None:
        """Learn from an answer whether the schema is what was refused: only a request that is answered without it
        tells.

        One refusal is enough where the server names the schema. Where the table does not know its words it takes
        SCHEMA_DOUBTS, with no answer to a schema between them.
        """
        if ask.is_structured:
            self._num_doubts = 0
        elif ask.suspect is not None and not self._is_schema_refused:
            self._num_doubts += SCHEMA_DOUBTS if ask.suspect.kind == "schema" else 1
            if self._num_doubts >= SCHEMA_DOUBTS:
                log.warning("%s: refuses a JSON schema (%s); asking without one", self.where, ask.suspect.said)
                self._is_schema_refused = True

    def _with_full_context(self, reply: Reply, request: Request) -> Reply:
        """Name an answer that was cut before `max_tokens`: prompt and answer fill the server's context.

        vLLM shortens `max_tokens` to what is left of the context, and says no more than "length".
        """
        most, usage = request.sampling.get("max_tokens"), reply.usage
        if reply.finish_reason != "length" or usage is None or reply.counted or type(most) is not int:
            return reply
        if not 0 < usage.completion_tokens < most or (self.context and usage.total < self.context - 1):
            return reply
        what = f"an answer was cut after {usage.completion_tokens} of {most} tokens"
        self._warn_once("cut", f"{what}: {MEANINGS['too_long'].what}; {MEANINGS['too_long'].fix}")
        return replace(reply, finish_reason=CONTEXT_FULL)

    def _warn_of_oddities(self, reply: Reply) -> None:
        """Say once of a run what is odd about its server's answers and no fault of any."""
        if reply.counted:
            self._warn_once("count", f"its count of {' and '.join(reply.counted)} cannot be, so they are counted here")
        if reply.model is not None and not _are_alike(reply.model, self.model):
            self._warn_once("model", f"asked for the model {self.model}, and says that {reply.model} answered")

    def _warn_once(self, oddity: str, words: str) -> None:
        if oddity not in self._warned:
            self._warned.add(oddity)
            log.warning("%s: %s", self.where, words)

    @property
    def context(self) -> int | None:
        """Tokens that prompt and answer may have together, where the server's list of models says so."""
        length = self.model_entry.get("max_model_len")
        return length if type(length) is int else None

    # --- errors ---

    async def start(self, wanted: str | None = None) -> None:
        """Ask which models there are and find ours among them: `wanted`, else that of the settings.

        Raises:
            Unreachable: nobody answers, or not yet again.
            TeacherError: it refuses the key, does not speak the protocol, or lacks the model.
        """
        wanted, entries = wanted or self.cfg.model, await self.models()
        if isinstance(entries, Refusal):
            if self.model_entry and entries.may_pass:
                raise Unreachable("lists no models now", where=self.where, got=entries.said)
            if wanted:
                self.model = wanted  # some hosts list no models; the first request will tell
                return
            what = "no list of models here, so it may not be an OpenAI-compatible endpoint"
            raise self.error(what, got=entries.said, fix="check the URL, or give --model")
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

    async def models(self) -> list[dict[str, Any]] | Refusal:
        """Ask which models there are; gives what is said in place of a list."""
        try:
            response = await self._connections.exchange(f"{self.url}/models")
        except (TimeoutError, httpx.RequestError) as error:
            is_late = isinstance(error, TimeoutError | httpx.TimeoutException)
            why = f"no answer within {self.cfg.timeout_s:g} s" if is_late else f"{type(error).__name__} {error}"
            fix = "start the server or check its address"
            raise Unreachable("cannot reach the teacher", where=self.where, got=self.clean(why), fix=fix) from None
        if response.status in (401, 403):
            self.stop_if_fatal(self.refusal(response))
        entries = None if response.is_cut else read_models(response)
        return self.refusal(response) if entries is None else entries

    def read(self, response: Response, request: Request, *, is_structured: bool) -> Reply | Refusal | str:
        """Give what a response says: a reply, what it refuses (some servers do so with status 200), or a word on what
        is wrong with it."""
        if response.status != 200:
            return self.refusal(response)
        if response.is_cut:
            return f"longer than max_reply_mb={self.cfg.max_reply_mb:g}"
        found = read_completion(response, request, "json_schema" if is_structured else "plain")
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
        """Give a server's error text, short and without the key."""
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


def _are_alike(one: str, two: str) -> bool:
    """Tell whether two names may be of one model: a server may add a date, a folder or a file's ending."""
    one, two = one.lower(), two.lower()
    return one in two or two in one
