"""Numba's `njit` with a cache that never serves stale code.

Numba caches a compiled function until its own file changes, even if functions that it calls change. Here each version
of all compiled sources together has its own cache folder, $XDG_CACHE_HOME/cosfly/<digest>, unless NUMBA_CACHE_DIR is
set. Processes that need a function at the same time each compile it.

Two rules keep compiling short. Pass literals as `int64(0)`, because numba treats a literal argument as a type of its
own and compiles the function once more. Set whole arrays by `fill` or a loop, because `array[:] = ...` also compiles
the formatting of its error message.
"""

import contextlib
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


class _LoggedCache(caching.FunctionCache):
    """The cache of a function, which logs that it must be compiled."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        overload = super().load_overload(sig, target_context)
        if overload is None:
            words = "compiling kernels of %s, once on this machine (30 s for planning, minutes if busy), into %s"
            log.info(words, self._py_func.__module__, self.cache_path)
        return overload


def njit(**options: Any) -> Callable[[Callable], Callable]:
    """Return numba's decorator without the wrapper for callers in C, which takes a tenth of the time to compile."""
    compile_lazily = numba.njit(no_cfunc_wrapper=True, **options)  # type: ignore[call-overload]

    def decorate(function: Callable) -> Callable:
        compiled = compile_lazily(function)
        if options.get("cache"):
            compiled._cache = _LoggedCache(function)
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
