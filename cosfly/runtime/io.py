"""Read regular files of bounded size; write files and folders atomically; checksums.

A pipe could block forever, a device never ends, and a link may lead out of a tree. Only this module converts errors of
the system about a file to InputError or StorageError.
"""

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
from pathlib import Path, PosixPath
from typing import IO

from cosfly.runtime.errors import InputError, StorageError

log = logging.getLogger(__name__)

MB = 1_000_000
FILE_MB = 2_048  # of a file that is read as a whole; the trajectories of a million frames have about 100 MB
LINE_MB = 64  # of a line of a JSON-lines file; a caption with its evidence has about 8 kB
UNPACK_FACTOR = 100  # largest ratio of unpacked to packed size; it is 3 for JSON and 15 for indented JSON
SMALL_UNPACKED_MB = 64  # unpacked size that is allowed for any ratio
CHECK_PATH = "check the path"
SPLIT = "split the file, or cut out the part that you need"
GZIP_MAGIC = b"\x1f\x8b"
LONGEST_NAME = 255  # bytes of one part of a path, on every common file system
CHECKSUMS = "checksums.sha256"
DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EIO})
NO_SUCH_PLACE = frozenset({errno.ENOENT, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP})


class LinkedPath(PosixPath):
    """A directory or file that the user trusts: all links below it are followed.

    Every path derived from it is a LinkedPath too, also in another process, so readers need no option.
    """


def over_limit(where: object, got: str, expected: str, fix: str) -> InputError:
    """Return the error of an input that is larger than its reader accepts."""
    return InputError("the input is over the limit", where=str(where), got=got, expected=f"at most {expected}", fix=fix)


# --- reading ----------------------------------------------------------------------------------------------------------


def open_file(path: Path, *, what: str = "file", fix: str = CHECK_PATH, tree: Path | None = None) -> io.BufferedReader:
    """Open a regular file to read its bytes.

    Args:
        what, fix: Name of the file and advice for messages.
        tree: The directory of the file: a link that leads out of it is refused. None: the user named this file.
    """
    if tree is not None:
        check_stays_below(path, tree)
    try:
        # Without O_NONBLOCK, opening a named pipe without a writer would block forever.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # an invalid name
        raise InputError(f"the {what} cannot be read", where=path, got=str(error), fix=fix) from None
    except OSError as error:
        got = "a socket" if error.errno == errno.ENXIO else error.strerror
        raise InputError(f"the {what} cannot be read", where=path, got=got, fix=fix) from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        got = {"d": "a folder", "p": "a named pipe"}.get(stat.filemode(mode)[0], "a device")
        raise InputError(f"the {what} cannot be read", where=path, got=got, expected="a regular file", fix=fix)
    return os.fdopen(descriptor, "rb")


@contextlib.contextmanager
def disk_errors(path: Path, what: str, fix: str = CHECK_PATH) -> Iterator[None]:
    """Convert an OSError during reading to an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"the {what} cannot be read", where=path, got=error.strerror or str(error), fix=fix) from None


def read_bytes(
    path: Path,
    *,
    what: str = "file",
    fix: str = CHECK_PATH,
    tree: Path | None = None,
    most_mb: float = FILE_MB,
    span: tuple[int, int] | None = None,
) -> bytes:
    """Read a file of at most `most_mb`, or a span (first byte, length) of it; other arguments as for `open_file`."""
    with open_file(path, what=what, fix=fix, tree=tree) as file, disk_errors(path, what, fix):
        first, size = span or (0, os.fstat(file.fileno()).st_size)
        if size > most_mb * MB:
            raise over_limit(path, f"{size / MB:,.3g} MB", f"{most_mb:,g} MB", SPLIT)
        file.seek(first)
        data = file.read(size)
    if span is not None and len(data) != size:
        got = f"{first + len(data)} bytes instead of {first + size} or more"
        fix = "run the command again when no other process writes this file"
        raise InputError(f"the {what} became shorter during reading", where=path, got=got, fix=fix)
    return data


def read_text(path: Path, *, what: str = "file", tree: Path | None = None) -> str:
    """Read a whole file of UTF-8 text."""
    return decoded(read_bytes(path, what=what, tree=tree), path)


def decoded(data: bytes, where: object) -> str:
    """Return UTF-8 bytes as text."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        got = f"the byte 0x{data[error.start]:02x} in line {line}"
        fix = "if the file is text, save it as UTF-8"
        raise InputError("the file is not UTF-8 text", where=str(where), got=got, fix=fix) from None


def read_lines(path: Path, *, what: str = "file", fix: str = CHECK_PATH) -> Iterator[bytes]:
    """Yield the lines of a file, each with its line end; a line has at most LINE_MB."""
    with open_file(path, what=what, fix=fix) as file:
        for number in itertools.count(1):
            with disk_errors(path, what, fix):
                line = file.readline(LINE_MB * MB + 1)
            if len(line) > LINE_MB * MB:
                fix = "check that the file is in JSON Lines format, with one record in each line"
                raise over_limit(f"{path}:{number}", f"a line of more than {LINE_MB} MB", f"{LINE_MB} MB", fix)
            if not line:
                return
            yield line


def read_unpacked(path: Path, *, what: str = "file", most_mb: float = FILE_MB) -> bytes:
    """Read a whole file, and unpack it if it is gzipped."""
    data = read_bytes(path, what=what, most_mb=most_mb)
    if not data.startswith(GZIP_MAGIC):
        return data
    by_factor = max(SMALL_UNPACKED_MB * MB, UNPACK_FACTOR * len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            unpacked = packed.read(int(min(by_factor, most_mb * MB)) + 1)
    except (OSError, EOFError, zlib.error) as error:
        fix = "copy or download the file again"
        raise InputError("the gzip data of the file is damaged", where=path, got=str(error), fix=fix) from None
    if len(unpacked) > most_mb * MB:
        limit = f"{most_mb:,g} MB"
        raise over_limit(path, f"more than {limit} after decompression", limit, SPLIT)
    if len(unpacked) > by_factor:
        got = f"{len(data):,} bytes, which decompress to more than {by_factor:,} bytes"
        fix = "if you trust the file, run gunzip on it first"
        raise over_limit(path, got, f"{UNPACK_FACTOR} times the size of the file", fix)
    return unpacked


def sha256_file(path: Path, *, tree: Path | None = None) -> str:
    """Return the hex digest of a file."""
    with open_file(path, tree=tree) as file, disk_errors(path, "file"):
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_bytes(data: bytes) -> str:
    """Return the hex digest of some bytes."""
    return hashlib.sha256(data).hexdigest()


def files_named(tree: Path, name: str) -> list[Path]:
    """Return the files with a name below a tree, sorted; skip hidden entries and the folders below a match.

    A linked directory is entered if it is inside the tree's parent directory, or anywhere with `follow_links`; others
    are logged.
    """
    matches = list[Path]()
    root = os.path.realpath(tree)
    parent = os.path.dirname(root)
    # Folders to search, each with the real paths of the tree and of the links above it.
    waiting: list[tuple[Path, tuple[str, ...]]] = [(tree, (root,))]
    while waiting:
        folder, above = waiting.pop()
        with disk_errors(folder, "folder"), os.scandir(folder) as listed:
            entries = {entry.name: entry for entry in listed if not entry.name.startswith(".")}
        if name in entries:
            matches.append(folder / name)
            continue
        for entry in entries.values():
            if entry.is_dir(follow_symlinks=False):
                waiting.append((folder / entry.name, above))
            elif entry.is_symlink() and os.path.isdir(entry.path):  # isdir is false for a link to itself
                real = os.path.realpath(entry.path)
                if not (isinstance(tree, LinkedPath) or is_below(real, parent)):
                    words = "%s: skipped, because this link leads to %s; pass --set follow_links=true to follow it"
                    log.warning(words, entry.path, real)
                elif real not in above and real != parent:  # a link to a folder above would be followed forever
                    waiting.append((folder / entry.name, (*above, real)))
    return sorted(matches)


# --- names and links --------------------------------------------------------------------------------------------------


def check_stays_below(path: Path, tree: Path, *, in_parent: bool = False) -> None:
    """Check that no symbolic link leads out of a tree, or with `in_parent` out of the tree's parent directory.

    The tree itself may be a link. In the cache of the hub's client, where a snapshot's files are links to blobs, the
    blobs are part of the tree.
    """
    if isinstance(tree, LinkedPath):
        return
    try:
        real, root = real_path(path), real_path(tree)
    except ValueError as error:  # a NUL in a name
        raise InputError("a path in this folder contains an invalid character", where=tree, got=str(error)) from None
    allowed = [os.path.dirname(root) if in_parent else root]
    allowed += [str(folder.parent / "blobs") for folder in Path(root).parents if folder.name == "snapshots"][:1]
    if not any(is_below(real, folder) for folder in allowed):
        what = "a symbolic link leads out of its folder"
        fix = "if you trust the link, pass --set follow_links=true"
        raise InputError(what, where=path, got=real, expected=f"a file below {tree}", fix=fix)


def real_path(path: Path) -> str:
    """Return `os.path.realpath`; on Linux the kernel resolves it in a sixth of the time."""
    with contextlib.suppress(OSError, AttributeError):  # no such file, or another system
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            return os.readlink(f"/proc/self/fd/{descriptor}")
        finally:
            os.close(descriptor)
    return os.path.realpath(path)


def is_below(path: str, root: str) -> bool:
    """Return whether one real path is another or is below it."""
    return path == root or path.startswith(root.rstrip(os.sep) + os.sep)


def inside(root: Path, name: str, *, in_parent: bool = False) -> Path:
    """Join a name from a file to a root; raises InputError if it leads out, by its parts or by a link.

    in_parent: A link may lead into the parent directory of the root.
    """
    plain = _plain_name(root, name)
    check_stays_below(root / plain, root, in_parent=in_parent)
    return root / plain


def _plain_name(root: Path, name: str) -> str:
    """Return a normalized name without `..`; a link may still lead out."""
    plain = os.path.normpath(name)
    parts = plain.split(os.sep)
    if "\0" in name or max(len(part.encode("utf-8", "surrogatepass")) for part in parts) > LONGEST_NAME:
        expected = f"no null character, and at most {LONGEST_NAME} bytes in the name of each folder and file"
        raise InputError("a path in this folder is not valid", where=root, got=name, expected=expected)
    if os.path.isabs(plain) or parts[0] == os.pardir:
        expected = "a relative path inside the folder"
        raise InputError("a path leads out of this folder", where=root, got=name, expected=expected)
    return plain


# --- writing ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Convert the error of a full, read-only or otherwise unusable disk into a StorageError that names the file."""
    try:
        yield
    except OSError as error:
        name = os.fsdecode(error.filename) if error.filename is not None else None
        is_about_path = name is not None and path.absolute().is_relative_to(Path(name).absolute())
        if error.errno in DISK_FULL:
            fix = "free some space or choose another --out, then run the same command again; finished work is kept"
        elif error.errno in NOT_WRITABLE or (error.errno in NO_SUCH_PLACE and is_about_path):
            fix = "choose another --out, or fix the folder and run the same command again; finished work is kept"
        else:
            raise
        raise StorageError("the file cannot be written", where=path, got=error.strerror, fix=fix) from error


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file under a temporary name that is renamed at the end: a kill leaves either the old file or the new."""
    if path.is_dir():
        fix = "pass the path of a file, not of a folder"
        raise StorageError("the file cannot be written, because a folder has this path", where=path, fix=fix)
    with _renamed(path) as partial, open(partial, "xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Make a folder under a temporary name that is renamed when the block ends without an error."""
    with _renamed(path) as partial:
        partial.mkdir()
        yield partial
        if path.exists():
            _remove(path)


@contextlib.contextmanager
def _renamed(path: Path) -> Iterator[Path]:
    """Remove temporary files of killed processes, yield a temporary name, and rename that file or folder at the end."""
    begin, end = f".{path.name}.", ".partial"
    partial = path.with_name(f"{begin}{os.getpid()}{end}")
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for name in os.listdir(path.parent):
            owner = name.removeprefix(begin).removesuffix(end)
            if name == f"{begin}{owner}{end}" and owner.isdecimal() and not _is_other_process(int(owner)):
                _remove(path.with_name(name))
        try:
            yield partial
            os.replace(partial, path)
        except BaseException:  # a partial file would occupy space on a full disk
            with contextlib.suppress(OSError):
                _remove(partial)
            raise


def _is_other_process(pid: int) -> bool:
    """Return whether another running process has this id; a file with our own id is left over from an earlier one."""
    with contextlib.suppress(PermissionError):
        try:
            os.kill(pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
    return pid != os.getpid()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def remove_partials(folder: Path) -> None:
    """Remove files and folders with temporary names; a folder with checksums is complete and not searched."""
    for parent, folders, files in os.walk(folder):
        partials = {name for name in (*folders, *files) if name.startswith(".") and name.endswith(".partial")}
        for name in partials:
            _remove(Path(parent, name))
        folders[:] = [] if CHECKSUMS in files else [name for name in folders if name not in partials]


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, then rename it."""
    with atomic_file(path) as file:
        file.write(data)


def write_checksums(folder: Path, digests: dict[str, str]) -> None:
    """Write `checksums.sha256` (the format of sha256sum) for files named relative to the folder."""
    write_bytes(folder / CHECKSUMS, checksum_lines(digests).encode())


def checksum_lines(digests: Mapping[str, str]) -> str:
    """Return the lines of `checksums.sha256`."""
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))


def read_checksums(folder: Path) -> dict[str, str]:
    """Read `checksums.sha256`: relative name -> hex digest; raises InputError if a name leads out of the folder."""
    path = folder / CHECKSUMS
    digests = dict[str, str]()
    checked = {""}  # folders: each is checked once, since a track has thousands of files
    for number, line in enumerate(read_text(path, what="checksums", tree=folder).splitlines(), 1):
        digest, _, name = line.partition("  ")
        if len(digest) != 64 or not name:
            what = "this line of the checksum file is damaged"
            fix = "copy the folder again from its source"
            expected = "64 hexadecimal digits, two spaces and a file name"
            raise InputError(what, where=f"{path}:{number}", got=line[:80], expected=expected, fix=fix)
        plain = _plain_name(folder, name)
        parent = os.path.dirname(plain)
        if parent not in checked or os.path.islink(f"{folder}{os.sep}{plain}"):
            check_stays_below(folder / plain, folder)
            checked.add(parent)
        digests[plain] = digest
    return digests
