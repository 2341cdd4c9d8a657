"""Errors that data, configuration or the environment can cause. Everything else is a bug and keeps its traceback.

A *fatal* error ends the stage; any other, raised inside one item, is recorded for that item and counted.
"""

import reprlib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

from cosfly.runtime.escaping import for_terminal

MOST_NAMED = 12  # problems in a message


class CosflyError(Exception):
    """An error that a user can act on.

    Args:
        what: What failed, one short sentence.
        where: The file, item id or field.
        got: The offending value.
        expected: The right value.
        fix: What to do.
    """

    fatal: ClassVar[bool] = False
    code: ClassVar[str] = "error"

    def __init_subclass__(cls, **fixed: Any) -> None:
        for name, value in fixed.items():
            setattr(cls, name, value)

    def __init__(
        self,
        what: str,
        *,
        where: str | Path | None = None,
        got: object = None,
        expected: str | None = None,
        fix: str | None = None,
    ) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.got = got
        self.expected = expected
        self.fix = fix

    def __str__(self) -> str:
        got = self.got if self.got is None or isinstance(self.got, str) else shown(self.got)
        details = (("got ", got), ("expected ", self.expected), ("", self.fix))
        parts = [self.what if self.where is None else f"{self.where}: {self.what}"]
        parts += [word + text for word, text in details if text is not None]
        # One line of printable characters.
        return " ".join("; ".join(map(for_terminal, parts)).split())

    @classmethod
    def of_all(cls, problems: Sequence[str], *, where: str | Path, expected: str | None = None) -> Self:
        """Return one error for several problems of a file: the first MOST_NAMED of them, and their number."""
        more = f"; and {len(problems) - MOST_NAMED} more" if len(problems) > MOST_NAMED else ""
        count = f"{len(problems)} to fix" if len(problems) > 1 else None
        return cls("; ".join(problems[:MOST_NAMED]) + more, where=where, expected=expected, fix=count)

    def __reduce__(self) -> tuple:
        # Errors cross process borders; the default reduction would drop the keyword arguments.
        details = {name: getattr(self, name) for name in ("where", "got", "expected", "fix")}
        return partial(type(self), self.what, **details), ()


class ConfigError(CosflyError, code="config"):
    """A setting is unknown, of the wrong type, or contradicts another."""


class InputError(CosflyError, code="input"):
    """A file is missing, malformed, of another version, or holds an impossible value."""


class ResumeError(CosflyError, code="resume"):
    """A folder holds work made with other settings or inputs."""


class EnvironmentMissing(CosflyError, code="environment", fatal=True):
    """A package, library, device or GL backend is missing."""


class StorageError(CosflyError, code="storage", fatal=True):
    """A disk is full or not writable."""


class NoPathError(CosflyError, code="no_path"):
    """There are no endpoints, no route, or no feasible trajectory."""


class NothingKept(CosflyError, code="nothing_kept"):
    """A stage has nothing for the next one."""


class RenderError(CosflyError, code="render"):
    """A frame cannot be rendered or is wrong."""


class TeacherError(CosflyError, code="teacher", fatal=True):
    """An endpoint cannot be reached or does not speak the protocol."""


class VerifyError(CosflyError, code="verify"):
    """A finished product differs from its records."""


def shown(value: Any, longest: int = 80) -> str:
    """Return a value of a JSON or YAML file for a message, cut to `longest` characters: null for None, 'text', 1.5."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return (reprlib.repr(value) if isinstance(value, dict | list) else repr(value))[:longest]


def json_type(value: Any) -> str:
    """Return the words for the type of a JSON or YAML value in a message: null, text, a list."""
    words = {type(None): "null", str: "text", bool: "a truth value", list: "a list", dict: "an object"}
    return words.get(type(value), "a number")


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts by reason for a message, such as `huge 3, no size 2`."""
    return ", ".join(f"{reason} {count}" for reason, count in sorted(counts.items()))


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ' (did you mean X?)' for the nearest known name, or the empty string."""
    matches = get_close_matches(name, list(known), 1)
    return f" (did you mean {matches[0]!r}?)" if matches else ""


def plain(message: str) -> str:
    """Return the message of a validator of ours without pydantic's prefix."""
    return message.removeprefix("Value error, ")
