"""The endpoint teacher against a real server that misbehaves: fault -> what the run must do."""

import asyncio
import heapq
import json
import logging
import math
import socket
import time
from contextlib import nullcontext

import pytest
from commands import invoke
from specimens_captions import deciding, report_of
from specimens_captions import settings as quick
from tables import each
from teacher_server import TeacherServer

from caption.schema import CaptionConfig
from caption.stage.stage import run
from cosfly.formats.captions import read_captions
from cosfly.llm.client import HEADROOM, KEY_VARIABLE, ConcurrencyLimit
from cosfly.runtime.errors import CosflyError, NothingKept, TeacherError

KEEP = {"hard_conflict": "keep"}


def settings(url: str, **changes) -> CaptionConfig:
    endpoint = {"max_tries": 4} | changes.pop("endpoint", {})
    return quick(url, **{"repair": {}, "endpoint": endpoint, **changes})


@pytest.mark.parametrize("writing", ["slots", "prose"])
def test_a_decision_against_its_own_reasoning_is_asked_for_again_with_what_was_wrong(tree, tmp_path, writing):
    with deciding("ascend", (lambda number, body: "wrong_therefore" if number < 1 else None)) as server:
        cfg = settings(server.url, limit=1, repair=KEEP, writing=writing)
        captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    assert [c.status for c in captions] == ["accepted"]
    assert captions[0].checks.refused == ["decision_mismatch"]
    assert captions[0].therefore == captions[0].en.flight_decision == "ascend"
    asked, corrected, _ = (json.loads(body) for body in server.bodies)
    assert corrected["messages"][:2] == asked["messages"]
    answer, complaint = corrected["messages"][2:]
    assert answer["role"] == "assistant"
    assert json.loads(answer["content"])["therefore"] == "hover"
    assert "hover" in complaint["content"][0]["text"]
    assert "ascend" in complaint["content"][0]["text"]
    assert corrected["seed"] != asked["seed"]


@each(("strategy", "rungs"), [
    ("anchored", ["anchored"] * 3),
    ("hint", ["hint"] * 3),
    ("multi_sample", ["multi_sample"] * 3),
    ("cascade", ["hint", "multi_sample", "anchored"]),
])  # fmt: skip
def test_strategies_ask_by_their_rungs(tree, tmp_path, strategy, rungs):
    with deciding() as server, nullcontext() if "anchored" in rungs else pytest.raises(NothingKept):
        run(settings(server.url, repair={"strategy": strategy}), tree, tmp_path / "out")
    repaired = [caption for caption in read_captions(tmp_path / "out" / "captions.jsonl") if caption.repair]
    assert repaired
    for caption in repaired:
        assert (caption.repair.strategy, caption.repair.first_decision) == (strategy, "hover")
        if "anchored" in rungs:
            assert caption.repair.rung == "anchored"
            assert caption.repair.asks == rungs.index("anchored") + 1
            assert (caption.repair.first_verdict, caption.verdict) == ("HARD_CONFLICT", "CONSISTENT")
            assert caption.en.flight_decision == caption.zh.flight_decision == caption.label
        else:
            assert (caption.repair.rung, caption.repair.asks) == (None, 3)
            assert caption.drop_reason == "regeneration_failed"
    hints = sum(b"Hint: an earlier answer" in body for body in server.bodies)
    assert hints == len(repaired) * rungs[: repaired[0].repair.asks].count("hint")
    schemas = [
        body["response_format"]["json_schema"]["schema"]["properties"]["flight_decision"]["enum"]
        for body in map(json.loads, server.bodies)
        if "Constraint: the flight" in body["messages"][0]["content"]
    ]
    assert [len(enum) for enum in schemas] == [1] * len(repaired) * ("anchored" in rungs)
    repair = report_of(tmp_path / "out")["repair"]
    assert repair["rejected"] == sum(repair["outcomes_by_strategy"][strategy].values()) == len(repaired)


def test_the_key_reaches_the_header_and_nothing_else(tree, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv(KEY_VARIABLE, "sk-very-secret-123")
    caplog.set_level(logging.DEBUG)
    with TeacherServer() as server:
        run(settings(server.url, limit=2), tree, tmp_path / "good")
    assert {headers["authorization"] for headers in server.headers} == {"Bearer sk-very-secret-123"}
    with TeacherServer(lambda number, body: "echo_key") as server, pytest.raises(TeacherError) as caught:
        run(settings(server.url, limit=2), tree, tmp_path / "bad")
    assert "refuses the API key" in str(caught.value)
    assert "sk-very-secret" not in str(caught.value)
    assert "***" in str(caught.value)
    assert "sk-very-secret" not in caplog.text
    for file in tmp_path.rglob("*"):
        assert not file.is_file() or b"sk-very-secret" not in file.read_bytes(), file


def test_unreachable_and_unknown_model_and_not_an_endpoint(tree, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(TeacherError, match=f"127.0.0.1:{port}/v1: cannot reach the teacher"):
        run(settings(f"http://127.0.0.1:{port}"), tree, tmp_path / "a")
    with TeacherServer(models=("one", "two")) as server:
        with pytest.raises(TeacherError, match="does not have this model; got three; expected one of one, two"):
            run(settings(server.url, endpoint={"model": "three"}), tree, tmp_path / "b")
        with pytest.raises(TeacherError, match="has several models"):
            run(settings(server.url), tree, tmp_path / "c")
        with pytest.raises(TeacherError, match="may not be an OpenAI-compatible endpoint"):
            run(settings(server.url.removesuffix("/v1") + "/elsewhere"), tree, tmp_path / "d")
        assert not server.bodies


@each("url", ["http://[::1", "http://user:hunter2@h/v1", "http://h/v1?api_key=hunter2", "http://u:hunter 2: 3@h"])
def test_no_command_takes_a_url_that_cannot_be_asked_or_holds_a_secret(tmp_path, url):
    at, data, asked = ["--out", tmp_path / "out"], ["--data", tmp_path], [url]
    commands = [
        ("caption --teacher", asked, data), ("caption --judge", asked, data),
        ("caption doctor", asked), ("caption judge-check", asked),
        ("caption compare-strategies --teacher", asked, at, data),
        ("run quickstart --set", [f"caption.teacher={json.dumps(url)}"], "--set caption.writing=prose", at),
    ]  # fmt: skip
    for command in commands:
        result = invoke(*command)
        assert result.exit_code == 1, command
        assert isinstance(result.exception, CosflyError), (command, result.exception)
        assert "URL" in str(result.exception)
        assert "hunter" not in f"{result.output}{result.exception}", command
    assert not list(tmp_path.rglob("*"))


def test_the_limit_on_concurrency_halves_and_recovers():
    limit = ConcurrencyLimit(64)
    for _ in range(4):
        limit.succeeded(is_quick=False)
    assert limit.limit == 2  # until a quick answer
    for _ in range(70):
        limit.succeeded(is_quick=True)
    assert limit.limit == 64
    now_s = time.monotonic()
    limit.was_busy(sent_s=now_s, retry_after_s=None)
    limit.was_busy(sent_s=now_s, retry_after_s=None)  # sent before the decrease: does not count again
    assert limit.limit == 32
    for _ in range(32):
        limit.succeeded(is_quick=True)
    assert 32.9 < limit.limit <= 33.0  # one more per round
    for _ in range(20):
        limit.was_busy(sent_s=float("inf"), retry_after_s=None)
    assert limit.limit == 1.0
    for _ in range(10_000):
        limit.succeeded(is_quick=True)
    assert limit.limit == 64


def waits_of(limit: ConcurrencyLimit, num_slots: int, answer_s: float, timeout_s: float) -> tuple[list[float], float]:
    """Return how long 500 answers take, waits in the server's queue included, and when the limit is reached."""
    free_s, in_flight, waits, now_s, full_s = [0.0] * num_slots, [], [], 0.0, math.inf
    while len(waits) < 500:
        while len(in_flight) < int(limit.limit):
            end_s = max(now_s, heapq.heappop(free_s)) + answer_s
            heapq.heappush(free_s, end_s)
            heapq.heappush(in_flight, (end_s, now_s))
        now_s, sent_s = heapq.heappop(in_flight)
        waits.append(now_s - sent_s)
        limit.succeeded(waits[-1] < HEADROOM * timeout_s)
        if limit.limit == limit.ceiling:
            full_s = min(full_s, now_s)
    return waits, full_s


@each(("num_slots", "answer_s"), [(1, 1.0), (1, 5.0), (1, 30.0), (1, 55.0), (4, 20.0)])
def test_no_request_times_out_in_the_queue_of_a_small_server(num_slots, answer_s):
    waits, _ = waits_of(ConcurrencyLimit(256), num_slots, answer_s, timeout_s=120.0)
    assert max(waits) < 120.0


@each("num_slots", [64, 256])
def test_all_slots_of_a_large_server_are_soon_in_use(num_slots):
    waits, full_s = waits_of(ConcurrencyLimit(num_slots), num_slots, 1.0, timeout_s=120.0)
    assert max(waits) == 1.0
    assert full_s <= math.log2(num_slots)


def test_a_retry_after_holds_every_request():
    async def start_s() -> float:
        limit = ConcurrencyLimit(2)
        begun_s = time.monotonic()
        limit.was_busy(sent_s=begun_s, retry_after_s=0.2)
        async with limit.slot():
            return time.monotonic() - begun_s

    assert asyncio.run(start_s()) >= 0.19


def test_a_hopeless_teacher_is_stopped_and_its_commonest_reasons_are_explained(tree, tmp_path):
    cfg = {"stop_after_dropped": 3, "endpoint": {"concurrency": 1}, "repair": KEEP}
    told = r"none of the first 3 answers.*3 structure .*\(no answer had the requested fields"
    with deciding("ascend", lambda number, body: "short") as server:
        with pytest.raises(TeacherError, match=told):
            run(settings(server.url, **cfg), tree, tmp_path / "out")
        with pytest.raises(NothingKept):
            run(settings(server.url, **cfg | {"stop_after_dropped": 0}), tree, tmp_path / "out")
    assert report_of(tmp_path / "out")["windows"]["input"] > 3
    with deciding("ascend", lambda number, body: "short" if number > 6 else None) as server:
        run(settings(server.url, **cfg), tree, tmp_path / "one")
    assert report_of(tmp_path / "one")["windows"]["kept"] > 0
