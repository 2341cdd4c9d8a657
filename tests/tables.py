"""Tables of cases that are one test: a row costs its own work, not a fixture's, and each that fails is named."""

import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest


def each(names: str | Sequence[str], rows: Iterable[Any], ids: object = None) -> Callable[[Callable], Callable]:
    """Take the place of `pytest.mark.parametrize`; `ids` are of no use here.

    The rows share the fixtures of the test, but each has a `tmp_path` and a `monkeypatch` of its own.
    """
    words = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    table = [dict(zip(words, row if len(words) > 1 else (row,), strict=True)) for row in rows]
    assert table

    def decorate(test: Callable) -> Callable:
        fixtures = [name for name in inspect.signature(test).parameters if name not in words]

        def of_all_rows(subtests: Any, **shared: Any) -> None:
            for number, row in enumerate(table):
                shown = {name: repr(value)[:200] for name, value in row.items()}
                with subtests.test(msg=f"row {number}", **shown), pytest.MonkeyPatch.context() as patch:
                    own = shared | {"monkeypatch": patch} if "monkeypatch" in shared else dict(shared)
                    if "tmp_path" in shared:
                        own["tmp_path"] = Path(shared["tmp_path"], str(number))
                        own["tmp_path"].mkdir()
                    test(**row, **own)

        asked = dict.fromkeys(["subtests", *fixtures])
        kind = inspect.Parameter.KEYWORD_ONLY
        of_all_rows.__signature__ = inspect.Signature([inspect.Parameter(name, kind) for name in asked])  # type: ignore[attr-defined]
        of_all_rows.__name__, of_all_rows.__doc__, of_all_rows.__module__ = test.__name__, test.__doc__, test.__module__
        return of_all_rows

    return decorate
