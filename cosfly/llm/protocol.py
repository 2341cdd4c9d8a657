"""The chat-completions protocol: request bodies, and what a response says."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

from cosfly.formats.captions import Usage
from cosfly.llm.contract import MOST_TOKENS, Reply, Request
from cosfly.llm.wire import Response
from cosfly.runtime.json_io import dump_json

_IMAGE_MARK = re.compile(rb'"\\u0000(\d+)"')
THOUGHT_FIELDS = ("reasoning_content", "reasoning", "thinking", "reasoning_details")  # of a message, beside its content
TEXT_PARTS = (None, "text", "output_text")
ERROR_INSTEAD = "an error in place of an answer"  # with status 200
ENDED = (
    "error",
    "abort",
)  # finish reasons of an answer that a server gave up, SGLang with status 200 and nothing in it
MOST_NAME = 256  # characters of a name that is kept: of a model, of why an answer ended


# --- requests ---------------------------------------------------------------------------------------------------------


def response_format(schema: dict) -> dict:
    """Return the field of a request that asks for an answer of a JSON schema."""
    return {"type": "json_schema", "json_schema": {"name": "chain_of_cause", "strict": True, "schema": schema}}


def encode_body(payload: dict) -> bytes:
    """Write a request as JSON. Data URLs, a megabyte of them, need no escaping: they are copied in, not scanned."""
    urls: list[str] = []

    messages = _with_parts(payload["messages"], lambda part: _marked_part(part, urls))
    text = dump_json(payload | {"messages": messages})
    pieces = _IMAGE_MARK.split(text.encode())
    for at in range(1, len(pieces), 2):
        pieces[at] = b'"' + urls[int(pieces[at])].encode("ascii") + b'"'
    return b"".join(pieces)


def _marked_part(part: dict, urls: list[str]) -> dict:
    if part["type"] != "image_url" or not part["image_url"]["url"].startswith("data:image/"):
        return part
    urls.append(part["image_url"]["url"])
    return part | {"image_url": part["image_url"] | {"url": f"\x00{len(urls) - 1}"}}


def request_body(model: str, request: Request) -> dict[str, Any]:
    """Return a request's body without its response format."""
    return {"model": model, "messages": request.messages, **request.sampling}


def _with_parts(messages: list[dict], change: Callable[[dict], object]) -> list[dict]:
    """Change every part of the messages; a content that is one text stays."""
    return [
        message if isinstance(message["content"], str) else message | {"content": [*map(change, message["content"])]}
        for message in messages
    ]


# --- responses --------------------------------------------------------------------------------------------------------


def read_body(content: bytes) -> Any:
    """Read the JSON that a server sent, of which most fields are nobody's: a long number or a key that stands there
    twice costs no answer. Half a surrogate pair, which no file can hold, becomes U+FFFD.

    Raises:
        ValueError: it is no JSON, or nested deeper than can be read.
    """
    try:
        return _writable(json.loads(content, parse_constant=_no_constant))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is no JSON")


def _writable(value: Any) -> Any:
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_writable(key): _writable(member) for key, member in value.items()}
    return [_writable(member) for member in value] if isinstance(value, list) else value


def error_words(value: Any) -> str:
    """Return what a server's JSON says of an error: its `error`, or all of it."""
    error = value.get("error", value) if isinstance(value, dict) else value
    return str(error.get("message", error) if isinstance(error, dict) else error)


def read_completion(response: Response, structured: str) -> Reply | str:
    """Return the reply to a request of which the shape was enforced in this way, or a word on what is wrong with it.

    Nothing of it is taken on trust: what is kept has the type and size that it should have.
    """
    try:
        value = read_body(response.body)
    except ValueError:
        return "the body is not JSON"
    choices = value.get("choices") if isinstance(value, dict) else None
    if not isinstance(choices, list) or not choices or not isinstance(choices[0], dict):
        has_error = isinstance(value, dict) and value.get("error")
        return f"{ERROR_INSTEAD}: {error_words(value)}" if has_error else "no choices"
    choice, finish_reason = choices[0], choices[0].get("finish_reason")
    message = choice["message"] if isinstance(choice.get("message"), dict) else {}
    text = final_text(message)
    if choice.get("error") or finish_reason in ENDED:
        return f"{ERROR_INSTEAD}: {error_words(choice) if choice.get('error') else finish_reason}"
    if text is None:
        return "no text in the message"
    return Reply(text, _usage(value.get("usage")), structured, _name(finish_reason))


def _name(value: Any) -> str | None:
    """Return a name that can stand in a record, None where it is none."""
    return value if isinstance(value, str) and value.isprintable() and 0 < len(value) <= MOST_NAME else None


def final_text(message: dict[str, Any]) -> str | None:
    """Return what a message says in the end: its text, or why it refuses; "" where it holds thoughts alone, None where
    it holds nothing."""
    text = _joined(message.get("content"))
    if text:
        return text
    if isinstance(message.get("refusal"), str):
        return message["refusal"]
    return "" if any(message.get(name) for name in THOUGHT_FIELDS) else text


def thoughts_of(completion: Any) -> int:
    """Count the characters that a completion, of which a reply was read, says before its answer."""
    message = completion["choices"][0].get("message")
    thoughts = [message.get(name) for name in THOUGHT_FIELDS] if isinstance(message, dict) else []
    return max((len(text) for text in thoughts if isinstance(text, str)), default=0)


def _joined(content: Any) -> str | None:
    """Return the text of a content, which is a text or a list of parts."""
    if isinstance(content, list):
        parts = (part.get("text") for part in content if isinstance(part, dict) and part.get("type") in TEXT_PARTS)
        return "".join(part for part in parts if isinstance(part, str))
    return content if isinstance(content, str) else None


def _usage(value: Any) -> Usage | None:
    """Read the counts of tokens; gives None where the server counts nothing, or what can be no count."""
    counts = [value.get(name) if isinstance(value, dict) else None for name in Usage.model_fields]
    if not all(type(count) is int and 0 <= count <= MOST_TOKENS for count in counts) or not counts[0]:
        return None
    return Usage(**dict(zip(Usage.model_fields, counts, strict=True)))


def read_models(response: Response) -> list[dict[str, Any]] | None:
    """Read the list of models, each an object with `id`, a name; None where there is none."""
    if response.status != 200:
        return None
    try:
        value = read_body(response.body)
    except ValueError:
        return None
    listed = value.get("data") if isinstance(value, dict) else None
    if not isinstance(listed, list):
        return None
    return [entry for entry in listed if isinstance(entry, dict) and _name(entry.get("id"))]
