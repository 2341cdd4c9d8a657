"""The chat-completions protocol: URLs, request bodies, and what a response says."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import httpx

from cosfly.chat.contract import Reply, Request, Usage
from cosfly.store import dump_json, parse_json, sha256_bytes

_IMAGE_MARK = re.compile(rb'"\\u0000(\d+)"')


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


def read_completion(response: httpx.Response, structured: str) -> Reply | str:
    """Give the reply of a completion that was asked for in this way, or a word on what is wrong with it."""
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
    return Reply(text, Usage(**counts) if counts else None, structured, choices[0].get("finish_reason"))


def read_models(response: httpx.Response) -> list[dict[str, Any]] | None:
    """Read the list of models, each an object with `id`; None where there is none."""
    if response.status_code != 200:
        return None
    try:
        value = parse_json(response.content)
    except ValueError:
        return None
    listed = value.get("data") if isinstance(value, dict) else None
    if not isinstance(listed, list):
        return None
    return [entry for entry in listed if isinstance(entry, dict) and isinstance(entry.get("id"), str)]


def retry_after_s(response: httpx.Response) -> float | None:
    """Read Retry-After in seconds, bounded; None where absent or a date."""
    try:
        return min(600.0, max(0.0, float(response.headers.get("retry-after", ""))))
    except ValueError:
        return None
