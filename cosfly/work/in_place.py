"""Data files of somebody's own in the place of those that ship, for as long as a stage works with them.

They belong to the process; workers get those of the process that started them
(worker_pool.py). What is worked out of such a file is kept by `kept`, and forgotten as soon as another takes its place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

_in_place: dict[str, Any] = {}
_forget: list[Callable[[], None]] = []


def given(name: str) -> Any:
    """Give what stands in the place of a file that ships; None: nothing does."""
    return _in_place.get(name)


def everything() -> dict[str, Any]:
    """Give everything that stands in the place of something, for a worker."""
    return dict(_in_place)


def put_all(files: Mapping[str, Any]) -> None:
    """Put files in place of those that ship, by name; None takes one away."""
    changed = {name: value for name, value in files.items() if _in_place.get(name) != value}
    for name, value in changed.items():
        if value is None:
            _in_place.pop(name, None)
        else:
            _in_place[name] = value
    if changed:
        for forget in _forget:
            forget()


@contextmanager
def put(**files: Any) -> Iterator[None]:
    """Put files in place of those that ship while a block runs, whatever stood there before it; None: what ships."""
    before = {name: _in_place.get(name) for name in files}
    put_all(files)
    try:
        yield
    finally:
        put_all(before)


def kept(most: int | None = None) -> Callable[[Function], Function]:
    """Keep the results of a function that reads such files, at most so many of them, until another file is put in
    place."""

    def keep(function: Function) -> Function:
        cached = lru_cache(maxsize=most)(function)
        _forget.append(cached.cache_clear)
        return cached  # type: ignore[return-value]

    return keep
