"""Windows per second and peak memory of the rule teacher with all checks. Run: python
tests/benchmarks/bench_captions.py 10000 100000

Each size runs in a process of its own, on one core. `loop` is from flight arrays to written caption lines (window,
facts, label, prompts, both answers, structure, verdict, evidence, mirror, JSON); `stage` is the whole of
`caption.run.stage.run` on a playback
tree without pictures: reading trajectories, part files, merge, report. Memory is the peak of the resident set.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from caption.run.stage import caption_in_order, run
from caption.run.windows import cut_windows
from caption.schema import CaptionConfig, WindowConfig
from caption.teachers.teacher import RuleTeacher
from specimens import FIRST_SECOND, make_flight, make_playback_tree

CFG = CaptionConfig(window=WindowConfig(require_images=False))
NUM_POINTS, NUM_FLIGHTS = 156, 20  # frames of a flight, as the public release has; flights that take turns
WINDOWS_PER_FLIGHT = NUM_POINTS - 9


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure_loop(num_windows: int) -> dict[str, float]:
    flights = [
        dataclasses.replace(make_flight(NUM_POINTS, seed=seed, width_px=1280, height_px=720)[0], folder=Path("nowhere"))
        for seed in range(NUM_FLIGHTS)
    ]
    count, spent_s, cpu_s = 0, 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        number = 0
        while count < num_windows:
            # A new name each time, so that wording and ids differ as between real flights.
            flight = dataclasses.replace(
                flights[number % NUM_FLIGHTS], trajectory=f"trajectory_{FIRST_SECOND + number}"
            )
            start_s, start_cpu_s = time.perf_counter(), time.process_time()
            windows = cut_windows(flight, CFG.window)
            count += asyncio.run(caption_in_order(windows, RuleTeacher(0), CFG, Path(folder) / "part.jsonl"))
            spent_s += time.perf_counter() - start_s
            cpu_s += time.process_time() - start_cpu_s
            number += 1
    return {"windows": count, "per_s": count / spent_s, "per_cpu_s": count / cpu_s, "peak_mib": peak_mib()}


def measure_stage(num_windows: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        num_flights = -(-num_windows // WINDOWS_PER_FLIGHT)
        tree = make_playback_tree(root / "tree", num_flights, NUM_POINTS, with_images=False, with_augmented=False)
        before_mib = peak_mib()
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        run(CFG, tree, root / "out")
        spent_s, cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    count = num_flights * WINDOWS_PER_FLIGHT
    return {
        "windows": count, "per_s": count / spent_s, "per_cpu_s": count / cpu_s, "peak_mib": peak_mib(),
        "peak_before_mib": before_mib,
    }  # fmt: skip


MEASURES = {"loop": measure_loop, "stage": measure_stage}


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["--one"]:
        print(json.dumps(MEASURES[arguments[1]](int(arguments[2]))))
        return
    kinds = [name for name in arguments if name in MEASURES] or ["loop"]
    sizes = [int(name) for name in arguments if name.isdigit()] or [10_000, 100_000]
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    for kind in kinds:
        peaks = []
        for size in sizes:
            words = [sys.executable, __file__, "--one", kind, str(size)]
            found = json.loads(
                subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
            )
            peaks.append(found["peak_mib"])
            print(
                f"{kind}: {found['windows']} windows, {found['per_s']:.0f} per second ({found['per_cpu_s']:.0f} per "
                f"second of CPU time), peak {found['peak_mib']:.1f} MiB"
            )
        if len(peaks) > 1:
            print(f"{kind}: peak memory of the largest over the smallest: {peaks[-1] / peaks[0]:.3f}")


if __name__ == "__main__":
    main(sys.argv[1:])
