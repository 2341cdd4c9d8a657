"""The chat-completions protocol: URLs, request bodies, and what a response says."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import httpx

from cosfly.chat.contract import Reply, Request, Usage
from cosfly.reading.documents import parse_json
from cosfly.store import dump_json, sha256_bytes

_IMAGE_MARK = re.compile(rb'"\\u0000(\d+)"')
THOUGHT_FIELDS = ("reasoning_content", "reasoning", "thinking", "reasoning_details")  # of a message, beside its content
ERROR_INSTEAD = "an error in place of an answer"  # with status 200
MOST_TOKENS = 10**12  # of one answer: what is more is no count


def base_url(url: str) -> str:
    """Give the API root of whatever form of URL a user has: host, host/v1, or the whole chat-completions path."""
    root = url.rstrip("/").removesuffix("/chat/completions").rstrip("/")
    return root if re.search(r"/v\d+(beta)?(/openai)?$", root) else f"{root}/v1"


def shown_url(url: str) -> str:
    """Give a URL without user, password and query, for messages and records."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https"):
        return url  # vllm:MODEL_DIR
    host = parts.hostname or ""
    return urlunsplit((parts.scheme, f"{host}:{parts.port}" if parts.port else host, parts.path, "", ""))


# --- requests ---------------------------------------------------------------------------------------------------------


def response_format(schema: dict) -> dict:
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


def request_body(model: str, request: Request, *, with_ids: bool = False) -> dict[str, Any]:
    """Give a request's body without its response format; `with_ids` as in with_image_ids."""
    messages = with_image_ids(request.messages, request.digests) if with_ids else request.messages
    return {"model": model, "messages": messages, **request.sampling}


def with_image_ids(messages: list[dict], digests: list[str]) -> list[dict]:
    """Give each image its digest as `uuid`, by which vLLM finds it in its cache."""
    left = iter(digests)
    return _with_parts(messages, lambda part: part | {"uuid": next(left)} if part["type"] == "image_url" else part)


def _with_parts(messages: list[dict], change: Callable[[dict], object]) -> list[dict]:
    """Change every part of the messages; a content that is one text stays."""
    return [
        message if isinstance(message["content"], str) else message | {"content": [*map(change, message["content"])]}
        for message in messages
    ]


def answer_key(model: str, request: Request) -> str:
    """Hash image bytes, prompt, model and sampling: what an answer depends on."""
    texts = _with_parts(request.messages, lambda part: part.get("text", "image"))
    sampling = {"model": model, **request.sampling}
    return sha256_bytes(dump_json([texts, request.digests, sampling, request.schema]).encode())


# --- responses --------------------------------------------------------------------------------------------------------


def read_body(content: bytes) -> Any:
    """Read the JSON that a server sent. Half a surrogate pair, which no file can hold, becomes U+FFFD.

    Raises:
        ValueError: it is no JSON, or nested deeper than can be read.
    """
    return _writable(parse_json(content))


def _writable(value: Any) -> Any:
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_writable(key): _writable(member) for key, member in value.items()}
    return [_writable(member) for member in value] if isinstance(value, list) else value


def error_words(value: Any) -> str:
    """Give what a server's JSON says of an error: its `error`, or all of it."""
    error = value.get("error", value) if isinstance(value, dict) else value
    return str(error.get("message", error) if isinstance(error, dict) else error)


def read_completion(response: httpx.Response, structured: str) -> Reply | str:
    """Give the reply of a completion that was asked for in this way, or a word on what is wrong with it."""
    try:
        value = read_body(response.content)
    except ValueError:
        return "the body is not JSON"
    choices = value.get("choices") if isinstance(value, dict) else None
    if not isinstance(choices, list) or not choices or not isinstance(choices[0], dict):
        has_error = isinstance(value, dict) and value.get("error")
        return f"{ERROR_INSTEAD}: {error_words(value)}" if has_error else "no choices"
    choice, finish_reason = choices[0], choices[0].get("finish_reason")
    if choice.get("error") or finish_reason == "error":
        return f"{ERROR_INSTEAD}: {error_words(choice)}"
    message = choice.get("message")
    text = final_text(message) if isinstance(message, dict) else None
    if text is None:
        return "no text in the message"
    reason = finish_reason if isinstance(finish_reason, str) else None
    return Reply(text, _usage(value.get("usage")), structured, reason)


def final_text(message: dict[str, Any]) -> str | None:
    """Give what a message says in the end, "" where it holds thoughts alone, None where it holds nothing.

    That is its text, the arguments of the one function that it calls (a schema is served so by some), or why it refuses.
    """
    text = _joined(message.get("content"))
    if text:
        return text
    calls = [call.get("function") for call in _objects(message.get("tool_calls"))] or [message.get("function_call")]
    if len(calls) == 1 and isinstance(calls[0], dict) and (arguments := _joined(calls[0].get("arguments"))):
        return arguments
    if isinstance(message.get("refusal"), str):
        return message["refusal"]
    is_thought = any(message.get(name) for name in THOUGHT_FIELDS)
    return "" if is_thought else text


def _joined(content: Any) -> str | None:
    """Give the text of a content: a text, a list of parts, or an object that should have been a text."""
    if isinstance(content, list):
        parts = (part.get("text") if isinstance(part, dict) else part for part in content if _is_said(part))
        return "".join(part for part in parts if isinstance(part, str))
    if isinstance(content, dict):
        try:
            return content["text"] if isinstance(content.get("text"), str) else dump_json(content)
        except ValueError:  # it holds 1e999
            return None
    return content if isinstance(content, str) else None


def _is_said(part: Any) -> bool:
    return not isinstance(part, dict) or part.get("type") in (None, "text", "output_text")


def _objects(value: Any) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _usage(value: Any) -> Usage | None:
    """Read the counts of tokens; one that cannot be a count is left out."""
    found = value if isinstance(value, dict) else {}
    counts = {name: found.get(name) for name in Usage.model_fields}
    good = {name: count for name, count in counts.items() if type(count) is int and 0 <= count <= MOST_TOKENS}
    return Usage(**good) if good else None


def read_models(response: httpx.Response) -> list[dict[str, Any]] | None:
    """Read the list of models, each an object with `id`; None where there is none."""
    if response.status_code != 200:
        return None
    try:
        value = read_body(response.content)
    except ValueError:
        return None
    listed = value.get("data") if isinstance(value, dict) else None
    if not isinstance(listed, list):
        return None
    return [entry for entry in _objects(listed) if isinstance(entry.get("id"), str)]


def retry_after_s(response: httpx.Response) -> float | None:
    """Read Retry-After in seconds, bounded; None where absent or a date."""
    try:
        return min(600.0, max(0.0, float(response.headers.get("retry-after", ""))))
    except ValueError:
        return None
