"""Items to work: resume, tally, failures; workers that die, stall or never end; Ctrl-C while requests are in flight; the
cache of compiled functions."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from processes import QUICK, children_of, is_running, ran, wait_until
from toy_workers import items_of, make_faulty, stage_in

import cosfly
from cosfly.runtime import console
from cosfly.runtime.errors import EnvironmentMissing, InputError, StorageError
from cosfly.runtime.events import LOSSES, read_events
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Kept
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome


def make_worker(log: Path):
    """A stand-in stage: the payload says what happens; every call leaves a line."""

    def work(item: Item) -> Outcome:
        with open(log, "a") as file:
            file.write(item.item_id + "\n")
        action, value = item.payload
        if action == "drop":
            return Outcome(drop_reason=value)
        if action == "fail":
            raise InputError("broken", where=item.item_id, got=value)
        if action == "bug":
            raise KeyError(value)
        if action == "full":
            raise StorageError("disk full", where="there")
        if action == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        return Outcome({"square": value**2, "draw": float(rng_for(1, "demo", item.item_id).random())})

    return work


def _items(*payloads):
    return [Item(f"i{k}", payload) for k, payload in enumerate(payloads)]


MIXED = (("keep", 2), ("drop", "short"), ("fail", "x"), ("keep", 3), ("bug", "y"), ("drop", "short"))


def test_everything_is_counted_and_what_failed_is_done_again(tmp_path):
    finished = run_items(stage_in(tmp_path), _items(*MIXED), make_worker, (tmp_path / "log",))
    found = finished.tally.model_dump()
    assert found == {"input": 6, "kept": 2, "dropped": {"short": 2}, "failed": {"bug": 1, "input": 1}}
    assert [record.id for record in finished.kept] == ["i0", "i3"]
    failures = (tmp_path / "s/failures.jsonl").read_text()
    assert "got x" in failures
    assert "KeyError" in failures
    (tmp_path / "log").unlink()
    again = run_items(stage_in(tmp_path), _items(*MIXED), make_worker, (tmp_path / "log",))
    assert (tmp_path / "log").read_text().split() == ["i2", "i4"]
    assert again.tally == finished.tally


def test_a_record_is_the_last_of_its_item_and_a_failure_undoes_nothing(tmp_path):
    stage = stage_in(tmp_path)
    with stage.journal as journal:
        for record in (
            Failed(id="i0", code="input", message="at first"), Kept(id="i0", result={"square": 4}),
            Failed(id="i0", code="input", message="of somebody else"), Kept(id="another"),
            Failed(id="i1", code="input", message="at first"),
        ):  # fmt: skip
            journal.append(record.model_dump())
    finished = run_items(stage, _items(("keep", 9), ("fail", "x")), make_worker, (tmp_path / "log",))
    kept, failed = finished.records
    assert (kept.result, failed.message.partition(";")[2]) == ({"square": 4}, " got x")
    assert (finished.tally.kept, finished.tally.failed) == (1, {"input": 1})
    (tmp_path / "s/items.jsonl").write_text("damaged meanwhile\n")
    with pytest.raises(InputError, match=r"changed while the command.*same command again"):
        list(finished.records)


def test_a_dying_worker_loses_no_other_item_and_leaves_the_stage_open(tmp_path):
    payloads = [("keep", k) for k in range(5)]
    payloads[2] = ("die", 0)
    stage = stage_in(tmp_path)
    with pytest.raises(EnvironmentMissing, match=r"1 of 5 items without a result.*fewer --workers"):
        run_items(stage, _items(*payloads), make_worker, (tmp_path / "log",), workers=2)
    assert sorted(r["id"] for r in stage.journal.read() if r["status"] == "kept") == ["i0", "i1", "i3", "i4"]
    assert not stage_in(tmp_path).is_complete


def test_a_fatal_error_stops_and_keeps_what_was_done(tmp_path):
    stage = stage_in(tmp_path)
    items = _items(("keep", 1), ("keep", 2), *[("full", 0)] * 4)
    with pytest.raises(StorageError, match="disk full"):
        run_items(stage, items, make_worker, (tmp_path / "log",), workers=2)
    assert all(r["status"] == "kept" for r in stage.journal.read())


def make_broken_worker(error: Exception):
    raise error


@pytest.mark.parametrize("error", [InputError("no such map", where="map.json"), KeyError("no such map")])
def test_an_error_in_the_factory_is_the_stages_error(tmp_path, error):
    arguments = stage_in(tmp_path), _items(("keep", 1), ("keep", 2)), make_broken_worker, (error,)
    with pytest.raises(type(error), match="no such map"):
        run_items(*arguments, workers=2)


def work_on(path: Path, kinds: list[str], workers: int, watch: Watch = QUICK):
    return run_items(stage_in(path), items_of(*kinds), make_faulty, (path / "s",), workers=workers, watch=watch)


@pytest.mark.parametrize(
    ("workers", "lost"),
    [(1, {"i0": "heartbeat_lost"}), (2, {"i0": "heartbeat_lost", "i1": "worker_died", "i2": "timed_out"})],
)
def test_workers_that_die_and_stall_once_cost_nothing_but_time(tmp_path, workers, lost):
    kinds = ["once-stop", "once-die", "once-sleep"][: len(lost)] + ["nothing"] * 2
    finished = work_on(tmp_path, kinds, workers)
    assert [record.id for record in finished.kept] == [f"i{k}" for k in range(len(kinds))]
    found = {event.item: event.event for event in read_events(tmp_path / "s") if event.event in LOSSES}
    assert found == found | lost
    assert not list((tmp_path / "s").glob(".*.partial"))
    assert all((tmp_path / "s" / record.id / "frame").read_text() == record.id for record in finished.kept)


@pytest.mark.slow
def test_an_item_that_never_ends_has_failed_and_the_others_are_done(tmp_path, caplog):
    finished = work_on(tmp_path, ["loop", "slow", "nothing"], workers=2)
    assert [record.id for record in finished.kept] == ["i1", "i2"]
    assert finished.tally.model_dump()["failed"] == {"timed_out": 1}
    failure = next(record for record in finished.records if isinstance(record, Failed))
    assert failure.message.startswith("i0: 3 attempts failed")
    assert "finished no step within its time limit" in failure.message
    assert caplog.text.count("cosfly tries the item again") >= 2
    assert not list((tmp_path / "s").glob(".*.partial"))


def test_work_without_progress_logs_a_heartbeat(monkeypatch, caplog):
    monkeypatch.setattr(console, "SECONDS_BETWEEN_LINES", 0.001)
    monkeypatch.setattr(console, "SECONDS_OF_SILENCE", 0.001)
    with caplog.at_level("INFO"), console.progress_bar("demo", 2) as advance:
        advance(1, "the second item")
        wait_until(lambda: caplog.text.count("demo: 1 of 2, the second item, no change for ") >= 2)


def test_workers_that_die_all_the_time_end_the_stage(tmp_path):
    kinds = ["nothing"] + ["die"] * 30
    with pytest.raises(
        EnvironmentMissing, match=r"worker processes died or stalled.*3 workers lost, 1 items done.*item_limit_s"
    ):
        work_on(tmp_path, kinds, workers=1, watch=Watch(restarts=1))
    assert [record.id for record in stage_in(tmp_path).items()] == ["i0"]
    # The machine is fit again.
    assert work_on(tmp_path, ["nothing"] * 31, workers=1).tally.kept == 31


PROGRAM = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from toy_workers import make_idle_worker, stage_in
from cosfly import cli
from cosfly.runtime.worker import Item
from cosfly.runtime.pool import run_items

if __name__ == "__main__":
    @cli.app.command()
    def work(folder: Path) -> None:
        run_items(stage_in(folder), [Item(str(k)) for k in range(4)], make_idle_worker, (folder,), workers=2)
    sys.argv = ["cosfly", "work", {folder!r}]
    cli.main()
"""


def start_program(folder: Path, until: Sequence[str] = ("0.pid", "1.pid"), **options) -> subprocess.Popen:
    program = folder / "program.py"
    program.write_text(PROGRAM.format(tests=str(Path(__file__).parent), folder=str(folder)))
    parent = subprocess.Popen([sys.executable, str(program)], **options)
    wait_until(lambda: all((folder / name).exists() and (folder / name).read_text() for name in until))
    return parent


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    parent = start_program(tmp_path)
    pids = [int((tmp_path / name).read_text()) for name in ("0.pid", "1.pid")]
    assert all(map(is_running, pids))
    parent.kill()
    parent.wait()
    wait_until(lambda: not any(map(is_running, pids)))
    assert not stage_in(tmp_path).is_complete  # and nobody holds the folder


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
@pytest.mark.parametrize(
    ("number", "word", "until"),
    [(signal.SIGINT, "interrupted", ("s/stage.json",)), (signal.SIGTERM, "terminated", ("0.pid", "1.pid"))],
    ids=["while workers start", "while they work"],
)
def test_a_signal_ends_a_command_and_its_workers_in_one_line(tmp_path, until, number, word):
    options: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    process = start_program(tmp_path, until, **options)
    wait_until(lambda: children_of(process.pid))
    os.killpg(process.pid, number)  # what a terminal and a service manager do
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert text.splitlines() == [f"error: {word}; finished work is kept; run the same command again to resume"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
@pytest.mark.parametrize("gap_s", [0.0, 0.002, 0.01])
def test_a_second_signal_that_breaks_off_the_ending_ends_the_workers_too(tmp_path, gap_s):
    process = start_program(tmp_path, ("0.pid", "1.pid"), stderr=subprocess.DEVNULL)
    pids = [int((tmp_path / name).read_text()) for name in ("0.pid", "1.pid")]
    process.send_signal(signal.SIGINT)
    time.sleep(gap_s)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) in (130, 143, -signal.SIGTERM)
    wait_until(lambda: not any(map(is_running, pids)))


CHILD = """
import asyncio, sys, time
from cosfly.llm.contract import run_until_interrupted

async def main():
    loop = asyncio.get_running_loop()
    loop.slow_callback_duration = 3600  # development mode reports slow steps, as a busy machine has them
    if "thread" in sys.argv:
        loop.run_in_executor(None, lambda: (print("asking", flush=True), time.sleep(2)))
        return
    print("asking", flush=True)
    try:
        await asyncio.gather(*(asyncio.sleep(3600) for _ in range(20)))
    finally:
        print("ending", flush=True)
        if "hang" in sys.argv:
            await asyncio.sleep(3600)

try:
    run_until_interrupted(main())
except KeyboardInterrupt:
    print("ended", flush=True)
    sys.exit(7)
"""
AT_ONCE = "error: interrupted at once; recorded answers are kept; run the same command again to continue\n"


@pytest.mark.parametrize(("words", "number", "status", "said", "complained"), [
    ((), signal.SIGINT, 7, ["asking", "ending", "ended"], ""),
    (("thread",), signal.SIGINT, 7, ["asking", "ended"], ""),
    ((), signal.SIGTERM, 128 + signal.SIGTERM, ["asking", "ending"], ""),
    (("hang",), signal.SIGINT, 130, ["asking", "ending"], AT_ONCE),
], ids=["once", "while threads are waited for", "terminated", "twice"])  # fmt: skip
def test_a_signal_ends_everything_in_order_and_a_second_one_at_once(words, number, status, said, complained):
    with subprocess.Popen(
        [sys.executable, "-X", "dev", "-c", CHILD, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        found = []
        for line in process.stdout:
            found.append(line.strip())
            if found[-1] == "asking" or (found[-1] == "ending" and "hang" in words):
                process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, found, errors) == (status, said, complained)


def make_package(root: Path) -> Path:
    package = root / "src" / "cosfly"
    package.mkdir(parents=True)
    shutil.copy(Path(cosfly.__file__).parent / "__init__.py", package)
    shutil.copytree(Path(cosfly.__file__).parent / "runtime", package / "runtime")
    return package


@pytest.mark.slow
def test_a_caller_sees_a_change_of_what_it_calls(tmp_path):
    package = make_package(tmp_path)
    (package / "upper.py").write_text(
        "from cosfly.runtime.compiled import njit\nfrom cosfly.lower import f\n\n\n"
        "@njit(cache=True)\ndef g(x):\n    return f(x)\n"
    )
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    env |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    env["PYTHONDONTWRITEBYTECODE"] = (
        "1"  # an edit within a second that keeps the size would leave the old bytecode in use
    )
    printed = []
    for factor in (2, 3, 2):
        (package / "lower.py").write_text(
            f"from cosfly.runtime.compiled import njit\n\n\n@njit(cache=True)\ndef f(x):\n    return {factor} * x\n"
        )
        code = "from cosfly.upper import g; print(g(7), sum(g.stats.cache_hits.values()))"
        printed.append(ran(sys.executable, "-c", code, env=env, cwd=tmp_path).stdout.split())
    assert printed == [["14", "0"], ["21", "0"], ["14", "1"]]  # what was compiled for the first sources is still there
    assert len(list((tmp_path / "cache" / "cosfly").iterdir())) == 2
