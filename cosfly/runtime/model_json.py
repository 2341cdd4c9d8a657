"""The JSON object in a model's answer: the last complete one of its final message.

An answer takes one of six forms: the plain object; the object in a code fence; after thoughts in the common tags
(`<think>`, `<thinking>`, `<reasoning>`, `<thought>`, `[THINK]`, the channels of gpt-oss and Gemma), whose beginning may
be missing; with other text around it; as the value of a key of one other object, such as a function call; and as an
escaped string there. Nothing is completed or guessed: an object without an end, with a repeated key, or in another form
is a failure with a reason.
"""

import json
import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from cosfly.runtime.json_io import is_deep

MAX_DIGITS = 18  # of an integer; longer ones are read as floats
MAX_CHARACTERS = 100_000  # of reasoning and answer; a longer text is not read
MAX_BROKEN = 100  # texts that begin like an object but are no object

_THOUGHT = r"think(?:ing)?|reasoning|thought"
# The beginning and the end of thoughts. Text before an end without a beginning is thought too, because templates put
# the beginning into the prompt.
_MARK = re.compile(
    rf"(?P<opens><(?:{_THOUGHT})>|\[THINK\]|<\|channel\|?>(?:analysis|commentary|thought))"
    rf"|(?P<closes></(?:{_THOUGHT})>|\[/THINK\]|<\|channel\|>final|<channel\|>)|\{{(?!\{{)",
    re.IGNORECASE,
)

DECLINED = "declined"  # finish reason: the model declines to answer, in its own words
CONTEXT_FULL = "context_full"  # finish reason: prompt and answer fill the context, before `max_tokens`
_NOTHING = re.compile(r"(?:[\s\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u2064\ufeff]|```\w*)*+")
# Finish reason of a message that was cut off or declines to answer -> ours.
_CUT = {
    "length": "cut_short", "max_tokens": "cut_short", "content_filter": "content_filter",
    CONTEXT_FULL: CONTEXT_FULL, DECLINED: DECLINED,
}  # fmt: skip

_KEY = re.compile(r'\s*"')
# Half a surrogate pair, which cannot be written, and the replacement of bytes that a decoder could not read.
_UNREADABLE = re.compile("[\ud800-\udfff\ufffd]")


@dataclass(frozen=True)
class AnswerObject:
    """The object in an answer, or the reason why there is none."""

    value: dict[str, Any] | None
    reason: str | None = None
    recovered: tuple[str, ...] = ()  # the kinds of text around it
    is_end: bool = True  # no text follows it


@dataclass
class _Object:
    """A complete object, text[start:end]."""

    value: dict[str, Any]
    start: int
    end: int
    problem: str | None  # the reason why its value is refused


@dataclass
class _Message:
    """The final message of a text."""

    start: int = 0
    has_thoughts: bool = False  # before it
    is_thought: bool = False  # it ends within thoughts
    objects: list[_Object] = field(default_factory=list)
    broken_at: int = -1  # the position of the last object without an end


def find_object(text: str, names: Collection[str], finish_reason: str | None = None) -> AnswerObject:
    """Return the last complete object of the final message with one of these names.

    Without such an object, the last one is returned. Reasons: empty, too_long, no_json_object, only_thinking,
    broken_json, duplicate_key, not_finite, unreadable_character; and for a message that was cut off, whose object may
    be a draft if text follows it: cut_short, content_filter, context_full, declined.
    """
    if len(text) > MAX_CHARACTERS:
        return AnswerObject(None, "too_long")
    answer = _last_object(text, names)
    cut = _CUT.get((finish_reason or "").lower())
    if cut is None or (answer.value is not None and answer.is_end):
        return answer
    return AnswerObject(None, cut, answer.recovered, is_end=False)


def _last_object(text: str, names: Collection[str]) -> AnswerObject:
    message = _read_message(text)
    for candidate in reversed(message.objects):
        inner = _unwrapped(candidate.value, names)
        if inner is None:
            continue
        if message.broken_at >= candidate.end:  # a later object, which was meant to replace this one, has no end
            break
        return _answer_object(text, message, candidate, inner)
    if message.broken_at >= 0:
        return AnswerObject(None, "broken_json", is_end=False)
    if message.objects:
        last = message.objects[-1]
        return AnswerObject(None, last.problem) if last.problem else AnswerObject(last.value)
    if message.is_thought or (message.has_thoughts and _NOTHING.fullmatch(text, message.start)):
        return AnswerObject(None, "only_thinking", is_end=False)
    return AnswerObject(None, "empty" if _NOTHING.fullmatch(text) else "no_json_object")


def _answer_object(text: str, message: _Message, candidate: _Object, inner: dict[str, Any]) -> AnswerObject:
    """Return the answer whose object is a candidate of the message, or an object inside it."""
    before = text[message.start : candidate.start]
    after = text[candidate.end :]
    is_end = _NOTHING.fullmatch(after) is not None
    recovered = {
        "thinking_tags": message.has_thoughts,
        "code_fence": "```" in before or "```" in after,
        "prose_around": not (is_end and _NOTHING.fullmatch(before)),
        "wrapped": inner is not candidate.value,
    }
    kinds = tuple(kind for kind, is_found in recovered.items() if is_found)
    problem = candidate.problem
    if problem is None and _UNREADABLE.search(json.dumps(inner, ensure_ascii=False)):
        problem = "unreadable_character"
    return AnswerObject(None if problem else inner, problem, kinds, is_end)


def _unwrapped(value: dict[str, Any], names: Collection[str]) -> dict[str, Any] | None:
    """Return the object with one of the names: this one, or the only one among its values; else None."""
    if not value.keys().isdisjoint(names):
        return value
    members = [_object_of(member) for member in value.values()]
    named = [member for member in members if member and not member.keys().isdisjoint(names)]
    return named[0] if len(named) == 1 else None


def _object_of(member: Any) -> dict[str, Any] | None:
    """Return a member that is an object, or a JSON text of one; else None."""
    if isinstance(member, str) and member.lstrip().startswith("{"):
        try:
            parsed = _reader()(member.strip(), 0)
        except (ValueError, RecursionError):
            return None
        return None if parsed.problem else parsed.value
    return member if isinstance(member, dict) else None


# --- where the objects are --------------------------------------------------------------------------------------------


def _read_message(text: str) -> _Message:
    read_object = _reader()
    message = _Message()
    position = 0
    num_broken = 0
    last_brace = text.rfind("}")
    while mark := _MARK.search(text, position):
        position = mark.end()
        if mark.lastgroup is not None:  # everything before is thought, or a draft
            message = _Message(position, has_thoughts=True, is_thought=mark.lastgroup == "opens")
        elif not message.is_thought:
            try:
                message.objects.append(read_object(text, mark.start()))
                position = message.objects[-1].end
            except (ValueError, RecursionError):
                # A quoted key or a missing closing brace shows that an object was intended.
                has_key = _KEY.match(text, position) is not None
                if has_key or last_brace < position:
                    message.broken_at = mark.start()
                if has_key:  # without a key, reading has ended at once
                    num_broken += 1
                if num_broken > MAX_BROKEN:
                    message.broken_at = len(text)
                    break
    return message


def _reader() -> Callable[[str, int], _Object]:
    """Return a function that reads the object at a position of a text and records why its value is refused."""
    problems = list[str]()

    def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        value = dict(pairs)
        if len(value) < len(pairs):
            problems.append("duplicate_key")
        return value

    def finite(word: str) -> float:
        value = float(word)
        if not math.isfinite(value):
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
