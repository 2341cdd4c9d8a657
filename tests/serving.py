"""Servers of a test on 127.0.0.1, each a thread of its own."""

import contextlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Handler(BaseHTTPRequestHandler):
    """Keeps connections open and says nothing on the terminal."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *args: object) -> None:
        pass

    def answer(self, status: int, value: object = None) -> None:
        data = b"" if value is None else json.dumps(value).encode()
        self.send_response(status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def answer_range(self, data: bytes) -> bytes:
        begin, end = map(int, self.headers["range"].removeprefix("bytes=").split("-"))
        part = data[begin : end + 1]
        self.send_response(206)
        self.send_header("content-range", f"bytes {begin}-{begin + len(part) - 1}/{len(data)}")
        self.send_header("content-length", str(len(part)))
        self.end_headers()
        self.wfile.write(part)
        return part


@contextlib.contextmanager
def serving(handler: type[Handler], **state: object) -> Iterator[ThreadingHTTPServer]:
    """Serve by a handler, whose `server` has this state and its own `address`."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    vars(server).update(state, address=f"http://127.0.0.1:{server.server_address[1]}")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
