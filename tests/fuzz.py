"""Gives mutated files to every reader, and says which ended in anything but success or one clear line: `make fuzz`.

A child process does the reading: what takes more than CPU_S seconds of its time is ended by the system, what takes
MEMORY_MB more than before is found by the peak that the kernel keeps. An input is made from (reader, seed, number)
alone, so each can be made again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fuzzing import HUGE, Instead, clear, mutated, put

from cosfly.errors import CosflyError

CPU_S = 5.0
MEMORY_MB = 1_000
SILENT_S = 30.0  # of the clock, asleep without any CPU time: blocked. A child that waits for its turn is not asleep
LONGEST_LINE = 5_000  # characters of a message
BREAKING = ("Cc", "Zl", "Zp", "Cs")  # Unicode's controls, line breaks, half pairs
# What changes the direction of writing.
TURNING = "\u200e\u200f\u061c\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
MOST_TRIALS = 150  # to make an input smaller
SHOWN_BYTES = 300
SHOW_EVERY_S = 10.0


class Reader(NamedTuple):
    """files: what is changed, one at a time. call: reads it, with a scratch folder for what it writes. share: of the
    inputs.

    hashes: it reads every byte of a file, however large, for its digest: its files are not made huge.
    """

    files: tuple[str, ...]
    call: Callable[[Path, Path], object]
    share: float = 1.0
    hashes: bool = False


@dataclass(frozen=True)
class Finding:
    """An input that ended in something else. place: what makes two findings one. smallest: of the changed file."""

    reader: str
    number: int
    file: str
    place: str
    smallest: str

    def __str__(self) -> str:
        return f"{self.reader}, input {self.number}, {self.file}: {self.place}\n    {self.smallest}"


@dataclass
class Summary:
    """inputs: by reader. found: the first of each place. counts: by (reader, place)."""

    inputs: Counter[str] = field(default_factory=Counter)
    found: list[Finding] = field(default_factory=list)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, finding: Finding) -> None:
        self.counts[finding.reader, finding.place] += 1
        if self.counts[finding.reader, finding.place] == 1:
            self.found.append(finding)

    def __str__(self) -> str:
        failed = Counter[str]()
        for (reader, _), count in self.counts.items():
            failed[reader] += count
        rows = [f"{reader:24} {count:7} inputs {failed[reader]:6} failed" for reader, count in self.inputs.items()]
        times = [f"{self.counts[f.reader, f.place]} times: {f}" for f in self.found]
        return "\n".join([*rows, f"{'all':24} {self.inputs.total():7} inputs {failed.total():6} failed", *times])


# --- the child --------------------------------------------------------------------------------------------------------


def outcome_of(call: Callable[[], object]) -> str | None:
    """Say what an input ended in; None for success or an error that is one clear line."""
    try:
        call()
    except CosflyError as error:
        line = str(error)
        if len(line) > LONGEST_LINE or any(
            unicodedata.category(letter) in BREAKING or letter in TURNING for letter in line
        ):
            return f"{type(error).__name__} that is no line: {line[:80]!r}, {len(line)} characters"
        return None
    except MemoryError:
        return "memory"
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "site-packages" not in frame.filename and "/tests/" not in frame.filename]
        last = (ours or frames)[-1]
        return f"{type(error).__name__} in {last.name} of {Path(last.filename).name}"
    return None


class Input:
    """One changed file of a reader's specimens, in place while the context is open."""

    def __init__(self, root: Path, name: str, reader: Reader, seed: int, number: int) -> None:
        rng = random.Random(f"{name}/{seed}/{number}")
        self.file = rng.choice(reader.files)
        self.path = root / self.file
        self.honest = self.path.read_bytes()
        self.content: bytes | Instead = mutated(self.file, self.honest, rng)
        if reader.hashes and self.content == HUGE:
            self.content = "nothing"

    @contextlib.contextmanager
    def in_place(self, content: bytes | Instead | None = None) -> Iterator[None]:
        put(self.path, self.content if content is None else content)
        try:
            yield
        finally:
            clear(self.path)
            self.path.write_bytes(self.honest)


def _peak_mb() -> float:
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1000 for line in status if line.startswith("VmHWM"))


def _reset_peak() -> float:
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    return _peak_mb()


def read_all(
    root: Path, readers: Mapping[str, Reader], state: Path, todo: Mapping[str, Sequence[int]], seed: int, cpu_s: float
) -> None:
    """Read the inputs of these numbers; a line of `state` before each, a line for each finding."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * os.sysconf("SC_PAGE_SIZE") + 4 * MEMORY_MB * 1_000_000  # a margin: what is mapped need not be used
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    known: set[str] = set()
    with open(state, "a", encoding="utf-8", buffering=1) as out:
        for reader, numbers in todo.items():
            out.write(json.dumps({"warm": reader}) + "\n")
            _warm_up(root, readers[reader])
            for number in numbers:
                out.write(json.dumps([reader, number]) + "\n")
                _read_one(root, readers, reader, (seed, number), cpu_s, known, out)
        out.write('"end"\n')


def _warm_up(root: Path, reader: Reader) -> None:
    """Read the honest specimens: what is compiled or imported once is no input's time and memory."""
    scratch = root.with_name("scratch")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    reader.call(root, scratch)


def _read_one(
    root: Path, readers: Mapping[str, Reader], reader: str, which: tuple[int, int], cpu_s: float, known: set[str], out
) -> None:
    scratch = root.with_name("scratch")

    def ends(content: bytes | Instead | None = None) -> str | None:
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        before_mb = _reset_peak()
        signal.setitimer(signal.ITIMER_PROF, cpu_s)
        with item.in_place(content):
            place = outcome_of(lambda: readers[reader].call(root, scratch))
        signal.setitimer(signal.ITIMER_PROF, 0)
        return "memory" if _peak_mb() - before_mb > MEMORY_MB else place

    item = Input(root, reader, readers[reader], *which)
    out.write(json.dumps({"file": item.file}) + "\n")
    place = ends()
    if place is None:
        return
    content = item.content
    if isinstance(content, bytes) and place not in known and place != "memory":
        content = _smaller(content, lambda smaller: ends(smaller) == place)
    known.add(place)
    out.write(json.dumps(vars(Finding(reader, which[1], item.file, place, _shown(content)))) + "\n")


def _smaller(data: bytes, fails: Callable[[bytes], bool]) -> bytes:
    """Leave out pieces, halves first, while it still fails."""
    size, trials = len(data) // 2, 0
    while size and trials < MOST_TRIALS:
        at = 0
        while at < len(data) and trials < MOST_TRIALS:
            trials += 1
            less = data[:at] + data[at + size :]
            if fails(less):
                data = less
            else:
                at += size
        size //= 2
    return data


def _shown(content: bytes | Instead) -> str:
    if isinstance(content, str):
        return content
    return repr(content[:SHOWN_BYTES]) + (f"... of {len(content):,} bytes" if len(content) > SHOWN_BYTES else "")


# --- the parent -------------------------------------------------------------------------------------------------------


def run(
    module: str, root: Path, numbers: Mapping[str, Sequence[int]], *, seed: int = 0, cpu_s: float = CPU_S,
    silent_s: float = SILENT_S, tick: Callable[[object], None] = lambda line: None,
) -> Summary:  # fmt: skip
    """Give inputs to readers in child processes, and begin a new one where one was ended.

    Args:
        module: of tests/, with the table READERS. root: specimens; they are the same afterwards, and beside them stands
            `scratch`.
        numbers: reader -> which inputs.
    """
    summary, todo = Summary(), {reader: list(wanted) for reader, wanted in numbers.items()}
    with tempfile.TemporaryDirectory() as folder:
        state = Path(folder) / "state"
        while any(todo.values()):
            state.write_bytes(b"")
            reason = _child(module, root, state, {k: v for k, v in todo.items() if v}, seed, cpu_s, silent_s, tick)
            lines = [json.loads(line) for line in state.read_text(encoding="utf-8").splitlines()]
            _take(lines, reason, summary, todo)
            _restore(root)
    return summary


def _child(
    module: str,
    root: Path,
    state: Path,
    todo: dict,
    seed: int,
    cpu_s: float,
    silent_s: float,
    tick: Callable[[object], None],
) -> str:
    """Start a child, and wait for its end; says what ended it."""
    start = {"module": module, "root": str(root), "state": str(state), "todo": todo, "seed": seed, "cpu_s": cpu_s}
    with open(state.with_name("errors"), "wb+") as errors:
        process = subprocess.Popen(
            [sys.executable, __file__, "--child"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors
        )
        process.stdin.write(json.dumps(start).encode())
        process.stdin.close()
        try:
            if not _followed(process, state, silent_s, tick):
                return "blocked"
        finally:
            process.kill()
            process.wait()
        errors.seek(0)
        said = errors.read()[-2000:].decode(errors="replace")
    if process.returncode == -signal.SIGPROF:
        return f"more than {cpu_s:g} s of CPU time"
    return f"ended with {process.returncode}: {said}"


def _followed(process: subprocess.Popen, state: Path, silent_s: float, tick: Callable[[object], None]) -> bool:
    """Wait for the end of a child; False where it does nothing more."""
    since_s, before = time.monotonic(), 0
    with open(state, encoding="utf-8") as lines:
        while process.poll() is None:
            for line in lines:
                tick(json.loads(line))
            is_asleep, ticks = _activity(process.pid)
            if not is_asleep or ticks != before:
                since_s, before = time.monotonic(), ticks
            if time.monotonic() - since_s > silent_s:
                return False
            time.sleep(0.02)
    return True


def _activity(pid: int) -> tuple[bool, int]:
    """Tell whether a child sleeps, and how many ticks of CPU time it has taken."""
    fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    return fields[0] == b"S", int(fields[11]) + int(fields[12])


def _take(lines: list, reason: str, summary: Summary, todo: dict[str, list[int]]) -> None:
    """Note what a child did; where it was ended within an input, that is a finding."""
    reader, number, file = "", None, ""
    for line in lines:
        if isinstance(line, list):
            reader, number = line
            summary.inputs[reader] += 1
            todo[reader].remove(number)
        elif "warm" in line:
            reader, number, file = line["warm"], None, "the honest specimens"
        elif "place" in line:
            summary.add(Finding(**line))
        elif "file" in line:
            file = line["file"]
    if lines[-1:] == ["end"]:
        return
    if number is None:  # its specimens cannot be read: none of its inputs would say anything
        todo[reader] = []
    summary.add(Finding(reader, -1 if number is None else number, file, reason, "see --only and --first"))


def _restore(root: Path) -> None:
    """Put the honest specimens back after a child that was ended: a copy stands beside them."""
    copy = root.with_name("honest")
    if copy.is_dir():
        shutil.rmtree(root)
        shutil.copytree(copy, root)


class _Progress:
    """Prints a line every few seconds."""

    def __init__(self, numbers: Mapping[str, Sequence[int]]) -> None:
        self.num_all, self.num, self.at_s = sum(map(len, numbers.values())), 0, 0.0
        self.told: set[tuple[str, str]] = set()

    def __call__(self, line: object) -> None:
        if isinstance(line, dict) and "place" in line and (line["reader"], line["place"]) not in self.told:
            self.told.add((line["reader"], line["place"]))
            print(f"  {Finding(**line)}", flush=True)
        elif isinstance(line, list):
            self.num += 1
            if time.monotonic() - self.at_s > SHOW_EVERY_S:
                self.at_s = time.monotonic()
                print(f"{self.num:,} of {self.num_all:,} inputs: {line[0]}", flush=True)


def main() -> None:
    if sys.argv[1:] == ["--child"]:
        start = json.load(sys.stdin)
        logging.disable(logging.CRITICAL)
        readers = __import__(start["module"]).READERS
        read_all(Path(start["root"]), readers, Path(start["state"]), start["todo"], start["seed"], start["cpu_s"])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="of all readers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each reader")
    parser.add_argument("--only", action="append", help="a reader; may be repeated")
    asked = parser.parse_args()
    from fuzz_readers import READERS, make_specimens

    names = asked.only or list(READERS)
    each = max(1, round(asked.inputs / sum(READERS[name].share for name in names)))
    numbers = {name: range(asked.first, asked.first + max(1, round(each * READERS[name].share))) for name in names}
    with tempfile.TemporaryDirectory() as folder:
        logging.disable(logging.CRITICAL)
        root = make_specimens(Path(folder) / "specimens")
        shutil.copytree(root, root.with_name("honest"))
        summary = run("fuzz_readers", root, numbers, seed=asked.seed, tick=_Progress(numbers))
    print(summary)
    sys.exit(1 if summary.found else 0)


if __name__ == "__main__":
    main()
