"""Runs of an endpoint teacher that stop, go on, retry and show what they do; and the book of answers."""

import json
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from itertools import accumulate
from pathlib import Path

import pytest
from processes import full_disk, wait_until
from specimens_captions import deciding, report_of, settings
from teacher_server import is_mirror, kept_answers

from caption.schema import CaptionConfig
from caption.stage import asking
from caption.stage.stage import run
from caption.stage.trial import show_windows
from cosfly.formats.captions import read_captions
from cosfly.llm import client
from cosfly.llm.answers import Budget, BudgetConfig
from cosfly.runtime.errors import ConfigError, StorageError, TeacherError
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 20, with_augmented=False)  # 2 flights of 11 windows


@pytest.fixture(scope="module")
def whole(tree, tmp_path_factory) -> bytes:
    with deciding() as server:
        return run(settings(server.url), tree, tmp_path_factory.mktemp("whole") / "out").read_bytes()


def test_a_larger_limit_goes_on_where_a_smaller_one_stopped(tree, tmp_path, whole):
    out = tmp_path / "out"
    with deciding() as server:
        for limit, num_windows in ((3, 3), (3, 3), (15, 15), (None, 22)):
            path = run(settings(server.url, limit=limit), tree, out)
            assert len(list(read_captions(path))) == num_windows
            assert (out / "manifest.json").exists()
            assert len(server.bodies) == 2 * num_windows  # nothing is asked twice
        run(settings(server.url, limit=5), tree, out)  # the folder holds more already: that is no reason to lose it
    assert path.read_bytes() == whole


# Each answer has 1,000 tokens in and 100 out: 1,100, or 0.0045 at 3 and 15 per million. The 32nd passes the limit.
# A run that is killed before it writes the product again leaves a share of a flight there, and no word of the gap.
@pytest.mark.parametrize(
    ("budget", "has_gaps"),
    [({"max_tokens": 35_000}, True), ({"max_cost": 0.14, "price_prompt": 3.0, "price_completion": 15.0}, False)],
    ids=["tokens", "cost"],
)
def test_a_spent_budget_stops_the_run_and_a_larger_one_goes_on(tree, tmp_path, whole, budget, has_gaps):
    out = tmp_path / "out"
    few = {"concurrency": 1}  # only one request in flight may pass the limit
    with deciding() as server:
        with pytest.raises(TeacherError, match=r"captioning stopped, because the budget is spent.*raise --max-cost"):
            run(settings(server.url, budget=budget, endpoint=few), tree, out)
        assert len(server.bodies) == len(kept_answers(out)) == 32  # what was sent was also kept
        assert not (out / "manifest.json").exists()
        steps = accumulate(-1 if is_mirror(json.loads(raw)) else 1 for raw in server.bodies)
        assert max(steps) <= 2  # at most two windows are in work
        num_mirrored = sum(record["purpose"].startswith("mirror") for record in kept_answers(out))
        assert len(list(read_captions(out / "captions.jsonl"))) == num_mirrored > 0
        with pytest.raises(TeacherError, match="captioning stopped"):  # the same budget is not spent twice
            run(settings(server.url, budget=budget, endpoint=few), tree, out)
        assert len(server.bodies) == 32
        for gap in () if has_gaps else (out / "parts").glob("*.gap"):
            gap.unlink()
        assert run(settings(server.url), tree, out).read_bytes() == whole
    assert len(server.bodies) == 44


def test_the_quarantine_is_asked_about_again(tree, tmp_path, whole):
    out = tmp_path / "out"
    bad: set[int] = set()

    def fault(number, body):
        if not is_mirror(body) and len(bad) < 3:
            bad.add(body["seed"])
        return "500" if body["seed"] in bad else None

    with deciding(fault=fault) as server:
        with pytest.raises(TeacherError, match=r"3 of 22 windows got no answer.*http_500 3.*same command again"):
            run(settings(server.url), tree, out)
        held = [json.loads(line) for line in (out / "quarantine.jsonl").read_text().splitlines()]
        assert [record["code"] for record in held] == ["http_500"] * 3
        assert report_of(out)["windows"]["failed"] == {"no_answer": 3}
        assert {json.loads(line)["code"] for line in (out / "failures.jsonl").read_text().splitlines()} == {"http_500"}
        server.fault, asked = (lambda number, body: None), len(server.bodies)
        path = run(settings(server.url), tree, out, retry_failed=True)
        assert len(server.bodies) - asked == 6  # three windows in two languages
    assert (out / "quarantine.jsonl").read_text() == ""
    assert path.read_bytes() == whole
    assert (out / "manifest.json").exists()


def test_the_total_timeout_bounds_all_tries(tree, tmp_path, monkeypatch):
    monkeypatch.setattr(client, "FIRST_PAUSE_S", 0.3)
    monkeypatch.setattr(client, "LONGEST_PAUSE_S", 0.3)
    monkeypatch.setattr(client, "TOTAL_TIMEOUT_S", 0.5)
    monkeypatch.setattr(asking, "STOP_AFTER_FAILURES", 1)
    with deciding(fault=lambda number, body: "500") as server:
        with pytest.raises(TeacherError, match="total_timeout"):
            run(settings(server.url, endpoint={"max_tries": 50}, limit=1), tree, tmp_path / "out")
        assert 1 <= len(server.bodies) <= 4


def test_a_disk_that_fills_up_costs_nothing_that_was_written(tree, tmp_path, whole):
    out = tmp_path / "out"
    with deciding() as server:
        config = settings(server.url)
        with full_disk(9_000), pytest.raises(StorageError, match=r"cannot be written.*finished work is kept"):
            run(config, tree, out)
        assert not (out / "manifest.json").exists()
        kept = kept_answers(out)
        assert run(config, tree, out).read_bytes() == whole
    now = kept_answers(out)
    assert [record for record in now if record in kept] == kept
    assert len(now) == len({record["key"] for record in now})


@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_a_run_that_is_ended_leaves_a_report_and_no_traceback(tree, tmp_path, whole, number, code, word):
    out, half = tmp_path / "out", threading.Event()

    def fault(index: int, body: dict) -> None:
        if index >= 30:  # of 44; the English answers come first
            half.set()
            ended.wait(60)

    ended = threading.Event()
    with deciding(fault=fault) as server:
        cfg = tmp_path / "config.yaml"
        cfg.write_text(json.dumps({"caption": settings(server.url).model_dump(mode="json")}))
        options = ["--config", str(cfg), "--data", str(tree), "--out", str(out), "--no-check"]
        command = [sys.executable, "-m", "cosfly", "caption", *options]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert half.wait(120)
        # Windows have ended whose answers, one a language, are two; of three of them the first one is written.
        wait_until(lambda: sorted(Counter(kept["sample_id"] for kept in kept_answers(out)).values())[-3:] == [2, 2, 2])
        process.send_signal(number)
        _, errors = process.communicate(timeout=120)
        ended.set()
    assert process.returncode == code
    assert "Traceback" not in errors
    assert errors.strip().splitlines()[-1].startswith(f"error: {word}")
    tally = report_of(out)["windows"]
    assert 0 < tally["kept"] == tally["input"] < 22
    assert report_of(out)["flights"]["kept"] == report_of(out)["flights"]["input"] == 2
    with deciding() as server:
        assert run(settings(server.url), tree, out).read_bytes() == whole


def test_a_run_that_ends_early_counts_the_track_in_work_and_keeps_its_first_error(tree, tmp_path, monkeypatch):
    def full(path: Path, captions: list) -> None:
        raise StorageError("the file cannot be written", where=path)

    monkeypatch.setattr(asking, "write_captions", full)
    monkeypatch.setattr(asking, "WAITING_WINDOWS", 0)
    with (
        deciding(fault=lambda number, body: "401" if number >= 6 else None) as server,
        pytest.raises(TeacherError, match="HTTP 401"),
    ):
        run(settings(server.url, endpoint={"concurrency": 2}), tree, tmp_path / "out")
    assert report_of(tmp_path / "out")["flights"] == {"input": 1, "kept": 1, "dropped": {}, "failed": {}}


def test_windows_with_recorded_answers_say_nothing_about_the_time_that_is_left():
    totals, shown = Counter[str](), list[str]()
    progress = asking.RunProgress(lambda count, words: shown.append(words), 3, Budget(BudgetConfig(), 1, totals))
    progress.add(None)
    assert " left" not in shown[-1]
    totals["answers"] += 1
    progress.add(None)
    assert re.search(r"answers 1 in .* (windows/s|s per window), .* left", shown[-1])


def test_a_trial_shows_questions_answers_and_outcomes_and_keeps_the_answers(tree, tmp_path):
    with deciding(fault=lambda index, body: "wrong_shape" if index == 0 else None) as server:
        lines = list(show_windows(settings(server.url), tree, tmp_path / "out", 1))
        num_asked = len(server.bodies)
        run(settings(server.url, limit=1), tree, tmp_path / "out")
    text = "\n".join(lines)
    assert num_asked == len(server.bodies) == 3  # a wrong one, the English and the Chinese answer
    assert "[picture 15," in text
    assert text.count("--- answer ") == 3
    assert "because" in text  # the words of the wrong answer
    assert lines[lines.index("--- outcome ---") + 1] == "accepted"
    with deciding(fault=lambda index, body: "500" if index == 0 else None) as server:
        cfg = settings(server.url, endpoint={"max_tries": 1, "concurrency": 1})
        text = "\n".join(show_windows(cfg, tree, tmp_path / "other", 2))
    assert text.count("--- outcome ---") == 2
    assert text.count("no answer: http_500") == 1
    with deciding() as server:
        server.text = lambda body: "The drone follows."
        cfg = settings(server.url, endpoint={"json_schema": False})
        text = "\n".join(show_windows(cfg, tree, tmp_path / "prose", 1))
    assert text.count(", no json object) ---") == 3
    with deciding("ascend", lambda index, body: "wrong_therefore" if index == 0 else None) as server:
        text = "\n".join(show_windows(settings(server.url), tree, tmp_path / "corrected", 1))
    assert text.count("[as in request 1]") == 2  # the system prompt and the flight data, not the complaint
    with pytest.raises(ConfigError, match="asks no model"):
        list(show_windows(CaptionConfig(), tree, tmp_path / "out", 1))
