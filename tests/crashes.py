"""kill -9 at every point: a command is run in a process whose every step on the disk is counted, and the N-th one ends
it and all its workers.

A step is what changes a folder that is watched: a file opened for writing, written to (half of the bytes go out first),
cut or made safe, and a name made, changed, linked or removed. What a library writes without Python (parquet's rows,
tensors) is one step, its name.
"""

import builtins
import io
import json
import multiprocessing
import os
import random
import re
import select
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from cosfly.runtime import worker
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.events import EVENTS
from cosfly.runtime.run_dir import checked_inputs, recorded_digests
from release.verify.verify import verify

PACKAGES = tuple(f"/{name}/" for name in ("cosfly", "caption", "distill", "release"))
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
GONE_S = 30.0  # for workers to be gone after the process that was killed with them
NAMES = {"os.rename": 2, "os.link": 2, "os.remove": 1, "os.mkdir": 1, "os.rmdir": 1, "os.truncate": 1, "os.symlink": 2}


Kind = tuple[str, str, str]


@dataclass(frozen=True)
class Step:
    """One step of an undisturbed run: what is done, to which path below the watched folder, and where in our code."""

    event: str
    path: str
    place: str

    @property
    def kind(self) -> Kind:
        """Steps of one kind differ in the numbers of their names alone; in a folder that has not its name yet, in the
        files too."""
        path, partial, _ = self.path.partition(".partial/")
        return self.event, re.sub(r"[0-9a-f]{16,}|\d+", "#", path) + partial, self.place

    @property
    def is_of_a_temporary_file(self) -> bool:
        return self.path.endswith(".partial") and self.event not in ("os.mkdir", "os.rmdir")


# The n-th step of a kind, n from 1 on: how many others come between, as what workers tell of themselves, may differ.
Moment = tuple[Kind, int]


class _Watch:
    """Counts the steps of this process and of those that it forks, and ends them all at one of them."""

    def __init__(self, root: Path, die_at: Moment | None, trace: int) -> None:
        self.root, self.die_at, self.trace = f"{root}{os.sep}", die_at, trace
        self.count = multiprocessing.get_context("fork").Value("q", 0)

    def begin(self) -> None:
        sys.addaudithook(self._hear)
        really_open, fsync = builtins.open, os.fsync

        def watched_open(file: Any, mode: str = "r", *args: Any, **more: Any) -> Any:
            opened = really_open(file, mode, *args, **more)
            if not isinstance(file, int) and set(mode) & set("wax+") and self._is_watched(file):
                self._count_writes(opened, os.fspath(file))
            return opened

        def watched_fsync(file: Any) -> None:
            self._step("fsync", file if isinstance(file, int) else file.fileno())
            fsync(file)

        builtins.open = io.open = watched_open  # type: ignore[assignment]
        os.fsync = watched_fsync

    def _count_writes(self, opened: Any, path: Any) -> None:
        write = opened.write

        def watched_write(data: Any) -> Any:
            def half() -> None:
                write(data[: len(data) // 2])
                opened.flush()

            self._step("write", path, half)
            return write(data)

        opened.write = watched_write

    def _is_watched(self, path: Any) -> bool:
        return os.path.abspath(os.fsdecode(path)).startswith(self.root)

    def _hear(self, event: str, args: tuple) -> None:
        if event == "open":
            path, _, flags = args
            if not isinstance(path, int) and path is not None and flags & WRITES:
                self._step("open", path)
        elif event in NAMES:
            path, folder = args[NAMES[event] - 1], args[-1]
            is_relative = event in ("os.remove", "os.rmdir") and folder != -1
            self._step(event, os.path.join(os.readlink(f"/proc/self/fd/{folder}"), path) if is_relative else path)
        elif event == "subprocess.Popen":
            self._step(event, f"{self.root}process")

    def _step(self, event: str, path: Any, half: Callable[[], None] | None = None) -> None:
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}")
        if not self._is_watched(path):
            return
        step = Step(event, os.path.abspath(os.fsdecode(path)).removeprefix(self.root), _place())
        os.write(self.trace, f"{json.dumps([step.event, step.path, step.place])}\n".encode())
        if self.die_at is None or step.kind != self.die_at[0]:
            return
        with self.count.get_lock():
            self.count.value += 1
            is_now = self.count.value == self.die_at[1]
        if is_now:
            if half is not None:
                half()
            os.killpg(os.getpgrp(), signal.SIGKILL)
            time.sleep(60)  # of a thread that the signal has not reached


def _place() -> str:
    found, frame = list[str](), sys._getframe(2)
    while frame is not None and len(found) < 3:  # type: ignore[redundant-expr]
        name = frame.f_code.co_filename
        if any(package in name for package in PACKAGES) and "/site-packages/" not in name and "/tests/" not in name:
            found.append(f"{'/'.join(Path(name).parts[-2:])}:{frame.f_code.co_name}")
        frame = frame.f_back  # type: ignore[assignment]
    return " < ".join(found)


@dataclass
class Ended:
    code: int
    said: str
    steps: list[Step]


def run(work: Callable[[], object], root: Path, die_at: Moment | None = None) -> Ended:
    """Run something in a child of its own that forks its workers; die_at None: undisturbed."""
    resource_tracker.ensure_running()
    said, trace = root.with_name(f"{root.name}.said"), root.with_name(f"{root.name}.steps")
    gone, held = os.pipe()  # by the child and the workers that it forks, which have its lock too
    with open(said, "wb") as voice, open(trace, "wb") as steps:
        child = os.fork()
        if not child:
            _be_child(work, _Watch(root, die_at, steps.fileno()), voice.fileno())
        os.close(held)
        _, status = os.waitpid(child, 0)
    select.select([gone], [], [], GONE_S)
    os.close(gone)
    taken = [Step(*json.loads(line)) for line in trace.read_text().splitlines()]
    return Ended(os.waitstatus_to_exitcode(status), said.read_text(errors="replace"), taken)


def _be_child(work: Callable[[], object], watch: _Watch, voice: int) -> None:
    code = 1
    try:
        os.setsid()
        os.dup2(voice, 1)
        os.dup2(voice, 2)
        sys.stdout = sys.stderr = os.fdopen(voice, "w", buffering=1, closefd=False)
        # Workers that inherit the watch, and all that is imported.
        forking = SimpleNamespace(get_context=lambda _: multiprocessing.get_context("fork"))
        worker.multiprocessing = forking  # type: ignore[assignment]
        watch.begin()
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


TIMES = re.compile(
    rb'"(seconds\w*|planning_ms\w*|times_ms|(mean|p50|p95|max)_ms|latency_s|time|at|speed)": ?'
    rb'(\{[^}]*\}|"[^"]*"|[\d.]+)'
)


def contents(root: Path) -> dict[str, bytes]:
    """Give what stands below a folder, without what is documented to differ: times, what happened to workers, broken
    lines."""
    paths = [path for path in sorted(root.rglob("*")) if path.name != EVENTS]
    found = {path.relative_to(root).as_posix(): path for path in paths if path.stem != "reproduction"}  # tells times
    return {name: b"a folder" if path.is_dir() else _plain(path) for name, path in found.items()}


def _plain(path: Path) -> bytes:
    """Give a file without times; of a journal each line once, in order, without its checksum."""
    data = path.read_bytes()
    if path.suffix == ".jsonl":
        lines = {TIMES.sub(b"", re.sub(rb"^[0-9a-f]{16} ", b"", line)) for line in data.splitlines()}
        return b"\n".join(sorted(lines))
    if path.name == "manifest.json":  # with the digests of files that hold times
        data = re.sub(rb'\{\s*"path": "[^"]*\.jsonl"[^}]*\}', b"", data)
    return TIMES.sub(b"", data) if path.suffix == ".json" else data


def differences(found: dict[str, bytes], expected: dict[str, bytes]) -> list[str]:
    """Name the files that differ, that are missing and that are too much."""
    nothing = b"no file"
    return [
        f"{name}: {found.get(name, nothing)[:200]!r}, not {expected.get(name, nothing)[:200]!r}"
        for name in sorted(found.keys() | expected.keys())
        if found.get(name) != expected.get(name)
    ]


def called_complete(root: Path, wholes: list[Path]) -> list[str]:
    """Name the products that the next stage, or `release verify`, would take though they are what no finished run made.

    Args:
        wholes: what undisturbed runs made, that of the last command first.
    """
    wrong = []
    for manifest in wholes[0].rglob("manifest.json"):
        folder = manifest.parent.relative_to(wholes[0])
        for product in recorded_digests(manifest.parent):
            path, others = root / folder / product, [whole / folder / product for whole in wholes]
            known = [_plain(other) for other in others if other.exists()]
            if path.exists() and _is_taken(path) and _plain(path) not in known:
                wrong.append(f"{folder / product} is taken by the next stage")
    for record in wholes[0].rglob("release.json"):
        path = root / record.parent.relative_to(wholes[0])
        known = [contents(whole / path.relative_to(root)) for whole in wholes]
        if path.is_dir() and verify(path, level="structure").is_ok and contents(path) not in known:
            wrong.append(f"{path.relative_to(root)} verifies")
    return wrong


def _is_taken(path: Path) -> bool:
    try:
        checked_inputs({"product": path})
    except CosflyError:
        return False
    return True


@dataclass
class Swept:
    num_steps: int
    num_killed: int
    wrong: list[str]


def sweep(
    works: list[Callable[[], object]], root: Path, *, few: bool = False, twice: bool = False, only: str = ".*"
) -> Swept:
    """Kill a command at its steps, run it again after each, and compare what it made with what an undisturbed run
    makes.

    Args:
        works: commands that write into the folder `out` of `root`; the last is killed, where those before it have done
            their work.
        few: at some of the steps, see `moments`. twice: also the run that goes on is killed, at some step.
        only: a pattern of the paths at whose steps it is killed.
    """
    out, whole, begun, rng = root / "out", root / "whole", root / "begun", random.Random(0)
    for folder in (out, whole, begun):
        shutil.rmtree(folder, ignore_errors=True)
    out.mkdir()
    for work in works[:-1]:
        _run_through(work, out)
    shutil.copytree(out, begun)
    steps = _run_through(works[-1], out).steps
    out.rename(whole)
    expected, swept = contents(whole), Swept(len(steps), 0, [])
    for moment in moments(steps, few=few):
        (event, path, place), number = moment
        if not re.fullmatch(only, path):
            continue
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(begun, out)
        killed = run(works[-1], out, moment)
        swept.num_killed += killed.code == -signal.SIGKILL
        found = called_complete(out, [whole, begun])
        if twice:
            swept.num_killed += run(works[-1], out, rng.choice(moments(steps))).code == -signal.SIGKILL
        again = run(works[-1], out)
        failed = [f"exit {again.code}: {again.said[-800:]}"] if again.code else []
        found += failed or differences(contents(out), expected)
        swept.wrong += [f"killed at {event} {path} ({place}), time {number}: {words}" for words in found]
    return swept


def _run_through(work: Callable[[], object], out: Path) -> Ended:
    ended = run(work, out)
    assert ended.code == 0, ended.said
    return ended


def moments(steps: list[Step], *, few: bool = False) -> list[Moment]:
    """Give the moments of the kills.

    Args:
        few: of each kind the first and the last, and of a file that is written under another name only that it gets its
            own.
    """
    counts, found = Counter[Kind](), []
    for step in steps:
        counts[step.kind] += 1
        found.append((step, counts[step.kind]))
    return [
        (step.kind, number)
        for step, number in found
        if not few or (number in (1, counts[step.kind]) and not step.is_of_a_temporary_file)
    ]
