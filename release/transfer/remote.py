"""Bytes of files that lie somewhere else: a folder, an http(s) address, or anything that fsspec opens (zip, memory, hf, s3 ...).

Whoever answers may lie: no answer is read beyond what was asked for, sizes are compared before anything is trusted, and names come
only from here. Addresses may hold secrets (user:password@, ?token=): `Remote.shown` is the address without them, and the only form
that is logged, recorded or put in an error.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit, urlunsplit

from cosfly.errors import EnvironmentMissing, InputError
from cosfly.escaping import published_name
from cosfly.reading.files import open_file
from cosfly.work.runner import advance
from cosfly.work.store import inside
from release.record import release_folder

Answer = TypeVar("Answer")
MB = 1024 * 1024
CHUNK = 4 * MB
TRIES, FIRST_WAIT_S = 4, 0.5  # a request that broke is made anew, after 0.5, 1, 2 s
TIMEOUT_S = 60.0
MOST_REDIRECTS = 5
LOCAL = ("file", "local")  # schemes of files of this machine
CHAIN = re.compile(r"::(?![^\[]*\])")  # between the links of a chain, not within [::1]


class Remote(Protocol):
    """The files below an address. `shown`: the address without secrets."""

    shown: str

    @abstractmethod
    def size(self, name: str) -> int:
        """Give the size of a file. Raises InputError: there is none, or the other side does not say."""

    @abstractmethod
    def read(self, name: str, start: int, length: int) -> bytes:
        """Give exactly these bytes of a file. Raises InputError: they are not to be had."""


def open_remote(address: str) -> Remote:
    """Give the files below an address; nothing is asked yet.

    Raises:
        InputError: no such folder, or not an address. EnvironmentMissing: what opens such addresses is not installed.
    """
    if address.startswith(("http://", "https://")):
        return HttpRemote(address)
    if "://" in address:
        return FsspecRemote(address)
    folder = Path(address)
    if not folder.is_dir():
        raise InputError("there is no such folder", where=folder, expected="a release folder, or an address")
    return FolderRemote(folder)


def without_secrets(address: str) -> str:
    """Give an address without user, password, query and fragment; of a chain (`zip://x::https://...`) each link."""
    return "::".join(_plain(link) for link in CHAIN.split(address))


def _plain(link: str) -> str:
    if "://" not in link:  # a folder, or what is left of an address that is none
        return re.split("[?#]", link, maxsplit=1)[0].rpartition("@")[2]
    try:
        parts = urlsplit(link)
        host = parts.netloc.rpartition("@")[2]
    except ValueError:
        return f"{link.partition('://')[0]}://..."
    return urlunsplit((parts.scheme, host, parts.path, "", ""))


def published_address(shown: str) -> str:
    """Give an address as a record that is published may name it: of what lies on this machine the last name alone."""
    links = (link.partition("://") for link in CHAIN.split(shown))
    return "::".join(
        published_name(path if mark else scheme) if not mark or scheme in LOCAL else f"{scheme}://{path}"
        for scheme, mark, path in links
    )


def check_length(data: bytes, length: int, where: str) -> bytes:
    """Give the data; raise InputError where the other side sent more or less of it than was asked for."""
    if len(data) != length:
        raise InputError(
            "the other side sent another number of bytes", where=where, got=len(data), expected=f"{length}"
        )
    return data


class FolderRemote:
    """A folder of this machine, read as every folder is."""

    def __init__(self, folder: Path) -> None:
        folder = release_folder(folder)
        self.folder, self.shown = folder, str(folder)

    def size(self, name: str) -> int:
        with open_file(inside(self.folder, name), what="file of the release", tree=self.folder) as file:
            return os.fstat(file.fileno()).st_size

    def read(self, name: str, start: int, length: int) -> bytes:
        with open_file(inside(self.folder, name), what="file of the release", tree=self.folder) as file:
            file.seek(start)
            return check_length(file.read(length), length, f"{self.shown}/{name}")


class HttpRemote:
    """Files below an http(s) address, by ranges."""

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self._base, self._query = urlunsplit((parts.scheme, parts.netloc, parts.path.rstrip("/"), "", "")), parts.query
        self.shown = without_secrets(self._base)
        self._client: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_client": None}

    def size(self, name: str) -> int:
        return self._tried(name, lambda: self._size_once(name))

    def read(self, name: str, start: int, length: int) -> bytes:
        return self._tried(name, lambda: self._read_once(name, start, length)) if length else b""

    def _tried(self, name: str, ask: Callable[[], Answer]) -> Answer:
        for attempt in range(TRIES):
            try:
                return ask()
            except _Broken as broken:
                why = str(broken)
            if attempt + 1 < TRIES:
                time.sleep(FIRST_WAIT_S * 2**attempt)
        raise InputError("the transfer broke", where=f"{self.shown}/{name}", got=why, fix="run the same command again")

    def _size_once(self, name: str) -> int:
        with self._asked(name, 0, 1) as response:
            total = response.headers.get("content-range", "").rpartition("/")[2]
            if response.status_code >= 500:
                raise _Broken(f"HTTP {response.status_code}")
            if response.status_code != 206 or not total.isascii() or not total.isdigit() or len(total) > 15:
                raise self._refusal(name, response, "an answer to a range with the size of the file")
            return int(total)

    def _read_once(self, name: str, start: int, length: int) -> bytes:
        import httpx

        with self._asked(name, start, length) as response:
            wanted = f"bytes {start}-{start + length - 1}/"
            if response.status_code >= 500:
                raise _Broken(f"HTTP {response.status_code}")
            if response.status_code != 206 or not response.headers.get("content-range", "").startswith(wanted):
                raise self._refusal(name, response, f"HTTP 206 with {wanted}...")
            parts, found = [], 0
            try:
                for part in response.iter_raw(CHUNK):  # as sent: a coding would let a small answer unpack to anything
                    found += len(part)
                    if found > length:
                        raise InputError(
                            "the other side sent more than was asked for",
                            where=f"{self.shown}/{name}",
                            expected=f"{length} bytes",
                        )
                    parts.append(part)
            except httpx.HTTPError as error:
                raise _Broken(type(error).__name__) from None
        if found < length:
            raise _Broken(f"{found} of {length} bytes")
        return b"".join(parts)

    def _asked(self, name: str, start: int, length: int) -> Any:
        """Ask for a range; a context that gives the response before its body."""
        import httpx

        if self._client is None:
            self._client = httpx.Client(timeout=TIMEOUT_S, follow_redirects=True, max_redirects=MOST_REDIRECTS)
        headers = {"range": f"bytes={start}-{start + length - 1}", "accept-encoding": "identity"}
        address = f"{self._base}/{name}" + (f"?{self._query}" if self._query else "")

        @contextlib.contextmanager
        def asked() -> Iterator[Any]:
            try:
                with self._client.stream("GET", address, headers=headers) as response:
                    if self._base.startswith("https:") and response.url.scheme != "https":
                        raise self._refusal(name, response, "an answer over https, as the address says")
                    yield response
            except (httpx.HTTPError, httpx.InvalidURL) as error:
                raise _Broken(type(error).__name__) from None  # its words may hold the address

        return asked()

    def _refusal(self, name: str, response: Any, expected: str) -> InputError:
        coding = response.headers.get("content-encoding")
        got = f"HTTP {response.status_code}" + (f", {coding}" if coding else "")
        return InputError("not what was asked for", where=f"{self.shown}/{name}", got=got, expected=expected)


class _Broken(Exception):
    """A transfer that may work when it is tried again."""


class FsspecRemote:
    """Files below any address that fsspec knows."""

    def __init__(self, address: str) -> None:
        self._address, self.shown = address, without_secrets(address)
        self._opened: tuple[Any, str] | None = None
        # The one that was read last: opening asks again, and unpacks a zip's from its begin.
        self._file: tuple[str, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_opened": None, "_file": None}

    def size(self, name: str) -> int:
        system, root = self._system()
        size = self._asked(name, lambda: system.size(f"{root}/{name}"))
        if not isinstance(size, int):
            raise InputError("the other side does not say how large a file is", where=f"{self.shown}/{name}")
        return size

    def read(self, name: str, start: int, length: int) -> bytes:
        system, root = self._system()

        def read() -> bytes:
            if self._file is None or self._file[0] != name:
                self._close()
                self._file = name, system.open(f"{root}/{name}", "rb", block_size=CHUNK, cache_type="none")
            file = self._file[1]
            file.seek(start)
            return file.read(length)

        return check_length(self._asked(name, read), length, f"{self.shown}/{name}")

    def _close(self) -> None:
        if self._file is not None:
            self._file[1].close()
            self._file = None

    def _asked(self, name: str, ask: Any) -> Any:
        try:
            return ask()
        except EnvironmentMissing:
            raise
        except Exception as error:  # every file system has its own; their words may hold the address
            self._file = None  # opened anew, whatever it was that broke
            raise InputError("cannot read a file", where=f"{self.shown}/{name}", got=type(error).__name__) from None

    def _system(self) -> tuple[Any, str]:
        if self._opened is None:
            try:
                from fsspec.core import url_to_fs
            except ImportError:
                raise EnvironmentMissing(
                    "fsspec is not installed", where=self.shown, fix="pip install 'cosfly[remote]'"
                ) from None
            try:
                system, root = url_to_fs(self._address)
            except (ValueError, ImportError, OSError) as error:
                raise InputError(
                    "no such address", where=self.shown, got=type(error).__name__, expected="what fsspec opens"
                ) from None
            self._opened = system, str(root).rstrip("/")
        return self._opened


class RemoteFile(io.RawIOBase):
    """A file of a remote for readers that seek; `num_bytes` are its size, which the caller has compared."""

    def __init__(self, remote: Remote, name: str, num_bytes: int) -> None:
        self._remote, self._name, self._size, self._at = remote, name, num_bytes, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = max(0, offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence])
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, self._size - self._at)
        length = left if size is None or size < 0 else min(size, left)
        parts = []
        while length:
            parts.append(self._remote.read(self._name, self._at, min(length, CHUNK)))
            self._at += len(parts[-1])
            length -= len(parts[-1])
            advance(0)  # a sign of life
        return b"".join(parts)

    def readinto(self, buffer: Any) -> int:
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)
