"""The worst answers of tests/test_cosfly_answers.py through `cosfly caption`, and again: no window is lost, none is
wrong."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections import Counter

from teacher_server import CHINESE, ENGLISH, MODEL, TeacherServer, kept_answers, obedient_answer

from cosfly.products.captions import read_captions
from specimens import make_playback_tree


def said(text: str | None, reason: object = "stop", **more: object) -> dict:
    """Give the body of a completion with this text."""
    message = {"role": "assistant", "content": text, **more}
    usage = {"prompt_tokens": 1000, "completion_tokens": 10**4200 if text is None else 100}
    return {"model": MODEL, "choices": [{"index": 0, "message": message, "finish_reason": reason}], "usage": usage}


# What a server may make of an obedient answer; False: it holds none that may be taken.
SHAPES = [
    (lambda answer: said(answer), True),
    (lambda answer: said(f"{answer}\n</think>\n```json\n{answer}\n```\nHope it helps {{you}}"), True),
    (lambda answer: said(f"<|channel|>analysis<|message|>{answer}<|end|><|channel|>final<|message|>{answer}<|return|>"),
    True),
    (lambda answer: said("", "tool_calls", tool_calls=[{"function": {"name": "f", "arguments": answer}}]), True),
    (lambda answer: said(json.dumps(answer)), True),
    (lambda answer: said(answer.replace('"', "'")), True),
    (lambda answer: said(answer[:-1] + ",}"), True),
    (lambda answer: said(answer.replace('": "', '": "\\ud83d ')), False),  # an escape in the answer
    (lambda answer: said(answer.replace('": "', '": "\ud83d ')), False),  # half a character in the body
    (lambda answer: said(f"<think>I would say {answer}", "length"), False),
    (lambda answer: said(f"I would say {answer} but", "length"), False),
    (lambda answer: said("", reasoning=answer), False),
    (lambda answer: said(answer[:-1] + ', "flight_decision": "hover"}'), False),
    (lambda answer: said('{"a":' * 10_000), False),
    (lambda answer: said("", refusal="I can't help with that. \ud83d"), False),
    (lambda answer: said(answer[:40], "length"), False),
    (lambda answer: said(None, {"deep": "\udeb6"}), False),  # nothing, and a count of tokens of 4,201 digits
]  # fmt: skip


def shape_of(body: dict) -> int:
    """Choose a shape by the request alone, so that an answer is the same in every run."""
    return int(hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest(), 16) % len(SHAPES)


def test_the_worst_answers_through_the_command_and_again(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 2, 20, with_augmented=False)  # 22 windows
    out = tmp_path / "out"
    shapes: Counter[int] = Counter()
    with TeacherServer(delay_s=0.01) as server:

        def respond(body: dict) -> tuple[int, dict]:
            shape = shape_of(body)
            shapes[shape] += 1
            return 200, SHAPES[shape][0](json.dumps(obedient_answer(server, body), ensure_ascii=False))

        server.respond = respond
        sets = {"json_schema": "true", "max_tries": 2, "backoff_s": 0.02, "max_backoff_s": 0.05, "concurrency": 4}
        command = [
            sys.executable,
            "-m",
            "cosfly",
            "caption",
            "--data",
            tree,
            "--out",
            out,
            "--teacher",
            server.url,
            "--no-check",
        ]
        command += [word for name, value in sets.items() for word in ("--set", f"caption.endpoint.{name}={value}")]
        command += ["--set", "caption.image.max_side_px=32"]
        command = [str(word) for word in command]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        asked = len(server.bodies)
        again = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "Traceback" not in ended.stderr + again.stderr, ended.stderr + again.stderr
    report = json.loads((out / "caption_report.json").read_text(encoding="utf-8"))
    windows = report["windows"]
    assert (
        windows["input"] == 22 == windows["kept"] + sum(windows["dropped"].values()) + sum(windows["failed"].values())
    )
    assert windows["kept"], windows
    assert len(shapes) >= 12, "the requests must meet most of the shapes"
    for caption in read_captions(out / "captions.jsonl"):
        if caption.status == "accepted":
            assert caption.en.reasoning_trace == ENGLISH["reasoning_trace"]
            assert caption.zh.reasoning_trace == CHINESE["reasoning_trace"]
    keys = [record["key"] for record in kept_answers(out)]
    assert len(keys) == len(set(keys))
    tries = 2 * sum(windows["failed"].values())  # what got no answer may be asked for again
    assert len(server.bodies) - asked <= tries
