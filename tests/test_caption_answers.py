"""The worst answers of tests/test_cosfly_answers.py through a run, and again: no window is lost, none is
wrong."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import Counter

from specimens_captions import report_of, settings
from teacher_server import CHINESE, ENGLISH, MODEL, TeacherServer, kept_answers, obedient_answer

from caption.run.stage import run
from cosfly.errors import TeacherError
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


def test_the_worst_answers_through_a_run_and_again(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 2, 20, with_augmented=False)  # 22 windows
    out = tmp_path / "out"
    shapes: Counter[int] = Counter()
    with TeacherServer(delay_s=0.01) as server:

        def respond(body: dict) -> tuple[int, dict]:
            shape = shape_of(body)
            shapes[shape] += 1
            return 200, SHAPES[shape][0](json.dumps(obedient_answer(server, body), ensure_ascii=False))

        server.respond = respond
        cfg, asked = settings(server.url, endpoint={"json_schema": True}, repair={}), []
        for _ in range(2):
            with contextlib.suppress(TeacherError):  # of windows without an answer
                run(cfg, tree, out)
            asked.append(len(server.bodies))
    windows = report_of(out)["windows"]
    assert windows["input"] == 22
    assert windows["input"] == windows["kept"] + sum((windows["dropped"] | windows["failed"]).values())
    assert windows["kept"], windows
    assert len(shapes) >= 12, "the requests must meet most of the shapes"
    for caption in read_captions(out / "captions.jsonl"):
        if caption.status == "accepted":
            assert caption.en.reasoning_trace == ENGLISH["reasoning_trace"]
            assert caption.zh.reasoning_trace == CHINESE["reasoning_trace"]
    keys = [record["key"] for record in kept_answers(out)]
    assert len(keys) == len(set(keys))
    assert asked[1] - asked[0] <= 2 * sum(windows["failed"].values())  # what got no answer may be asked for again
