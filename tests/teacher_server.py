"""A real HTTP server on 127.0.0.1 that speaks chat completions and misbehaves on demand.

Its answers are a function of the request alone, so that two runs that ask the same get the same. A fault is chosen per
request by a function (number of the request, body) -> name or None.
"""

import contextlib
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import BinaryIO

from cosfly.formats.captions import TOKENS
from cosfly.llm import client
from cosfly.runtime.journal import Journal

client.FIRST_PAUSE_S = client.LOADING_PAUSE_S = 0.01  # no test waits for a server that fails
client.LONGEST_PAUSE_S = 0.02
MODEL = "test-teacher"
USAGE = {"prompt_tokens": 1000, "completion_tokens": 100}
ENGLISH = {
    "critical_components": "The target pedestrian is {visibility} and walks on the road ahead of the drone.",
    "reasoning_trace": "The line of sight is free and the motion is regular, so this manoeuvre keeps the target in "
    "frame.",
}
CHINESE = {
    "critical_components": "目标行人{visibility}，正在无人机前方的道路上行走。",
    "reasoning_trace": "视线通畅且运动规律，因此该动作可将目标保持在画面内。",
}

# Faults of the text; those of the protocol are a status, "empty_choices" and "wrong_therefore".
TEXT_FAULTS: dict[str, Callable[[dict], str]] = {
    "wrong_shape": lambda answer: json.dumps({"decision": answer["flight_decision"], "why": "because"}),
    "wrong_decision": lambda answer: json.dumps(answer | {"flight_decision": "do a barrel roll"}),
    "short": lambda answer: json.dumps(answer | {"reasoning_trace": "ok"}),
}
Fault = Callable[[int, dict], str | None]


@dataclass(frozen=True)
class Sent:
    """An answer to the byte."""

    status: int
    body: bytes
    headers: dict[str, str] = field(default_factory=dict)


# Writes what it likes to the connection, which is closed then.
Wild = Callable[[BinaryIO], object]


class TeacherServer:
    """Use as a context manager. `bodies` are the raw request bodies in order of arrival."""

    def __init__(
        self,
        fault: Fault | None = None,
        *,
        models: tuple[str, ...] = (MODEL,),
        decision: Callable[[dict], str] | None = None,
        respond: Callable[[dict], tuple[int, dict] | Sent | Wild | None] | None = None,
        list_models: Callable[[], Sent | Wild | None] | None = None,
    ) -> None:
        """
        Args:
            respond: gives status and body of an answer instead of ours; None: ours.
            list_models: gives what is sent in place of that list; None: the list.
        """
        self.fault, self.models = fault or (lambda number, body: None), models
        self.decision = decision or (lambda body: TOKENS[body.get("seed", 0) % len(TOKENS)])
        self.respond, self.list_models = respond, list_models
        self.text: Callable[[dict], str] | None = None  # answers with any text at all, for instance a judge's
        self.bodies: list[bytes] = []
        self.headers: list[dict[str, str]] = []
        self.paths: list[str] = []
        self.most_at_once = 0
        self.active = 0
        self._lock = threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    def __enter__(self) -> "TeacherServer":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def begin(self, raw: bytes, headers: dict[str, str]) -> int:
        with self._lock:
            self.bodies.append(raw)
            self.headers.append(headers)
            self.active += 1
            self.most_at_once = max(self.most_at_once, self.active)
            return len(self.bodies) - 1

    def end(self) -> None:
        with self._lock:
            self.active -= 1


def kept_answers(out: Path) -> list[dict]:
    lines = [record for path in sorted((out / "answers").glob("*.jsonl")) for record in Journal(path).read()]
    return [record for record in lines if "key" in record]


def refusal(status: int, text: str) -> tuple[int, dict]:
    return status, {"error": {"message": text, "type": "invalid_request_error", "param": None, "code": status}}


def is_mirror(body: dict) -> bool:
    return isinstance(body["messages"][-1]["content"], str)


def obedient_answer(server: TeacherServer, body: dict, fault: str | None = None) -> dict:
    if is_mirror(body):
        english = json.loads(body["messages"][-1]["content"].rsplit("\n\n", 1)[-1])
        return {**CHINESE, "flight_decision": english["flight_decision"]}
    schema = body.get("response_format", {}).get("json_schema", {}).get("schema", {})
    allowed = schema.get("properties", {}).get("flight_decision", {}).get("enum", TOKENS)
    decision = allowed[0] if len(allowed) == 1 else server.decision(body)
    therefore = "hover" if fault == "wrong_therefore" and decision != "hover" else decision
    fields = {"therefore": therefore} if "therefore" in json.dumps(body) else {}  # students are not asked for it
    # Students are asked in both languages.
    texts = ENGLISH if str(body["messages"][0]["content"]).isascii() else CHINESE
    return {**texts, **fields, "flight_decision": decision}


def completion(body: dict, text: str) -> dict:
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop"}
    return {"id": "x", "object": "chat.completion", "model": body["model"], "choices": [choice], "usage": USAGE}


def _handler(server: TeacherServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        # Headers and body are two writes: else each answer waits 40 ms for an acknowledgement.
        disable_nagle_algorithm = True

        def do_GET(self) -> None:
            sent = server.list_models() if server.list_models is not None else None
            if sent is not None:
                self._send_anything(sent)
            elif self.path == "/v1/models":
                entries = [{"id": name, "object": "model"} for name in server.models]
                self._send(200, {"object": "list", "data": entries})
            else:
                self._send(404, {"error": {"message": f"no such path {self.path}"}})

        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            raw = self.rfile.read(length)
            if len(raw) < length:  # the client was killed while it sent: nobody asked anything
                self.close_connection = True
                return
            server.paths.append(self.path)
            number = server.begin(raw, {name.lower(): value for name, value in self.headers.items()})
            try:
                self._complete(number, json.loads(raw))
            finally:
                server.end()

        def _complete(self, number: int, body: dict) -> None:
            fault = server.fault(number, body)
            responded = server.respond(body) if server.respond is not None else None
            if responded is not None:
                self._send_anything(responded)
            elif fault is not None and fault.isdecimal():
                self._send(int(fault), {"error": {"message": f"planted {fault}"}})
            elif fault == "empty_choices":
                self._send(200, {"choices": []})
            else:
                self._send_answer(body, fault)

        def _send_answer(self, body: dict, fault: str | None) -> None:
            write = TEXT_FAULTS.get(fault or "", lambda value: json.dumps(value, ensure_ascii=False))
            text = server.text(body) if server.text else write(obedient_answer(server, body, fault))
            self._send_bytes(200, json.dumps(completion(body, text), ensure_ascii=False).encode())

        def _send_anything(self, sent: tuple[int, dict] | Sent | Wild) -> None:
            if isinstance(sent, Sent):
                self._send_bytes(sent.status, sent.body, sent.headers)
            elif isinstance(sent, tuple):
                self._send(*sent)
            else:
                self.close_connection = True
                with contextlib.suppress(OSError):
                    sent(self.wfile)

        def _send(self, status: int, value: dict) -> None:
            self._send_bytes(status, json.dumps(value).encode())

        def _send_bytes(self, status: int, data: bytes, headers: dict[str, str] | None = None) -> None:
            try:
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(data)))
                for name, value in (headers or {}).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(data)
            except OSError:
                self.close_connection = True  # the client went away: it may

        def log_message(self, *args: object) -> None:
            pass

    return Handler
