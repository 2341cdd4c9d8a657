"""Opening files: regular ones only, of a bounded size, and not through links that lead out of their tree.

A pipe would block for ever, a device never end. What the disk says against a file becomes an InputError here and
nowhere else.
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
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path, PosixPath

from cosfly.runtime.errors import InputError

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
