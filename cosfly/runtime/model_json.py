"""The JSON object in a model's answer: the last complete one of its final message.

Thoughts, drafts, fences and prose around it are skipped. Nothing is completed or guessed: an object without an end, or
with a repeated key, is a failure with a reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from cosfly.runtime.json_io import is_deep

MAX_DIGITS = 18  # of an integer; longer ones are read as floats
MAX_CHARACTERS = 100_000  # of reasoning and answer; a longer text is not read
MAX_SCANNED = 50 * MAX_CHARACTERS  # of texts that begin like an object but are no object
MAX_WRAPPERS = 3  # around the object that was asked for

# Marks of the beginning and end of thoughts: tags, special tokens, channels, sentences. Text before an end without a
# beginning is thought too, because templates put the beginning into the prompt.
_THOUGHT = r"(?:think(?:ing|_fast|_faster)?|thoughts?|reasoning|reflection|analysis|scratchpad)"
_TAG = (
    rf"(?:[\w|:]{{1,20}}[_:|]|ant)?{_THOUGHT}"  # bounded like all others, because some texts would take quadratic time
)
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

DECLINED = "declined"  # finish reason: the model declines to answer, in its own words
CONTEXT_FULL = "context_full"  # finish reason: prompt and answer fill the context, before `max_tokens`
_NOTHING = re.compile(r"(?:[\s\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u2064\ufeff]|```\w*)*+")
# Finish reason -> ours, of a message that was cut off or declines to answer.
_CUT = {"length": "cut_short", "max_tokens": "cut_short"}
_CUT |= {name: name for name in ("content_filter", CONTEXT_FULL, DECLINED)}

_KEY = re.compile(r'\s*"')
# Half a surrogate pair, which cannot be written, and the replacement of bytes that a decoder could not read.
_UNREADABLE = re.compile("[\ud800-\udfff\ufffd]")


@dataclass(frozen=True)
class AnswerObject:
    """The object, or None and the reason. recovered: The kinds of text around it. is_end: No text follows it."""

    value: dict[str, Any] | None
    reason: str | None = None
    recovered: tuple[str, ...] = ()
    is_end: bool = True


def find_object(text: str, names: Collection[str], finish_reason: str | None = None) -> AnswerObject:
    """Return the last complete object of the final message with one of these names, its keys spelled like them.

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
    names_by_plain = {_plain(name): name for name in names}
    for candidate in reversed(message.objects):
        if (inner := _unwrapped(candidate.value, names_by_plain)) is None:
            continue
        if message.broken_at >= candidate.end:
            return AnswerObject(None, "broken_json", is_end=False)
        around = (text[message.start : candidate.start], text[candidate.end :])
        renamed = {names_by_plain.get(_plain(key), key): member for key, member in inner.items()}
        problem = candidate.problem or ("duplicate_key" if len(renamed) < len(inner) else None)
        if problem is None and _UNREADABLE.search(json.dumps(renamed, ensure_ascii=False)):
            problem = "unreadable_character"
        recovered = {
            "thinking_tags": message.has_thoughts,
            "code_fence": any("```" in part for part in around),
            "prose_around": not all(_NOTHING.fullmatch(part) for part in around),
            "wrapped": inner is not candidate.value,
            "key_names": renamed.keys() != inner.keys(),
        }
        kinds = tuple(filter(recovered.get, recovered))
        is_end = _NOTHING.fullmatch(around[1]) is not None
        return AnswerObject(None if problem else renamed, problem, kinds, is_end)
    if message.broken_at >= 0:
        return AnswerObject(None, "broken_json", is_end=False)
    if message.objects:
        last = message.objects[-1]
        return AnswerObject(None, last.problem) if last.problem else AnswerObject(last.value)
    if message.is_thought or (message.has_thoughts and _NOTHING.fullmatch(text, message.start)):
        return AnswerObject(None, "only_thinking", is_end=False)
    return AnswerObject(None, "empty" if _NOTHING.fullmatch(text) else "no_json_object")


def _plain(name: str) -> str:
    """Return the letters of a name in any spelling: criticalComponents, Critical-Components, **critical component**."""
    return re.sub(r"[\W_]+", "", name).lower()


def _unwrapped(value: dict[str, Any], plain_names: Collection[str], wrappers: int = 0) -> dict[str, Any] | None:
    """Return the object with one of the names: this one, or the only one inside, as in a function call; else None."""
    if any(_plain(key) in plain_names for key in value):
        return value
    if wrappers == MAX_WRAPPERS:
        return None
    members = filter(None, map(_object_of, value.values()))
    inner = [_unwrapped(member, plain_names, wrappers + 1) for member in members]
    objects = [value for value in inner if value is not None]
    return objects[0] if len(objects) == 1 else None


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

    is_thought: It ends within thoughts. broken_at: The position of the last object without an end.
    """

    start: int = 0
    has_thoughts: bool = False
    is_thought: bool = False
    objects: list[_Object] = field(default_factory=list)
    broken_at: int = -1


def _read_message(text: str) -> _Message:
    read_object = _reader()
    message = _Message()
    position = num_scanned = 0
    while mark := _MARK.search(text, position):
        position = mark.end()
        if mark.lastgroup == "opens":
            message.has_thoughts = True
            close = _CLOSE.search(text, position)
            if close is None:
                message.is_thought = True
                break
            position = close.end()
            if not message.objects:
                message.start = position
        elif mark.lastgroup == "closes":  # everything before it is thought
            message = _Message(position, has_thoughts=True)
        else:
            try:
                message.objects.append(read_object(text, mark.start()))
                position = message.objects[-1].end
            except (ValueError, RecursionError) as error:
                # A quoted key or a missing closing brace shows that an object was intended.
                if _KEY.match(text, position) or text.find("}", position) < 0:
                    message.broken_at = mark.start()
                num_scanned += getattr(error, "pos", len(text)) - position
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
