"""What `release verify` costs: processor time, frames a second of one core, peak memory.

    python tests/benchmarks/bench_verify.py runs/quickstart/release/dataset --level pixels
    python tests/benchmarks/bench_verify.py --make 4000 --level structure     # a release of small pictures, made first

One process, and processor time, so that other programs matter less; the first pass, which compiles, is not counted.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench_release import SIZES, build, cpu_seconds, make_tree

from release.record import read_record
from release.verify.verify import LEVELS, verify


def measure(folder: Path, level: str, rounds: int) -> None:
    """Verify a release several times and print what the best pass took."""
    num_frames = read_record(folder / "release.json").numbers.frames
    report = verify(folder, level=level, workers=0)
    if not report.is_ok:  # of a release that is made here the pictures repeat, which is found
        print("not in order:", ", ".join(f"{kind.code} {kind.count:,} times" for kind in report.kinds))
    passes = []
    for _ in range(rounds):
        start_s, used_s = time.perf_counter(), cpu_seconds()
        verify(folder, level=level, workers=0)
        passes.append((cpu_seconds() - used_s, time.perf_counter() - start_s))
    used_s, clock_s = min(passes)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{level}: {num_frames:,} frames, {used_s:.2f} s of processor time ({clock_s:.2f} s on the clock), "
        f"{num_frames / used_s:,.0f} frames/s a core, peak {peak:.0f} MiB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a release's dataset folder")
    parser.add_argument("--make", type=int, help="frames of a release that is made for the measurement")
    parser.add_argument("--level", choices=LEVELS, default="pixels")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    if given.make is None and given.folder is not None:
        measure(given.folder, given.level, given.rounds)
    elif given.make is not None:
        with tempfile.TemporaryDirectory() as scratch:
            root = Path(scratch)
            make_tree(root, given.make, SIZES["memory"])
            build(root, root / "out", ("rgb", "depth", "instance"), 1)
            own = [str(root / "out/dataset"), "--level", given.level, "--rounds", str(given.rounds)]
            subprocess.run([sys.executable, __file__, *own], check=True)  # whose peak is of the verification alone
    else:
        parser.error("a folder, or --make")


if __name__ == "__main__":
    main()
