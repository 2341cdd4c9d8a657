"""Numba's `njit` with a cache that never serves stale code.

Numba caches a compiled function until its own file changes, even if functions that it calls change. Here each version
of all compiled sources together has its own cache folder, $XDG_CACHE_HOME/cosfly/<digest>, unless NUMBA_CACHE_DIR is
set. If several processes need a function, one compiles it and the others wait for the lock of the cache and load it.

Two rules keep compiling short. Pass literals as `int64(0)`, because numba treats a literal argument as a type of its
own and compiles the function once more. Set whole arrays by `fill` or a loop, because `array[:] = ...` also compiles
the formatting of its error message.
"""

import contextlib
import hashlib
import itertools
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba import boolean, int64
from numba.core import caching

from cosfly.runtime.io import read_bytes

__all__ = ["boolean", "int64", "njit"]

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).parents[1]


class _SharedCache(caching.FunctionCache):
    """The cache of a function. A process that compiles it holds the lock of the cache until it has saved the result."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        overload = super().load_overload(sig, target_context)
        if overload is None:
            with contextlib.suppress(OSError):  # where no lock can be created, each process compiles
                _lock.acquire()
            overload = super().load_overload(sig, target_context)  # another process may have compiled it meanwhile
            if overload is None:
                words = "compiling kernels of %s, once on this machine (those of planning take about 30 s), into %s"
                log.info(words, self._py_func.__module__, self.cache_path)
            else:
                _lock.release()
        return overload

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        finally:
            _lock.release()


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
    """Let numba cache in a folder named after the digest of the sources, if it can be created."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        if b"@njit" in (text := read_bytes(path)):
            digest.update(str(path.relative_to(PACKAGE)).encode() + b"\0" + text)
    folder = caches / digest.hexdigest()[:16]
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]


# Only the first record is logged: a process and its workers, whose records come here too, compile many functions.
_num_records = itertools.count()
log.addFilter(lambda record: next(_num_records) == 0)

if "NUMBA_CACHE_DIR" not in os.environ:
    _use_own_cache(Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "cosfly")
_lock = FileLock(Path(numba.config.CACHE_DIR or tempfile.gettempdir(), "compiling.lock"))  # type: ignore[attr-defined]
