"""Workers that die, stall or never end, and what the stage makes of it."""

import contextlib
import logging
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pynvml
import pytest
from processes import is_running, wait_until
from toy_workers import make_broken_worker, make_counting_worker, make_talking_worker, make_worker, stage_in

from cosfly.errors import EnvironmentMissing
from cosfly.work import stage_events
from cosfly.work.journal import Journal
from cosfly.work.runner import Item, Watch, run_items
from cosfly.work.stage_events import (
    EVENTS,
    LOSSES,
    PROBES_OF_ONE_PACE,
    EventLog,
    HowFar,
    gpu_use,
    progress_of,
    read_events,
)
from cosfly.work.stage_folder import Failed
from cosfly.work.worker import signals_held_back
from cosfly.work.worker_pool import limit_s

# Stands still after 2 s, and a while before its item has taken too long, or chance would say which of them it was.
QUICK = Watch(item_limit_s=3.2, heartbeat_s=0.1, check_s=0.4, probe_s=0.3, failed_checks=5)


def items_of(*kinds: str) -> list[Item]:
    return [Item(f"i{k}", (kind, bytes(1_000_000))) for k, kind in enumerate(kinds)]  # more than a pipe holds


def work_on(path: Path, kinds: list[str], workers: int, watch: Watch = QUICK):
    return run_items(stage_in(path), items_of(*kinds), make_worker, (path / "s",), workers=workers, watch=watch)


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
    assert "did not get on within its time limit, 3 times" in failure.message
    assert caplog.text.count("it is tried again") >= 2
    assert not list((tmp_path / "s").glob(".*.partial"))


def test_the_limit_of_an_item():
    nothing_set, set_s = Watch(), Watch(item_limit_s=7.0)
    assert limit_s(nothing_set, [], 0, True) == 600
    assert limit_s(nothing_set, [1.0, 50.0, 90.0], 0, True) == 1000
    assert limit_s(nothing_set, [1.0], 2, True) == 2400, "with each attempt twice as long"
    assert limit_s(set_s, [50.0], 2, True) == 7
    assert limit_s(set_s, [], 0, False) == 600, "a worker that still starts"
    assert limit_s(Watch(item_limit_s=0), [1.0], 0, True) == float("inf")


def test_workers_that_die_all_the_time_end_the_stage(tmp_path):
    kinds = ["nothing"] + ["die"] * 30
    with pytest.raises(EnvironmentMissing, match=r"die or stall all the time.*3 lost, 1 items done.*item_limit_s"):
        work_on(tmp_path, kinds, workers=1, watch=Watch(restarts=1))
    assert [record.id for record in stage_in(tmp_path).items()] == ["i0"]
    # The machine is fit again.
    assert work_on(tmp_path, ["nothing"] * 31, workers=1).tally.kept == 31


def test_a_bug_in_making_a_worker_is_told_in_its_words(tmp_path):
    with pytest.raises(RuntimeError, match=r"a bug in a worker: Local: the GPU is on fire") as caught:
        run_items(stage_in(tmp_path), [Item("a")], make_broken_worker, workers=1)
    assert "in make_broken_worker" in caught.value.__notes__[0]


# --- what the parent's end leaves behind ------------------------------------------------------------------------------

PROGRAM = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from toy_workers import make_idle_worker, stage_in
from cosfly import cli
from cosfly.work.runner import Item, run_items

if __name__ == "__main__":
    @cli.app.command()
    def work(folder: Path) -> None:
        run_items(stage_in(folder), [Item(str(k)) for k in range(4)], make_idle_worker, (folder,), workers=2)
    sys.argv = ["cosfly", "work", {folder!r}]
    cli.main()
"""


def start_program(folder: Path, until: Sequence[str] = ("0.pid", "1.pid"), **options) -> subprocess.Popen:
    """Start a command whose two workers hang, and wait until these files are there: else until they do."""
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
    time.sleep(0.2)
    os.killpg(process.pid, number)  # what a terminal and a service manager do
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert text.splitlines() == [f"error: {word}; finished work is kept: run the same command again to continue"]


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


def test_a_signal_that_another_thread_takes_waits_until_a_process_has_started():
    done, steps = threading.Event(), []

    def start() -> None:
        with signals_held_back():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
            steps.append("started")

    other = threading.Thread(target=done.wait)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            start()
    finally:
        done.set()
        other.join()
    assert steps == ["started"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# --- telling how far it is --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize(("sizes", "expected"), [((5, 7, 9), 21), ((5, None, 9), 3)], ids=["frames", "items"])
def test_progress_is_told_in_steps_where_all_items_know_theirs(tmp_path, monkeypatch, workers, sizes, expected):
    bars = []

    @contextlib.contextmanager
    def bar(label, total, done):
        moves: list[int] = []
        bars.append((total, done, moves))
        yield moves.append

    monkeypatch.setattr("cosfly.work.runner.progress_bar", bar)
    payload = "once-die" if workers and expected == 21 else None
    items = [Item(f"i{k}", payload if k == 1 else None, size) for k, size in enumerate(sizes)]
    run_items(stage_in(tmp_path), items[:1], make_counting_worker, (tmp_path,))
    run_items(stage_in(tmp_path), items, make_counting_worker, (tmp_path,), workers=workers, watch=QUICK)
    _, (total, done, moves) = bars
    assert total == expected
    assert done == (5 if expected == 21 else 1)
    assert done + sum(moves) == total
    if workers and expected == 21:
        assert -7 in moves, "begun again"


# --- events -----------------------------------------------------------------------------------------------------------


def test_events_tell_what_happened_and_a_damaged_line_is_no_harm(tmp_path):
    # Probed all the time: at longer intervals all may be over before a worker that has loaded anything is looked at.
    work_on(tmp_path, ["nothing", "once-die"], workers=1, watch=Watch(probe_s=0.01))
    path = tmp_path / "s" / EVENTS
    kinds = [event.event for event in read_events(tmp_path / "s") if event.event != "probe"]
    assert kinds == [
        "began", "worker_started", "item_done", "worker_died", "retried", "restarted", "item_done", "ended",
    ]  # fmt: skip
    events = read_events(tmp_path / "s")
    probes = [event for event in events if event.event == "probe"]
    assert probes
    assert all(event.disk_free_mib > 0 for event in probes)
    assert any(rss > 10 for event in probes for rss in event.rss_mib.values())
    assert [(event.done, event.total, event.unit) for event in probes[:1]] == [(0, 2, "items")]
    with Journal(path) as journal:
        journal.append({"at_s": 1.0, "event": "of a later cosfly"})
    path.write_bytes(path.read_bytes() + b"cut sho")
    assert read_events(tmp_path / "s") == events


def test_probes_tell_how_far_the_stage_is_and_their_pace_how_long_it_will_take(tmp_path):
    at = [0]

    def how_far() -> HowFar:
        return HowFar(at[0], 428, "steps")

    for first, last in ((0, 400), (100, 120)):  # the second time the stage goes on: its pace is its own
        log = EventLog(tmp_path, how_far)
        log.tell("began", workers=1)
        assert progress_of(read_events(tmp_path)) is None  # what a run before told counts no more
        at[0] = first
        log.probe({})
        assert progress_of(read_events(tmp_path)) == (how_far(), None)
        at[0] = last
        time.sleep(0.2)
        log.probe({})
        log.close()
    events = read_events(tmp_path)
    far, left_s = progress_of(events)
    assert far == (120, 428, "steps")
    assert left_s == pytest.approx((events[-1].at_s - events[-2].at_s) / 20 * 308)
    assert progress_of([]) is None


def test_what_the_driver_says_of_processes_is_told_by_worker(monkeypatch):
    """A driver with two devices, one of which does not tell of processes; the names and the structures are NVIDIA's."""
    devices = {0: (40, 3), 1: (20, 1)}  # load in per cent, GiB in use
    answers: dict[str, Callable] = {
        "nvmlInit": lambda: None,
        "nvmlDeviceGetCount": lambda: len(devices),
        "nvmlDeviceGetHandleByIndex": lambda index: index,
        "nvmlDeviceGetUtilizationRates": lambda device: SimpleNamespace(gpu=devices[device][0]),
        "nvmlDeviceGetMemoryInfo": lambda device: SimpleNamespace(used=devices[device][1] << 30),
    }
    both = [SimpleNamespace(pid=71, usedGpuMemory=700 << 20), SimpleNamespace(pid=99, usedGpuMemory=1 << 30)]

    def of_processes(found):
        def answer(device, *since_us):
            if device:
                raise pynvml.NVMLError(pynvml.NVML_ERROR_NO_PERMISSION)
            return found

        return answer

    answers["nvmlDeviceGetGraphicsRunningProcesses"] = of_processes(
        [*both, SimpleNamespace(pid=72, usedGpuMemory=None)]
    )
    answers["nvmlDeviceGetComputeRunningProcesses"] = of_processes(both)
    sample = pynvml.c_nvmlProcessUtilizationSample_t
    samples = [sample(pid=71, timeStamp=2, smUtil=30), sample(pid=71, timeStamp=1, smUtil=90), sample(pid=99, smUtil=5)]
    answers["nvmlDeviceGetProcessUtilization"] = of_processes(samples)
    for name, answer in answers.items():
        monkeypatch.setattr(pynvml, name, answer)
    stage_events._nvml.cache_clear()
    try:
        of_devices = {"gpu_percent": 30.0, "gpu_mib": 4096.0}
        by_worker = {"worker_gpu_percent": {0: 30.0}, "worker_gpu_mib": {0: 700.0}}
        assert gpu_use({0: 71, 1: 72}) == of_devices | by_worker
        assert gpu_use({0: 5}) == of_devices | {"worker_gpu_percent": {}, "worker_gpu_mib": {}}  # ids of a container
    finally:
        stage_events._nvml.cache_clear()


def test_without_a_driver_there_are_no_figures_of_a_gpu(monkeypatch):
    def absent(name: str):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(pynvml, "nvmlLib", None)
    monkeypatch.setattr(pynvml, "CDLL", absent)
    stage_events._nvml.cache_clear()
    try:
        assert gpu_use({0: os.getpid()}) == {}
    finally:
        stage_events._nvml.cache_clear()


def test_a_week_of_probes_stays_small(tmp_path):
    log = EventLog(tmp_path)
    for _ in range(20 * PROBES_OF_ONE_PACE):
        log.probe({})
    log.close()
    assert len(read_events(tmp_path)) < 5 * PROBES_OF_ONE_PACE


def test_a_workers_log_lines_reach_the_stages_log(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    run_items(stage_in(tmp_path), [Item("a")], make_talking_worker, workers=1)
    assert "a speaks of 7" in caplog.text
    assert "not this" not in caplog.text


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries are not told")
def test_freed_memory_is_not_asked_for_again():
    """A process of its own: what is set stays set."""
    code = """if 1:
        import resource, numpy as np
        from cosfly.work.worker import keep_freed_memory
        def num_pages():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            for _ in range(20):
                arrays = [np.ones(3 << 20, np.uint8) for _ in range(4)]
                del arrays
            return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
        without = num_pages()
        keep_freed_memory()
        num_pages()
        print(without, num_pages())
    """
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    without, kept = map(int, found.stdout.split())
    assert kept < 3000 < without  # 12 MB are 3,072 pages
