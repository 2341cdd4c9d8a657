"""How many steps a second an environment takes: alone, and two side by side in processes.

    python tests/benchmarks/bench_flying.py --rounds 3   cosfly/Follow-v0, 640x360; --size 64 48 for another

Steps alone are counted, from the second on.
"""

import argparse
import os
import time

import gymnasium

from cosfly.envs.episodes import NUM_DECISIONS
from cosfly.formats.captions import TOKENS


def time_envs(num: int, size_px: list[int]) -> None:
    hover = TOKENS.index("hover")  # which crashes nowhere, so that no town is made meanwhile
    how = {"shared_memory": False, "context": "spawn"}
    envs = gymnasium.make_vec(
        "cosfly/Follow-v0",
        num_envs=num,
        vectorization_mode="async" if num > 1 else "sync",
        vector_kwargs=how if num > 1 else {},
        size_px=tuple(size_px),
    )
    envs.reset(seed=64)
    envs.step([hover] * num)
    load, begun_s = os.getloadavg()[0], time.monotonic()
    for _ in range(NUM_DECISIONS - 2):
        envs.step([hover] * num)
    seconds = time.monotonic() - begun_s
    print(f"{num} side by side: {num * (NUM_DECISIONS - 2) / seconds:.1f} steps a second; load before {load:.1f}")
    envs.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), help="width and height of pictures")
    asked = parser.parse_args()
    for _ in range(asked.rounds):
        for num in (1, 2):
            time_envs(num, asked.size)


if __name__ == "__main__":
    main()
