"""Errors that data, configuration or the environment can cause. Everything else is a bug and keeps its traceback.

CosflyError
|-- ConfigError         a setting is unknown, of the wrong type, or contradicts another
|-- InputError          a file is missing, malformed, of another version, or holds an impossible value
|-- ResumeError         a folder holds work made with other settings or inputs
|-- EnvironmentMissing  a package, library, device or GL backend is missing        (fatal)
|-- StorageError        a disk is full or not writable                             (fatal)
|-- NoPathError         no endpoints, no route, no feasible trajectory
|-- NothingKept         a stage has nothing for the next one
|-- RenderError         a frame cannot be made or is not what it must be
|-- TeacherError        an endpoint cannot be reached or does not speak the protocol (fatal)
`-- VerifyError         a finished product differs from its records

A *fatal* error ends the stage; any other, raised inside one item, is recorded for that item and counted.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import SequenceMatcher
from functools import partial
from pathlib import Path
from typing import Any, Self

from cosfly.runtime.escaping import for_terminal

MOST_NAMED = 12  # problems in a message
# Names of settings that share words are nearer than their letters: goal_min_m is min_distance_m, not resolution_m.
NEAR, SHARED_WORD = 0.6, 0.15


class CosflyError(Exception):
    """An error that a user can act on.

    Args:
        what: What failed, one short sentence.
        where: The file, item id or field.
        got: The offending value.
        expected: The right value.
        fix: What to do.
    """

    fatal = False
    code = "error"

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
        self.what, self.where, self.got, self.expected, self.fix = what, where, got, expected, fix

    def __str__(self) -> str:
        parts = [f"{self.where}: {self.what}" if self.where is not None else self.what]
        if self.got is not None:
            parts.append(f"got {self.got if isinstance(self.got, str) else repr(self.got)}")
        if self.expected is not None:
            parts.append(f"expected {self.expected}")
        if self.fix is not None:
            parts.append(self.fix)
        # One line that a terminal prints, whatever the parts held.
        return " ".join("; ".join(map(for_terminal, parts)).split())

    @classmethod
    def of_all(cls, problems: Sequence[str], *, where: str | Path, expected: str | None = None) -> Self:
        """Return one error for several problems of a file: the first of them, and how many there are."""
        more = f"; and {len(problems) - MOST_NAMED} more" if len(problems) > MOST_NAMED else ""
        count = f"{len(problems)} to fix" if len(problems) > 1 else None
        return cls("; ".join(problems[:MOST_NAMED]) + more, where=where, expected=expected, fix=count)

    def __reduce__(self) -> tuple:
        # Errors cross process borders; the default reduction would drop the keyword arguments.
        details: dict[str, Any] = {"where": self.where, "got": self.got, "expected": self.expected, "fix": self.fix}
        return partial(type(self), self.what, **details), ()


class ConfigError(CosflyError):
    code = "config"


class InputError(CosflyError):
    code = "input"


class ResumeError(CosflyError):
    code = "resume"


class EnvironmentMissing(CosflyError):
    fatal = True
    code = "environment"


class StorageError(CosflyError):
    fatal = True
    code = "storage"


class NoPathError(CosflyError):
    code = "no_path"


class NothingKept(CosflyError):
    code = "nothing_kept"


class RenderError(CosflyError):
    code = "render"


class TeacherError(CosflyError):
    fatal = True
    code = "teacher"


class VerifyError(CosflyError):
    code = "verify"


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ' (did you mean X?)' for the nearest known name, or the empty string."""
    found = max(known, key=partial(_nearness, name), default="")
    return f" (did you mean {found!r}?)" if found and _nearness(name, found) >= NEAR else ""


def _nearness(name: str, known: str) -> float:
    """Return the share of letters that two names have in common, and more for each common word that is no unit."""
    shared = {*re.split(r"[\W_]+", name)} & {*re.split(r"[\W_]+", known)}
    counts = len(shared) if any(len(word) > 2 for word in shared) else 0
    return SequenceMatcher(None, name, known).ratio() + SHARED_WORD * counts


def plain(message: str) -> str:
    """Return the message of a validator of ours without pydantic's prefix."""
    return message.removeprefix("Value error, ")
