"""Numba's `njit` with a cache that never serves stale code.

Numba keeps a compiled function until its own file changes, with everything it calls compiled in: after an update of
`kernels.py` alone, a planner would go on with the old kernels. Here every version of the compiled sources, taken
together, has a cache folder of its own: $XDG_CACHE_HOME/cosfly/<digest>. NUMBA_CACHE_DIR, if set, is left alone.

Of several processes that need a function, one compiles it and the others wait for its lock and load it. Compiling costs
seconds at first use. Two habits keep it down: a constant among the arguments of a compiled function is a type of its
own to numba, which compiles the function once more, so it is passed as `int64(0)`; and whole arrays are set by `fill`
or a loop, because numba's `array[:] = ...` brings the formatting of its error message along.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import boolean, int64
from numba.core import caching, event

from cosfly.runtime.io import read_bytes

__all__ = ["boolean", "int64", "njit"]

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).parents[1]
UNUSED_DAYS = 30  # a cache of other sources that no process has opened for so long is deleted


class _SharedCache(caching.FunctionCache):
    """What is compiled of a function. Who finds nothing holds the function's lock until it has saved its own."""

    _lock: Any = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None and self._take_lock():
            found = super().load_overload(sig, target_context)  # another process may have compiled it meanwhile
            if found is not None:
                self._release_lock()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        finally:
            self._release_lock()

    def _take_lock(self) -> bool:
        if self._lock is None:  # a function may need itself, or another overload of itself
            try:
                os.makedirs(self.cache_path, exist_ok=True)
                path = os.path.join(self.cache_path, f"{self._py_func.__qualname__}.lock")
                self._lock = open(path, "w")  # noqa: SIM115
                fcntl.flock(self._lock, fcntl.LOCK_EX)
            except OSError:  # no place for a lock: each compiles for itself
                self._release_lock()
                return False
        return True

    def _release_lock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def njit(**options: Any) -> Callable[[Callable], Callable]:
    """Numba's decorator, without the wrapper for callers in C, which nobody uses and which takes a tenth of the
    time."""
    compile_lazily = numba.njit(no_cfunc_wrapper=True, **options)  # type: ignore[call-overload]

    def decorate(function: Callable) -> Callable:
        compiled = compile_lazily(function)
        if options.get("cache"):
            compiled._cache = _SharedCache(function)
        return compiled

    return decorate


def sources_digest(package: Path) -> str:
    """Hash the sources below a folder that hold compiled functions, 16 hex digits."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        text = read_bytes(path)
        if b"@njit" in text:
            digest.update(str(path.relative_to(package)).encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def use_own_cache(caches: Path, digest: str, now_s: float) -> None:
    """Let numba cache in `caches/digest`, if it can be made, and delete what has not been used for long."""
    folder = caches / digest
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder, (now_s, now_s))
    except OSError:
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    for other in caches.iterdir():
        with contextlib.suppress(OSError):  # another process may have deleted it
            if now_s - other.stat().st_mtime > UNUSED_DAYS * 86400.0:
                shutil.rmtree(other, ignore_errors=True)


def cache_folder() -> Path | None:
    """Where numba keeps what it has compiled; None: beside the sources."""
    return Path(numba.config.CACHE_DIR) if numba.config.CACHE_DIR else None  # type: ignore[attr-defined]


class _Tells(event.Listener):
    """Says that something is compiled, which is not what usually takes time: it is loaded from the cache."""

    def on_start(self, event: event.Event) -> None:
        place = cache_folder() or "__pycache__"
        log.info("compiling kernels, once on this machine (planning: about 30 s); kept in %s", place)

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


class FirstRecord(logging.Filter):
    """Lets one record through: a process hears of compiling by itself, and from each of its workers."""

    has_passed = False

    def filter(self, record: logging.LogRecord) -> bool:
        had_passed, self.has_passed = self.has_passed, True
        return not had_passed


log.addFilter(FirstRecord())
event.register("numba:compile", _Tells())

if "NUMBA_CACHE_DIR" not in os.environ:
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    use_own_cache(Path(home) / "cosfly", sources_digest(PACKAGE), time.time())
