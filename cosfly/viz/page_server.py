"""A web server of one page, for this machine only."""

import contextlib
import hmac
import json
import logging
import secrets
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol

from cosfly.runtime.errors import CosflyError, EnvironmentMissing, InputError, StorageError

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
MOST_BYTES = 32 * 1024 * 1024  # of a request: a region of 100,000 vertices takes 4 MB


class Site(Protocol):
    """A page and the answers to its requests: a CosflyError is a message for the page, KeyError an unknown name."""

    def page_html(self) -> str: ...

    def answer(self, name: str, data: bytes) -> bytes: ...


class PageServer:
    """A server of one page for this machine only, under `address`, which nobody can guess."""

    def __init__(self, site: Site, port: int) -> None:
        self.site = site
        self.token = secrets.token_hex(24)
        try:
            self.http = ThreadingHTTPServer((HOST, port), type("Handler", (_Handler,), {"server_of_page": self}))
        except OSError as error:
            where = f"{HOST}:{port}"
            fix = "pass another --port, or omit it to use a free port"
            raise EnvironmentMissing("the port cannot be opened", where=where, got=error.strerror, fix=fix) from None
        self.host = f"{HOST}:{self.http.server_address[1]}"
        self.address = f"http://{self.host}/{self.token}/"

    def serve(self) -> None:
        """Answer requests until an interrupt, which is how a user ends it."""
        try:
            with contextlib.suppress(KeyboardInterrupt):
                self.http.serve_forever()
        finally:
            self.http.server_close()


class _Handler(BaseHTTPRequestHandler):
    server_of_page: PageServer
    timeout = 30
    server_version = "cosfly"
    sys_version = ""

    def do_GET(self) -> None:
        if self._name() != "":
            return self._send(404, b"", "text/plain")
        self._send(200, self.server_of_page.site.page_html().encode(), "text/html; charset=utf-8")

    def do_POST(self) -> None:
        """Answer the page only: other pages in a browser have another origin and do not know the token."""
        site = self.server_of_page.site
        name = self._name()
        length = self.headers.get("Content-Length", "")
        if name is None or self.headers.get("Origin") != f"http://{self.server_of_page.host}":
            return self._send(404, b"", "text/plain")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            expected = f"at most {MOST_BYTES} bytes"
            return self._send_error(InputError("the request is too large", got=length or "no size", expected=expected))
        try:
            self._send(200, site.answer(name, self.rfile.read(int(length))), "application/octet-stream")
        except CosflyError as error:
            self._send_error(error)
        except KeyError:
            self._send(404, b"", "text/plain")

    def _name(self) -> str | None:
        """Return the requested name below the address; None for another host or token."""
        begin = f"/{self.server_of_page.token}/"
        is_known = hmac.compare_digest(self.path[: len(begin)].encode(), begin.encode())
        return self.path[len(begin) :] if is_known and self.headers.get("Host") == self.server_of_page.host else None

    def _send_error(self, error: CosflyError) -> None:
        status = 409 if isinstance(error, StorageError) else 400
        self._send(status, json.dumps({"error": str(error)}).encode(), "application/json")

    def _send(self, status: int, data: bytes, kind: str) -> None:
        self.close_connection = True
        self.send_response(status)
        for name, value in {
            "Content-Type": kind, "Content-Length": str(len(data)), "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY",
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug("answered %s", args[1] if len(args) > 1 else "")  # the address stays out of logs
