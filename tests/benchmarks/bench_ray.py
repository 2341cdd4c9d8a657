"""Two workers on a Ray cluster next to two processes of the local engine, in pairs of one render stage.

    python tests/benchmarks/bench_ray.py --rounds 2

The cluster is one of several processes on this machine. Writes below the folder of --work only.
"""

import argparse
import contextlib
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from crashes import differences
from test_cosfly_ray import Nodes, products

from cosfly.pipeline import run as pipeline
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from cosfly.runtime.events import Event, read_events
from cosfly.runtime.ray_engine import RayConfig, connected

WORKERS = 2
TOWN = ("pedestrians.num_paths=7", "render.width_px=320", "render.height_px=180", "release.licence=cc-by-4.0")


@contextlib.contextmanager
def cluster() -> Iterator[RayConfig]:
    """A head without CPUs and nodes of one."""
    begun_s, nodes = time.monotonic(), Nodes()
    for _ in range(WORKERS):
        nodes.add()
    cfg = RayConfig(address=nodes.address)
    connected(cfg)
    print(f"cluster of {WORKERS} nodes, and this process connected: {time.monotonic() - begun_s:.1f} s")
    try:
        yield cfg
    finally:
        nodes.end()


def stages(out: Path, cfg: RayConfig | None) -> dict[str, pipeline.Stage]:
    on = [] if cfg is None else ["engine=ray", f"ray.address={cfg.address}"]
    run = load(RunConfig, None, [*TOWN, f"workers={WORKERS}", *on])
    return {stage.name: stage for stage in pipeline.stages(run, out)}


def begin(work: Path) -> Path:
    for name in ("maps", "simplify", "pedestrians", "plan"):
        stages(work / "base/run", None)[name].work()
    return work / "base/run"


def render(base: Path, place: Path, cfg: RayConfig | None) -> list[Event]:
    shutil.copytree(base, place / "run")
    before = Path.cwd()
    os.chdir(place)  # so that paths in records are the same
    try:
        stages(Path("run"), cfg)["render"].work()
    finally:
        os.chdir(before)
    return read_events(place / "run/render")


def spans(events: list[Event]) -> tuple[float, float, int]:
    done = [event for event in events if event.event == "item_done"]
    first_s = min(event.at_s - (event.seconds or 0.0) for event in done)
    return first_s - events[0].at_s, done[-1].at_s - first_s, sum(event.steps or 0 for event in done)


def measure_render(work: Path, rounds: int) -> None:
    base, rates = begin(work), {"local": list[float](), "ray": list[float]()}
    with cluster() as cfg:
        for number in range(rounds):
            for name, engine in (("local", None), ("ray", cfg)):
                start_s, work_s, frames = spans(render(base, work / f"{name}{number}", engine))
                rates[name].append(frames / work_s)
                pace, load = f"{frames} frames in {work_s:.1f} s, {frames / work_s:.1f}/s", os.getloadavg()[0]
                print(f"{name}: start {start_s:.1f} s, then {pace}; load {load:.0f}", flush=True)
    told = differences(products(work / "ray0"), products(work / "local0"))
    ratios = [f"{ray / local:.2f}" for local, ray in zip(*rates.values(), strict=True)]
    print(f"ray / local, by rounds: {', '.join(ratios)}; differences: {told}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--work", type=Path, help="new folder; without: one that goes again")
    given = parser.parse_args()
    logging.getLogger().setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as place:
        measure_render((given.work or Path(place)).absolute(), given.rounds)


if __name__ == "__main__":
    main()
