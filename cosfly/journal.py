"""Append-only journals whose lines carry their own checksums: what a kill cannot half write."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosfly.store import dump_json, parse_json, sha256_bytes, storage_errors


class Journal:
    """An append-only JSON-lines file whose every line carries its own checksum.

    A line is on the disk before `append` returns, or with `sync=False` in the hands of the system, which a kill of this process does
    not reach; `sync` then waits for the disk. A line that a kill cut short, or that was damaged, is skipped by `read` and
    counted in `num_damaged`; what stood in it is done again.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_damaged = 0
        self._file: Any = None
        self._lock = threading.Lock()

    def read(self) -> Iterator[dict]:
        """Yield the records in order, damaged lines left out."""
        for _, _, record in self.lines():
            yield record

    def lines(self, start: int = 0, end: int | None = None) -> Iterator[tuple[int, int, dict]]:
        """Yield (first byte, byte after the last, record) of the lines that begin in a range of bytes, damaged ones left out.

        Args:
            start: where a line begins.
        """
        self.num_damaged = 0
        if not self.path.exists():
            return
        with open(self.path, "rb") as file:
            file.seek(start)
            position = start
            for line in file:
                first, position = position, position + len(line)
                if end is not None and first >= end:
                    return
                try:
                    digest, body = line.rstrip(b"\n").split(b" ", 1)
                    if not line.endswith(b"\n") or digest.decode("ascii") != sha256_bytes(body)[:16]:
                        raise ValueError
                    record = parse_json(body)
                except (ValueError, UnicodeDecodeError):
                    self.num_damaged += 1
                    continue
                yield first, position, record

    def append(self, record: dict, *, sync: bool = True) -> int:
        """Add a record and, unless told otherwise, wait until it is on the disk. Gives the length of the file, bytes."""
        body = dump_json(record).encode()
        line = sha256_bytes(body)[:16].encode() + b" " + body + b"\n"
        with self._lock, storage_errors(self.path):
            self._open()
            self._file.write(line)
            self._file.flush()
            if sync:
                os.fsync(self._file.fileno())
            return int(self._file.tell())

    def sync(self) -> None:
        """Wait until all that was appended is on the disk."""
        with storage_errors(self.path):
            if self._file is not None:
                os.fsync(self._file.fileno())

    def start(self) -> int:
        """Open the file for appending, without a line that a kill cut short. Gives its length, bytes."""
        with self._lock, storage_errors(self.path):
            self._open()
            return int(self._file.tell())

    def _open(self) -> None:
        if self._file is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _cut_torn_line(self.path)
            self._file = open(self.path, "ab")  # noqa: SIM115 (kept open, closed by close())

    def close(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            with contextlib.suppress(OSError):  # a line that did not fit stays in the buffer; `append` has told of it
                file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _cut_torn_line(path: Path) -> None:
    """Take off the line that a kill cut short: a reader skips it, so it must not come back to life when more is written."""
    if not path.exists():
        return
    with open(path, "r+b") as file:
        end = file.seek(0, os.SEEK_END)
        keep, block = end, 65536
        while keep > 0:
            start = max(0, keep - block)
            file.seek(start)
            newline = file.read(keep - start).rfind(b"\n")
            if newline >= 0:
                keep = start + newline + 1
                break
            keep = start
        if keep < end:
            file.truncate(keep)
