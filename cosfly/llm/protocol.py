"""The chat-completions protocol: writes request bodies and reads responses."""

from __future__ import annotations

import json
import re
from typing import Any

from cosfly.formats.captions import Usage
from cosfly.llm.contract import MOST_TOKENS, Reply, Request
from cosfly.llm.wire import Response
from cosfly.runtime.json_io import dump_json

_PLACEHOLDER = re.compile(rb'"\\u0000(\d+)"')
THOUGHT_FIELDS = ("reasoning_content", "reasoning", "thinking", "reasoning_details")  # of a message
TEXT_PARTS = (None, "text", "output_text")
ERROR_INSTEAD = "an error in place of an answer"  # with status 200
ENDED = ("error", "abort")  # finish reasons of an answer that a server gave up; SGLang sends them with status 200
MOST_NAME = 256  # characters of a name that is kept, such as a model or a finish reason


# --- requests ---------------------------------------------------------------------------------------------------------


def response_format(schema: dict) -> dict:
    """Return the request field that asks for answers of a JSON schema."""
    return {"type": "json_schema", "json_schema": {"name": "chain_of_cause", "strict": True, "schema": schema}}


def request_body(model: str, request: Request) -> dict[str, Any]:
    """Return a request's body without its response format."""
    return {"model": model, "messages": request.messages, **request.sampling}


def encode_body(payload: dict) -> bytes:
    """Write a request as JSON. Data URLs, a megabyte of them, need no escaping: they are copied in, not scanned."""
    urls: list[str] = []

    def with_placeholder(part: dict) -> dict:
        if part["type"] != "image_url" or not part["image_url"]["url"].startswith("data:image/"):
            return part
        urls.append(part["image_url"]["url"])
        return part | {"image_url": part["image_url"] | {"url": f"\x00{len(urls) - 1}"}}

    messages = [
        message
        if isinstance(message["content"], str)
        else message | {"content": [with_placeholder(part) for part in message["content"]]}
        for message in payload["messages"]
    ]
    pieces = _PLACEHOLDER.split(dump_json(payload | {"messages": messages}).encode())
    for at in range(1, len(pieces), 2):
        pieces[at] = b'"' + urls[int(pieces[at])].encode("ascii") + b'"'
    return b"".join(pieces)


# --- responses --------------------------------------------------------------------------------------------------------


def read_body(content: bytes) -> Any:
    """Read JSON of a server: long numbers and duplicate keys are accepted, half a surrogate pair becomes U+FFFD.

    Raises:
        ValueError: The content is not JSON, or is nested too deeply.
    """

    def reject(constant: str) -> float:
        raise ValueError(f"{constant} is not JSON")

    try:
        return _writable(json.loads(content, parse_constant=reject))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _writable(value: Any) -> Any:
    """Replace surrogates that no file can hold, in all texts of a JSON value."""
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_writable(key): _writable(member) for key, member in value.items()}
    return [_writable(member) for member in value] if isinstance(value, list) else value


def error_words(value: Any) -> str:
    """Return the text of an error in a server's JSON: its `error`, or all of it."""
    error = value.get("error", value) if isinstance(value, dict) else value
    return str(error.get("message", error) if isinstance(error, dict) else error)


def read_completion(response: Response, structured: str) -> Reply | str:
    """Return the reply in a response, or what is wrong with it. structured: as in `Reply`.

    Types and sizes are checked: a server is not trusted.
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
    """Return a printable name of bounded length, None if the value is none."""
    return value if isinstance(value, str) and value.isprintable() and 0 < len(value) <= MOST_NAME else None


def final_text(message: dict[str, Any]) -> str | None:
    """Return a message's text or refusal; "" if it contains only thoughts, None if it contains nothing."""
    text = _joined(message.get("content"))
    if text:
        return text
    if isinstance(message.get("refusal"), str):
        return message["refusal"]
    return "" if any(message.get(name) for name in THOUGHT_FIELDS) else text


def thoughts_of(completion: Any) -> int:
    """Return the number of characters of thoughts in a completion from which a reply was read."""
    message = completion["choices"][0].get("message")
    thoughts = [message.get(name) for name in THOUGHT_FIELDS] if isinstance(message, dict) else []
    return max((len(text) for text in thoughts if isinstance(text, str)), default=0)


def _joined(content: Any) -> str | None:
    """Return the text of a message's content, which is a text or a list of parts."""
    if isinstance(content, list):
        parts = (part.get("text") for part in content if isinstance(part, dict) and part.get("type") in TEXT_PARTS)
        return "".join(part for part in parts if isinstance(part, str))
    return content if isinstance(content, str) else None


def _usage(value: Any) -> Usage | None:
    """Return the token counts, None if there are none or they are not plausible."""
    counts = [value.get(name) if isinstance(value, dict) else None for name in Usage.model_fields]
    if not all(type(count) is int and 0 <= count <= MOST_TOKENS for count in counts) or not counts[0]:
        return None
    return Usage(**dict(zip(Usage.model_fields, counts, strict=True)))


def read_models(response: Response) -> list[dict[str, Any]] | None:
    """Return the entries of a list of models, each with a usable `id`; None if the response has no list."""
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
