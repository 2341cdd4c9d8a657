"""Read and write files: regular ones of a bounded size, atomic writes, checksums, folders that appear whole.

A pipe would block for ever, a device never end, and a link may lead out of a tree. What the system reports against a
file becomes an InputError or a StorageError here and nowhere else.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import hashlib
import io
import itertools
import logging
import os
import shutil
import stat
import zlib
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path, PosixPath
from typing import IO

from cosfly.runtime.errors import InputError, StorageError

log = logging.getLogger(__name__)

MB = 1_000_000
FILE_MB = 2_048  # read as a whole: the flights of a town are some 100 MB a million frames
LINE_MB = 64  # of a JSON-lines file: a caption with its evidence has some 8 kB
UNPACK_FACTOR = 100  # times its own size may a packed file unpack to: JSON packs to a third, an indented one to a 15th
CHECK_PATH = "check the path"
SPLIT = "split it, or cut out the part that is needed"
GZIP_MAGIC = b"\x1f\x8b"
SMALL_UNPACKED_MB = 64  # what any packed file may unpack to, however small it is
CHUNK = 16 * MB

_KINDS = (
    (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a named pipe"), (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"),
)  # fmt: skip


class LinkedPath(PosixPath):
    """A folder or file that the user trusts: links below it are followed wherever they lead.

    Every path that is made from it is one too, also in another process, so nothing else tells readers.
    """


def over_limit(where: object, got: str, expected: str, fix: str) -> InputError:
    """Return the error of what is larger than its reader takes."""
    return InputError("over the limit", where=str(where), got=got, expected=f"at most {expected}", fix=fix)


def open_file(path: Path, *, what: str = "file", fix: str = CHECK_PATH, tree: Path | None = None) -> io.BufferedReader:
    """Open a regular file to read its bytes.

    Args:
        what, fix: for the message.
        tree: the folder whose files are being read: a link that leads out of it is refused. None: the user named this
        file.
    Raises:
        InputError: it is missing, no regular file, not readable, or not below its tree.
    """
    if tree is not None:
        check_stays_below(path, tree)
    try:
        # A named pipe without a writer would hold a plain open for ever.
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        got = "a socket" if error.errno == errno.ENXIO else error.strerror
        raise InputError(f"cannot read the {what}", where=path, got=got, fix=fix) from None
    except ValueError as error:  # a name that no system has
        raise InputError(f"cannot read the {what}", where=path, got=str(error), fix=fix) from None
    mode = os.fstat(number).st_mode
    if not stat.S_ISREG(mode):
        os.close(number)
        got = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise InputError(f"cannot read the {what}", where=path, got=got, expected="a regular file", fix=fix)
    return os.fdopen(number, "rb")


@contextlib.contextmanager
def disk_errors(path: Path, what: str, fix: str = CHECK_PATH) -> Iterator[None]:
    """Turn what the system says while it reads into an InputError; only calls that read stand in it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot read the {what}", where=path, got=error.strerror or str(error), fix=fix) from None


def read_bytes(
    path: Path,
    *,
    what: str = "file",
    fix: str = CHECK_PATH,
    tree: Path | None = None,
    most_mb: float = FILE_MB,
    split: str = SPLIT,
) -> bytes:
    """Read a whole file.

    Args:
        what, fix, tree: as for `open_file`. most_mb: its largest size. split: what to do about a larger one.
    Raises:
        InputError: as `open_file`; or it is over the limit.
    """
    with open_file(path, what=what, fix=fix, tree=tree) as file, disk_errors(path, what, fix):
        return file.read(_size_within(file, path, most_mb, split))


def read_span(path: Path, first: int, size: int, *, what: str = "file", fix: str = CHECK_PATH) -> bytes:
    """Read `size` bytes from byte `first` on of a file that the user named; raises as `read_bytes`, and where it ends
    before.
    """
    if size > FILE_MB * MB:
        raise over_limit(path, f"{size / MB:,.0f} MB", f"{FILE_MB:,} MB in one piece", SPLIT)
    with open_file(path, what=what, fix=fix) as file, disk_errors(path, what, fix):
        file.seek(first)
        data = file.read(size)
    if len(data) != size:
        raise InputError(
            f"the {what} became shorter while it was read", where=path, got=f"{first + len(data)} bytes", fix=fix
        )
    return data


def _size_within(file: io.BufferedReader, path: Path, most_mb: float = FILE_MB, split: str = SPLIT) -> int:
    """Return the size of an open file; InputError where it is larger."""
    size = os.fstat(file.fileno()).st_size
    if size > most_mb * MB:
        raise over_limit(path, f"{size / MB:,.3g} MB", f"{most_mb:,g} MB in one piece", split)
    return size


def read_text(path: Path, *, what: str = "file", fix: str = CHECK_PATH, tree: Path | None = None) -> str:
    """Read a whole file of UTF-8 text; raises as `read_bytes`, and for other text."""
    return decoded(read_bytes(path, what=what, fix=fix, tree=tree), path)


def decoded(data: bytes, where: object) -> str:
    """Return UTF-8 bytes as text."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise not_utf8(error, where) from None


def not_utf8(error: UnicodeDecodeError, where: object) -> InputError:
    """Return which byte of which line is no UTF-8, and what to do."""
    line = error.object[: error.start].count(b"\n") + 1
    got = f"the byte 0x{error.object[error.start]:02x} in line {line}"
    return InputError("not UTF-8 text", where=str(where), got=got, fix="if it is text, save it as UTF-8")


def read_lines(path: Path, *, what: str = "file", fix: str = CHECK_PATH, tree: Path | None = None) -> Iterator[bytes]:
    """Yield the lines of a file, each with its end; raises as `open_file`, and for a line over the limit."""
    with open_file(path, what=what, fix=fix, tree=tree) as file:
        for number in itertools.count(1):
            with disk_errors(path, what, fix):
                line = file.readline(LINE_MB * MB + 1)
            if len(line) > LINE_MB * MB:
                fix = "check that it is JSON lines, one record a line"
                raise over_limit(f"{path}:{number}", "a longer line", f"{LINE_MB} MB", fix)
            if not line:
                return
            yield line


def read_unpacked(path: Path, *, what: str = "file", most_mb: float = FILE_MB) -> bytes:
    """Read a whole file, and unpack it where it is gzipped; raises as `read_bytes`, and for damaged gzip data."""
    data = read_bytes(path, what=what, most_mb=most_mb)
    if not data.startswith(GZIP_MAGIC):
        return data
    by_factor = max(SMALL_UNPACKED_MB * MB, UNPACK_FACTOR * len(data))
    chunks, size = [], 0
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            while chunk := packed.read(CHUNK):
                size += len(chunk)
                if size > most_mb * MB:
                    raise over_limit(path, "more, unpacked", f"{most_mb:,g} MB in one piece", SPLIT)
                if size > by_factor:
                    got = f"{len(data):,} bytes that unpack to more"
                    raise over_limit(path, got, f"{UNPACK_FACTOR} times the file", "if you trust it, gunzip it before")
                chunks.append(chunk)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError("the gzip data is damaged", where=path, got=str(error)) from None
    return b"".join(chunks)


def sha256_file(path: Path, *, tree: Path | None = None) -> str:
    """Return the hex digest of a file; raises as `open_file`."""
    with open_file(path, tree=tree) as file, disk_errors(path, "file"):
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_named(tree: Path, name: str) -> list[Path]:
    """Find the files of a name below a tree, sorted; what begins with a dot is left out, and nothing is looked for
    below a folder that has one.

    A folder that is a link is gone into where it leads to a place inside the tree's parent folder, or anywhere with
    `follow_links`; of others the log tells.
    """
    found: list[Path] = []
    waiting: list[tuple[Path, tuple[str, ...]]] = [(tree, (os.path.realpath(tree),))]
    parent = os.path.dirname(os.path.realpath(tree))
    while waiting:
        folder, above = waiting.pop()
        with disk_errors(folder, "folder"), os.scandir(folder) as listed:
            entries = {entry.name: entry for entry in listed if not entry.name.startswith(".")}
        if name in entries:
            found.append(folder / name)
            continue
        for entry in entries.values():
            if entry.is_dir(follow_symlinks=False):
                waiting.append((folder / entry.name, above))
            elif entry.is_symlink() and os.path.isdir(entry.path):  # a link to itself is none, and no error
                real = os.path.realpath(entry.path)
                if not (isinstance(tree, LinkedPath) or is_below(real, parent)):
                    log.warning("%s: leads to %s, which is not looked at; --set follow_links=true", entry.path, real)
                elif real not in above and real != parent:  # a link to a folder above would go round for ever
                    waiting.append((folder / entry.name, (*above, real)))
    return sorted(found)


# --- links ------------------------------------------------------------------------------------------------------------


def check_stays_below(path: Path, tree: Path, *, beside: bool = False) -> None:
    """Check that no symbolic link leads from a tree to a file outside; `beside`: out of the folder that the tree stands
    in.

    The tree itself may be a link. Where it is a snapshot in the cache of the hub's client, whose files are links to
    blobs, these are part of it.
    """
    if isinstance(tree, LinkedPath):
        return
    try:
        real, root = real_path(path), real_path(tree)
    except ValueError as error:  # a NUL in a name
        raise InputError("not a name of a file", where=tree, got=str(error)) from None
    if not any(is_below(real, allowed) for allowed in (os.path.dirname(root) if beside else root, *_blobs(Path(root)))):
        raise InputError(
            "a link leads out of its folder", where=path, got=real, expected=f"a file below {tree}",
            fix="if you trust it, --set follow_links=true",
        )  # fmt: skip


def real_path(path: Path) -> str:
    """As `os.path.realpath`, which looks at every folder on the way, by asking the system, where there is such a file
    and it can be asked.
    """
    try:
        number = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except (OSError, AttributeError):  # not there, or another system
        return os.path.realpath(path)
    try:
        return os.readlink(f"/proc/self/fd/{number}")
    except OSError:  # no /proc
        return os.path.realpath(path)
    finally:
        os.close(number)


def is_below(path: str, root: str) -> bool:
    """Tell of two real paths whether the first is the second or stands below it."""
    return path == root or path.startswith(root.rstrip(os.sep) + os.sep)


def _blobs(root: Path) -> list[str]:
    """Return the folder of blobs of a tree in the hub client's cache: `<repository>/snapshots/<revision>/...` links to
    `<repository>/blobs`.
    """
    snapshots = next((folder for folder in root.parents if folder.name == "snapshots"), None)
    if snapshots is None:
        return []
    blobs = snapshots.parent / "blobs"
    return [str(blobs)] if blobs.is_dir() else []


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
