"""One process at a time in a run or stage folder: a second one is refused and told who is at work.

The lock is the system's (flock) on a file `.lock` in the folder, so a process that was killed holds nothing. Worker
processes do not inherit it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import socket
import stat
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import IO
from weakref import WeakValueDictionary

from cosfly.errors import ResumeError, StorageError
from cosfly.reading.documents import parse_json
from cosfly.work.store import storage_errors

log = logging.getLogger(__name__)

LOCK = ".lock"
MAX_HOLDER_BYTES = 2_000


class FolderLock:
    """Holds a folder until it is released, or nobody refers to it any more, or the process ends."""

    def __init__(self, path: Path, file: IO[str] | None, made: Collection[Path], nothing: Collection[str]) -> None:
        self.path, self._file, self._made, self._nothing = path, file, made, nothing

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Let others in; the file goes, so that a finished folder holds products only."""
        if self._file is not None:
            file, self._file = self._file, None
            with contextlib.suppress(OSError):
                self.path.unlink()
            file.close()

    def give_up(self) -> None:
        """Let others in, and leave a folder in which nothing was done as it was before."""
        others = [entry for entry in self._entries() if entry != self.path] if self._file is not None else []
        if self._file is None or any(entry.name not in self._nothing for entry in others):
            return self.release()
        with contextlib.suppress(OSError):
            for entry in others:
                entry.unlink()
        self.release()
        with contextlib.suppress(OSError):  # somebody who waited is there already
            for folder in self._made:
                folder.rmdir()

    def _entries(self) -> list[Path]:
        try:
            return list(self.path.parent.iterdir())
        except OSError:  # somebody has removed the folder meanwhile
            return []

    def __del__(self) -> None:
        self.release()


# A process may open a folder again while it still refers to the one before, as after an error in a notebook.
_held: WeakValueDictionary[Path, FolderLock] = WeakValueDictionary()


def hold_folder(folder: Path, nothing: Collection[str] = ()) -> FolderLock:
    """Hold a folder, which is made where there is none.

    Args:
        nothing: names of files that are no work: where only these stand in the folder when it is given up, they go too,
            and so does a folder that was made for them.
    Raises:
        ResumeError: another process holds it; names its id, machine, command and since when.
        StorageError: the folder cannot be written to.
    """
    path = folder.resolve() / LOCK
    held = _held.get(path)
    if held is None or held._file is None:
        made = [place for place in path.parents if not place.exists()]
        held = _held[path] = FolderLock(path, _locked(path), made, nothing)
    return held


def give_up(below: Path | None = None) -> None:
    """Let go of all folders that this process holds, or those below one, the innermost first, as after an error."""
    for path, held in sorted(_held.items(), key=lambda one: len(one[0].parts), reverse=True):
        if below is None or path.is_relative_to(below.resolve()):
            held.give_up()


def remove_left_lock(folder: Path) -> None:
    """Remove the file that a kill left in a finished folder, unless somebody holds it or the disk is read-only."""
    if (folder / LOCK).exists() and not is_held(folder):
        with contextlib.suppress(ResumeError, StorageError):
            hold_folder(folder).release()


def is_held(folder: Path) -> bool:
    """Tell whether a process holds a folder now; where the file system has no locks, it does not."""
    try:
        file = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # a pipe would wait for its writer
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(file)
    return False


def _locked(path: Path) -> IO[str] | None:
    """Open and lock a file; None where the file system has no locks."""
    while True:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(number).st_mode):
            os.close(number)
            raise StorageError("cannot lock the folder", where=path, got="no regular file", fix="remove it")
        file = os.fdopen(number, "r+", errors="replace")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ResumeError(
                "another process is at work in this folder",
                where=path.parent,
                got=_holder(file.read(MAX_HOLDER_BYTES)),
                fix="wait for it or stop it, then run the same command again; or choose another --out",
            ) from None
        except OSError as error:
            log.warning("%s: no lock against a second run here (%s)", path.parent, error.strerror)
            file.close()
            path.unlink(missing_ok=True)
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # who held it took the file away between our opening and our locking
    file.truncate(0)
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:2]])
    since = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    json.dump({"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": since}, file)
    file.flush()
    return file


def _holder(text: str) -> str:
    """Say who holds a lock, from what stands in its file."""
    try:
        found = parse_json(text)
        return f"process {found['pid']:d} on {found['host']}, {found['command']!r} since {found['since']}"
    except (ValueError, LookupError, TypeError):
        return "a process that has not said who it is"
