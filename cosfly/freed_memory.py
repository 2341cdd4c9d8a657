"""Memory that was freed is kept for what comes next: a frame's arrays are megabytes each, and what the system gives anew it clears page by page."""

from __future__ import annotations

import contextlib
import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # what `mallopt` of glibc can set
GREATEST_KEPT_BYTES = 32 << 20  # an array, the most that glibc takes
MOST_KEPT_BYTES = 64 << 20  # together


def keep_freed_memory() -> None:
    """Let this process keep up to 64 MiB of what it frees. Where another C library allocates, nothing changes."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, GREATEST_KEPT_BYTES)
        mallopt(TRIM_THRESHOLD, MOST_KEPT_BYTES)
