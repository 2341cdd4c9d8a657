"""The chat-completions protocol: checks addresses, writes request bodies, reads responses and the causes of refusals.

Servers share no status codes: what one reports as 400 another reports as 422 or 500. So causes are recognized by the
text of the server, by one table for all servers, `refusals.yaml`. The patterns match the texts of vLLM, SGLang,
llama.cpp, TGI, LM Studio, LiteLLM, OpenAI and similar hosts; tests/refusals.tsv lists them.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import httpx
from pydantic_core import to_json

from cosfly.formats.captions import Usage
from cosfly.llm.contract import MOST_TOKENS, Reply, Request
from cosfly.runtime.config import read_yaml
from cosfly.runtime.escaping import without_keys
from cosfly.runtime.model_json import DECLINED

Kind = Literal[
    "account", "too_long", "text_only", "pictures", "no_system", "schema", "parameter", "content", "unknown"
]  # fmt: skip

KEY_VARIABLE = "COSFLY_API_KEY"
MOST_CHARACTERS = 4000  # of a text that are searched: some servers echo the request
NEVER = "$^"  # a pattern that matches nothing
THOUGHT_FIELDS = ("reasoning_content", "reasoning", "thinking", "reasoning_details")  # of a message
MESSAGE_FIELDS = ("message", "msg", "detail")  # of an error
EVENT_STARTS = (b"data:", b"event:", b"id:", b"retry:", b":")  # of a stream of server-sent events
TEXT_PARTS = (None, "text", "output_text")  # types of the parts of a message that hold its text
ENDED = ("error", "abort")  # finish reasons of an answer that a server gave up; SGLang sends them with status 200
MOST_NAME = 256  # characters of a name, such as a model or a finish reason; longer ones are dropped


# --- addresses --------------------------------------------------------------------------------------------------------


def check_url(url: str) -> None:
    """Check that a URL is usable and contains no secret, since it is written to `run.yaml` and shown in messages.

    The message of the ValueError omits the parts of the URL that may be secret.
    """
    host = re.match(r"https?://[\w.-]{1,200}(?=[:/]|$)", url)  # what follows may be a key
    got = f", got {host[0]!r}" if host and "@" not in url else ""
    if re.search("[@?#]", url) or without_keys(url) != url:
        problem = "the URL must not contain a user, password, query, fragment or key, because it is recorded"
        raise ValueError(f"{problem}{got}; set the key in the environment variable {KEY_VARIABLE}")
    try:
        parts = httpx.URL(url)
        parts.raw_host.decode("ascii").encode("idna")  # the encoding that the resolver uses
    except (httpx.InvalidURL, ValueError):
        parts = httpx.URL("")
    is_host = parts.scheme in ("http", "https") and parts.host and "%" not in parts.host
    is_port = parts.port is None or 0 < parts.port < 65_536
    if not (is_host and is_port) or re.search(r"[\s\x00-\x1f\x7f]", url):
        problem = "the URL must start with http:// or https:// and have a host name, no spaces, and no port above 65535"
        raise ValueError(f"{problem}{got}")


def base_url(url: str) -> str:
    """Return the API root of a URL: of host or host/v1, host/v1; a full chat-completions address is used as given."""
    root = url.rstrip("/")
    if root.endswith("/chat/completions"):
        return root.removesuffix("/chat/completions")
    return root if re.search(r"/v\d+(beta)?(/openai)?$", root) else f"{root}/v1"


# --- requests ---------------------------------------------------------------------------------------------------------


def request_body(model: str, request: Request, *, with_schema: bool = True, with_system: bool = True) -> bytes:
    """Return the body of a request as JSON. Without its schema, the server enforces none."""
    messages = request.messages if with_system else without_system(request.messages)
    body = {"model": model, "messages": messages, "stream": False, **request.sampling}
    if with_schema:
        json_schema = {"name": "chain_of_cause", "strict": True, "schema": request.schema}
        body["response_format"] = {"type": "json_schema", "json_schema": json_schema}
    return to_json(body)  # ten times as fast as the json module with a megabyte of pictures


def without_system(messages: list[dict]) -> list[dict]:
    """Return messages whose system text begins the first question, for chat templates without a system role."""
    if len(messages) < 2 or messages[0]["role"] != "system":
        return messages
    system, question, *others = messages
    content = question["content"]
    if isinstance(content, str):
        return [question | {"content": f"{system['content']}\n\n{content}"}, *others]
    return [question | {"content": [{"type": "text", "text": system["content"]}, *content]}, *others]


# --- refusals --------------------------------------------------------------------------------------------------------


class Meaning(NamedTuple):
    """A cause of refusals."""

    what: str  # of the error
    fix: str  # of the error
    ends_run: bool  # all requests are refused
    pattern: str = NEVER  # of the server's text


MEANINGS: dict[Kind, Meaning] = {
    kind: Meaning(cause["what"], cause["fix"], cause["ends_run"], "|".join(cause["patterns"]) or NEVER)
    for kind, cause in read_yaml(Path(__file__).with_name("refusals.yaml")).items()
}
ADDRESS = Meaning(
    "the server does not have this model, or the URL is not a chat endpoint", "correct the URL or --model", True
)
KEY = Meaning("the API key is missing, or the server refuses the API key", f"set {KEY_VARIABLE} to a valid key", True)
# The meaning of a status if no pattern matches the text.
STATUSES = dict.fromkeys((401, 403), KEY) | dict.fromkeys((*range(300, 400), 404, 405), ADDRESS)
# Statuses of a server that is busy or away (above 511: Cloudflare's, 424: TGI's of a failed generation); only an empty
# account takes precedence.
AWAY = frozenset({408, 409, 424, 425, 429, 502, 503, 504, *range(520, 531)})


def kind_of(status: int, text: str) -> Kind:
    """Return the cause of a refusal with this body; `unknown` if no pattern matches."""
    start = text[:MOST_CHARACTERS]
    flags = re.IGNORECASE | re.DOTALL
    matching = (kind for kind, meaning in MEANINGS.items() if re.search(meaning.pattern, start, flags))
    kind: Kind = "account" if status == 402 else next(matching, "unknown")
    if status in AWAY and kind != "account":
        return "unknown"
    if status >= 500 and kind in ("content", "schema"):  # such words of a failed server are about something else
        return "unknown"
    return kind


@dataclass(eq=False)
class Refusal(Exception):
    """A request that a server refused."""

    status: int
    kind: Kind
    message: str  # the server's text; the client makes it one short line without the key
    wait_s: float | None = None  # how long the server asks to wait

    @property
    def code(self) -> str:
        """The cause, as tallies count it."""
        return f"refused_{self.status if self.kind == 'unknown' else self.kind}"

    def __str__(self) -> str:
        return f"HTTP {self.status} {self.message}".rstrip()

    @property
    def meaning(self) -> Meaning:
        """The cause by the text, unless the status says more."""
        by_text = MEANINGS[self.kind]
        return by_text if by_text.ends_run or self.kind == "content" else STATUSES.get(self.status, by_text)

    @property
    def is_loading(self) -> bool:
        """Whether the server is loading its model."""
        return self.status in AWAY and re.search(r"\bloading\b", self.message, re.IGNORECASE) is not None

    @property
    def may_pass(self) -> bool:
        """Whether the same request may be answered later, because the server is busy, away or broken."""
        return self.kind == "unknown" and (self.status in AWAY or self.status >= 500)


# --- responses --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Response:
    status: int
    body: bytes
    is_cut: bool = False  # the body exceeds the size limit
    retry_after_s: float | None = None  # None unless given in seconds


class BadReply(Exception):
    """A response with status 200 that holds no usable reply."""


def read_body(content: bytes) -> Any:
    """Read JSON of a server: long numbers and duplicate keys are accepted, half a surrogate pair becomes U+FFFD."""

    def reject(constant: str) -> float:
        raise ValueError(f"the response contains {constant}, which is not valid in JSON")

    try:
        if content.lstrip().startswith(EVENT_STARTS):
            return _writable(_joined_events(content, reject))
        return _writable(json.loads(content, parse_constant=reject))
    except RecursionError:
        raise ValueError("the lists and objects of the response are nested too deeply") from None


def _joined_events(content: bytes, reject: Callable[[str], float]) -> dict[str, Any]:
    """Return the completion whose pieces an event stream holds: some servers stream whatever the request says."""
    texts: dict[str, str] = {}
    finish_reason: str | None = None
    usage: Any = None
    for line in content.split(b"\n"):  # not splitlines: a JSON string may contain other line separators
        name, _, data = line.partition(b":")
        if name != b"data" or not data.strip():
            continue
        if data.strip() == b"[DONE]":
            finish_reason = finish_reason or "stop"
            continue
        event = json.loads(data, parse_constant=reject)
        choices = event.get("choices") if isinstance(event, dict) else None
        if not isinstance(choices, list):
            return event if isinstance(event, dict) else {}  # an error, for instance
        usage = event.get("usage") or usage
        choice = choices[0] if choices and isinstance(choices[0], dict) else {}
        finish_reason = choice.get("finish_reason") or finish_reason
        delta = choice.get("delta")
        if isinstance(delta, dict):
            for field, piece in delta.items():
                if isinstance(piece, str):
                    texts[field] = texts.get(field, "") + piece
    if finish_reason is None:
        raise ValueError("the event stream ends before the answer is complete")
    return {"choices": [{"message": texts, "finish_reason": finish_reason}], "usage": usage}


def _writable(value: Any) -> Any:
    """Replace unpaired surrogates, which UTF-8 cannot encode, in all texts of a JSON value."""
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_writable(key): _writable(member) for key, member in value.items()}
    return [_writable(member) for member in value] if isinstance(value, list) else value


def _object(response: Response) -> dict[str, Any] | None:
    """Return the object in a response; {} for other JSON, None if it is not JSON."""
    try:
        value = read_body(response.body)
    except ValueError:
        return None
    return value if isinstance(value, dict) else {}


def error_words(value: Any) -> str:
    """Return the text of an error in a server's JSON: the message of its `error`, or of itself, or all of it."""
    error = value.get("error", value) if isinstance(value, dict) else value
    if not isinstance(error, dict):
        return str(error)
    return str(next((error[name] for name in MESSAGE_FIELDS if error.get(name)), error))


def read_refusal(response: Response) -> Refusal:
    """Return the refusal in a response whose status is not 200."""
    text = response.body.decode("utf-8", "replace")  # the charset in the header is ignored
    try:
        message = error_words(read_body(response.body))
    except ValueError:
        message = text
    return Refusal(response.status, kind_of(response.status, text), message, response.retry_after_s)


def _error_instead(value: dict[str, Any], wait_s: float | None) -> Refusal | BadReply:
    """Return the refusal in a response of status 200, a BadReply if its cause is not known.

    An error may give its status as its code.
    """
    error = value.get("error")
    code = str((error if isinstance(error, dict) else value).get("code"))
    status = int(code) if re.fullmatch("[45][0-9]{2}", code) else 200
    problem = f"the server sent an error instead of an answer: {error_words(value)}"
    refusal = Refusal(status, kind_of(status, problem), problem, wait_s)
    return refusal if refusal.kind != "unknown" or refusal.may_pass else BadReply(problem)


def read_completion(response: Response, structured: str) -> Reply:
    """Return the reply in a response; structured: As in `Reply`.

    Raises:
        BadReply: A type or a size is wrong. Refusal: The server refuses the request; some do with status 200.
    """
    if response.status != 200:
        raise read_refusal(response)
    if response.is_cut:
        raise BadReply(f"the response is longer than {len(response.body) / 1e6:g} MB")
    value = _object(response)
    if value is None:
        raise BadReply("the response is not JSON")
    choice = _first_choice(value, response.retry_after_s)
    finish_reason = choice.get("finish_reason")
    message = choice["message"] if isinstance(choice.get("message"), dict) else {}
    text = _final_text(message)
    usage = _usage(value.get("usage"))
    refusal = message.get("refusal")
    if not text and isinstance(refusal, str) and refusal:
        return Reply(refusal, usage, structured, DECLINED)
    if text is None and finish_reason == "length":
        text = ""  # thoughts that the server does not return took all tokens
    if text is None:
        raise BadReply("the message has no text")
    thoughts = [len(message[name]) for name in THOUGHT_FIELDS if isinstance(message.get(name), str)]
    return Reply(text, usage, structured, _name(finish_reason), num_thoughts=max(thoughts, default=0))


def _first_choice(value: dict[str, Any], wait_s: float | None) -> dict[str, Any]:
    """Return the first choice of a completion; raise the error that a server sent instead of one or in it."""
    choices = value.get("choices")
    if not isinstance(choices, list) or not choices or not isinstance(choices[0], dict):
        if any(value.get(name) for name in ("error", *MESSAGE_FIELDS)):
            raise _error_instead(value, wait_s)
        raise BadReply("the response has no choices")
    choice = choices[0]
    if choice.get("error"):
        raise _error_instead(choice, wait_s)
    if choice.get("finish_reason") in ENDED:
        raise _error_instead({"error": choice["finish_reason"]}, wait_s)
    return choice


def _name(value: Any) -> str | None:
    """Return a value that is a printable name of bounded length, else None."""
    return value if isinstance(value, str) and value.isprintable() and 0 < len(value) <= MOST_NAME else None


def _final_text(message: dict[str, Any]) -> str | None:
    """Return a message's text; "" if it contains only thoughts, None if it contains nothing."""
    text = message.get("content")
    if isinstance(text, list):
        parts = (part.get("text") for part in text if isinstance(part, dict) and part.get("type") in TEXT_PARTS)
        text = "".join(part for part in parts if isinstance(part, str))
    if isinstance(text, str) and text:
        return text
    return "" if isinstance(text, str) or any(message.get(name) for name in THOUGHT_FIELDS) else None


def _usage(value: Any) -> Usage | None:
    """Return the token counts, None if there are none or they are not plausible."""
    counts = {name: value.get(name) if isinstance(value, dict) else None for name in Usage.model_fields}
    is_plausible = all(type(count) is int and 0 <= count <= MOST_TOKENS for count in counts.values())
    return Usage.model_validate(counts) if is_plausible and counts["prompt_tokens"] else None


def read_models(response: Response) -> dict[str, int | None] | None:
    """Return the models that a server lists, with the length of their context if it is given; None without a list."""
    value = _object(response) if response.status == 200 and not response.is_cut else None
    entries = (value or {}).get("data")
    if not isinstance(entries, list):
        return None
    named = [entry for entry in entries if isinstance(entry, dict) and _name(entry.get("id"))]
    lengths = {entry["id"]: entry.get("max_model_len") for entry in named}
    return {name: length if type(length) is int else None for name, length in lengths.items()}
