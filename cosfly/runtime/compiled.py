"""Numba's `njit` with a cache that never serves stale code.

Numba keeps a compiled function until its own file changes, whatever becomes of those that it calls. Here every version
of all compiled sources together has its own cache folder, $XDG_CACHE_HOME/cosfly/<digest>, unless NUMBA_CACHE_DIR is
set. Of several processes that need a function, one compiles it and the others wait for its lock and load it.

Two habits keep compiling short: a literal argument is a type of its own to numba, which compiles the function once
more, so it is passed as `int64(0)`; and whole arrays are set by `fill` or a loop, because numba's `array[:] = ...`
compiles the formatting of its error message too.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import itertools
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import boolean, int64
from numba.core import caching

from cosfly.runtime.io import read_bytes

__all__ = ["boolean", "int64", "njit"]

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).parents[1]


class _SharedCache(caching.FunctionCache):
    """The cache of a function. A process that finds nothing holds the function's lock until it has saved its own."""

    _lock: Any = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None:
            if self._lock is None:  # a function may need itself, or another overload of itself
                with contextlib.suppress(OSError):  # no place for a lock: each compiles for itself
                    os.makedirs(self.cache_path, exist_ok=True)
                    path = os.path.join(self.cache_path, f"{self._py_func.__qualname__}.lock")
                    self._lock = open(path, "w")  # noqa: SIM115
                    fcntl.flock(self._lock, fcntl.LOCK_EX)
            found = super().load_overload(sig, target_context)  # another process may have compiled it meanwhile
            if found is None:
                log.info("compiling kernels, once on this machine (planning: about 30 s); kept in %s", self.cache_path)
            else:
                self._release_lock()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        finally:
            self._release_lock()

    def _release_lock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def njit(**options: Any) -> Callable[[Callable], Callable]:
    """Return numba's decorator without the wrapper for callers in C, which takes a tenth of the time to compile."""
    compile_lazily = numba.njit(no_cfunc_wrapper=True, **options)  # type: ignore[call-overload]

    def decorate(function: Callable) -> Callable:
        compiled = compile_lazily(function)
        if options.get("cache"):
            compiled._cache = _SharedCache(function)
        return compiled

    return decorate


def _use_own_cache(caches: Path) -> None:
    """Let numba cache in a folder of the sources' own, if it can be made."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        if b"@njit" in (text := read_bytes(path)):
            digest.update(str(path.relative_to(PACKAGE)).encode() + b"\0" + text)
    folder = caches / digest.hexdigest()[:16]
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]


# One line: a process compiles several functions, and so does each of its workers, whose records come here too.
_num_records = itertools.count()
log.addFilter(lambda record: next(_num_records) == 0)

if "NUMBA_CACHE_DIR" not in os.environ:
    _use_own_cache(Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "cosfly")
