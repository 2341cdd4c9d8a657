"""Files that are never half written: atomic writes, lists of checksums, folders that appear whole."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import IO, Any

from pydantic import BaseModel

from cosfly.runtime.documents import FileFormat
from cosfly.runtime.errors import InputError, StorageError
from cosfly.runtime.files import check_stays_below, read_text

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EIO})
NO_SUCH_PLACE = frozenset({errno.ENOENT, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP})


# --- bytes and JSON ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn a full, read-only or otherwise unusable disk into a StorageError that names the file."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL:
            fix = "free some space or choose another --out, then run the same command again: finished work is kept"
        elif error.errno in NOT_WRITABLE or (error.errno in NO_SUCH_PLACE and _concerns(error, path)):
            fix = "choose another --out, or mend the folder and run the same command again: finished work is kept"
        else:
            raise
        raise StorageError("cannot write", where=path, got=error.strerror, fix=fix) from error


def _concerns(error: OSError, path: Path) -> bool:
    """Return whether an error is about the file that is being written or a folder above it, not about something
    read."""
    return error.filename is not None and path.absolute().is_relative_to(Path(os.fsdecode(error.filename)).absolute())


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Fill a file under a temporary name; rename it when the block ends, so that a kill leaves either the old file or
    the new."""
    refuse_link(path)
    if path.is_dir():  # asked first: `.` and `/` have no name to put a temporary one beside
        raise StorageError("cannot write a file where a folder is", where=path, fix="name a file in it")
    partial = _partial(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_left(path)
        try:
            with open(partial, "xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)  # on a full disk it would hold the space that is needed
            raise


def _partial(path: Path) -> Path:
    """Return the temporary name of a file or folder; `remove_partials` knows it."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def remove_left(path: Path) -> None:
    """Remove what kills left under the temporary names of a file or folder: names of processes that are gone, and of
    this one."""
    begin = f".{path.name}."
    for name in os.listdir(path.parent):
        if name.startswith(begin) and name.endswith(".partial"):
            owner = name.removeprefix(begin).removesuffix(".partial")
            if owner.isdecimal() and not _is_another(int(owner)):
                _remove(path.with_name(name))


def _is_another(pid: int) -> bool:
    """Return whether another process has this id."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return pid != os.getpid()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def is_partial_of(name: str, path: Path) -> bool:
    """Return whether a path is the temporary name of a file or folder, of any process."""
    return fnmatch(path.name, f".{name}.*.partial")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, then rename it."""
    with atomic_file(path) as file:
        file.write(data)


_COMPACT = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def dump_json(value: Any, *, indent: int | None = None) -> str:
    """Return JSON text; NaN and infinity are an error, never a value."""
    encoder = _COMPACT if indent is None else json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=indent)
    return encoder.encode(value)


def write_json(path: Path, value: Any, *, indent: int | None = 1) -> None:
    """Write JSON as `write_bytes` writes; indent None: on one line."""
    write_bytes(path, (dump_json(value, indent=indent) + "\n").encode())


def write_model(path: Path, content: BaseModel, form: FileFormat) -> None:
    """Write what `read_model` reads."""
    write_json(path, {**form.header, **content.model_dump(mode="json")})


def sha256_bytes(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# --- folders of many files --------------------------------------------------------------------------------------------


def refuse_link(path: Path) -> None:
    """Refuse to write to a link, which may lead anywhere."""
    if path.is_symlink():
        raise StorageError(
            "a link stands where files are written, and writing follows none",
            where=path,
            got=f"a link to {os.readlink(path)}",
            fix="remove it, or put what it leads to in its place; the folder that --out names may itself be a link",
        )


def refuse_links(folder: Path) -> None:
    """Refuse to write into a folder in which a link stands, at any depth; the folder itself may be one."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                refuse_link(Path(entry.path))
            elif entry.is_dir():
                refuse_links(Path(entry.path))


def remove_partials(folder: Path) -> None:
    """Remove what a kill left under temporary names. A folder with checksums appeared whole, so what is below it is not
    looked at: a flight has a folder for each frame."""
    for place, folders, files in os.walk(folder):
        partials = {name for name in (*folders, *files) if name.startswith(".") and name.endswith(".partial")}
        for name in partials:
            _remove(Path(place, name))
        folders[:] = [] if CHECKSUMS in files else [name for name in folders if name not in partials]


LONGEST_NAME = 255  # bytes of one part of a path, on every common file system


def inside(root: Path, name: str, *, beside: bool = False) -> Path:
    """Join a name from a file to a root.

    Args:
        beside: a link may lead into the folder that the root stands in.

    Raises:
        InputError: the name leads out of the root, or a link that stands there does; or no file can have it.
    """
    plain = _plain_name(root, name)
    check_stays_below(root / plain, root, beside=beside)
    return root / plain


def _plain_name(root: Path, name: str) -> str:
    """Return a name without detours; raises as `inside`, but looks at no link."""
    plain = os.path.normpath(name)
    if "\0" in name or max(len(part.encode("utf-8", "surrogatepass")) for part in plain.split(os.sep)) > LONGEST_NAME:
        raise InputError(
            "not a name of a file", where=root, got=name, expected=f"parts of at most {LONGEST_NAME} bytes"
        )
    if os.path.isabs(plain) or plain.split(os.sep)[0] == os.pardir:
        raise InputError("a name leads out of its folder", where=root, got=name, expected="a path inside the folder")
    return plain


CHECKSUMS = "checksums.sha256"


def write_checksums(folder: Path, digests: dict[str, str]) -> None:
    """Write `checksums.sha256` (the format of sha256sum) for files named relative to the folder."""
    write_bytes(folder / CHECKSUMS, checksum_lines(digests).encode())


def checksum_lines(digests: Mapping[str, str]) -> str:
    """Return the lines of `checksums.sha256`."""
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))


def read_checksums(folder: Path) -> dict[str, str]:
    """Read `checksums.sha256`: relative name -> hex digest.

    Raises:
        InputError: it is missing or broken, or a name leads out of the folder.
    """
    path = folder / CHECKSUMS
    digests: dict[str, str] = {}
    plain_folders, root = {""}, f"{folder}{os.sep}"
    for number, line in enumerate(read_text(path, what="checksums", tree=folder).splitlines(), 1):
        digest, _, name = line.partition("  ")
        if len(digest) != 64 or not name:
            raise InputError("a broken checksum line", where=f"{path}:{number}", got=line[:80])
        plain = _plain_name(folder, name)
        if not _is_plain_folder(root, os.path.dirname(plain), plain_folders) or os.path.islink(root + plain):
            check_stays_below(folder / plain, folder)
        digests[plain] = digest
    return digests


def _is_plain_folder(root: str, name: str, known: set[str]) -> bool:
    """Return whether no part of a folder's name is a link; `known` are those of which that is known, each looked at
    once."""
    if name not in known:
        if not _is_plain_folder(root, os.path.dirname(name), known) or os.path.islink(root + name):
            return False
        known.add(name)
    return True


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Fill a folder under a temporary name; rename it when the block ends without an error."""
    partial = _partial(path)
    refuse_link(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_left(path)
        partial.mkdir()
        try:
            yield partial
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        if path.exists():
            shutil.rmtree(path)
        os.replace(partial, path)
