"""The chat-completions protocol: URLs, request bodies, and what a response says."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable
from typing import Any, get_args

import httpx

from cosfly.chat.contract import MOST_TOKENS, CountName, Reply, Request
from cosfly.chat.wire import KEY_VARIABLE, Response
from cosfly.products.captions import Usage
from cosfly.work.store import dump_json, sha256_bytes

_IMAGE_MARK = re.compile(rb'"\\u0000(\d+)"')
THOUGHT_FIELDS = ("reasoning_content", "reasoning", "thinking", "reasoning_details")  # of a message, beside its content
ERROR_INSTEAD = "an error in place of an answer"  # with status 200
ENDED = (
    "error",
    "abort",
)  # finish reasons of an answer that a server gave up, SGLang with status 200 and nothing in it
MOST_NAME = 256  # characters of a name that is kept: of a model, of why an answer ended
BYTES_PER_TOKEN = 3  # a low guess: a budget that counts with it is kept
PIXELS_PER_TOKEN = 28 * 28  # of common vision encoders
# What no tokenizer and no vision encoder gets below: a count that is smaller is none.
MOST_BYTES_PER_TOKEN, LEAST_PER_PICTURE = 16, 16


def check_url(url: str) -> None:
    """Check that a URL can be asked, and holds no secret: it is written into `run.yaml` and shown in messages.

    Raises:
        ValueError: says what is wrong, and nothing of the URL that may be a secret.
    """
    shown = "" if "@" in url else f", got {re.split('[?#]', url)[0][:200]!r}"
    if not re.match(r"https?://", url, re.IGNORECASE):
        raise ValueError(f"a URL must begin with http:// or https://{shown}")
    if re.search(r"[\s\x00-\x1f\x7f]", url):
        raise ValueError(f"a URL must not hold blanks{shown}")
    if re.search("[@?#]", url):
        what = "a URL must hold no user, password, query or fragment, since it is written down"
        raise ValueError(f"{what}; a key goes into the environment variable {KEY_VARIABLE}{shown}")
    try:
        parts = httpx.URL(url)
        host = parts.host
        parts.raw_host.decode("ascii").encode("idna")  # as the system's resolver will
    except (httpx.InvalidURL, ValueError) as error:
        raise ValueError(f"not a URL that can be asked{shown} ({' '.join(str(error).split())[:100]})") from None
    if not host or "%" in host:
        raise ValueError(f"a URL must name a host{shown}")
    if parts.port is not None and not 0 < parts.port < 65_536:
        raise ValueError(f"the port must be from 1 to 65535{shown}")


def split_urls(urls: str) -> list[str]:
    """Give the addresses of servers that stand with commas between.

    Raises:
        ValueError: one is none that can be asked (check_url), or stands there twice.
    """
    found = [url.strip() for url in urls.split(",")]
    for number, url in enumerate(found):
        check_url(url)
        if base_url(url) in map(base_url, found[:number]):
            raise ValueError(f"a server stands in the list twice, got {url!r}")
    return found


def base_url(url: str) -> str:
    """Give the API root of whatever form of URL a user has: host, host/v1, or the whole chat-completions path."""
    root = url.rstrip("/").removesuffix("/chat/completions").rstrip("/")
    return root if re.search(r"/v\d+(beta)?(/openai)?$", root) else f"{root}/v1"


# --- requests ---------------------------------------------------------------------------------------------------------


def response_format(schema: dict) -> dict:
    """Give the field of a request that asks for an answer of a JSON schema."""
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
    """Give what a server's JSON says of an error: its `error`, or all of it."""
    error = value.get("error", value) if isinstance(value, dict) else value
    return str(error.get("message", error) if isinstance(error, dict) else error)


def read_completion(response: Response, request: Request, structured: str) -> Reply | str:
    """Give the reply to a request that was sent in this way, or a word on what is wrong with it.

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
    usage, counted = _usage(value.get("usage"), request, message)
    return Reply(text, usage, structured, _name(finish_reason), counted, _name(value.get("model")))


def _name(value: Any) -> str | None:
    """Give a name that can stand in a record, None where it is none."""
    return value if isinstance(value, str) and value.isprintable() and 0 < len(value) <= MOST_NAME else None


def final_text(message: dict[str, Any]) -> str | None:
    """Give what a message says in the end, "" where it holds thoughts alone, None where it holds nothing.

    That is its text, the arguments of the one function that it calls (a schema is served so by some), or why it
    refuses.
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


def _usage(value: Any, request: Request, message: dict[str, Any]) -> tuple[Usage | None, tuple[CountName, ...]]:
    """Read the counts of tokens; gives None where the server counts nothing, and the names of those that are ours since
    its cannot be."""
    found = value if isinstance(value, dict) else {}
    names = get_args(CountName)
    if all(found.get(name) is None for name in names):
        return None, ()
    said = [text for text in (final_text(message), *map(message.get, THOUGHT_FIELDS)) if isinstance(text, str)]
    texts, pictures = _asked(request)
    least: dict[CountName, int] = {
        "prompt_tokens": max(1, _least_tokens(texts) + LEAST_PER_PICTURE * len(pictures)),
        "completion_tokens": max(min(1, _tokens(said)), _least_tokens(said)),
    }
    wrong = tuple(name for name in names if not _is_count(found.get(name), least[name]))
    if not wrong:
        return Usage(**{name: found[name] for name in names}), ()
    pixels = (_num_pixels(picture) for picture in pictures if "prompt_tokens" in wrong)
    asked = max(1, _tokens(texts)) + sum(-(-number // PIXELS_PER_TOKEN) for number in pixels)
    ours = {"prompt_tokens": asked, "completion_tokens": _tokens(said)}
    return Usage(**{name: ours[name] if name in wrong else found[name] for name in names}), wrong


def _is_count(value: Any, least: int) -> bool:
    """Tell whether this can be a number of tokens."""
    return type(value) is int and least <= value <= MOST_TOKENS


def _asked(request: Request) -> tuple[list[str], list[str]]:
    """Give the texts and the pictures (data URLs) of a request."""
    contents = [message["content"] for message in request.messages]
    parts: list[dict] = [part for one in contents for part in ([{"text": one}] if isinstance(one, str) else one)]
    texts = [part.get("text", "") for part in parts if "image_url" not in part]
    pictures = [part["image_url"]["url"] for part in parts if "image_url" in part]
    return texts, pictures


def _num_pixels(data_url: str) -> int:
    from PIL import Image

    with Image.open(io.BytesIO(base64.b64decode(data_url.partition(",")[2]))) as image:
        return image.width * image.height


def _tokens(texts: list[str]) -> int:
    return -(-sum(len(text.encode()) for text in texts) // BYTES_PER_TOKEN)


def _least_tokens(texts: list[str]) -> int:
    """Give fewer tokens than texts can have; white space counts for nothing, since a token may hold a line of it."""
    return sum(len("".join(text.split()).encode()) for text in texts) // MOST_BYTES_PER_TOKEN


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
    return [entry for entry in _objects(listed) if _name(entry.get("id"))]
