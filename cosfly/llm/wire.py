"""HTTP exchanges in bounded time and memory, whatever the server sends."""

from __future__ import annotations

import asyncio
import functools
import math
import re
import ssl
from dataclasses import dataclass

import httpx

from cosfly.runtime.errors import TeacherError

KEY_VARIABLE = "COSFLY_API_KEY"
HEADERS = {"Content-Type": "application/json", "Accept-Encoding": "identity"}


def check_url(url: str) -> None:
    """Check that a URL is usable and contains no secret, since it is written to `run.yaml` and shown in messages.

    Raises:
        ValueError: Says what is wrong, without parts of the URL that may be secret.
    """
    shown = "" if "@" in url else f", got {re.split('[?#]', url)[0][:200]!r}"
    if not re.match(r"https?://", url, re.IGNORECASE):
        raise ValueError(f"a URL must begin with http:// or https://{shown}")
    if re.search(r"[\s\x00-\x1f\x7f]", url):
        raise ValueError(f"a URL must not contain blanks{shown}")
    if re.search("[@?#]", url):
        what = "a URL must not contain a user, password, query or fragment, since it is recorded"
        raise ValueError(f"{what}; set the key in the environment variable {KEY_VARIABLE}{shown}")
    try:
        parts = httpx.URL(url)
        host = parts.host
        parts.raw_host.decode("ascii").encode("idna")  # as the resolver does
    except (httpx.InvalidURL, ValueError) as error:
        raise ValueError(f"not a usable URL{shown} ({' '.join(str(error).split())[:100]})") from None
    if not host or "%" in host:
        raise ValueError(f"a URL must contain a host name{shown}")
    if parts.port is not None and not 0 < parts.port < 65_536:
        raise ValueError(f"the port must be from 1 to 65535{shown}")


def base_url(url: str) -> str:
    """Return the API root of a URL given as host, host/v1 or the full chat-completions path."""
    root = url.rstrip("/").removesuffix("/chat/completions").rstrip("/")
    return root if re.search(r"/v\d+(beta)?(/openai)?$", root) else f"{root}/v1"


@dataclass(frozen=True)
class Response:
    """A server's response. body: cut at the size limit (`is_cut`). retry_after_s: None if not given in seconds."""

    status: int
    body: bytes
    is_cut: bool = False
    retry_after_s: float | None = None


class Connections:
    """One connection per request in flight, each in its own client.

    httpx searches a pool of 64 connections at every request, which takes longer than sending fifteen pictures.
    """

    def __init__(self, key: str, *, timeout_s: float, most_bytes: int) -> None:
        """
        Args:
            key: API key sent with each request; "": none.
            timeout_s: limit of one exchange. most_bytes: limit of one body.
        """
        if not (key.isascii() and key.isprintable()):  # an error of httpx would quote it
            what = "the API key contains a character that no header can contain, perhaps a line break"
            raise TeacherError(what, where=KEY_VARIABLE, fix="check the environment variable")
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._timeout_s, self._most_bytes = timeout_s, most_bytes
        self._free = [self._connect()]

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        for connection in self._free:
            await connection.aclose()

    async def exchange(self, url: str, content: bytes | None = None) -> Response:
        """Send one request, a POST if it has a content, and read the response. Redirects are not followed.

        Raises:
            TimeoutError: The response was not complete in time.
            httpx.RequestError: The connection failed, or the body is compressed.
        """
        method, body = "GET" if content is None else "POST", bytearray()
        connection = self._free.pop() if self._free else self._connect()
        try:
            async with (
                asyncio.timeout(self._timeout_s),
                connection.stream(method, url, content=content, headers=HEADERS) as response,
            ):
                encoding = response.headers.get("content-encoding", "identity")
                if encoding.strip().lower() not in ("", "identity"):
                    raise httpx.DecodingError(f"compressed with {encoding[:40]!r}, which was not requested")
                async for piece in response.aiter_raw():
                    body += piece
                    if len(body) > self._most_bytes:  # the rest stays unread, and the connection is closed
                        break
                is_cut = len(body) > self._most_bytes
                wait_s = retry_after_s(response.headers.get("retry-after", ""))
                return Response(response.status_code, bytes(body[: self._most_bytes]), is_cut, wait_s)
        except (httpx.InvalidURL, UnicodeError) as error:  # also of the address of a redirect
            raise httpx.UnsupportedProtocol(f"invalid address: {type(error).__name__}") from None
        finally:
            self._free.append(connection)

    def _connect(self) -> httpx.AsyncClient:
        limits = httpx.Limits(max_connections=1, max_keepalive_connections=1)
        try:
            return httpx.AsyncClient(headers=self._headers, timeout=self._timeout_s, limits=limits, verify=_tls())
        except (httpx.InvalidURL, ValueError, ImportError) as error:
            where = "HTTP_PROXY, HTTPS_PROXY, ALL_PROXY"
            raise TeacherError("the proxy cannot be used", where=where, got=type(error).__name__) from None


@functools.cache
def _tls() -> ssl.SSLContext:
    """Read the certificates once: it takes longer than a request."""
    try:
        return httpx.create_ssl_context()
    except OSError as error:
        where = "SSL_CERT_FILE, SSL_CERT_DIR"
        raise TeacherError("the certificates cannot be read", where=where, got=str(error)) from None


def retry_after_s(header: str) -> float | None:
    """Return the seconds of a Retry-After header, None if it contains none."""
    try:
        wait_s = float(header)
    except ValueError:
        return None
    return wait_s if 0.0 <= wait_s < math.inf else None
