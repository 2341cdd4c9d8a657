"""The JSON object in what a model wrote: the last complete one of its final message.

Thoughts, drafts, fences and prose round it are passed over. Read is JSON, and what differs from it in punctuation alone: trailing commas,
comments, other quotes round a string, full-width colons and commas. The inside of a string stays as it is, and nothing is completed
or chosen: an object that ends in the middle, or has a key twice, is a failure with a reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from cosfly.reading.lenient import BLANK, Broken, ObjectReader

MAX_CHARACTERS = 100_000  # more than any reasoning and answer take; what is longer is not read
MAX_WRAPPERS = 3  # round the object that was asked for

# How models mark where their thoughts begin and end: tags, special tokens, channels, sentences. What stands before the last end that has
# no beginning was thought, too: templates put the beginning into the prompt.
_THOUGHT = r"(?:think(?:ing|_fast|_faster)?|thoughts?|reasoning|reflection|analysis|scratchpad)"
_TAG = rf"(?:[\w|:]{{1,20}}[_:|]|ant)?{_THOUGHT}"  # bounded, as all here: else the worst texts take quadratic time
_END = r"(?=[\w:]{0,20}end)"
_TOKEN = rf"(?:[\w:]{{1,20}}[_:])?{_THOUGHT}[\w:]{{0,20}}\|>"
_OPENS = (
    rf"<\s{{0,3}}{_TAG}\b[^<>/|]{{0,80}}>|<\|(?!{_END}){_TOKEN}|<\|open\|>think|<\|inner_prefix\|>|to=self<\|message\|>"
    r"|\[THINK\]|\[unused16\]|<unused94>|◁think▷"
    r"|<\|channel\|?>\s{0,3}(?:analysis|commentary|thought)|\A\s{0,9}(?-i:analysis)(?=(?-i:[A-Z]))"
)
_CLOSES = (
    rf"<\s{{0,3}}/\s{{0,3}}{_TAG}\s{{0,3}}>|<\|{_END}{_TOKEN}|<\|close\|>think|<\|inner_suffix\|>|to=user<\|message\|>"
    r"|\[/THINK\]|\[unused17\]|<unused95>|◁/think▷"
    r"|<\|channel\|>\s{0,3}final|<channel\|>|(?-i:assistantfinal)|\[BEGIN FINAL RESPONSE\]|Here is my response:"
)
_MARK = re.compile(rf"(?P<opens>{_OPENS})|(?P<closes>{_CLOSES})|\{{(?!\{{)", re.IGNORECASE)
_CLOSE = re.compile(_CLOSES, re.IGNORECASE)

CONTEXT_FULL = "context_full"  # why an answer ended: prompt and answer fill the context, before `max_tokens`
_NOTHING = re.compile(rf"(?:[{BLANK}]|```\w*)*+")
# Finish reason -> ours, of a message that was cut off.
_CUT = {
    "length": "cut_short",
    "max_tokens": "cut_short",
    "content_filter": "content_filter",
    CONTEXT_FULL: CONTEXT_FULL,
}

# Half a surrogate pair, which no file can hold, and what a decoder puts in the place of bytes that it could not read.
_UNREADABLE = re.compile("[\ud800-\udfff\ufffd]")


@dataclass(frozen=True)
class Found:
    """The object, or None and the reason; `mended` names what stood in the way. is_end: nothing was written after it."""

    value: dict[str, Any] | None
    reason: str | None = None
    mended: tuple[str, ...] = ()
    is_end: bool = True


def find_object(text: str, names: Collection[str], finish_reason: str | None = None) -> Found:
    """Find the last complete object of the final message that has one of these names, which its keys are spelled as.

    Reasons: empty, too_long, no_json_object, only_thinking, broken_json, duplicate_key, not_finite, unreadable_character, and of a message
    that was cut off (an object that was not the end of it may be a draft) cut_short, content_filter, context_full. An object that has none of the
    names is given where there is no other.
    """
    if len(text) > MAX_CHARACTERS:
        return Found(None, "too_long")
    found = _found(text, names)
    cut = _CUT.get((finish_reason or "").lower())
    return found if cut is None or (found.value is not None and found.is_end) else Found(None, cut, found.mended, False)


def _found(text: str, names: Collection[str]) -> Found:
    try:
        value = _STRICT.decode(text)  # most answers are nothing but JSON
    except (ValueError, RecursionError):
        return _searched(text, names)
    if isinstance(value, str):
        found = _found(value, names)
        return Found(found.value, found.reason, (*found.mended, "encoded_twice"), found.is_end)
    if not isinstance(value, dict):
        return _searched(text, names)
    return _named(value, text, names, [], True)


class _Refused(ValueError):
    """Strict JSON does not hold this."""


def _distinct(members: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(members)
    if len(value) < len(members):
        raise _Refused("a key stands there twice")
    return value


def _no_constant(word: str) -> float:
    raise _Refused(word)


def _finite(number: str) -> float:
    value = float(number)
    if abs(value) == float("inf"):
        raise _Refused(number)
    return value


_STRICT = json.JSONDecoder(object_pairs_hook=_distinct, parse_float=_finite, parse_constant=_no_constant)


# --- where the object is ------------------------------------------------------------------------------------------------


@dataclass
class _Message:
    """What was found of the final message up to some place.

    start: where it begins. objects: complete ones and their readers. broken_at: of the last object that ends in the middle.
    """

    start: int = 0
    has_thoughts: bool = False
    is_thought: bool = False  # it ends within thoughts
    objects: list[tuple[dict[str, Any], ObjectReader]] = field(default_factory=list)
    broken_at: int = -1


def _searched(text: str, names: Collection[str]) -> Found:
    message = _read_message(text)
    plain_names = {_plain(name) for name in names}
    for value, reader in reversed(message.objects):
        if _unwrapped(value, plain_names) is None:
            continue
        if message.broken_at >= reader.end:
            return Found(None, "broken_json", is_end=False)
        around = (text[message.start : reader.start], text[reader.end :])
        mended = ["thinking_tags"] if message.has_thoughts else []
        mended += ["code_fence"] if any("```" in part for part in around) else []
        mended += [] if all(_NOTHING.fullmatch(part) for part in around) else ["prose_around"]
        is_end = _NOTHING.fullmatch(around[1]) is not None
        if reader.problem is not None:
            return Found(None, reader.problem, tuple(mended), is_end)
        return _named(value, text, names, mended + sorted(reader.mended), is_end)
    return _unescaped_object(text[message.start :], names) or _without_names(text, message)


def _read_message(text: str) -> _Message:
    message, at = _Message(), 0
    while mark := _MARK.search(text, at):
        at = mark.end()
        if mark.lastgroup == "opens":
            message.has_thoughts, close = True, _CLOSE.search(text, at)
            if close is None:
                message.is_thought = True
                break
            at = close.end()
            message.start = message.start if message.objects else at
        elif mark.lastgroup == "closes":  # all before it was thought
            message = _Message(at, has_thoughts=True)
        else:
            reader = ObjectReader(text, mark.start())
            try:
                value, at = reader.read()
                message.objects.append((value, reader))
            except Broken as broken:
                at = broken.resume
                if reader.is_begun:
                    message.broken_at = mark.start()
    return message


def _without_names(text: str, message: _Message) -> Found:
    """Say why there is no object, or give one of other names."""
    if message.broken_at >= 0:
        return Found(None, "broken_json", is_end=False)
    if message.objects:
        value, reader = message.objects[-1]
        return Found(None, reader.problem) if reader.problem else Found(value)
    if message.is_thought or (message.has_thoughts and _NOTHING.fullmatch(text, message.start)):
        return Found(None, "only_thinking", is_end=False)
    return Found(None, "empty" if _NOTHING.fullmatch(text) else "no_json_object")


def _unescaped_object(text: str, names: Collection[str]) -> Found | None:
    r"""Find an object all of whose quotes are escaped, `{\"a\": \"b\"}`: the inside of a JSON text."""
    escaped = text[text.find("{") : text.rfind("}") + 1]
    if '\\"' not in escaped:
        return None
    try:
        found = _found(json.loads(f'"{escaped}"', strict=False), names)
    except ValueError:
        return None
    return None if found.value is None else Found(found.value, None, (*found.mended, "encoded_twice"), found.is_end)


# --- which object it is -------------------------------------------------------------------------------------------------


def _plain(name: str) -> str:
    """Give the letters of a name, however it is spelled: criticalComponents, Critical-Components, **critical components**."""
    return re.sub(r"[\W_]+", "", name).lower()


def _unwrapped(value: dict[str, Any], plain_names: Collection[str], wrappers: int = 0) -> dict[str, Any] | None:
    """Give the object that has one of the names: this one, or the only one in it, as in a function call; else None."""
    if any(_plain(key) in plain_names for key in value):
        return value
    if wrappers == MAX_WRAPPERS:
        return None
    found = [_unwrapped(member, plain_names, wrappers + 1) for member in map(_object_of, value.values()) if member]
    inner = [member for member in found if member is not None]
    return inner[0] if len(inner) == 1 else None


def _object_of(member: Any) -> dict[str, Any] | None:
    """Give a member that is an object, or one as a JSON text."""
    if isinstance(member, str) and member.lstrip().startswith("{"):
        try:
            member = _STRICT.decode(member)
        except (ValueError, RecursionError):
            return None
    return member if isinstance(member, dict) else None


def _named(value: dict[str, Any], text: str, names: Collection[str], mended: list[str], is_end: bool) -> Found:
    """Spell the keys of the object that was asked for as they are asked for."""
    if not all(map(names.__contains__, value)):
        names_by_plain = {_plain(name): name for name in names}
        inner = _unwrapped(value, names_by_plain.keys())
        if inner is None:
            return Found(value, None, tuple(mended), is_end)
        renamed = {names_by_plain.get(_plain(key), key): member for key, member in inner.items()}
        if len(renamed) < len(inner):
            return Found(None, "duplicate_key", tuple(mended), is_end)
        mended = (
            mended
            + (["wrapped"] if inner is not value else [])
            + (["key_names"] if renamed.keys() != inner.keys() else [])
        )
        value = renamed
    if _may_be_unreadable(text) and _UNREADABLE.search(json.dumps(value, ensure_ascii=False)):
        return Found(None, "unreadable_character", tuple(mended), is_end)
    return Found(value, None, tuple(mended), is_end)


def _may_be_unreadable(text: str) -> bool:
    """Tell by a glance at a text whether its object may hold what is no character."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return True
    return "\\u" in text or "\ufffd" in text
