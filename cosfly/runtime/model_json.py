"""The JSON object in a model's answer: the last complete one of its final message.

Thoughts, drafts, fences and prose around it are skipped. Nothing is completed or chosen: an object that ends in the
middle, or has a key twice, is a failure with a reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from cosfly.runtime.json_io import is_deep

MAX_DIGITS = 18  # of an integer; what has more is read as a float
MAX_CHARACTERS = 100_000  # more than any reasoning and answer take; a longer text is not read
MAX_SCANNED = 50 * MAX_CHARACTERS  # in texts that begin like an object and are none
MAX_WRAPPERS = 3  # around the object that was asked for

# Marks of the beginning and end of thoughts: tags, special tokens, channels, sentences. The text before the last end
# that has no beginning is thought, too: templates put the beginning into the prompt.
_THOUGHT = r"(?:think(?:ing|_fast|_faster)?|thoughts?|reasoning|reflection|analysis|scratchpad)"
_TAG = rf"(?:[\w|:]{{1,20}}[_:|]|ant)?{_THOUGHT}"  # bounded, as all here: else some texts take quadratic time
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

CONTEXT_FULL = "context_full"  # finish reason: prompt and answer fill the context, before `max_tokens`
_NOTHING = re.compile(r"(?:[\s\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u2064\ufeff]|```\w*)*+")
# Finish reason -> ours, of a message that was cut off.
_CUT = {"length": "cut_short", "max_tokens": "cut_short"} | {name: name for name in ("content_filter", CONTEXT_FULL)}

_KEY = re.compile(r'\s*"')
# Half a surrogate pair, which no file can hold, and the replacement of bytes that a decoder could not read.
_UNREADABLE = re.compile("[\ud800-\udfff\ufffd]")


@dataclass(frozen=True)
class Found:
    """The object, or None and the reason. recovered: the kinds of text around it. is_end: no text follows it."""

    value: dict[str, Any] | None
    reason: str | None = None
    recovered: tuple[str, ...] = ()
    is_end: bool = True


def find_object(text: str, names: Collection[str], finish_reason: str | None = None) -> Found:
    """Return the last complete object of the final message that has one of these names, with keys spelled like them.

    Reasons: empty, too_long, no_json_object, only_thinking, broken_json, duplicate_key, not_finite,
    unreadable_character, and of a message that was cut off (an object that was not the end of it may be a draft)
    cut_short, content_filter, context_full. An object that has none of the names is returned where there is no other.
    """
    if len(text) > MAX_CHARACTERS:
        return Found(None, "too_long")
    found = _found(text, names)
    cut = _CUT.get((finish_reason or "").lower())
    if cut is None or (found.value is not None and found.is_end):
        return found
    return Found(None, cut, found.recovered, is_end=False)


def _found(text: str, names: Collection[str]) -> Found:
    message = _read_message(text)
    names_by_plain = {_plain(name): name for name in names}
    for one in reversed(message.objects):
        if (inner := _unwrapped(one.value, names_by_plain)) is None:
            continue
        if message.broken_at >= one.end:
            return Found(None, "broken_json", is_end=False)
        around = (text[message.start : one.start], text[one.end :])
        renamed = {names_by_plain.get(_plain(key), key): member for key, member in inner.items()}
        problem = one.problem or ("duplicate_key" if len(renamed) < len(inner) else None)
        if problem is None and _UNREADABLE.search(json.dumps(renamed, ensure_ascii=False)):
            problem = "unreadable_character"
        recovered = {
            "thinking_tags": message.has_thoughts,
            "code_fence": any("```" in part for part in around),
            "prose_around": not all(_NOTHING.fullmatch(part) for part in around),
            "wrapped": inner is not one.value,
            "key_names": renamed.keys() != inner.keys(),
        }
        kinds = tuple(filter(recovered.get, recovered))
        is_end = _NOTHING.fullmatch(around[1]) is not None
        return Found(None if problem else renamed, problem, kinds, is_end)
    if message.broken_at >= 0:
        return Found(None, "broken_json", is_end=False)
    if message.objects:
        last = message.objects[-1]
        return Found(None, last.problem) if last.problem else Found(last.value)
    if message.is_thought or (message.has_thoughts and _NOTHING.fullmatch(text, message.start)):
        return Found(None, "only_thinking", is_end=False)
    return Found(None, "empty" if _NOTHING.fullmatch(text) else "no_json_object")


def _plain(name: str) -> str:
    """Return the letters of a name in any spelling: criticalComponents, Critical-Components, **critical component**."""
    return re.sub(r"[\W_]+", "", name).lower()


def _unwrapped(value: dict[str, Any], plain_names: Collection[str], wrappers: int = 0) -> dict[str, Any] | None:
    """Return the object that has one of the names: this one or the only one in it, as in a function call; or None."""
    if any(_plain(key) in plain_names for key in value):
        return value
    if wrappers == MAX_WRAPPERS:
        return None
    members = filter(None, map(_object_of, value.values()))
    inner = [one for member in members if (one := _unwrapped(member, plain_names, wrappers + 1)) is not None]
    return inner[0] if len(inner) == 1 else None


def _object_of(member: Any) -> dict[str, Any] | None:
    """Return a member that is an object, or one as a JSON text."""
    if isinstance(member, str) and member.lstrip().startswith("{"):
        try:
            found = _reader()(member.strip(), 0)
        except (ValueError, RecursionError):
            return None
        return None if found.problem else found.value
    return member if isinstance(member, dict) else None


# --- where the objects are --------------------------------------------------------------------------------------------


@dataclass
class _Object:
    """A complete object, text[start:end]. problem: the reason why its value is refused."""

    value: dict[str, Any]
    start: int
    end: int
    problem: str | None


@dataclass
class _Message:
    """The objects of the final message, which begins at `start`.

    is_thought: it ends within thoughts. broken_at: the place of the last object that ends in the middle.
    """

    start: int = 0
    has_thoughts: bool = False
    is_thought: bool = False
    objects: list[_Object] = field(default_factory=list)
    broken_at: int = -1


def _read_message(text: str) -> _Message:
    read = _reader()
    message = _Message()
    at = num_scanned = 0
    while mark := _MARK.search(text, at):
        at = mark.end()
        if mark.lastgroup == "opens":
            message.has_thoughts = True
            close = _CLOSE.search(text, at)
            if close is None:
                message.is_thought = True
                break
            at = close.end()
            if not message.objects:
                message.start = at
        elif mark.lastgroup == "closes":  # everything before it is thought
            message = _Message(at, has_thoughts=True)
        else:
            try:
                message.objects.append(read(text, mark.start()))
                at = message.objects[-1].end
            except (ValueError, RecursionError) as error:
                # A quoted key or a missing closing brace shows that an object was intended.
                if _KEY.match(text, at) or text.find("}", at) < 0:
                    message.broken_at = mark.start()
                num_scanned += getattr(error, "pos", len(text)) - at
                if num_scanned > MAX_SCANNED:
                    message.broken_at = len(text)
                    break
    return message


def _reader() -> Callable[[str, int], _Object]:
    """Return a function that reads the object at a position of a text and records why its value is refused."""
    problems = list[str]()

    def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(value := dict(pairs)) < len(pairs):
            problems.append("duplicate_key")
        return value

    def finite(word: str) -> float:
        if not abs(value := float(word)) < float("inf"):
            problems.append("not_finite")
        return value

    def whole(digits: str) -> float:
        return int(digits) if len(digits) <= MAX_DIGITS else finite(digits)

    decoder = json.JSONDecoder(
        object_pairs_hook=members, parse_int=whole, parse_float=finite, parse_constant=finite, strict=False
    )

    def read(text: str, start: int) -> _Object:
        problems.clear()
        value, end = decoder.raw_decode(text, start)
        if is_deep(value):
            raise RecursionError
        return _Object(value, start, end, problems[-1] if problems else None)

    return read
