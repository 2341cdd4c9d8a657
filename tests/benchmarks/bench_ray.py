"""Two workers on a Ray cluster beside two processes of the local engine; memory of the driver.

    python tests/benchmarks/bench_ray.py render --rounds 2        # pairs A B A B of one render stage
    python tests/benchmarks/bench_ray.py memory                   # 1,000, 10,000, 100,000 items that do nothing

The cluster is one of several processes on this machine. Writes below the folder of --work only.
"""

import argparse
import contextlib
import logging
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from crashes import differences
from test_cosfly_ray import Nodes, products
from toy_workers import make_talking_worker, stage_in

from cosfly.pipeline import run as pipeline
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from cosfly.runtime.events import Event, Vitals, read_events
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.ray_engine import RayConfig, connected
from cosfly.runtime.worker import Item

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


def do_nothing(folder: Path, engine: RayConfig | None, count: int) -> None:
    """Do items that do nothing, as a command does; tell the memory of this process."""
    logging.getLogger().setLevel(logging.ERROR)
    folder.mkdir(parents=True)
    items = [Item(str(k)) for k in range(count)]
    if engine is not None:
        connected(engine)
    before_mib, begun_s = Vitals.of(os.getpid()).rss_mib, time.monotonic()
    run_items(stage_in(folder), items, make_talking_worker, workers=WORKERS, watch=Watch(engine))
    pace = count / (time.monotonic() - begun_s)
    name, after_mib = "local" if engine is None else "ray", Vitals.of(os.getpid()).rss_mib
    print(f"{name}, {count:,} items: driver {before_mib:.0f} MiB before, {after_mib:.0f} after; {pace:.0f} items/s")


def measure_memory(work: Path, counts: Iterable[int]) -> None:
    spawn = multiprocessing.get_context("spawn")
    with cluster() as cfg:
        for count in counts:
            for engine in (None, cfg):
                process = spawn.Process(target=do_nothing, args=(work / f"{count}{engine is None}", engine, count))
                process.start()
                process.join()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("render", "memory"))
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--counts", type=int, nargs="+", default=(1_000, 10_000, 100_000), help="of items")
    parser.add_argument("--work", type=Path, help="new folder; without: one that goes again")
    given = parser.parse_args()
    logging.getLogger().setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as place:
        work = (given.work or Path(place)).absolute()
        if given.what == "render":
            measure_render(work, given.rounds)
        else:
            measure_memory(work, given.counts)


if __name__ == "__main__":
    main()
