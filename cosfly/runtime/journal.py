"""Append-only journals whose lines carry their own checksums, so that a line cut short by a kill is recognized."""

from __future__ import annotations

import contextlib
import mmap
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from cosfly.runtime.errors import InputError, StorageError, plain
from cosfly.runtime.io import disk_errors, open_file, read_lines, sha256_bytes, storage_errors
from cosfly.runtime.json_io import dump_json, parse_json

T = TypeVar("T")


class Journal:
    """An append-only JSON-lines file in which each line has a checksum.

    `append` returns when the line is on the disk, or with `sync=False` when the system holds it, which survives a kill
    of this process; `sync` then waits for the disk. `read` skips lines that a kill cut short or that were damaged and
    counts them in `num_damaged`; their items are done again.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_damaged = 0
        self.line_num = 0  # of the line that was read last, from 1
        self.line_byte = 0  # first byte of this line
        self._file: Any = None
        self._lock = threading.Lock()

    def read(self) -> Iterator[dict]:
        """Yield the records in order; damaged lines are skipped."""
        self.num_damaged = 0
        if not self.path.exists():
            return
        end = 0
        for number, line in enumerate(read_lines(self.path, what="journal"), 1):
            self.line_num = number
            self.line_byte = end
            end += len(line)
            record = _record_of(line)
            if record is None:
                self.num_damaged += 1
            else:
                yield record

    def read_as(self, read_record: Callable[[dict], T]) -> Iterator[T]:
        """Yield `read_record` of each record; its ValidationError becomes an InputError that names the line."""
        for record in self.read():
            try:
                value = read_record(record)
            except ValidationError as error:
                detail = error.errors(include_url=False, include_input=False)[0]
                field = ".".join(str(part)[:40] for part in detail["loc"]) or "top level"
                what = "this line of the journal is not a valid record"
                got = f"{field}: {plain(detail['msg'])[:200]}"
                fix = "delete this line and run the same command again; cosfly repeats the item of this line"
                raise InputError(what, where=f"{self.path}:{self.line_num}", got=got, fix=fix) from None
            yield value

    def read_at(self, line_bytes: Iterable[int]) -> Iterator[dict]:
        """Yield the records of the lines that begin at these bytes; InputError if one is damaged."""
        if not self.path.exists():
            return
        with open_file(self.path, what="journal") as file:
            for line_byte in line_bytes:
                with disk_errors(self.path, "journal"):
                    file.seek(line_byte)
                    record = _record_of(file.readline())
                if record is None:
                    what = "a line of the journal was changed while the command was running"
                    fix = "run the same command again; cosfly repeats the item of this line"
                    raise InputError(what, where=f"{self.path}: byte {line_byte}", fix=fix)
                yield record

    def append(self, record: dict, *, sync: bool = True) -> int:
        """Add a record, wait until it is on the disk if `sync`, and return the byte at which it begins."""
        body = dump_json(record).encode()
        line = sha256_bytes(body)[:16].encode() + b" " + body + b"\n"
        with self._lock, storage_errors(self.path):
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                if self.path.is_symlink():
                    fix = "replace the link by a copy of the file, or choose another --out"
                    raise StorageError("the journal is a link, which may lead anywhere", where=self.path, fix=fix)
                _cut_torn_line(self.path)
                self._file = open(self.path, "ab")  # noqa: SIM115 (kept open, closed by close())
            line_byte = self._file.tell()
            self._file.write(line)
            self._file.flush()
            if sync:
                os.fsync(self._file.fileno())
        return line_byte

    def sync(self) -> None:
        """Wait until all appended lines are on the disk."""
        with storage_errors(self.path):
            if self._file is not None:
                os.fsync(self._file.fileno())

    def close(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            with contextlib.suppress(OSError):  # a line that did not fit is still in the buffer; `append` raised
                file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _record_of(line: bytes) -> dict | None:
    """Return the record of a line; None if the line is cut short or damaged."""
    digest, _, body = line.removesuffix(b"\n").partition(b" ")
    if not line.endswith(b"\n") or digest != sha256_bytes(body)[:16].encode():
        return None
    try:
        record = parse_json(body)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def _cut_torn_line(path: Path) -> None:
    """Remove a last line without an end, to which the next line would be appended."""
    if not path.exists() or not path.stat().st_size:  # an empty file cannot be mapped
        return
    with open(path, "r+b") as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            end = content.rfind(b"\n") + 1
        file.truncate(end)
