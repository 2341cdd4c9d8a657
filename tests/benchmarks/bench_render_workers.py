"""Frames/s to disk by the number of workers, and what bounds them: made for a machine with a GPU and many cores.

    python tests/benchmarks/bench_render_workers.py --inputs work/render --make          # once, anywhere: maps and
    flights python tests/benchmarks/bench_render_workers.py --inputs work/render --workers 1 4 8 16 python
    tests/benchmarks/bench_render_workers.py --inputs work/render --maps town --workers 16 --pinned --seconds 10

1280x720, colours, depth, instances, annotation and digests of every frame, by the code that the stage runs. The workers
are started once; then, for each number, so many draw flights for `--seconds`, and what they finished within that time
counts. Milliseconds are those of one worker; drawing, reading back and looking come one after the other, encoding and
writing run beside them in two threads. The 60 seconds that it takes on 16 cores are half start and half measurement.
Files go to `--out`, and each flight is deleted when it is finished.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import scenes
from bench_render import FILES, make_inputs

from cosfly.products import frames
from cosfly.products.boxes import read_boxes
from cosfly.products.traces import read_traces
from cosfly.render import flight as flights
from cosfly.render.flight import Writing, render_flight
from cosfly.render.gl import backend
from cosfly.render.perturbation import Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, script_flight
from cosfly.work.worker import keep_freed_memory

NUM_FLIGHTS = 4
LEAD_S = 0.5  # between the word and the first frame that counts: the first flight's shadows
IN_TURN = ("submit", "wait for GL", "read back", "soften, split", "look", "wait for files")
BESIDE = ("PNG of colours", "PNG of ids", "depth", "hash", "annotation, write")


class Over(Exception):
    """The time is up: leaves a flight in the middle."""


@dataclass
class Spans:
    """What took how long, in the threads of one worker: (name, end, seconds on the clock, processor seconds of that
    thread)."""

    found: list[tuple[str, float, float, float]] = field(default_factory=list)

    def of(self, name: str, function: Callable) -> Callable:
        def timed(*args: Any, **named: Any) -> Any:
            clock_s, used_s = time.monotonic(), time.thread_time()
            try:
                return function(*args, **named)
            finally:
                end_s = time.monotonic()
                # One step: no thread comes between.
                self.found.append((name, end_s, end_s - clock_s, time.thread_time() - used_s))

        return timed

    def within(self, begin_s: float, end_s: float) -> dict[str, list[float]]:
        """Seconds on the clock and processor seconds of what ended within a time, and how often."""
        sums: dict[str, list[float]] = {}
        for name, at_s, clock_s, used_s in self.found:
            if begin_s <= at_s < end_s:
                row = sums.setdefault(name, [0.0, 0.0, 0])
                row[0], row[1], row[2] = row[0] + clock_s, row[1] + used_s, row[2] + 1
        return sums


def instrumented(renderer: Any, spans: Spans) -> None:
    """Time the parts of a worker. Drawing is awaited before it is read back, which would wait for it anyway."""
    read, finish = renderer._read, spans.of("wait for GL", renderer.context.finish)

    def read_when_drawn() -> Any:
        finish()
        return spans.of("read", read)()

    renderer._read = read_when_drawn
    renderer.render = spans.of("render", renderer.render)
    backend.smoothed = spans.of("smooth", backend.smoothed)
    flights.draw_frame = spans.of("draw_frame", flights.draw_frame)
    flights._write_frame = spans.of("write_frame", flights._write_frame)
    frames.rgb_bytes = spans.of("PNG of colours", frames.rgb_bytes)
    frames.instance_bytes = spans.of("PNG of ids", frames.instance_bytes)
    frames.depth_file = spans.of("depth", frames.depth_file)
    flights.sha256_bytes = spans.of("hash", flights.sha256_bytes)


def parts_of(sums: dict[str, list[float]], column: int) -> dict[str, float]:
    """Seconds by part, where parts do not overlap."""
    s = {name: row[column] for name, row in sums.items()}

    def of(name: str) -> float:
        return s.get(name, 0.0)

    found = {
        "submit": of("render") - of("wait for GL") - of("read"),
        "wait for GL": of("wait for GL"),
        "read back": of("read") - of("smooth"),
        "soften, split": of("smooth"),
        "look": of("draw_frame") - of("render"),
        **{name: of(name) for name in BESIDE[:-1]},
    }
    return found | {BESIDE[-1]: of("write_frame") - sum(of(name) for name in BESIDE[:-1])}


# --- a worker ---------------------------------------------------------------------------------------------------------


def worker(talk: Connection, folder: Path, out: Path, number: int, num_workers: int, cores: set[int] | None) -> None:
    """Open a renderer, then draw whenever told to."""
    if cores is not None:
        os.sched_setaffinity(0, cores)
    if num_workers > 1:
        os.environ["LP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // num_workers))  # as the stage does
    cv2.setNumThreads(1)
    keep_freed_memory()
    cfg = RenderConfig(fovs_deg=(90.0,), first_timestamp=1776000000)
    box_map, traces = read_boxes(folder / FILES[0]), read_traces(folder / FILES[1])
    renderer: Any = open_renderer("gl", box_map, cfg.width_px, cfg.height_px)
    spans, surroundings = Spans(), Surroundings(box_map)
    instrumented(renderer, spans)
    writing = Writing(tuple(cfg.modalities), cfg.visible_threshold)
    until_s = [float("inf")]

    def draw(first: int) -> None:
        for turn in range(first, first + 1000):
            k = turn % len(traces)
            script = script_flight(traces[k], k, "clean", "Town", surroundings, cfg, 0)
            with tempfile.TemporaryDirectory(dir=out) as scratch:
                render_flight(renderer, script, Path(scratch), writing)

    def sign_of_life() -> None:
        if time.monotonic() > until_s[0]:
            raise Over

    flights.advance = sign_of_life  # what the stage's watch is told once a frame
    until_s[0] = time.monotonic() + 0.5  # compiles shaders, and whatever else the first frames do
    with suppress(Over):
        draw(number)
    talk.send(renderer.device)
    while (span := talk.recv()) is not None:
        spans.found.clear()
        begin_s, until_s[0] = span
        time.sleep(max(0.0, begin_s - LEAD_S - time.monotonic()))
        clock_s, used_s = time.monotonic(), time.process_time()
        with suppress(Over):
            draw(number)
        talk.send((spans.within(*span), (time.process_time() - used_s) / (time.monotonic() - clock_s)))


# --- all of them ------------------------------------------------------------------------------------------------------


def gpu_busy() -> str:
    """What the GPU's own tool says of the last moments; nothing where there is none."""
    if shutil.which("nvidia-smi") is None:
        return "-"
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.split("\n")[0] or "-"


def measured(talks: list[Connection], seconds: float) -> tuple[list[Any], dict[str, float], dict[str, float]]:
    """Let these workers draw. Gives a row of the first table; milliseconds a frame by part, on the clock and of
    processor time."""
    begin_s = time.monotonic() + 2 * LEAD_S
    for talk in talks:
        talk.send((begin_s, begin_s + seconds))
    time.sleep(max(0.0, begin_s + 0.7 * seconds - time.monotonic()))
    busy = gpu_busy()
    sums: dict[str, list[float]] = {}
    cores = 0.0
    for talk in talks:
        found, used = talk.recv()
        cores += used
        for name, row in found.items():
            sums[name] = [a + b for a, b in zip(sums.get(name, [0.0] * 3), row, strict=True)]
    count = sums["write_frame"][2]
    clock, used_ms = ({name: 1e3 * s / count for name, s in parts_of(sums, k).items()} for k in (0, 1))
    clock["wait for files"] = 1e3 * seconds * len(talks) / count - sum(clock[name] for name in IN_TURN[:-1])
    row = [len(talks), count / seconds, count / seconds / len(talks), cores, 1e3 * cores * seconds / count, busy]
    return row, clock, used_ms


def run_map(name: str, folder: Path, given: argparse.Namespace) -> None:
    """Measure one map with every number of workers."""
    most, every = max(given.workers), sorted(os.sched_getaffinity(0))
    context = multiprocessing.get_context("spawn")
    talks, processes = [], []
    for number in range(most):
        here, there = context.Pipe()
        cores = {every[number % len(every)]} if given.pinned else None
        process = context.Process(target=worker, args=(there, folder, given.out, number, most, cores), daemon=True)
        process.start()
        there.close()
        talks.append(here)
        processes.append(process)
    started_s = time.monotonic()
    devices = {talk.recv() for talk in talks}
    print(f"## {name}: {', '.join(sorted(devices))}; {most} workers ready after {time.monotonic() - started_s:.0f} s\n")
    rows, in_turn, beside = [], [], []
    for count in given.workers:
        row, clock, used_ms = measured(talks[:count], given.seconds)
        rows.append(row)
        in_turn.append([count, *(clock[part] for part in IN_TURN)])
        beside.append([count, *(used_ms[part] for part in (*IN_TURN[:-1], *BESIDE))])
    for talk, process in zip(talks, processes, strict=True):
        talk.send(None)
        process.join()
    names = ["workers", "frames/s", "of each", f"cores used of {len(every)}", "CPU ms a frame", "GPU busy"]
    scenes.print_table("To disk", names, rows)
    scenes.print_table("ms a frame on the clock of a worker, one after the other", ["workers", *IN_TURN], in_turn)
    scenes.print_table(
        "CPU ms a frame, of the threads of Python (a driver's own are in the first table alone)",
        ["workers", *IN_TURN[:-1], *BESIDE],
        beside,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=Path, required=True, help="folder of maps and flights")
    parser.add_argument("--make", action="store_true", help="make that folder, and measure nothing")
    parser.add_argument("--maps", nargs="+", default=["town", "city"], help="which of them")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=3.0, help="how long each number of workers is measured")
    parser.add_argument("--pinned", action="store_true", help="hold worker k to core k")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()), help="where the frames go")
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    if given.make:
        given.inputs.mkdir(parents=True)
        make_inputs(given.inputs, NUM_FLIGHTS)
        return
    for name in given.maps:
        run_map(name, given.inputs / name, given)


if __name__ == "__main__":
    main()
