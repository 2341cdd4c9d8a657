"""Rendering with workers that are killed and one that is stopped, all in one run: the finished set against an
undisturbed run's.

    cosfly run quickstart --out RUN --set pedestrians.num_paths=7 --set render.width_px=64  # or stop it after plan
    python tests/benchmarks/bench_faults.py RUN  # 20 kills, 1 stop

Small pictures, as what counts is what becomes of the files. Where so many workers are lost that the stage gives up, it
is started again, as a user would.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import scenes
from faults import Faults, planted

from cosfly.errors import EnvironmentMissing
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.work.runner import Watch
from cosfly.work.stage_events import read_events
from cosfly.work.stage_folder import read_manifest

RECORDS = ("stage.json", "manifest.json", "events.jsonl", "items.jsonl", "failures.jsonl")  # of times and processes


def render(root: Path, out: Path, size: tuple[int, int], workers: int) -> int:
    """Draw the flights of a run; gives how often the stage was started."""
    cfg = RenderConfig(width_px=size[0], height_px=size[1], first_timestamp=1776000000)
    inputs = (root / "maps/boxes_3d.json", root / "simplify/step2_simplified.json", root / "plan/drone_trace.json")
    attempts = 0
    while not (out / "manifest.json").exists():
        attempts += 1
        try:
            run(cfg, *inputs, out, workers=workers, watch=Watch())
        except EnvironmentMissing as error:
            if attempts > 10:
                raise
            print(f"(the stage gave up and is started again: {error})")
    return attempts


def digests(out: Path) -> dict[str, str]:
    """Every file of a tree, but the records of who made it when."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in RECORDS
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run folder that is finished up to plan")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--stops", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--size", type=int, nargs=2, default=(64, 36))
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        plain, broken = Path(scratch, "plain"), Path(scratch, "broken")
        begin_s = time.monotonic()
        render(given.run, plain, given.size, given.workers)
        plain_s, begin_s = time.monotonic() - begin_s, time.monotonic()
        faults = (("kill", given.kills), ("stall", given.stops))
        moments = [stack.enter_context(planted(Faults(k, n, plain_s, 0), broken)) for k, n in faults]
        attempts = render(given.run, broken, given.size, given.workers)
        broken_s = time.monotonic() - begin_s
        events = Counter(event.event for event in read_events(broken))
        counts = read_manifest(broken).counts
        ours, theirs = digests(plain), digests(broken)
        rows = [
            [len(list(plain.rglob("rgb.png"))), *(len(m) for m in moments), events["worker_died"],
             events["heartbeat_lost"], events["restarted"], events["retried"], attempts, counts.failed.total(),
             len(ours), "yes" if ours == theirs else "NO", plain_s, broken_s]
        ]  # fmt: skip
        names = [
            "frames",
            "kills",
            "stops",
            "died",
            "stood still",
            "restarts",
            "retries",
            "starts of the stage",
            "failed",
            "files",
        ]
        scenes.print_table("Faults", [*names, "all the same", "s undisturbed", "s disturbed"], rows)


if __name__ == "__main__":
    main()
