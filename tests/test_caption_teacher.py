"""The endpoint teacher against servers that misbehave: fault -> what the run must do.

A run loses nothing: what a server refuses for a reason of its own ends it and is no window's fault, what it refuses of
one window is kept in the server's words, and asked again by `--retry-failed`. The tables are where the next one is added.
"""

import asyncio
import heapq
import json
import logging
import re
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from commands import invoke
from simulator_serving import free_port
from specimens_captions import deciding, report_of
from specimens_captions import settings as quick
from teacher_server import TeacherServer, is_mirror, refusal

from caption.schema import CaptionConfig
from caption.stage.stage import run
from cosfly.formats.captions import read_captions
from cosfly.llm.client import HEADROOM, KEY_VARIABLE, ConcurrencyLimit
from cosfly.runtime.errors import CosflyError, NothingKept, TeacherError
from specimens import make_playback_tree

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
    (refused,) = captions[0].checks.refused
    assert refused.startswith('decision_mismatch: "therefore" says')
    assert captions[0].therefore == captions[0].en.flight_decision == "ascend"
    asked, corrected, _ = (json.loads(body) for body in server.bodies)
    assert corrected["messages"][:2] == asked["messages"]
    answer, complaint = corrected["messages"][2:]
    assert answer["role"] == "assistant"
    assert json.loads(answer["content"])["therefore"] == "hover"
    assert "hover" in complaint["content"][0]["text"]
    assert "ascend" in complaint["content"][0]["text"]
    assert corrected["seed"] != asked["seed"]


@pytest.mark.parametrize(("strategy", "rungs"), [
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
    quoted = refusal(401, "bad key Bearer sk-very-secret-123")
    with TeacherServer(respond=lambda body: quoted) as server, pytest.raises(TeacherError) as caught:
        run(settings(server.url, limit=2), tree, tmp_path / "bad")
    assert "refuses the API key" in str(caught.value)
    assert "sk-very-secret" not in str(caught.value)
    assert "***" in str(caught.value)
    assert "sk-very-secret" not in caplog.text
    for file in tmp_path.rglob("*"):
        assert not file.is_file() or b"sk-very-secret" not in file.read_bytes(), file


def test_unreachable_and_unknown_model_and_not_an_endpoint(tree, tmp_path):
    port = free_port()
    with pytest.raises(TeacherError, match=f"127.0.0.1:{port}/v1: cannot reach the server"):
        run(settings(f"http://127.0.0.1:{port}"), tree, tmp_path / "a")
    with TeacherServer(models=("one", "two")) as server:
        with pytest.raises(TeacherError, match="does not have this model; got three; expected one of one, two"):
            run(settings(server.url, endpoint={"model": "three"}), tree, tmp_path / "b")
        with pytest.raises(TeacherError, match="may not be an OpenAI-compatible endpoint"):
            run(settings(server.url.removesuffix("/v1") + "/elsewhere"), tree, tmp_path / "d")
        assert not server.bodies


@pytest.mark.parametrize(
    "url", ["http://[::1", "http://user:hunter2@h/v1", "http://h/v1?api_key=hunter2", "http://u:hunter 2: 3@h"]
)
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
    for expected in (*range(3, 65), 64):  # one more per answer, so that it doubles per round
        limit.succeeded(is_quick=True)
        assert limit.limit == expected
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


@pytest.mark.parametrize(("num_slots", "answer_s"), [(1, 1.0), (1, 5.0), (1, 30.0), (1, 55.0), (4, 20.0)])
def test_no_request_times_out_in_the_queue_of_a_small_server(num_slots, answer_s):
    """500 answers, waits in the server's queue included."""
    limit, timeout_s = ConcurrencyLimit(256), 120.0
    free_s, in_flight, waits, now_s = [0.0] * num_slots, [], [], 0.0
    while len(waits) < 500:
        while len(in_flight) < int(limit.limit):
            end_s = max(now_s, heapq.heappop(free_s)) + answer_s
            heapq.heappush(free_s, end_s)
            heapq.heappush(in_flight, (end_s, now_s))
        now_s, sent_s = heapq.heappop(in_flight)
        waits.append(now_s - sent_s)
        limit.succeeded(waits[-1] < HEADROOM * timeout_s)
    assert max(waits) < timeout_s


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
    told = r"none of the first 3 windows.*3 structure: the last answer did not have the requested"
    with deciding("ascend", lambda number, body: "short") as server:
        with pytest.raises(TeacherError, match=told):
            run(settings(server.url, **cfg), tree, tmp_path / "out")
        assert report_of(tmp_path / "out")["windows"]["input"] >= 3  # also the last one
        with pytest.raises(NothingKept):
            run(settings(server.url, **cfg | {"stop_after_dropped": 0}), tree, tmp_path / "out")
    assert report_of(tmp_path / "out")["windows"]["input"] > 3
    with deciding("ascend", lambda number, body: "short" if number > 6 else None) as server:
        run(settings(server.url, **cfg), tree, tmp_path / "one")
    assert report_of(tmp_path / "one")["windows"]["kept"] > 0


TOO_LONG = "This model's maximum context length is 8192 tokens. However, you requested 8203 tokens."
NOT_KNOWN = "Something about this request is not as it should be."


@pytest.fixture(scope="module")
def small_tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 14, with_augmented=False)  # 2 flights of 5 windows


@pytest.fixture(scope="module")
def whole(small_tree, tmp_path_factory) -> tuple[bytes, list[int]]:
    """Return what an undisturbed run makes, and the seeds of what it asks in English."""
    with deciding() as server:
        path = run(quick(server.url), small_tree, tmp_path_factory.mktemp("whole") / "out")
    bodies = [json.loads(body) for body in server.bodies]
    return path.read_bytes(), sorted(body["seed"] for body in bodies if not is_mirror(body))


def quarantine(out: Path) -> dict[str, dict]:
    lines = (out / "quarantine.jsonl").read_text(encoding="utf-8").splitlines()
    return {record["id"]: record for record in map(json.loads, lines)}


def refusing(server: TeacherServer, status: int, text: str, num_good: int = 3) -> Callable:
    """Refuse every window after so many requests; mirrors are answered."""
    return lambda body: None if is_mirror(body) or len(server.bodies) <= num_good else refusal(status, text)


# What a server says to every window from some time on: status, words, and what the error must say beside them.
SERVER_FAULTS = {
    "no vision": (500, "image input is not supported - hint: if this is unexpected, you may need to provide the mmproj",
        "--mmproj"),
    "no credit": (429, "You exceeded your current quota. insufficient_quota",
        "the account has no credit left"),
    "a wrong key": (401, "Incorrect API key provided.", "set COSFLY_API_KEY"),
}  # fmt: skip


@pytest.mark.parametrize("name", SERVER_FAULTS)
def test_what_is_the_servers_fault_ends_the_run_and_is_no_windows(small_tree, tmp_path, whole, name):
    status, text, words = SERVER_FAULTS[name]
    out = tmp_path / "out"
    with deciding() as server:
        server.respond = refusing(server, status, text)
        with pytest.raises(TeacherError, match=re.escape(text)) as caught:
            run(quick(server.url), small_tree, out)
        assert words in str(caught.value)
        assert len(server.bodies) < 30  # no window is asked in vain for long
        assert not (out / "manifest.json").exists()
        assert quarantine(out) == {}
        parts = [caption for path in (out / "parts").glob("*") for caption in read_captions(path)]
        assert [caption.checks.refusal for caption in parts if caption.checks.refusal] == []
        server.respond = None  # it is mended
        assert run(quick(server.url), small_tree, out).read_bytes() == whole[0]


def test_a_server_that_refuses_every_window_ends_the_run_and_retry_failed_asks_again(
    small_tree, tmp_path, whole, monkeypatch
):
    monkeypatch.setattr("caption.stage.asking.STOP_AFTER_FAILURES", 3)
    out = tmp_path / "out"
    with deciding() as server:
        # One good answer, whose mirror may come between the refusals: three in a row are left whatever the order.
        server.respond = refusing(server, 400, NOT_KNOWN, num_good=1)
        cfg = quick(server.url, endpoint={"concurrency": 1})
        with pytest.raises(TeacherError, match=NOT_KNOWN):
            run(cfg, small_tree, out)
        assert not (out / "manifest.json").exists()
        assert {held["code"] for held in quarantine(out).values()} == {"refused_400"}
        server.respond = None  # it is mended
        run(cfg, small_tree, out)
        assert run(cfg, small_tree, out, retry_failed=True).read_bytes() == whole[0]


# What a server says to some windows while it answers the others: status, words, and the reason they are dropped for.
WINDOW_FAULTS = {
    "too long": (400, TOO_LONG, "refused_too_long"),
    "too long, LM Studio": (200, "Trying to keep the first 9136 tokens when context the overflows. However, the model "
        "is loaded with context length of only 4096 tokens.", "refused_too_long"),
    "filtered, with the request": (400, "The request was blocked: response_format=json_schema, messages=...",
        "refused_schema"),
    "markup and escapes": (400, '[bold]\x1b[31m<script>alert("x")</script>\nnext\x00line[/] %s {0}', "refused_400"),
}  # fmt: skip


@pytest.mark.parametrize("name", WINDOW_FAULTS)
def test_what_is_a_windows_fault_costs_that_window_and_is_kept_in_the_servers_words(small_tree, tmp_path, whole, name):
    status, text, reason = WINDOW_FAULTS[name]
    out = tmp_path / "out"
    with deciding(respond=lambda body: refusal(status, text) if body["seed"] == whole[1][0] else None) as server:
        path = run(quick(server.url), small_tree, out)
        assert report_of(out)["windows"] == {"input": 10, "kept": 9, "dropped": {}, "failed": {"refused": 1}}
        how = Counter(caption.teacher.structured for caption in read_captions(path))
        assert how == {"json_schema": 9, None: 1}  # nobody else lost the schema
        [dropped] = [caption for caption in read_captions(path) if caption.status == "dropped"]
        [held] = quarantine(out).values()
        words = report_of(out)["refusals"][reason]
        assert held == {"id": dropped.sample_id, "code": reason, "message": words}
        assert dropped.checks.refusal == f"{reason}: {words}"
        assert words.startswith(f"HTTP {status} ")
        assert words.isprintable()
        assert text.split("\n")[0].replace("\x1b", "?")[:60] in words
        page = (out / "report.html").read_text(encoding="utf-8")
        assert "<script>" not in page
        assert reason in page
    assert run(quick(server.url), small_tree, out) == path  # complete: the server, which is gone, is not asked


def test_a_retry_that_stops_loses_and_doubles_nothing(small_tree, tmp_path, whole):
    out, status = tmp_path / "out", 400

    def respond(body: dict) -> tuple[int, dict] | None:
        return refusal(status, TOO_LONG) if body["seed"] == whole[1][0] else None

    with deciding(respond=respond) as server:
        first = run(quick(server.url), small_tree, out).read_bytes()
        status = 401
        with pytest.raises(TeacherError):
            run(quick(server.url), small_tree, out, retry_failed=True)
        ids = [caption.sample_id for caption in read_captions(out / "captions.jsonl")]
        assert 5 <= len(ids) == len(set(ids))
        flights = report_of(out)["flights"]
        assert flights["input"] == flights["kept"]
        status = 400
        assert run(quick(server.url), small_tree, out).read_bytes() == first


def test_what_a_model_declined_is_asked_again(small_tree, tmp_path, whole):
    message = {"content": None, "refusal": "I cannot help with that."}
    completion = {"choices": [{"message": message, "finish_reason": "stop"}], "usage": None}
    out, answer = tmp_path / "out", (200, completion)
    with deciding(respond=lambda body: answer) as server:
        for retry_failed in (False, True):
            with pytest.raises(NothingKept, match=r"10 declined: the model declined to answer"):
                run(quick(server.url), small_tree, out, retry_failed=retry_failed)
            assert message["refusal"] in report_of(out)["refusals"]["declined"]
        answer = None
        assert run(quick(server.url), small_tree, out, retry_failed=True).read_bytes() == whole[0]


def test_a_server_that_refuses_the_schema_is_asked_without_it(small_tree, tmp_path):
    refused = refusal(200, "response_format is not supported by this provider")
    with deciding(respond=lambda body: refused if "response_format" in body else None) as server:
        cfg = quick(server.url, limit=4, endpoint={"concurrency": 1, "max_tries": 1})
        path = run(cfg, small_tree, tmp_path / "out")
    assert sum(b"response_format" in body for body in server.bodies) == 1
    assert len(server.bodies) == 8 + 1
    assert [caption.teacher.structured for caption in read_captions(path)] == ["plain"] * 4
    assert report_of(tmp_path / "out")["refusals"] == {}
