"""Tables of cases that are one test: a row costs its own work, not a fixture's, and each that fails is named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any


def each(names: str | Sequence[str], rows: Iterable[Any], ids: object = None) -> Callable[[Callable], Callable]:
    """Take the place of `pytest.mark.parametrize` for a test without fixtures; `ids` are of no use here."""
    words = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    table = [dict(zip(words, row if len(words) > 1 else (row,), strict=True)) for row in rows]
    assert table

    def decorate(test: Callable) -> Callable:
        def of_all_rows(subtests: Any) -> None:
            for number, row in enumerate(table):
                with subtests.test(msg=f"row {number}", **{name: repr(value)[:200] for name, value in row.items()}):
                    test(**row)

        of_all_rows.__name__, of_all_rows.__doc__, of_all_rows.__module__ = test.__name__, test.__doc__, test.__module__
        return of_all_rows

    return decorate
