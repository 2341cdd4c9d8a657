"""A large file that is hashed while it is written, by a thread, so that nobody reads it again for its digest and no CPU waits for the disk."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import mmap
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import IO

BLOCK = 4 * 1024 * 1024  # bytes that are handed to the disk at once
NUM_BLOCKS = 3  # one is filled, one is written, one waits
DIRECT = getattr(os, "O_DIRECT", 0)  # Linux


class HashedFile:
    """What parquet writes to: blocks are filled here, and a thread hashes them and writes them to an open, empty file.

    Where the file system can, the blocks go past the page cache: a copy into it costs the processor more than the digest does, and nobody
    reads a shard soon. A block stands at a page's begin and is whole pages long, as that way of writing asks for, so the last one is padded
    and the file then cut to its length.
    """

    closed = False  # whoever opened the file closes it

    def __init__(self, file: IO[bytes]) -> None:
        self._number, self._sha256, self._size = file.fileno(), hashlib.sha256(), 0
        self._is_direct = _set_direct(self._number, True)
        self._blocks = deque(mmap.mmap(-1, BLOCK) for _ in range(NUM_BLOCKS))
        self._filled = 0  # of the first block
        self._on_the_way: deque[Future[None]] = deque()
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> HashedFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(cancel_futures=True)

    def write(self, data: bytes) -> int:
        """Take bytes; raises OSError, also for those of an earlier call."""
        view = memoryview(data)
        while view:
            part = view[: BLOCK - self._filled]
            self._blocks[0][self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            view = view[len(part) :]
            if self._filled == BLOCK:
                self._hand_over()
        self._size += len(data)
        return len(data)

    def finish(self) -> tuple[int, str]:
        """Write what is left; gives the number of bytes and their sha256. Raises OSError."""
        self._hand_over()
        while self._on_the_way:
            self._on_the_way.popleft().result()
        os.ftruncate(self._number, self._size)
        _set_direct(self._number, False)
        return self._size, self._sha256.hexdigest()

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing: the file's owner flushes it before it gets its name."""

    def close(self) -> None:
        """Nothing, as `flush`."""

    def _hand_over(self) -> None:
        self._on_the_way.append(self._thread.submit(self._store, self._blocks[0], self._filled))
        self._blocks.rotate(-1)
        self._filled = 0
        if len(self._on_the_way) == NUM_BLOCKS:  # the block that comes next is still on its way
            self._on_the_way.popleft().result()

    def _store(self, block: mmap.mmap, size: int) -> None:
        view = memoryview(block)
        self._sha256.update(view[:size])
        rest = view[: -(-size // mmap.PAGESIZE) * mmap.PAGESIZE]
        while rest:
            try:
                rest = rest[os.write(self._number, rest) :]
            except OSError as error:
                if error.errno != errno.EINVAL or not self._is_direct:
                    raise
                self._is_direct = _set_direct(self._number, False)  # it asks for more than whole pages


def _set_direct(number: int, wanted: bool) -> bool:
    """Have a file written past the page cache, or not; tells whether it now is."""
    if not DIRECT:
        return False
    flags = fcntl.fcntl(number, fcntl.F_GETFL)
    try:
        fcntl.fcntl(number, fcntl.F_SETFL, flags | DIRECT if wanted else flags & ~DIRECT)
    except OSError:  # the file system has no such way
        return False
    return wanted
