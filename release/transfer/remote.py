"""Bytes of files that lie somewhere else: a folder, an http(s) address, or anything that fsspec opens (zip, memory, hf,
s3 ...).

Whoever answers may lie: no answer is read beyond what was asked for, sizes are compared before anything is trusted, and
names come only from here. Addresses may hold secrets (user:password@, ?token=): `Remote.shown` is the address without
them, and the only form that is logged, recorded or put in an error.
"""

from __future__ import annotations

import asyncio
import io
import ipaddress
import os
import socket
import time
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import SplitResult, urljoin, urlsplit, urlunsplit

from cosfly.errors import EnvironmentMissing, InputError
from cosfly.escaping import published_name
from cosfly.reading.files import open_file
from cosfly.work.locations import CHAIN, opened, without_secrets
from cosfly.work.runner import advance
from cosfly.work.store import inside
from release.record import release_folder

if TYPE_CHECKING:
    from cosfly.chat.wire import Response

MB = 1024 * 1024
CHUNK = 4 * MB
TRIES, FIRST_WAIT_S = 4, 0.5  # a request that broke is made anew, after 0.5, 1, 2 s
TIMEOUT_S = 90.0  # of one answer, from its first byte to its last, however steadily it drips
REDIRECTS, MOST_REDIRECTS = (301, 302, 303, 307, 308), 5
MOST_DIGITS = 15  # of a size
LOCAL = ("file", "local")  # schemes of files of this machine


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
    """Give the files below an address; nothing is asked yet."""
    scheme, mark, path = address.partition("://")
    if scheme.lower() in ("http", "https") and not CHAIN.search(address):
        return HttpRemote(address)
    if mark and scheme not in LOCAL:
        return FsspecRemote(address)
    folder = Path(path if mark else address)
    if not os.path.isdir(folder):  # of any text; a path's own raises
        raise InputError("there is no such folder", where=folder, expected="a release folder, or an address")
    return FolderRemote(folder)


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
    """Files below an http(s) address, by ranges.

    Redirects are followed, as hubs need it: never from https to http, never with user and password, and to a private
    address only on the host that was named.
    """

    def __init__(self, address: str) -> None:
        self.shown = without_secrets(address.partition("?")[0].partition("#")[0].rstrip("/"))
        parts = parts_of(address)
        self._base, self._query = urlunsplit((parts.scheme, parts.netloc, parts.path.rstrip("/"), "", "")), parts.query
        self._host = parts.hostname
        self._lines: Any = None  # an event loop, connections to the host that was named, and to those that it leads to

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_lines": None}

    def size(self, name: str) -> int:
        response = self._asked(name, 0, 1)
        total = response.headers.get("content-range", "").rpartition("/")[2]
        if not (total.isascii() and total.isdigit() and len(total) <= MOST_DIGITS):
            raise self._refusal(name, response, "an answer to a range with the size of the file")
        return int(total)

    def read(self, name: str, start: int, length: int) -> bytes:
        if not length:
            return b""
        response = self._asked(name, start, length)
        wanted = f"bytes {start}-{start + length - 1}/"
        if not response.headers.get("content-range", "").startswith(wanted):
            raise self._refusal(name, response, f"HTTP 206 with {wanted}...")
        return check_length(response.body, length, f"{self.shown}/{name}")

    def _asked(self, name: str, start: int, length: int) -> Response:
        """Ask for a range, again where that broke."""
        import httpx

        from cosfly.chat.wire import Connections

        if self._lines is None:
            lines = (Connections("", timeout_s=TIMEOUT_S, most_bytes=CHUNK) for _ in range(2))
            self._lines = asyncio.Runner(), *lines
        for attempt in range(TRIES):
            time.sleep(FIRST_WAIT_S * 2 ** (attempt - 1) if attempt else 0.0)
            try:
                response = self._lines[0].run(self._answer(name, f"bytes={start}-{start + length - 1}"))
            except (httpx.HTTPError, OSError) as error:  # their words may hold the address
                why = type(error).__name__
                continue
            if response.status == 206:
                return response
            if response.status < 500:
                raise self._refusal(name, response, "HTTP 206, the range that was asked for")
            why = f"HTTP {response.status}"
        raise InputError("the transfer broke", where=f"{self.shown}/{name}", got=why, fix="run the same command again")

    async def _answer(self, name: str, span: str) -> Response:
        """Ask once, and where that leads."""
        _, here, elsewhere = self._lines
        headers = {"range": span, "accept-encoding": "identity"}
        url = f"{self._base}/{name}" + (f"?{self._query}" if self._query else "")
        response = await here.exchange(url, headers=headers)
        for _ in range(MOST_REDIRECTS):
            if response.status not in REDIRECTS:
                break
            parts = self._led_to(name, url, response)
            url, host, asked, tls_name = urlunsplit(parts), parts.hostname or "", parts, None
            if (
                host != self._host
            ):  # asked at the address that was looked at: the name could mean another one a moment later
                address, tls_name = public_address(host), host
                if address is None:
                    raise self._refusal(name, response, "a redirect to a public address")
                port = f":{parts.port}" if parts.port else ""
                asked = parts._replace(netloc=(f"[{address}]" if ":" in address else address) + port)
            about = headers | {"host": parts.netloc}
            response = await elsewhere.exchange(urlunsplit(asked), headers=about, tls_name=tls_name)
        return response

    def _led_to(self, name: str, url: str, response: Response) -> SplitResult:
        """Give where a redirect leads, without user and password."""
        try:
            parts = parts_of(urljoin(url, response.headers.get("location", "")))
        except (InputError, ValueError):
            raise self._refusal(name, response, "a redirect to an http(s) address") from None
        if self._base.startswith("https:") and parts.scheme != "https":
            raise self._refusal(name, response, "an answer over https, as the address says")
        return parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment="")

    def _refusal(self, name: str, response: Response, expected: str) -> InputError:
        coding = response.headers.get("content-encoding")
        place = without_secrets(response.headers.get("location", ""))[:80]
        got = f"HTTP {response.status}" + (f", {coding}" if coding else "") + (f" to {place}" if place else "")
        return InputError("not what was asked for", where=f"{self.shown}/{name}", got=got, expected=expected)


def parts_of(address: str) -> SplitResult:
    """Give the parts of an http(s) address.

    Raises:
        InputError: it is none.
    """
    try:
        parts = urlsplit(address)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.port == 0:
            raise ValueError
    except ValueError:
        raise InputError("no such address", where=without_secrets(address), expected="http(s)://HOST/...") from None
    return parts


def public_address(host: str) -> str | None:
    """Give an address of a host; None where one of its addresses is private, or it has none."""
    try:
        found = [
            str(entry[4][0]).partition("%")[0] for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        ]
    except (OSError, ValueError):  # ValueError: a name that none can be
        return None
    known = [ipaddress.ip_address(one) for one in found]
    known = [getattr(one, "ipv4_mapped", None) or one for one in known]
    return found[0] if known and all(one.is_global and not one.is_multicast for one in known) else None


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
            self._opened = opened(self._address)
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
