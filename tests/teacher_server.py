"""A real HTTP server on 127.0.0.1 that speaks chat completions and misbehaves on demand.

Its answers are a function of the request alone, so that two runs that ask the same get the same. A fault is chosen per
request by a function (number of the request, body) -> name or None; FAULTS lists the names.
"""

import contextlib
import hashlib
import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import BinaryIO

from cosfly.formats.captions import TOKENS
from cosfly.llm import client
from cosfly.runtime.journal import Journal

client.FIRST_PAUSE_S, client.LONGEST_PAUSE_S = 0.01, 0.02  # no test waits for a server that fails
MODEL = "test-teacher"
ENGLISH = {
    "critical_components": "The target pedestrian is {visibility} and walks on the road ahead of the drone.",
    "reasoning_trace": "The line of sight is free and the motion is regular, so this manoeuvre keeps the target in "
    "frame.",
}
CHINESE = {
    "critical_components": "目标行人{visibility}，正在无人机前方的道路上行走。",
    "reasoning_trace": "视线通畅且运动规律，因此该动作可将目标保持在画面内。",
}

# Faults of the transport and the protocol; the rest are faults of the text.
STATUS_FAULTS = {"429": 429, "500": 500, "503": 503, "401": 401, "404": 404, "413": 413}
TEXT_FAULTS: dict[str, Callable[[dict], str]] = {
    "prose": lambda answer: "Here is my decision:\n" + json.dumps(answer) + "\nI hope this helps.",
    "fence": lambda answer: "```json\n" + json.dumps(answer) + "\n```",
    "thinking": lambda answer: "<think>{maybe}</think>" + json.dumps(answer),
    "control": lambda answer: json.dumps(answer).replace("pedestrian", "pedes\x0ftrian"),
    "comma": lambda answer: json.dumps(answer)[:-1] + ",}",
    "wrong_shape": lambda answer: json.dumps({"decision": answer["flight_decision"], "why": "because"}),
    "wrong_decision": lambda answer: json.dumps(answer | {"flight_decision": "do a barrel roll"}),
    "short": lambda answer: json.dumps(answer | {"reasoning_trace": "ok"}),
    "cut": lambda answer: json.dumps(answer)[:60],
    "no_room": lambda answer: json.dumps(answer)[:60],
    "empty_text": lambda answer: "",
}
FAULTS = (
    *STATUS_FAULTS, *TEXT_FAULTS, "reset", "truncated_body", "not_json", "false_gzip", "empty_choices", "null_content",
    "slow", "drip",
    "schema_refused", "schema_ignored", "wrong_mirror_decision", "wrong_mirror_number", "wrong_therefore",
    "echo_key",
)  # fmt: skip

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
        delay_s: float = 0.0,
        decision: Callable[[dict], str] | None = None,
        respond: Callable[[dict], tuple[int, dict] | Sent | Wild | None] | None = None,
        model_facts: dict | None = None,
        list_models: Callable[[], Sent | Wild | None] | None = None,
        port: int = 0,
    ) -> None:
        """
        Args:
            respond: gives status and body of an answer instead of ours; None: ours.
            model_facts: what the list of models says about each, beside its name.
            list_models: gives what is sent in place of that list; None: the list.
        """
        self.fault, self.models, self.delay_s = fault or (lambda number, body: None), models, delay_s
        self.decision = decision or _decision_by_seed
        self.respond, self.model_facts, self.list_models = respond, model_facts or {}, list_models
        self.text: Callable[[dict], str] | None = None  # answers with any text at all, for instance a judge's
        self.bodies: list[bytes] = []
        self.headers: list[dict[str, str]] = []
        self.most_at_once = 0
        self.active = 0
        self._lock = threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), _handler(self))
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

    def digests(self) -> list[str]:
        return [hashlib.sha256(body).hexdigest() for body in self.bodies]


def kept_answers(out: Path) -> list[dict]:
    lines = [record for path in sorted((out / "answers").glob("*.jsonl")) for record in Journal(path).read()]
    return [record for record in lines if "key" in record]


def refusal(status: int, text: str) -> tuple[int, dict]:
    return status, {"error": {"message": text, "type": "invalid_request_error", "param": None, "code": status}}


def is_mirror(body: dict) -> bool:
    return isinstance(body["messages"][-1]["content"], str)


def _decision_by_seed(body: dict) -> str:
    return TOKENS[body.get("seed", 0) % len(TOKENS)]


def obedient_answer(server: TeacherServer, body: dict, fault: str | None = None) -> dict:
    if is_mirror(body):
        english = json.loads(body["messages"][-1]["content"])
        decision = "hover" if fault == "wrong_mirror_decision" else english["flight_decision"]
        reasons = CHINESE["reasoning_trace"]
        if fault == "wrong_mirror_number":
            reasons = reasons.replace("。", "，距离为 77.7 米。")
        return {**CHINESE, "reasoning_trace": reasons, "flight_decision": decision}
    schema = body.get("response_format", {}).get("json_schema", {}).get("schema", {})
    allowed = schema.get("properties", {}).get("flight_decision", {}).get("enum", TOKENS)
    decision = server.decision(body)
    if len(allowed) == 1 and fault != "schema_ignored":
        decision = allowed[0]
    therefore = "hover" if fault == "wrong_therefore" and decision != "hover" else decision
    fields = {"therefore": therefore} if "therefore" in json.dumps(body) else {}  # students are not asked for it
    # Students are asked in both languages.
    texts = ENGLISH if str(body["messages"][0]["content"]).isascii() else CHINESE
    return {**texts, **fields, "flight_decision": decision}


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
                entries = [{"id": name, "object": "model", **server.model_facts} for name in server.models]
                self._send(200, {"object": "list", "data": entries})
            else:
                self._send(404, {"error": {"message": f"no such path {self.path}"}})

        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            raw = self.rfile.read(length)
            if len(raw) < length:  # the client was killed while it sent: nobody asked anything
                self.close_connection = True
                return
            number = server.begin(raw, {name.lower(): value for name, value in self.headers.items()})
            try:
                self._complete(number, json.loads(raw))
            finally:
                server.end()

        def _complete(self, number: int, body: dict) -> None:
            fault = server.fault(number, body)
            assert fault is None or fault in FAULTS, fault
            time.sleep(server.delay_s)
            responded = server.respond(body) if server.respond is not None else None
            if responded is not None:
                self._send_anything(responded)
            elif fault in STATUS_FAULTS:
                extra = {"Retry-After": "0.05"} if fault == "429" else {}
                self._send(STATUS_FAULTS[fault], {"error": {"message": f"planted {fault}"}}, extra)
            elif fault == "echo_key":
                self._send(401, {"error": {"message": f"bad key {self.headers['Authorization']}"}})
            elif fault == "schema_refused" and "response_format" in body:
                self._send(400, {"error": {"message": "response_format is not supported"}})
            elif fault == "reset":
                # SO_LINGER 0: close sends RST, which the client sees as "connection reset by peer".
                self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.connection.close()
                self.close_connection = True
            elif fault == "not_json":
                self._send_bytes(200, b"<html>hello</html>")
            elif fault == "false_gzip":
                self._send_bytes(200, b"hello", {"Content-Encoding": "gzip"})
            elif fault == "empty_choices":
                self._send(200, {"choices": []})
            elif fault == "null_content":
                self._send(200, {"choices": [{"message": {"role": "assistant", "content": None}}]})
            else:
                if fault == "slow":
                    time.sleep(1.0)
                self._send_answer(body, fault)

        def _send_answer(self, body: dict, fault: str | None) -> None:
            answer = {} if server.text else obedient_answer(server, body, fault)
            write = TEXT_FAULTS.get(fault or "", lambda value: json.dumps(value, ensure_ascii=False))
            choice = {
                "index": 0,
                "message": {"role": "assistant", "content": server.text(body) if server.text else write(answer)},
            }
            choice["finish_reason"] = "length" if fault in ("cut", "no_room") else "stop"
            usage = {"prompt_tokens": 1000, "completion_tokens": body["max_tokens"] if fault == "cut" else 100}
            reply = {
                "id": "x", "object": "chat.completion", "model": body["model"], "choices": [choice], "usage": usage,
            }  # fmt: skip
            data = json.dumps(reply, ensure_ascii=False).encode()
            if fault == "truncated_body":
                self._send_bytes(200, data[: len(data) // 2])
            elif fault == "drip":
                self._drip(data)
            else:
                self._send_bytes(200, data)

        def _drip(self, data: bytes) -> None:
            """Send a byte now and then: a limit on the silence between two bytes never ends it."""
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            try:
                for at in range(len(data)):
                    self.wfile.write(data[at : at + 1])
                    time.sleep(0.05)
            except OSError:
                self.close_connection = True

        def _send_anything(self, sent: tuple[int, dict] | Sent | Wild) -> None:
            if isinstance(sent, Sent):
                self._send_bytes(sent.status, sent.body, sent.headers)
            elif isinstance(sent, tuple):
                self._send(*sent)
            else:
                self.close_connection = True
                with contextlib.suppress(OSError):
                    sent(self.wfile)

        def _send(self, status: int, value: dict, headers: dict[str, str] | None = None) -> None:
            self._send_bytes(status, json.dumps(value).encode(), headers)

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
