"""Problems of the material: reading goes on after one, so that all are reported together; nothing is written then."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from cosfly.runtime.errors import CosflyError, InputError, VerifyError
from cosfly.runtime.run_dir import Failed

MOST_NAMED = 10  # in a message


class Problems:
    """Collects problems, each under the name of its track or caption."""

    def __init__(self, most: int | None = None) -> None:
        """Take the number of problems after which all are raised, None for no limit."""
        self.failures: list[Failed] = []
        self._most = most

    def add(self, name: str, error: CosflyError) -> None:
        self.failures.append(Failed(id=name, code=error.code, message=str(error)))

    @contextmanager
    def collected(self, name: str) -> Iterator[None]:
        """Add what the block raises about the material."""
        try:
            yield
        except (InputError, VerifyError) as error:
            if len(self.failures) == self._most:
                raise  # the error that names all of them
            self.add(name, error)
            if len(self.failures) == self._most:
                self.raise_any("the material has {} or more")

    def raise_any(self, what: str, more: str = "", **context: Any) -> None:
        """Raise one error if there are problems. what: With {} for their number. more: Where the others are listed."""
        if not self.failures:
            return
        kind = VerifyError if all(one.code == VerifyError.code for one in self.failures) else InputError
        num = len(self.failures)
        named = " | ".join(one.message for one in self.failures[:MOST_NAMED])
        if num == 1 and not context:
            raise kind(named)
        unnamed = f" | and {num - MOST_NAMED} more{more}" if num > MOST_NAMED else ""
        raise kind(what.format("1 problem" if num == 1 else f"{num} problems"), got=named + unnamed, **context)
