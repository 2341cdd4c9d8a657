"""What data, configuration or the environment can cause. Everything else is a bug and keeps its traceback.

CosflyError
|-- ConfigError         a setting is unknown, of the wrong type, or contradicts another
|-- InputError          a file is missing, malformed, of another version, or holds a value that cannot be
|-- ResumeError         a folder holds work made with other settings or inputs
|-- EnvironmentMissing  a package, library, device or GL backend is not there      (fatal)
|-- StorageError        a disk is full or not writable                             (fatal)
|-- NoPathError         no endpoints, no route, no feasible flight
|-- NothingKept         a stage has nothing for the next one
|-- RenderError         a frame cannot be made or is not what it must be
|-- TeacherError        an endpoint cannot be reached or does not speak the protocol (fatal)
`-- VerifyError         a finished product is not what its records say

A *fatal* error ends the stage; any other, raised inside one item, is recorded for that item and counted.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

from cosfly.escaping import for_terminal


class CosflyError(Exception):
    """An error that a user can act on.

    Args:
        what: what failed, one short sentence.
        where: the file, item id or field.
        got: the offending value.
        expected: what would have been right.
        fix: what to do.
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
        return " ".join(
            "; ".join(map(for_terminal, parts)).split()
        )  # one line that a terminal prints, whatever the parts held

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
    """Give ' (did you mean X?)' for the nearest known name, or the empty string."""
    matches = get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean {matches[0]!r}?)" if matches else ""
