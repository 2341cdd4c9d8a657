"""Runs of an endpoint teacher that stop, go on, retry and show what they do; and the book of answers."""

from __future__ import annotations

import asyncio
import errno
import io
import json
import logging
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from rich.console import Console
from specimens_captions import deciding, report_of, settings
from teacher_server import is_mirror, kept_answers

from caption.run.progress import Display
from caption.run.stage import run
from cosfly.chat import answers, client
from cosfly.chat.answers import Answer, AnswerBook, journal_name
from cosfly.chat.budget import Budget, BudgetConfig, BudgetSpent
from cosfly.chat.protocol import encode_body
from cosfly.errors import InputError, TeacherError
from cosfly.products.captions import Usage, read_captions
from cosfly.work.journal import Journal
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 20, with_augmented=False)  # 2 flights of 11 windows


@pytest.fixture(scope="module")
def whole(tree, tmp_path_factory) -> bytes:
    with deciding() as server:
        return run(settings(server.url), tree, tmp_path_factory.mktemp("whole") / "out").read_bytes()


def keys_of(out: Path) -> list[str]:
    return [record["key"] for record in kept_answers(out)]


def keys_by_flight(out: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for kept in kept_answers(out):
        found.setdefault(kept["sample_id"].partition("_frame_")[0], []).append(kept["key"])
    return found


# --- limits -----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    "budget",
    [{"max_tokens": 16_000}, {"max_cost": 0.06, "price_prompt": 3.0, "price_completion": 15.0}],
    ids=["tokens", "cost"],
)
def test_a_budget_stops_the_run_before_it_is_passed_and_a_larger_one_goes_on(tree, tmp_path, whole, budget):
    out = tmp_path / "out"
    # One at a time: until an answer tells what a request takes, each one in flight counts as the longest prompt.
    few = {"concurrency": 1}
    with deciding() as server:  # each answer: 1,000 tokens in, 100 out
        with pytest.raises(TeacherError, match=r"stopped before the budget was passed.*raise --max-cost"):
            run(settings(server.url, budget=budget, endpoint=few), tree, out)
        answered = len(keys_of(out))
        assert len(server.bodies) == answered  # what was sent was also kept
        if "max_tokens" in budget:
            assert 0 < answered * 1100 <= 16_000
            assert answered >= 10  # nor does it stop long before
        else:
            assert 0 < answered * (1000 * 3 + 100 * 15) / 1e6 <= 0.06
        assert not (out / "manifest.json").exists()
        assert len(list(read_captions(out / "captions.jsonl"))) == sum(
            1 for record in kept_answers(out) if record["purpose"].startswith("mirror")
        )
        with pytest.raises(TeacherError, match="stopped before"):  # the same budget is not spent twice
            run(settings(server.url, budget=budget, endpoint=few), tree, out)
        if "max_tokens" in budget:
            assert len(server.bodies) * 1100 <= 16_000
        assert run(settings(server.url), tree, out).read_bytes() == whole
    assert len(server.bodies) == 44


def test_a_budget_needs_a_server_that_counts_and_a_price():
    with pytest.raises(ValueError, match="needs price"):
        BudgetConfig(max_cost=1.0)
    budget = Budget(BudgetConfig(max_tokens=10), Counter(), first_prompt=4, first_completion=1)
    assert asyncio.run(num_at_once(budget, [0] * 5)) == 2
    with pytest.raises(TeacherError, match="reports no token usage"):
        budget.note(None, "http://x")


async def num_at_once(budget: Budget, nums_pictures: list[int]) -> int:
    """Give how many requests are let through at once; the others wait, and follow."""
    held, most = 0, 0

    async def hold(num_pictures: int) -> None:
        nonlocal held, most
        async with budget.request(num_pictures):
            held, most = held + 1, max(most, held + 1)
            await asyncio.sleep(0.01)
            held -= 1

    await asyncio.gather(*map(hold, nums_pictures))
    return most


def test_a_request_that_would_not_fit_alone_ends_the_budget_and_one_that_would_waits():
    used = Counter(prompt_tokens=6)
    budget = Budget(BudgetConfig(max_tokens=10), used, first_prompt=4, first_completion=1)
    with pytest.raises(BudgetSpent, match="6 of at most 10"):
        asyncio.run(num_at_once(budget, [0]))
    used.clear()
    assert asyncio.run(num_at_once(budget, [0] * 5)) == 2


def test_what_a_judge_took_is_no_measure_of_a_request_with_pictures():
    """After a restart the first answer may be a judge's, all before it being known."""
    used = Counter()
    budget = Budget(BudgetConfig(max_tokens=1500), used, first_prompt=900, first_completion=100)
    assert asyncio.run(num_at_once(budget, [0])) == 1
    budget.note(Usage(prompt_tokens=10, completion_tokens=5), "http://x")
    assert asyncio.run(num_at_once(budget, [15, 15])) == 1
    budget.note(Usage(prompt_tokens=400, completion_tokens=50), "http://x", 15)
    assert asyncio.run(num_at_once(budget, [15, 0, 15])) == 3  # now both kinds are known


# --- what failed ------------------------------------------------------------------------------------------------------


def test_the_quarantine_is_replayed_alone(tree, tmp_path, whole):
    out = tmp_path / "out"
    bad: set[int] = set()
    state = {"on": True}

    def fault(number, body):
        if not is_mirror(body) and len(bad) < 3:
            bad.add(body["seed"])
        return "500" if state["on"] and body["seed"] in bad else None

    with deciding(fault=fault) as server:
        with pytest.raises(TeacherError, match=r"3 of 22 windows got no answer.*http_500 3.*--retry-failed"):
            run(settings(server.url), tree, out)
        held = [json.loads(line) for line in (out / "quarantine.jsonl").read_text().splitlines()]
        assert [record["code"] for record in held] == ["http_500"] * 3
        assert report_of(out)["windows"]["failed"] == {"no_answer": 3}
        assert {json.loads(line)["code"] for line in (out / "failures.jsonl").read_text().splitlines()} == {"http_500"}
        state["on"] = False
        asked = len(server.bodies)
        path = run(settings(server.url), tree, out, retry_failed=True)
        assert len(server.bodies) - asked == 6  # three windows in two languages
    assert (out / "quarantine.jsonl").read_text() == ""
    assert path.read_bytes() == whole
    assert (out / "manifest.json").exists()


def test_retry_failed_leaves_alone_what_was_never_asked(tree, tmp_path, whole):
    out = tmp_path / "out"
    state = {"on": True}

    def fault(number, body):
        return "500" if state["on"] and number >= 12 else None

    with deciding(fault=fault) as server:
        endpoint = {"stop_after_failures": 2, "concurrency": 1}
        with pytest.raises(TeacherError, match="in a row"):
            run(settings(server.url, endpoint=endpoint), tree, out)
        held = [json.loads(line)["id"] for line in (out / "quarantine.jsonl").read_text().splitlines()]
        answered = {record["sample_id"] for record in kept_answers(out)}
        assert 2 <= len(held) <= 4
        state["on"] = False
        run(settings(server.url), tree, out, retry_failed=True)
        now = {record["sample_id"] for record in kept_answers(out)}
        assert now == answered | set(held)
        assert not (out / "manifest.json").exists()
        assert run(settings(server.url), tree, out).read_bytes() == whole


def test_the_total_timeout_bounds_all_tries(tree, tmp_path, monkeypatch):
    monkeypatch.setattr(client, "FIRST_PAUSE_S", 0.3)
    monkeypatch.setattr(client, "LONGEST_PAUSE_S", 0.3)
    endpoint = {"max_tries": 50, "total_timeout_s": 0.5, "stop_after_failures": 1}
    with deciding(fault=lambda number, body: "500") as server:
        start_s = time.monotonic()
        with pytest.raises(TeacherError, match="total_timeout"):
            run(settings(server.url, endpoint=endpoint, limit=1), tree, tmp_path / "out")
        assert time.monotonic() - start_s < 5.0
        assert 1 <= len(server.bodies) <= 4


ANSWER = {
    "key": "k", "sample_id": "a_ORI_frame_00004", "purpose": "free/0", "model": "m", "text": "t",
    "usage": {"prompt_tokens": 10, "completion_tokens": 2},
    "structured": "plain", "finish_reason": "stop", "latency_s": 1.0, "time": 5.0,
}  # fmt: skip


# --- the request ------------------------------------------------------------------------------------------------------


def test_a_body_is_the_json_that_it_stands_for():
    url = "data:image/png;base64," + "QUJD" * 50
    parts = [
        {"type": "text", "text": 'quote " backslash \\ 中文 and \x00 0'},
        {"type": "image_url", "image_url": {"url": url}, "uuid": "u"},
        {"type": "image_url", "image_url": {"url": "https://example.org/a.png"}},
        {"type": "image_url", "image_url": {"url": url + "RA=="}},
    ]
    body = {"model": "m", "messages": [{"role": "system", "content": "s"}, {"role": "user", "content": parts}], "n": 1}
    assert json.loads(encode_body(body)) == body


# --- the display ------------------------------------------------------------------------------------------------------


def test_log_lines_stand_in_for_the_display(tree, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("caption.run.progress.SECONDS_BETWEEN_LINES", 0.0)
    caplog.set_level(logging.INFO, "caption.run.progress")
    with deciding() as server:
        run(settings(server.url, budget={"price_prompt": 10.0}), tree, tmp_path / "out")
    last = [record.message for record in caplog.records if record.name == "caption.run.progress"][-1]
    assert "22 of 22 windows; accepted 22 (repaired 0), dropped 0, no answer 0" in last
    assert "tokens 44,000 in 4,400 out, cost 0.44" in last


def test_the_panel_shows_the_bar_and_every_figure_on_lines_of_their_own():
    used = Counter()
    budget = Budget(BudgetConfig(price_prompt=2.0), used, first_prompt=1, first_completion=1)
    display = Display(100, budget, lambda: 5.0)
    display.num_accepted, display.num_repaired = 40, 3
    display.dropped.update(structure_cut_short=2, bilingual_number=1)
    used.update(prompt_tokens=100_000, completion_tokens=9_000, answers=88)
    for renderable in (display.panel(), display.closing_table()):
        file = io.StringIO()
        Console(file=file, width=100).print(renderable)
        text = file.getvalue()
        for words in ("40", "structure_cut_short", "100,000 in", "9,000 out", "0.20", "windows/s"):
            assert words in text, text
    file = io.StringIO()
    Console(file=file, width=100).print(display.panel())
    lines = file.getvalue().splitlines()
    assert "caption" not in lines[0]
    assert lines[1].strip() == "caption: 43 of 100 windows"


# --- the book of answers ----------------------------------------------------------------------------------------------


def flight_name(flight: int) -> str:
    return f"trajectory_{flight}_ORI"


def record(flight: int, window: int, purpose: str = "free/0") -> Answer:
    sample_id = f"{flight_name(flight)}_frame_{window:05d}"
    usage = {"prompt_tokens": 10, "completion_tokens": 2}
    return Answer(key=f"{sample_id}/{purpose}", sample_id=sample_id, purpose=purpose, usage=usage, text="t")


def fill(folder: Path, num_flights: int, num_windows: int, unfinished: set[int]) -> None:
    """Write journals as a run does, the answers of neighbouring flights in any order; an unfinished flight is cut off
    by a kill."""

    async def write() -> None:
        book = AnswerBook(folder)
        order = [(flight, window) for flight in range(num_flights) for window in range(num_windows)]
        open_count = Counter(dict.fromkeys(range(num_flights), num_windows))
        rng = random.Random(0)
        while order:
            flight, window = order.pop(rng.randrange(min(len(order), num_windows)))
            await book.put(flight_name(flight), record(flight, window))
            open_count[flight] -= 1
            if not open_count[flight] and flight not in unfinished:
                book.forget(flight_name(flight))

    asyncio.run(write())


def lines_read(monkeypatch) -> list[dict]:
    """Note every line that is read through from here on."""
    seen: list[dict] = []
    plain = Journal.read

    def read(self):
        for line in plain(self):
            seen.append(line)
            yield line

    monkeypatch.setattr(Journal, "read", read)
    return seen


def test_a_start_reads_the_last_line_of_finished_flights(tmp_path, monkeypatch):
    fill(tmp_path, 30, 20, unfinished={28})
    seen = lines_read(monkeypatch)
    with AnswerBook(tmp_path) as book:
        assert len(seen) == 20  # of 600
        assert book.totals == {"answers": 600, "prompt_tokens": 6000, "completion_tokens": 1200}
        assert book.get(flight_name(28), record(28, 7).key) == record(28, 7)
        # A part that was removed by hand makes its flight unfinished again: its answers are found all the same.
        assert book.get(flight_name(3), record(3, 7).key) == record(3, 7)
        assert len(seen) == 20 + 20 + 21
        assert book.get(flight_name(99), "no such key") is None


@pytest.mark.parametrize(
    ("record", "field"),
    [
        (ANSWER | {"usage": {"prompt_tokens": 10, "completion_tokens": 10**30}}, "usage.completion_tokens"),
        ({name: value for name, value in ANSWER.items() if name != "key"}, "key"),
        ({"totals": {"answers": 2, "prompt_tokens": -1, "completion_tokens": 4}}, "totals.prompt_tokens"),
    ],
)
def test_a_line_that_cannot_be_used_is_named(tmp_path, record, field):
    with Journal(tmp_path / "a_ORI.jsonl") as journal:
        for line in (ANSWER, record, ANSWER | {"key": "l"}):
            journal.append(line)
    with pytest.raises(InputError, match=f"a_ORI.jsonl:2: .*{field}"):
        AnswerBook(tmp_path)


def test_only_flights_that_are_worked_on_are_in_memory(tmp_path):
    fill(tmp_path, 3, 4, unfinished=set())

    async def go_on() -> None:
        with AnswerBook(tmp_path) as book:
            assert not book._flights
            for flight in range(3):
                book.get(flight_name(flight), "x")
                await book.put(flight_name(flight), record(flight, 4))
                assert list(book._flights) == [flight_name(flight)]
                book.forget(flight_name(flight))
            book.forget("never seen")

    asyncio.run(go_on())
    with AnswerBook(tmp_path) as book:
        assert book.totals["answers"] == 15


def test_a_disk_that_fails_in_its_own_way_holds_nobody_up(tmp_path, monkeypatch):
    def fails(_) -> None:
        raise OSError(errno.ESTALE, "stale file handle")

    async def put() -> None:
        async with asyncio.timeout(30):
            with AnswerBook(tmp_path) as book:
                await book.put(flight_name(0), record(0, 0))

    monkeypatch.setattr(Journal, "sync", fails)
    with pytest.raises(OSError, match="stale file handle"):
        asyncio.run(put())


def test_many_flights_at_once_do_not_use_up_the_open_files(tmp_path, monkeypatch):
    monkeypatch.setattr(answers, "MOST_OPEN_FILES", 4)

    async def write() -> int:
        with AnswerBook(tmp_path) as book:
            for window in range(3):
                await asyncio.gather(*(book.put(flight_name(flight), record(flight, window)) for flight in range(40)))
            return sum(opened.journal._file is not None for opened in book._flights.values())

    assert asyncio.run(write()) <= 4
    with AnswerBook(tmp_path) as book:
        assert book.totals["answers"] == 120
        assert book.get(flight_name(39), record(39, 2).key) == record(39, 2)


@pytest.mark.parametrize(
    "flight", ["..", ".hidden", "a/b", "../../etc/passwd", "", "x" * 300, "nul\0", "~", "飞" * 90, "-rf"]
)
def test_any_flight_has_a_journal_inside_its_folder(tmp_path, flight):
    assert (tmp_path / journal_name(flight)).resolve().parent == tmp_path.resolve()
    assert not journal_name(flight).startswith((".", "-"))
    assert len(journal_name(flight).encode()) < 250
    assert journal_name("trajectory_1_ORI") == "trajectory_1_ORI.jsonl"

    async def write() -> None:
        with AnswerBook(tmp_path) as book:
            await book.put(flight, record(0, 0))

    asyncio.run(write())
    with AnswerBook(tmp_path) as book:
        assert book.get(flight, record(0, 0).key) == record(0, 0)


# --- the disk ---------------------------------------------------------------------------------------------------------


def test_a_disk_that_fills_up_costs_nothing_that_was_written(tree, tmp_path, whole):
    """The limit on a file's size stands for the disk: the system cuts the line that passes it short, as a full disk
    does."""
    out = tmp_path / "out"
    with deciding() as server:
        config = settings(server.url)
        filled = subprocess.run(
            [sys.executable, "-c", LIMITED, "9000", str(tree), str(out), config.model_dump_json()],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert "cannot write" in filled.stderr, filled.stderr
        assert "finished work is kept" in filled.stderr
        assert not (out / "manifest.json").exists()
        kept = keys_by_flight(out)
        assert run(config, tree, out).read_bytes() == whole
    now = keys_by_flight(out)
    assert all(now[flight][: len(keys)] == keys for flight, keys in kept.items())
    assert len(keys_of(out)) == len(set(keys_of(out)))


LIMITED = """
import json, resource, sys
from pathlib import Path
from caption.schema import CaptionConfig
from caption.run.stage import run
from cosfly.errors import StorageError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
try:
    run(CaptionConfig.model_validate(json.loads(sys.argv[4])), Path(sys.argv[2]), Path(sys.argv[3]))
except StorageError as error:
    print(error, file=sys.stderr)
"""
