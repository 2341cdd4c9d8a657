"""The caption loop of several checkouts, in turns. Run: python tests/benchmarks/bench_turns.py TURNS TREE TREE...

On a machine where others work too a rate alone says little, but a neighbour slows all trees alike: each is a process of its own,
and they take turns flight by flight. Given are the CPU time per window and the median of its ratio to the first tree's.
"""

from __future__ import annotations

import asyncio
import dataclasses
import importlib
import statistics
import subprocess
import sys
import time
from pathlib import Path

NUM_FLIGHTS, NUM_POINTS, WARMING = 8, 40, 16  # flights that take turns, their frames, turns that are not counted


def work(tree: str) -> None:
    """Caption a flight for each line of input, with the code of a tree, and print the CPU time per window in us."""
    sys.path[:0] = [tree, f"{tree}/tests/benchmarks", f"{tree}/tests"]
    bench = importlib.import_module("bench_captions")
    made = [bench.make_flight(NUM_POINTS, seed=seed, width_px=1280, height_px=720)[0] for seed in range(NUM_FLIGHTS)]
    teacher = bench.RuleTeacher(0)
    loop = asyncio.new_event_loop()  # one for all, as in the stage
    print("ready", flush=True)
    for number, _ in enumerate(sys.stdin):
        name = f"trajectory_{bench.FIRST_SECOND + number}"
        flight = dataclasses.replace(made[number % NUM_FLIGHTS], folder=Path("nowhere"), trajectory=name)
        start_s = time.process_time()
        captions = loop.run_until_complete(bench._caption(flight, teacher))
        text = "".join(caption.model_dump_json() for caption in captions)
        assert text
        print((time.process_time() - start_s) / len(captions) * 1e6, flush=True)


def main(num_turns: int, trees: list[str]) -> None:
    words = [sys.executable, __file__, "--work"]
    workers = [
        subprocess.Popen([*words, tree], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        for tree in trees
    ]
    assert all(worker.stdout.readline() == "ready\n" for worker in workers)
    spent_us: list[list[float]] = [[] for _ in trees]
    for turn in range(WARMING + num_turns):
        for worker, times in zip(workers, spent_us, strict=True):
            worker.stdin.write("next\n")
            found = float(worker.stdout.readline())
            if turn >= WARMING:
                times.append(found)
    for worker in workers:
        worker.stdin.close()
        worker.wait()
    for tree, times in zip(trees, spent_us, strict=True):
        ratio = statistics.median(own / first for own, first in zip(times, spent_us[0], strict=True))
        print(
            f"{tree}: median {statistics.median(times):.0f}, least {min(times):.0f} us per window; {ratio:.2f} of the first one's time"
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2])
    else:
        main(int(sys.argv[1]), sys.argv[2:])
