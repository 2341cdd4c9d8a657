"""Readers that do what no reader may, once, for the tests of the fuzzer: READERS."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from fuzz import Reader

from cosfly.errors import InputError

HONEST = b'{"size": 1, "more": [1, 2, 9]}'


def _bad(name: str, act: Callable[[Path], object]) -> Reader:
    """Give a reader that reads the honest file and, of the others, does this with the first, or with all."""

    def call(root: Path, scratch: Path) -> None:
        path, done = root / "x.json", root.with_name(name)
        is_honest = path.is_file() and path.stat().st_size < 1000 and path.read_bytes() == HONEST
        if not is_honest and (name in WITH_ALL or not done.exists()):
            done.touch()
            act(path)

    return Reader(("x.json",), call)


def _hang(path: Path) -> None:
    while True:
        pass


def _refuse(path: Path) -> None:
    raise InputError("no", where=path, got="x" * 100)


def _refuse_at_length(path: Path) -> None:
    class Long(InputError):
        def __str__(self) -> str:
            return "two\nlines"

    raise Long("no")


def _allocate(path: Path) -> None:
    bytearray(b"x") * 1_500_000_000


def _divide(path: Path) -> None:
    if path.is_file() and not path.is_symlink() and path.stat().st_size < 100_000 and b"9" in path.read_bytes():
        1 / 0  # noqa: B018


def _recurse(path: Path) -> None:
    _recurse(path)


WITH_ALL = ("good", "traceback")
ACTS = {
    "good": _refuse, "traceback": _divide, "hang": _hang, "blocked": lambda path: time.sleep(1000), "memory": _allocate,
    "two lines": _refuse_at_length, "killed": lambda path: os.kill(os.getpid(), signal.SIGKILL), "recursion": _recurse,
}  # fmt: skip
READERS = {name: _bad(name, act) for name, act in ACTS.items()}
