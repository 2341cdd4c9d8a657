"""The caption loop of several checkouts, in turns. Run: python tests/benchmarks/bench_turns.py TURNS TREE TREE...

On a machine where others work too a rate alone says little, but a neighbour slows all trees alike: each is a process of its own,
and they take turns of a few flights. Given are the CPU time per window and the median of its ratio to the first tree's.
"""

from __future__ import annotations

import functools
import importlib
import statistics
import subprocess
import sys

NUM_WINDOWS, WARMING = 500, 2  # windows of a turn, turns that are not counted


def work(tree: str) -> None:
    """Caption some flights for each line of input, with the code of a tree, and print the CPU time per window in us."""
    sys.path[:0] = [tree, f"{tree}/tests/benchmarks", f"{tree}/tests"]
    bench = importlib.import_module("bench_captions")
    bench.make_flight = functools.cache(bench.make_flight)  # once for all turns
    print("ready", flush=True)
    for _ in sys.stdin:
        print(1e6 / bench.measure_loop(NUM_WINDOWS)["per_cpu_s"], flush=True)


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
