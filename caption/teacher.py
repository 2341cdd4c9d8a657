"""Teachers: who answers a `Question`.

`RuleTeacher` is embedded and deterministic. `EndpointTeacher` speaks chat completions with any OpenAI-compatible server; it
retries what may pass, names what cannot, and journals every answer before it hands it on. The key comes from the environment
variable COSFLY_API_KEY and goes into the request header only.
"""

from __future__ import annotations

import asyncio
import logging
import os
import random
import re
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol
from urllib.parse import urlsplit, urlunsplit

import httpx

from caption.answers import AnswerBook
from caption.images import FrameEncoder
from caption.prompts import Question, answer_schema, mirror_messages, mirror_schema, question_messages
from caption.rules import write_answers
from caption.schema import EndpointConfig, ImageConfig, Reply
from caption.throttle import Throttle
from cosfly.coc import Coc
from cosfly.errors import TeacherError
from cosfly.runner import rng_for
from cosfly.store import dump_json, parse_json, sha256_bytes

log = logging.getLogger(__name__)

KEY_VARIABLE = "COSFLY_API_KEY"
BUSY_STATUS = frozenset({429, 503, 529})
RETRIED_STATUS = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 529})


class NoAnswer(Exception):
    """A window got no answer; `cause` is a word for the tally. `is_final`: asking again later would not help."""

    def __init__(self, cause: str, detail: str, *, is_final: bool = False) -> None:
        super().__init__(f"{cause}: {detail}")
        self.cause, self.detail, self.is_final = cause, detail, is_final


class Teacher(Protocol):
    """`ask` answers in English, `mirror` gives the Chinese of an English answer."""

    record: dict[str, Any]

    async def ask(self, question: Question) -> Reply: ...

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply: ...


# --- rules ------------------------------------------------------------------------------------------------------------


class RuleTeacher:
    """Answers from the question's facts alone; see rules.py."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.record: dict[str, Any] = {"kind": "rules", "model": "rules-1", "settings": {"seed": seed}}
        self._last: tuple[str, tuple[Coc, Coc]] | None = None

    def _answers(self, question: Question) -> tuple[Coc, Coc]:
        key = f"{question.window.sample_id}/{question.purpose}"
        if self._last is None or self._last[0] != key:
            rng = rng_for(self.seed, "caption", key)
            self._last = (key, write_answers(question.facts, rng, question.decision))
        return self._last[1]

    async def ask(self, question: Question) -> Reply:
        return _native(self._answers(question)[0])

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply:
        return _native(self._answers(question)[1])


def _native(answer: Coc) -> Reply:
    return Reply(dump_json(answer.model_dump()), {}, "native", "stop")


# --- endpoint ---------------------------------------------------------------------------------------------------------


def base_url(url: str) -> str:
    """Give the API root of whatever form of URL a user has: host, host/v1, or the whole chat-completions path."""
    root = url.rstrip("/").removesuffix("/chat/completions").rstrip("/")
    return root if re.search(r"/v\d+(beta)?(/openai)?$", root) else f"{root}/v1"


def shown_url(url: str) -> str:
    """Give a URL without user, password and query, for messages and records."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    return urlunsplit((parts.scheme, f"{host}:{parts.port}" if parts.port else host, parts.path, "", ""))


class EndpointTeacher:
    """Asks a chat-completions server. Use as an async context manager."""

    def __init__(self, url: str, cfg: EndpointConfig, image: ImageConfig, answers: AnswerBook, seed: int) -> None:
        self.url, self.shown = base_url(url), shown_url(base_url(url))
        self.cfg, self.answers, self.seed = cfg, answers, seed
        self.record: dict[str, Any] = {}
        self.encoder = FrameEncoder(image)
        self._encoding = ThreadPoolExecutor(1, "encode")  # one thread: windows that share a frame find it encoded
        self.throttle = Throttle(cfg.concurrency)
        self._is_schema_refused = not cfg.json_schema
        self._key = os.environ.get(KEY_VARIABLE, "")
        self._jitter = random.Random()  # times of retries only: no product depends on it
        headers = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        limits = httpx.Limits(max_connections=cfg.concurrency, max_keepalive_connections=cfg.concurrency)
        try:
            self._client = httpx.AsyncClient(headers=headers, timeout=cfg.timeout_s, limits=limits)
        except (httpx.InvalidURL, ValueError, UnicodeError) as error:
            raise TeacherError("the key cannot be sent", where=KEY_VARIABLE, got=type(error).__name__) from None

    async def __aenter__(self) -> EndpointTeacher:
        try:
            model = await self._find_model()
        except BaseException:
            await self.__aexit__()
            raise
        c = self.cfg
        settings = {"temperature": c.temperature, "top_p": c.top_p, "max_tokens": c.max_tokens, "seed": self.seed}
        self.record = {"kind": "endpoint", "model": model, "settings": settings | {"extra_body": dict(c.extra_body)}}
        return self

    async def __aexit__(self, *exc: object) -> None:
        self._encoding.shutdown(wait=False, cancel_futures=True)
        await self._client.aclose()

    async def ask(self, question: Question) -> Reply:
        loop = asyncio.get_running_loop()
        messages, digests = await loop.run_in_executor(self._encoding, question_messages, question, self.encoder)
        schema = answer_schema(question.decision)
        return await self._answer(question.window.sample_id, question.purpose, messages, digests, schema)

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply:
        schema = mirror_schema(english.flight_decision)
        return await self._answer(question.window.sample_id, f"mirror/{ask}", mirror_messages(english), [], schema)

    # --- one answer, from the journal or the server ---

    async def _answer(self, sample_id: str, purpose: str, messages: list, digests: list[str], schema: dict) -> Reply:
        body = self._body(sample_id, purpose, messages)
        key = answer_key(body, digests, schema)
        known = self.answers.get(key)
        if known is None:
            start_s = time.monotonic()
            known = await self._post(body, schema)
            known |= {"key": key, "sample_id": sample_id, "purpose": purpose, "model": body["model"]}
            known |= {"latency_s": round(time.monotonic() - start_s, 3), "time": round(time.time(), 3)}
            self.answers.put(known)  # on the disk before anything is derived from it
        return Reply(known["text"], known["usage"], known["structured"], known["finish_reason"])

    def _body(self, sample_id: str, purpose: str, messages: list) -> dict[str, Any]:
        c = self.cfg
        sampling_seed = int(rng_for(self.seed, "teacher", f"{sample_id}/{purpose}").integers(1 << 31))
        body = {"model": self.record["model"], "messages": messages, "temperature": c.temperature, "top_p": c.top_p}
        return body | {"max_tokens": c.max_tokens, "seed": sampling_seed} | c.extra_body

    async def _post(self, body: dict, schema: dict) -> dict:
        """Send one request until it is answered; gives text, usage, structured and finish_reason."""
        cause, detail = "no_answer", ""
        for attempt in range(self.cfg.max_tries):
            is_structured = not self._is_schema_refused
            payload = body | ({"response_format": _response_format(schema)} if is_structured else {})
            wait_s: float | None = None
            try:
                async with self.throttle.slot() as given_s:
                    response = await self._client.post(f"{self.url}/chat/completions", json=payload)
            except httpx.TimeoutException:
                cause, detail = "timeout", f"no answer within {self.cfg.timeout_s} s"
            except httpx.TransportError as error:
                cause, detail = "connection", self._clean(f"{type(error).__name__} {error}")
            except httpx.InvalidURL:
                raise self._error("not a URL that can be asked", fix="check --teacher") from None
            else:
                status = response.status_code
                if status == 200:
                    found = _read_completion(response)
                    if isinstance(found, dict):
                        self.throttle.succeeded()
                        return found | {"structured": "json_schema" if is_structured else "plain"}
                    cause, detail = "bad_reply", found
                elif status in RETRIED_STATUS:
                    cause, detail = f"http_{status}", self._detail(response)
                    wait_s = _retry_after_s(response)
                    if status in BUSY_STATUS:
                        self.throttle.was_busy(given_s, wait_s)
                elif status in (400, 422) and is_structured:
                    log.warning(
                        "%s: refuses a JSON schema (%s); asking without one", self.shown, self._detail(response)
                    )
                    self._is_schema_refused = True
                    wait_s = 0.0
                else:
                    self._stop_if_fatal(response)
                    raise NoAnswer(f"refused_{status}", self._detail(response), is_final=True)
            if attempt + 1 < self.cfg.max_tries:
                await asyncio.sleep(self._wait_s(attempt) if wait_s is None else wait_s)
        raise NoAnswer(cause, detail)

    def _wait_s(self, attempt: int) -> float:
        longest = min(self.cfg.max_backoff_s, self.cfg.backoff_s * 2.0**attempt)
        return self._jitter.uniform(0.5, 1.0) * longest

    # --- errors ---

    async def _find_model(self) -> str:
        """Ask which models there are and check ours.

        Raises:
            TeacherError: unreachable, refuses the key, does not speak the protocol, or lacks the model.
        """
        try:
            response = await self._client.get(f"{self.url}/models")
        except httpx.InvalidURL:
            raise self._error("not a URL that can be asked", fix="check --teacher") from None
        except httpx.HTTPError as error:
            reason = self._clean(f"{type(error).__name__} {error}")
            raise self._error(
                "cannot reach the teacher", got=reason, fix="start the server or check --teacher"
            ) from None
        wanted = self.cfg.model
        if response.status_code in (401, 403):
            self._stop_if_fatal(response)
        names = _model_names(response)
        if names is None:
            if wanted:
                return wanted  # some hosts list no models; the first request will tell
            what = "no list of models here, so it may not be an OpenAI-compatible endpoint"
            raise self._error(what, got=f"HTTP {response.status_code}", fix="check the URL, or give --model")
        if wanted is None and len(names) == 1:
            return names[0]
        if wanted in names:
            return str(wanted)
        listed = ", ".join(names[:8]) or "none"
        raise self._error(
            "the endpoint does not have this model" if wanted else "the endpoint has several models",
            got=wanted or f"{len(names)} models",
            expected=f"one of {listed}",
            fix="give --model",
        )

    def _stop_if_fatal(self, response: httpx.Response) -> None:
        """Raise for what would fail for every window."""
        status, detail = response.status_code, self._detail(response)
        if status in (401, 403):
            raise self._error("the teacher refuses the key", got=f"HTTP {status} {detail}", fix=f"set {KEY_VARIABLE}")
        if status == 404:
            raise self._error(
                "no such model or not a chat endpoint", got=f"HTTP 404 {detail}", fix="check URL and model"
            )
        if 300 <= status < 400 or status == 405:
            raise self._error("not a chat endpoint", got=f"HTTP {status} {detail}", fix="check the URL")

    def _error(self, what: str, **parts: Any) -> TeacherError:
        return TeacherError(what, where=self.shown, **parts)

    def _detail(self, response: httpx.Response) -> str:
        try:
            value = parse_json(response.content)
            error = value.get("error", value) if isinstance(value, dict) else value
            text = str(error.get("message", error) if isinstance(error, dict) else error)
        except ValueError:
            text = response.text
        return self._clean(text)

    def _clean(self, text: str) -> str:
        """Cut a server's text short and take out the key, should the server echo it."""
        text = " ".join(text.split())
        secrets = [self._key, urlsplit(self.url).password or ""]
        for secret in filter(None, secrets):
            text = text.replace(secret, "***")
        return text[:200]


def answer_key(body: dict, digests: list[str], schema: dict) -> str:
    """Hash image bytes, prompt, model and sampling: what an answer depends on."""
    texts = [
        {
            "role": message["role"],
            "content": message["content"]
            if isinstance(message["content"], str)
            else [part.get("text", "image") for part in message["content"]],
        }
        for message in body["messages"]
    ]
    sampling = {name: value for name, value in body.items() if name != "messages"}
    return sha256_bytes(dump_json([texts, digests, sampling, schema]).encode())


def _response_format(schema: dict) -> dict:
    return {"type": "json_schema", "json_schema": {"name": "chain_of_cause", "strict": True, "schema": schema}}


def _read_completion(response: httpx.Response) -> dict | str:
    """Give text, usage and finish_reason of a completion, or a word on what is wrong with it."""
    try:
        value = parse_json(response.content)
    except ValueError:
        return "the body is not JSON"
    choices = value.get("choices") if isinstance(value, dict) else None
    if not isinstance(choices, list) or not choices or not isinstance(choices[0], dict):
        return "no choices"
    message = choices[0].get("message")
    text = message.get("content") if isinstance(message, dict) else None
    if isinstance(text, list):  # content parts
        text = "".join(str(part.get("text", "")) for part in text if isinstance(part, dict))
    if not isinstance(text, str):
        return "no text in the message"
    usage = value.get("usage") if isinstance(value.get("usage"), dict) else {}
    counts = {name: usage[name] for name in ("prompt_tokens", "completion_tokens") if type(usage.get(name)) is int}
    return {"text": text, "usage": counts, "finish_reason": choices[0].get("finish_reason")}


def _model_names(response: httpx.Response) -> list[str] | None:
    """Read the list of models; None where there is none."""
    if response.status_code != 200:
        return None
    try:
        value = parse_json(response.content)
    except ValueError:
        return None
    listed = value.get("data") if isinstance(value, dict) else None
    if not isinstance(listed, list):
        return None
    return [str(entry["id"]) for entry in listed if isinstance(entry, dict) and "id" in entry]


def _retry_after_s(response: httpx.Response) -> float | None:
    """Read Retry-After in seconds, bounded; None where absent or a date."""
    try:
        return min(600.0, max(0.0, float(response.headers.get("retry-after", ""))))
    except ValueError:
        return None
