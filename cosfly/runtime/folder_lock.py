"""One process at a time in a run or stage folder.

The lock is the system's, on a file `.lock` in the folder, so a process that was killed holds nothing.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from weakref import WeakValueDictionary

from filelock import FileLock, Timeout

from cosfly.runtime.errors import ResumeError, StorageError
from cosfly.runtime.store import storage_errors

LOCK = ".lock"


class FolderLock:
    """Holds a folder until it is released, or nobody refers to it any more, or the process ends."""

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, FileLock(path, timeout=0, thread_local=False)
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire()
            except Timeout:
                fix = "wait for it or stop it, then run the same command again; or choose another --out"
                raise ResumeError("another process is at work in this folder", where=path.parent, fix=fix) from None
            except NotImplementedError:
                fix = "choose another --out"
                raise StorageError("the file system has no locks", where=path.parent, fix=fix) from None

    @property
    def is_held(self) -> bool:
        return self._lock.is_locked

    def release(self) -> None:
        """Release the folder and remove the file, so that a finished folder holds products only."""
        if self._lock.is_locked:
            with contextlib.suppress(OSError):
                self.path.unlink()  # while it is locked: a process that waits for this file then makes its own
            self._lock.release(force=True)

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __del__(self) -> None:
        self.release()


# A process may open a folder again while it still refers to the first lock, for example after an error in a notebook.
_held: WeakValueDictionary[Path, FolderLock] = WeakValueDictionary()


def hold_folder(folder: Path) -> FolderLock:
    """Lock a folder, which is created if needed.

    Raises:
        ResumeError: another process holds it.
        StorageError: the folder cannot be written to.
    """
    path = folder.resolve() / LOCK
    held = _held.get(path)
    if held is None or not held.is_held:
        held = _held[path] = FolderLock(path)
    return held


def remove_left_lock(folder: Path) -> None:
    """Remove the file that a kill left in a finished folder, unless it is held or the disk is read-only."""
    if (folder / LOCK).exists():
        with contextlib.suppress(ResumeError, StorageError):
            hold_folder(folder).release()


def is_held(folder: Path) -> bool:
    """Return whether a process holds a folder now."""
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        if (folder / LOCK).is_file():
            lock.acquire()
            lock.release()
    except Timeout:
        return True
    except (OSError, NotImplementedError):
        return False
    return False
