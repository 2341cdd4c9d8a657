"""Memory and time of `distill prepare` and of reading what it made, over synthetic caption lines: docs/distillation.md.

    python tests/benchmarks/bench_prepare.py --folder /tmp/bench_prepare 10000 100000 1000000

Flights of 1,000 windows, two languages, samples of text alone (no picture is looked for, so that a million of them need no disk).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from specimens_distill import make_caption

from cosfly.products.captions import write_caption_lines
from cosfly.products.flights import find_flights
from cosfly.products.playback import read_flight, write_flight
from cosfly.reading.limits import Limits, use_limits
from distill.prepare import stage as prepare
from distill.prepare.sources import Source
from distill.prepare.stage import PrepareConfig
from distill.schema import open_split, split_path
from specimens import make_flight

WINDOWS = 1000  # of a flight
# As long as a real prompt's measurements.
STATE = " ".join(f"({k}.25, {k}.50, {k}.75; -30.0, 12.5, 0.0)" for k in range(24))


def write_material(folder: Path, num_windows: int) -> None:
    """Write a tree of flights without pictures, and captions of every window, all different."""
    flight, _ = make_flight(WINDOWS + 4)
    for number in range(num_windows // WINDOWS):
        name = f"trajectory_{number:06d}"
        away = flight.targets_m + np.array([200.0 * number, 0, 0])
        moved = json.loads(json.dumps(flight.raw))
        write_flight(folder / "tree/Town01" / name / "ORI", replace(flight, trajectory=name, targets_m=away, raw=moved))
    pattern = {frame: make_caption("Town01", "NAME", "ORI", frame).model_dump_json() for frame in range(4, WINDOWS + 4)}

    def lines():
        for number in range(num_windows // WINDOWS):
            for frame, text in pattern.items():
                told = text.replace("NAME", f"trajectory_{number:06d}").replace(
                    " Answer", f" {STATE} {number} {frame} Answer"
                )
                yield (told + "\n").encode()

    write_caption_lines(folder / "captions.jsonl", lines())


def measured(folder: Path, num_windows: int, queue: multiprocessing.Queue) -> None:
    use_limits(Limits())
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start_s, cpu_s = time.monotonic(), time.process_time()
    cfg = PrepareConfig(modalities=(), unbound="accept", too_few="fill", limit=num_windows // 2, balance="decisions")
    out = prepare.run(cfg, [Source.of_files(folder / "tree", folder / "captions.jsonl")], folder / "set")
    took = time.monotonic() - start_s, time.process_time() - cpu_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    samples = open_split(out, "train")
    order = np.random.default_rng(0).permutation(len(samples))[:2000]
    start_s = time.process_time()
    for k in order:
        samples[int(k)]
    look_ms = (time.process_time() - start_s) / len(order) * 1e3
    count = sum(len(open_split(out, split)) for split in ("train", "val", "test"))
    size = sum(split_path(out, split).stat().st_size for split in ("train", "val", "test"))
    queue.put((before_mb, peak_mb, *took, count, size, look_ms))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("windows", type=int, nargs="+")
    parser.add_argument("--folder", type=Path, required=True)
    args = parser.parse_args()
    print(
        "windows | before MB | peak MB | wall s | processor s | samples | bytes a sample | ms for one of all at random"
    )
    for num_windows in args.windows:
        shutil.rmtree(args.folder, ignore_errors=True)
        write_material(args.folder, num_windows)
        assert len(read_flight(find_flights(args.folder / "tree")[0])) == WINDOWS + 4
        queue: multiprocessing.Queue = multiprocessing.get_context("spawn").Queue()
        process = multiprocessing.get_context("spawn").Process(target=measured, args=(args.folder, num_windows, queue))
        process.start()
        before, peak, wall, cpu, count, size, look_ms = queue.get()
        process.join()
        print(
            f"{num_windows:,} | {before:.0f} | {peak:.0f} | {wall:.0f} | {cpu:.0f} | {count:,} | {size / count:.0f} | {look_ms:.2f}",
            flush=True,
        )
    shutil.rmtree(args.folder)


if __name__ == "__main__":
    main()
