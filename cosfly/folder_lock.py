"""One process at a time in a run or stage folder: a second one is refused and told who is at work.

The lock is the system's (flock) on a file `.lock` in the folder, so a process that was killed holds nothing. Worker processes
do not inherit it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import socket
import sys
import time
from pathlib import Path
from typing import IO
from weakref import WeakValueDictionary

from cosfly.errors import ResumeError
from cosfly.reading.documents import parse_json
from cosfly.store import storage_errors

log = logging.getLogger(__name__)

LOCK = ".lock"
MAX_HOLDER_BYTES = 2_000


class FolderLock:
    """Holds a folder until it is released, or nobody refers to it any more, or the process ends."""

    def __init__(self, path: Path, file: IO[str] | None) -> None:
        self.path, self._file = path, file

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

    def __del__(self) -> None:
        self.release()


# A process may open a folder again while it still refers to the one before, as after an error in a notebook.
_held: WeakValueDictionary[Path, FolderLock] = WeakValueDictionary()


def hold_folder(folder: Path) -> FolderLock:
    """Hold a folder, which is made where there is none.

    Raises:
        ResumeError: another process holds it; names its id, machine, command and since when.
        StorageError: the folder cannot be written to.
    """
    path = folder.resolve() / LOCK
    held = _held.get(path)
    if held is None or held._file is None:
        held = _held[path] = FolderLock(path, _locked(path))
    return held


def is_held(folder: Path) -> bool:
    """Tell whether a process holds a folder now; where the file system has no locks, it does not."""
    try:
        file = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW)
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
            file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644), "r+", errors="replace")
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
