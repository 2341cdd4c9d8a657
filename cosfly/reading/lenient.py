"""JSON as models write it: an object read with what differs from JSON in punctuation alone.

That is trailing commas, comments, other quotes round a string, bare keys, bold marks, full-width colons and commas. The inside of a string stays as
it is, and nothing is completed. Where the object stands in a text is found by objects.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable
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
        """Read an escape. A backslash before punctuation stands for it (`\\_`, `\\'`); before a letter it is no escape that anybody knows."""
        if escape[1]:
            return chr(int(escape[1], 16))
        if escape[2] in _ESCAPED:
            return _ESCAPED[escape[2]]
        if escape[2].isalnum() or escape[2].isspace():
            raise self._broken()
        self._note(escape[2] not in '"\\/')
        return escape[2]
