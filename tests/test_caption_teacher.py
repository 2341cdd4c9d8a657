"""The endpoint teacher against a real server that misbehaves: fault -> what the run must do."""

from __future__ import annotations

import json
import logging
import re
import shutil
import socket
from contextlib import nullcontext
from pathlib import Path

import pytest
from commands import invoke
from specimens_captions import deciding, report_of
from specimens_captions import settings as quick
from tables import each
from teacher_server import TeacherServer, kept_answers

from caption.run.reasons import REASONS, meaning_of
from caption.run.stage import run
from caption.schema import CaptionConfig
from cosfly.chat.client import KEY_VARIABLE
from cosfly.chat.throttle import Throttle
from cosfly.chat.wire import base_url, check_url
from cosfly.errors import CosflyError, NothingKept, TeacherError
from cosfly.products.captions import read_captions
from specimens import make_playback_tree

KEEP = {"hard_conflict": "keep"}
ROOT = Path(__file__).resolve().parents[1]


def settings(url: str, **changes) -> CaptionConfig:
    endpoint = {"max_tries": 4} | changes.pop("endpoint", {})
    return quick(url, **{"repair": {}, "endpoint": endpoint, **changes})


def first(fault: str, count: int = 1):
    """The fault for the first requests only."""
    return lambda number, body: fault if number < count else None


# What the run must do with one faulty answer among good ones: number of requests beyond an undisturbed run's, and the
# word under which the mended wrapper is counted.
PASSING_FAULTS = [
    ("429", 1, None), ("500", 1, None), ("503", 1, None), ("reset", 1, None), ("truncated_body", 1, None),
    ("not_json", 1, None), ("false_gzip", 1, None), ("empty_choices", 1, None), ("null_content", 1, None), ("slow", 1,
    None), ("drip", 1, None),
    ("wrong_shape", 1, None), ("wrong_decision", 1, None), ("short", 1, None), ("cut", 1, None), ("empty_text", 1,
    None),
    ("fence", 0, "code_fence"), ("control", 0, "control_characters"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "more_requests", "recovered"), PASSING_FAULTS)
def test_one_fault_is_survived(tree, tmp_path, fault, more_requests, recovered):
    # However busy the machine is: good answers may be late too, and are asked for again.
    patience = {"timeout_s": 0.5, "max_tries": 40} if (is_late := fault in ("slow", "drip")) else {}
    with deciding("hover", first(fault)) as server:
        path = run(settings(server.url, limit=2, repair=KEEP, endpoint=patience), tree, tmp_path / "out")
    captions = list(read_captions(path))
    assert [caption.status for caption in captions] == ["accepted", "accepted"]
    least = 4 + more_requests  # English and Chinese of two windows
    assert len(server.bodies) >= least if is_late else len(server.bodies) == least
    assert report_of(tmp_path / "out")["recovered"] == ({recovered: 1} if recovered else {})
    assert all("\x0f" not in caption.en.critical_components for caption in captions)


# What the run must do when every answer has the fault: the reason under which all windows are dropped.
DROPPING_FAULTS = [
    ("wrong_shape", "structure_missing_field"), ("wrong_decision", "structure_decision_not_in_closed_set"),
    ("short", "structure_reasoning_trace_too_short"), ("cut", "structure_cut_short"), ("empty_text", "structure_empty"),
    ("no_room", "structure_context_full"), ("wrong_therefore", "decision_against_reasoning"), ("wrong_mirror_decision",
    "bilingual_decision"), ("wrong_mirror_number", "bilingual_slots_number_outside"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "reason"), DROPPING_FAULTS)
def test_a_lasting_fault_drops_windows_with_its_reason(tree, tmp_path, fault, reason):
    told = rf"captions\.jsonl: .*2 dropped .{reason} 2.*; mend .*\({re.escape(meaning_of(reason))}"
    with deciding("ascend", lambda number, body: fault) as server, pytest.raises(NothingKept, match=told):
        run(settings(server.url, limit=2, repair=KEEP), tree, tmp_path / "out")
    windows = report_of(tmp_path / "out")["windows"]
    assert windows == {"input": 2, "kept": 0, "dropped": {reason: 2}, "failed": {}}


def test_a_hopeless_teacher_is_stopped_and_its_commonest_reasons_are_explained(tree, tmp_path):
    """Of its first answers none is accepted; a teacher of whom one was is not stopped, and a setting goes on."""
    cfg = {"stop_after_dropped": 3, "endpoint": {"concurrency": 1}, "repair": KEEP}
    told = r"none of the first 3 answers.*3 structure_.*\(no answer had the fields"
    with deciding("ascend", lambda number, body: "short") as server:
        with pytest.raises(TeacherError, match=told):
            run(settings(server.url, **cfg), tree, tmp_path / "out")
        with pytest.raises(NothingKept):
            run(settings(server.url, **cfg | {"stop_after_dropped": 0}), tree, tmp_path / "out")
    assert report_of(tmp_path / "out")["windows"]["input"] > 3
    with deciding("ascend", lambda number, body: "short" if number > 6 else None) as server:
        run(settings(server.url, **cfg), tree, tmp_path / "one")
    assert report_of(tmp_path / "one")["windows"]["kept"] > 0


def test_every_code_of_a_dropped_window_is_explained_in_one_table():
    """The documents' table is the messages' one, and holds every code that the ways of writing and the window loop
    give."""
    docs = (ROOT / "docs" / "captions.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `([a-z_]+)(?:\.\.\.)?` \| (.+) \|$", docs, re.MULTILINE))
    assert {code: rows.get(code) for code in REASONS} == REASONS
    sources = [path.read_text("utf-8") for path in (ROOT / "caption").rglob("*.py") if path.name != "reasons.py"]
    codes = {code for text in sources for code in re.findall(r"\"((?:slots|conflict|regeneration)_[a-z_]+)\"", text)}
    assert {code for code in codes if code not in REASONS} <= {"slots_"}


@pytest.mark.parametrize("writing", ["slots", "prose"])
def test_a_decision_against_its_own_reasoning_is_asked_for_again_with_what_was_wrong(tree, tmp_path, writing):
    """In every way of writing the action that the reasoning came to stands before the decision."""
    with deciding("ascend", first("wrong_therefore")) as server:
        cfg = settings(server.url, limit=1, repair=KEEP, writing=writing)
        captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    assert [c.status for c in captions] == ["accepted"]
    assert captions[0].checks.refused == ["decision_against_reasoning"]
    assert captions[0].therefore == captions[0].en.flight_decision == "ascend"
    asked, corrected, _ = (json.loads(body) for body in server.bodies)
    assert corrected["messages"][:2] == asked["messages"]
    answer, complaint = corrected["messages"][2:]
    assert answer["role"] == "assistant"
    assert json.loads(answer["content"])["therefore"] == "hover"
    assert "hover" in complaint["content"][0]["text"]
    assert "ascend" in complaint["content"][0]["text"]
    assert corrected["seed"] != asked["seed"]


@pytest.mark.parametrize(
    ("fault", "reason", "num_asks"),
    [
        ("wrong_therefore", "regeneration_failed", 1 + 2 * 2),  # each anchored ask, and its correction
        ("no_room", "regeneration_context_full", 1 + 1),  # the server had no room: not the teacher's failure
    ],
)
def test_a_repair_that_fails_drops_its_window_for_that_reason(tree, tmp_path, fault, reason, num_asks):
    def anchored(number, body):
        return fault if "Hard constraint" in body["messages"][0]["content"] else None

    with deciding("hover", anchored) as server, pytest.raises(NothingKept):
        run(settings(server.url, limit=2, repair={"max_asks": 2}), tree, tmp_path / "out")
    report = report_of(tmp_path / "out")
    assert report["windows"]["dropped"] == {reason: 2}
    assert ("regeneration_context_full" in report["refusals"]) == (fault == "no_room")
    assert len(server.bodies) == 2 * num_asks


def test_an_unreadable_picture_drops_its_windows_and_asks_nothing(tree, tmp_path):
    root = tmp_path / "tree"
    shutil.copytree(tree, root)
    broken = next(root.rglob("frame_00002/rgb.png"))
    broken.write_bytes(broken.read_bytes()[:20])
    with deciding() as server:
        run(settings(server.url, repair=KEEP), root, tmp_path / "out")
    # Frame 2 is observed by the windows at 4, 5 and 6 of 4..8.
    windows = report_of(tmp_path / "out")["windows"]
    assert windows == {"input": 5, "kept": 2, "dropped": {"unreadable_frame": 3}, "failed": {}}
    assert len(server.bodies) == 4


@pytest.mark.parametrize(
    ("strategy", "rungs"),
    [
        ("anchored", ["anchored"] * 3),
        ("hint", ["hint"] * 3),
        ("multi_sample", ["multi_sample"] * 3),
        ("cascade", ["hint", "multi_sample", "anchored"]),
    ],
)
def test_strategies_ask_by_their_rungs(tree, tmp_path, strategy, rungs):
    """A teacher that insists on hovering: only an enforced decision can mend it."""
    with deciding() as server, nullcontext() if "anchored" in rungs else pytest.raises(NothingKept):
        run(settings(server.url, repair={"strategy": strategy}), tree, tmp_path / "out")
    repaired = [caption for caption in read_captions(tmp_path / "out" / "captions.jsonl") if caption.repair]
    assert repaired
    for caption in repaired:
        assert caption.repair.strategy == strategy
        assert caption.repair.first_decision == "hover"
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
        if "Hard constraint" in body["messages"][0]["content"]
    ]
    assert [len(enum) for enum in schemas] == [1] * len(repaired) * ("anchored" in rungs)
    repair = report_of(tmp_path / "out")["repair"]
    assert repair["rejected"] == sum(repair["rungs"].values()) == len(repaired)


def test_a_hint_can_mend_a_conflict(tree, tmp_path):
    """A teacher that thinks again when told so: the rung says hint, and the text was not anchored."""

    def decide(body):
        return "search_to_reacquire_target" if "Hint:" in body["messages"][0]["content"] else "hover"

    with TeacherServer(decision=decide) as server:
        path = run(settings(server.url, repair={"strategy": "cascade"}), tree, tmp_path / "out")
    repaired = [caption for caption in read_captions(path) if caption.repair]
    assert {"hint", "anchored"} == {caption.repair.rung for caption in repaired}
    # Nor does it stop at a decision that the flight merely does not contradict.
    assert {caption.verdict for caption in repaired} == {"CONSISTENT"}


def test_the_key_reaches_the_header_and_nothing_else(tree, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv(KEY_VARIABLE, "sk-very-secret-123")
    caplog.set_level(logging.DEBUG)
    with TeacherServer() as server:
        run(settings(server.url, limit=2), tree, tmp_path / "good")
    assert {headers["authorization"] for headers in server.headers} == {"Bearer sk-very-secret-123"}
    with TeacherServer(lambda number, body: "echo_key") as server, pytest.raises(TeacherError) as caught:
        run(settings(server.url, limit=2), tree, tmp_path / "bad")
    assert "refuses the key" in str(caught.value)
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


def test_a_servers_address_is_read_in_the_ways_that_it_is_written():
    assert base_url("http://h:8000") == base_url("http://h:8000/") == "http://h:8000/v1"
    assert base_url("http://h/v1/chat/completions") == "http://h/v1"
    assert base_url("https://h/api/v3/") == "https://h/api/v3"


# What is no URL that can be asked, and what is said of it.
BAD_URLS = [
    ("http://", "must name a host"), ("http://:80/v1", "must name a host"), ("http://h%zz/v1", "must name a host"),
    ("htp://x", "begin with http"), ("localhost:8000", "begin with http"), ("ftp://h/v1", "begin with http"),
    ("http:/h", "begin with http"), ("http://[::1", "can be asked"), ("http://h:x/v1", "can be asked"),
    ("http://a..b/v1", "can be asked"), (f"http://{'a' * 70}.com/v1", "can be asked"), ("http://xn--/v1",
    "can be asked"),
    ("http://1.2.3.999/v1", "can be asked"), ("http://h:99999/v1", "port"), ("http://h:0/v1", "port"),
    ("http://my host/v1", "blanks"), ("http://h/v1 ", "blanks"), ("http://h/\x00", "blanks"), ("http://h/\nv1",
    "blanks"),
    ("http://user:hunter2@h/v1", KEY_VARIABLE), ("http://hunter2@h/v1", KEY_VARIABLE), ("http://u:hunter2/x@h",
    KEY_VARIABLE),
    ("http://h/v1?api_key=hunter2", KEY_VARIABLE), ("http://h/v1?key=hunter2", KEY_VARIABLE), ("http://h/v1#hunter2",
    KEY_VARIABLE),
    ("http://u:hunter2@h:99999", KEY_VARIABLE), ("htp://u:hunter2@h", "begin with http"), ("http://u:hunter 2@h",
    "blanks"),
]  # fmt: skip


@each(("url", "words"), BAD_URLS, ids=range(len(BAD_URLS)))
def test_what_is_wrong_with_a_url_is_one_line_without_a_secret(url, words):
    with pytest.raises(ValueError, match=words) as caught:
        check_url(url)
    assert "hunter" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["http://[::1", "http://user:hunter2@h/v1", "http://h/v1?api_key=hunter2", "http://u:hunter 2: 3@h"]
)
def test_no_command_takes_a_url_that_cannot_be_asked_or_holds_a_secret(tmp_path, url):
    at, data, asked = ["--out", tmp_path / "out"], ["--data", tmp_path], [url]
    commands = [
        ("caption --teacher", asked, data), ("caption --judge", asked, data), ("caption --plan --teacher", asked, data),
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


# --- the throttle ---


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_the_throttle_ramps_halves_and_recovers():
    clock = Clock()
    throttle = Throttle(64, clock)
    assert throttle.limit == 8
    for _ in range(8):
        throttle.succeeded()
    assert throttle.limit == 24  # tripled by one round of answers
    clock.now_s = 1.0
    throttle.was_busy(given_s=0.5, retry_after_s=None)
    throttle.was_busy(given_s=0.5, retry_after_s=None)  # sent before the decrease: says nothing new
    assert throttle.limit == 12
    for _ in range(12):
        throttle.succeeded()
    assert 12.9 < throttle.limit <= 13.0  # one more per round from now on
    for _ in range(20):
        clock.now_s += 1.0
        throttle.was_busy(given_s=clock.now_s, retry_after_s=None)
    assert throttle.limit == 1.0
    for _ in range(10_000):
        throttle.succeeded()
    assert throttle.limit == 64


def test_a_server_with_room_for_three_is_not_flooded(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 2, 20, with_augmented=False)
    with TeacherServer(lambda number, body: "429" if server.active > 3 else None, delay_s=0.05) as server:
        endpoint = {"concurrency": 16, "max_tries": 20}
        run(settings(server.url, endpoint=endpoint), tree, tmp_path / "out")
        asked = len(server.bodies)
        answered = len(kept_answers(tmp_path / "out"))
    assert report_of(tmp_path / "out")["windows"]["failed"] == {}
    assert asked - answered < answered  # most requests are answered at once; of one that floods, one in twenty
    assert asked > answered  # the limit was met
