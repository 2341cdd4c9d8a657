"""A teacher's server as a process of its own, with faults of its life: `python tests/teacher_process.py NAME --port P`.

`--journal FILE` gets a line for each answer that was sent: pid, and the digest of the request.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from simulator_serving import free_port
from teacher_server import TeacherServer, obedient_answer


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--journal", type=Path)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--die-after", type=int, default=0, help="answers; then the process ends, each time")
    parser.add_argument("--dying-s", type=float, default=0.0, help="time for which it answers 500 before it so ends")
    parser.add_argument("--hang-after", type=int, default=0, help="answers; then nobody is answered, and it lives")
    parser.add_argument("--status", type=int, default=0, help="of every answer, in place of one")
    parser.add_argument("--silent", action="store_true", help="never listen")
    parser.add_argument("--last-words", default="", help="say this and end with status 3")
    parser.add_argument("--child", type=Path, help="start a child in a session of its own, and write its pid here")
    args = parser.parse_args()
    if args.child:
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], start_new_session=True)
        args.child.write_text(f"{os.getpid()} {child.pid}")
    if args.last_words:
        print(f"loading {args.name}\n{args.last_words}\nthe engine did not start", flush=True)
        sys.exit(3)
    if args.silent:
        time.sleep(600)
    num_answers, lock = 0, threading.Lock()

    def hang() -> None:
        if args.hang_after and num_answers > args.hang_after:
            time.sleep(600)

    def respond(body: dict) -> tuple[int, dict] | None:
        nonlocal num_answers
        if args.status:
            return args.status, {"error": {"message": f"planted {args.status}"}}
        with lock:
            num_answers += 1
            if args.die_after and num_answers > args.die_after:
                if not args.dying_s:
                    os._exit(9)
                if num_answers == args.die_after + 1:
                    threading.Timer(args.dying_s, os._exit, (9,)).start()
                return 500, {"error": {"message": "EngineCore encountered an issue."}}
        hang()
        if args.journal:
            digest = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
            with args.journal.open("a") as file:
                file.write(f"{os.getpid()} {digest}\n")
        text = json.dumps(obedient_answer(server, body), ensure_ascii=False)
        choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop"}
        usage = {"prompt_tokens": 1000, "completion_tokens": 100}
        return 200, {"object": "chat.completion", "model": body["model"], "choices": [choice], "usage": usage}

    decide = lambda body: "hover"  # noqa: E731
    with TeacherServer(
        models=(args.name,), port=args.port, delay_s=args.delay, decision=decide, respond=respond, list_models=hang
    ) as server:
        print(f"{os.environ.get('CUDA_VISIBLE_DEVICES', 'all')} --port {args.port}", flush=True)
        time.sleep(600)


def command(name: str = "test-teacher", *more: object, port: int = 0) -> list[str]:
    return [sys.executable, __file__, name, "--port", str(port or free_port()), *map(str, more)]


@contextlib.contextmanager
def running(words: list[str]) -> Iterator[tuple[subprocess.Popen, str]]:
    """Run a server by its command; gives the process and its URL once it listens."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert "--port" in process.stdout.readline()
        yield process, f"http://127.0.0.1:{words[words.index('--port') + 1]}/v1"
    finally:
        process.kill()
        process.wait()


def journaled(path: Path) -> list[tuple[int, str]]:
    """Read what was answered: pid of the server, digest of the request."""
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [(int(pid), digest) for pid, digest in map(str.split, lines)]


if __name__ == "__main__":
    main()
