"""The JSON object in what a model wrote: the last complete one of its final message.

Thoughts, drafts, fences and prose round it are passed over. Read is JSON, and what differs from it in punctuation
alone: trailing commas, comments, other quotes round a string, full-width colons and commas. The inside of a string
stays as it is, and nothing is completed
or chosen: an object that ends in the middle, or has a key twice, is a failure with a reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

MAX_DEPTH = 50  # of brackets
MAX_DIGITS = 18  # of an integer; what has more is read as a float

BLANK = r"\s\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u2064\ufeff"
_GAP = re.compile(rf"(?:[{BLANK}]++|//[^\n]*+|/\*.*?\*/|\*\*)*+", re.DOTALL)
_QUOTES = {'"': '"', "'": "'", "`": "`", "“": "“”", "”": "“”", "‘": "‘’", "’": "‘’", "＂": "＂"}  # opens -> what closes
_STRINGS = {
    opens: re.compile(rf"([^{closes}\\]*+(?:\\.[^{closes}\\]*+)*+)[{closes}]", re.DOTALL)
    for opens, closes in _QUOTES.items()
}
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|(.))", re.DOTALL)
_ESCAPED = {"b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?([eE][-+]?[0-9]+)?(?!\w)")
_WORD = re.compile(r"-?[^\W\d]\w*")
_WORDS = {"true": True, "false": False, "null": None, "True": True, "False": False, "None": None}
_NOT_FINITE = frozenset({"NaN", "nan", "Infinity", "-Infinity", "inf", "-inf"})
_COMMAS, _COLONS = (",", "，"), (":", "：")
MAX_CHARACTERS = 100_000  # more than any reasoning and answer take; what is longer is not read
MAX_WRAPPERS = 3  # round the object that was asked for

# How models mark where their thoughts begin and end: tags, special tokens, channels, sentences. What stands before the
# last end that has no beginning was thought, too: templates put the beginning into the prompt.
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
    """The object, or None and the reason; `mended` names what stood in the way. is_end: nothing was written after
    it.
    """

    value: dict[str, Any] | None
    reason: str | None = None
    mended: tuple[str, ...] = ()
    is_end: bool = True


def find_object(text: str, names: Collection[str], finish_reason: str | None = None) -> Found:
    """Find the last complete object of the final message that has one of these names, which its keys are spelled as.

    Reasons: empty, too_long, no_json_object, only_thinking, broken_json, duplicate_key, not_finite,
    unreadable_character, and of a message that was cut off (an object that was not the end of it may be a draft)
    cut_short, content_filter, context_full. An object that has none of the names is given where there is no other.
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


# --- where the object is ----------------------------------------------------------------------------------------------


@dataclass
class _Message:
    """What was found of the final message up to some place.

    start: where it begins. objects: complete ones and their readers. broken_at: of the last object that ends in the
    middle.
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


# --- which object it is -----------------------------------------------------------------------------------------------


def _plain(name: str) -> str:
    """Give the letters of a name, however it is spelled: criticalComponents, Critical-Components, **critical
    components**.
    """
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


# --- one object, as models write it -----------------------------------------------------------------------------------


class Broken(Exception):
    """No object is here. resume: where the next may begin; what was read before it is part of the broken one."""

    def __init__(self, resume: int) -> None:
        super().__init__(resume)
        self.resume = resume


class ObjectReader:
    """Reads one object. `mended`: what differs from JSON. `problem`: why its value may not be taken."""

    def __init__(self, text: str, start: int) -> None:
        self.text, self.start, self.end = text, start, start
        self.mended: set[str] = set()
        self.problem: str | None = None
        self._string_at = start  # the last string's beginning: if it never ends, the next object begins within it

    @property
    def is_begun(self) -> bool:
        """Whether this can be meant as an object: it has a key in quotes, or is not closed."""
        return self._string_at > self.start or self.text.find("}", self.start) < 0

    def read(self) -> tuple[dict[str, Any], int]:
        """Give the object and where it ends.

        Raises:
            Broken: it is none, or not complete.
        """
        value, self.end = self._object(self.start, 1)
        return value, self.end

    def _broken(self) -> Broken:
        return Broken(self._string_at + 1)

    def _gap(self, at: int) -> int:
        """Pass over blanks, comments and bold marks."""
        found = _GAP.match(self.text, at)
        assert found is not None  # it may be empty
        if self.text.startswith("/*", found.end()):
            raise Broken(len(self.text))  # a comment to the end
        if "/" in found[0] or "*" in found[0]:
            self.mended.add("loose_syntax")
        return found.end()

    def _char(self, at: int) -> str:
        return self.text[at : at + 1]

    def _items(self, at: int, end: str, read_item: Callable[[int], int]) -> int:
        """Read what stands between two brackets, separated by commas; gives the place after the closing one."""
        at = self._gap(at + 1)
        while self._char(at) != end:
            at = self._gap(read_item(at))
            if self._char(at) in _COMMAS:
                self._note(self._char(at) != ",")
                at = self._gap(at + 1)
                if self._char(at) == end:
                    self.mended.add("trailing_comma")
            elif self._char(at) != end:
                raise self._broken()
        return at + 1

    def _note(self, is_loose: bool) -> None:
        if is_loose:
            self.mended.add("loose_syntax")

    def _object(self, at: int, depth: int) -> tuple[dict[str, Any], int]:
        members: dict[str, Any] = {}

        def read_member(at: int) -> int:
            key, at = self._key(at)
            at = self._gap(at)
            if self._char(at) not in _COLONS:
                raise self._broken()
            self._note(self._char(at) != ":")
            if key in members:
                self.problem = "duplicate_key"
            members[key], at = self._value(self._gap(at + 1), depth)
            return at

        return members, self._items(at, "}", read_member)

    def _array(self, at: int, depth: int) -> tuple[list[Any], int]:
        items: list[Any] = []

        def read_item(at: int) -> int:
            item, at = self._value(at, depth)
            items.append(item)
            return at

        return items, self._items(at, "]", read_item)

    def _key(self, at: int) -> tuple[str, int]:
        if self._char(at) in _QUOTES:
            return self._string(at)
        word = _WORD.match(self.text, at)
        if word is None:
            raise self._broken()
        self.mended.add("loose_syntax")
        return word[0], word.end()

    def _value(self, at: int, depth: int) -> tuple[Any, int]:
        char = self._char(at)
        if char in _QUOTES:
            return self._string(at)
        if char in ("{", "["):
            if depth == MAX_DEPTH:
                raise Broken(at)
            return self._object(at, depth + 1) if char == "{" else self._array(at, depth + 1)
        if number := _NUMBER.match(self.text, at):
            is_integer = number[1] is None and number[2] is None and len(number[0].lstrip("-")) <= MAX_DIGITS
            value = int(number[0]) if is_integer else float(number[0])
            self.problem = "not_finite" if abs(value) == float("inf") else self.problem
            return value, number.end()
        word = _WORD.match(self.text, at)
        if word is None or word[0] not in _WORDS.keys() | _NOT_FINITE:
            raise self._broken()
        if word[0] in _NOT_FINITE:
            self.problem = "not_finite"
        self._note(word[0] in ("True", "False", "None"))
        return _WORDS.get(word[0]), word.end()

    def _string(self, at: int) -> tuple[str, int]:
        self._string_at, quote = at, self.text[at]
        found = _STRINGS[quote].match(self.text, at + 1)
        if found is None:
            raise self._broken()
        self._note(quote != '"')
        text = _ESCAPE.sub(self._character, found[1])
        if "\\" in found[1] and not text.isascii():  # two escapes may be one character
            text = text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
        return text, found.end()

    def _character(self, escape: re.Match[str]) -> str:
        """Read an escape. A backslash before punctuation stands for it (`\\_`, `\\'`); before a letter it is no escape
        that anybody knows.
        """
        if escape[1]:
            return chr(int(escape[1], 16))
        if escape[2] in _ESCAPED:
            return _ESCAPED[escape[2]]
        if escape[2].isalnum() or escape[2].isspace():
            raise self._broken()
        self._note(escape[2] not in '"\\/')
        return escape[2]
