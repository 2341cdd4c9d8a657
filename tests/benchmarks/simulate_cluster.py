"""More machines than there are here: a discrete-event simulation of a run's stages on many nodes, fitted to a real run.

    cosfly run quickstart --out runs/quickstart --workers 2     # what it is fitted to; a second run is predicted
    python tests/benchmarks/simulate_cluster.py runs/quickstart --figure scale.png

Simulated: items of a stage that one driver hands out to workers, which are lost with their process or their node;
storage and teachers that serve so many requests a second. Not simulated: the network, storage that slows down early.
"""

import argparse
import heapq
import json
import tempfile
import time
import timeit
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import scenes

from cosfly.runtime.config import Config
from cosfly.runtime.events import read_events
from cosfly.runtime.journal import Journal
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.ray_engine import RayConfig
from cosfly.runtime.run_dir import StageFolder
from cosfly.runtime.worker import Item, Outcome, Work

STAGES = ("plan", "render", "inspect", "caption", "release")
OPS = {"render": 5.1, "inspect": 9.5, "caption": 2.2, "release": 3.2}  # opens and mkdirs of a frame, counted by strace
NODE_FPS, NODE_WORKERS = 148.5, 12  # one H100, 16 cores, measured: docs/performance.md
NODE_USD_H = 2.5 + 16 * 0.04  # stated: such a GPU, and its cores
TEACHER_USD_H, WINDOWS_S = 3.5, 3.7  # stated; measured: vLLM on one H200, 15 pictures a request, a JSON schema
STORAGE_OPS_S, STORAGE_S = 20_000.0, 1e-3  # stated: what a parallel file system serves, and what one operation takes
NODE_LOSSES_H, WORKER_LOSSES_H = 1 / 6300, 1e-3  # 419 in 54 days of 2,048 nodes (Llama 3, 2024); stated
RAY_S = 8e-4  # an item's of the driver, measured with --ray; a heartbeat is such a call too
BEAT_S, NEVER = Watch().heartbeat_s, float("inf")
PAPER = {"A": (16, 2, 94.7, 814), "B": (12, 1, 91.5, 497), "C": (18, 2, 85.0, 1178), "D": (1, 1, 86.5, 175)}
PILOT = {1: 1.07, 2: 1.43, 4: 2.55, 6: 2.68}  # frames/s of one GPU by workers (tab:render_scaling); no more beyond
PILOT_FRAMES = 698  # of a trajectory with its augmentations: 2,792 of four
COMPLETED, RESTARTS = 0.27, 2325 / (497 / 0.27 - 497)  # machine B: of its attempts; of each attempt that failed


@dataclass(frozen=True)
class Cluster:
    """What a stage is done on. Times in s; losses in the mean, of each and an hour."""

    nodes: int
    workers: int = NODE_WORKERS  # on each
    start_s: float = 0.0  # a worker reads maps and compiles
    hand_out_s: float = 0.0  # the driver, an item: its message, its line in the journal on the disk
    beat_s: float = 0.0  # the driver, a heartbeat
    finish_s: float = 0.0  # the driver, an item, when the stage ends
    worker_losses_h: float = 0.0
    node_losses_h: float = 0.0
    node_down_s: float = 900.0
    ops_s: float = NEVER  # of the storage
    teachers: int = 0
    resumes: bool = False  # an item that is lost goes on where it was: it is a whole run


@dataclass
class Result:
    """given_up: lost with three workers, so that the stage ends unfinished. busy: share of the time of what is there
    once."""

    seconds: float
    lost: int = 0
    given_up: int = 0
    busy: dict[str, float] = field(default_factory=dict)


def simulate(items_s: Sequence[float], on: Cluster, rng: np.random.Generator, ops: float = 0.0, windows: float = 0.0):
    """Do the items of a stage, first come, first served.

    Args:
        items_s: how long each takes in a worker that waits for nothing. ops, windows: what each asks, in the mean.
    """
    num_workers = on.nodes * on.workers
    beats = num_workers / BEAT_S * on.beat_s
    if beats >= 1.0:
        return Result(NEVER, busy={"heartbeats": beats})
    hand_out_s, ops_s = on.hand_out_s / (1.0 - beats), ops / on.ops_s
    teachers = on.teachers * (1.0 - on.node_losses_h * on.node_down_s / 3600)  # that are up, in the mean
    windows_s = windows / (WINDOWS_S * teachers) if teachers else 0.0
    waiting, epoch = deque((seconds, 0) for seconds in items_s), [0] * num_workers
    in_hand: dict[int, tuple[float, float, int]] = {}  # worker -> begun, seconds, attempt
    now = driver = storage = teacher = 0.0
    lost = given_up = done = 0
    free, finished, broken, node_lost = range(4)
    queue = [(on.start_s, free, worker, 0) for worker in range(min(num_workers, len(items_s)))]

    def lose(worker: int) -> None:
        nonlocal lost, given_up
        begun, seconds, attempt = in_hand.pop(worker)
        lost += 1
        if on.resumes:
            waiting.append((max(0.0, seconds - (now - begun)) + on.start_s, 0))
        elif attempt < Watch().retries:
            waiting.append((seconds, attempt + 1))
        else:
            given_up += 1

    def expect_node() -> None:
        if on.node_losses_h:
            heapq.heappush(queue, (now + rng.exponential(3600.0 / on.node_losses_h / on.nodes), node_lost, 0, 0))

    expect_node()
    while done + given_up < len(items_s):
        now, what, worker, of_epoch = heapq.heappop(queue)
        if what == node_lost:
            first = int(rng.integers(on.nodes)) * on.workers
            for one in range(first, first + on.workers):
                epoch[one] += 1
                if one in in_hand:
                    lose(one)
                heapq.heappush(queue, (now + on.node_down_s + on.start_s, free, one, epoch[one]))
            expect_node()
        elif of_epoch != epoch[worker]:
            continue
        elif what == broken:
            lose(worker)
            heapq.heappush(queue, (now + on.start_s, free, worker, of_epoch))
        else:
            if what == finished:
                del in_hand[worker]
                done += 1
                now = driver = max(driver, now) + hand_out_s
            if waiting:
                seconds, attempt = waiting.popleft()
                storage, teacher = max(storage, now) + ops_s, max(teacher, now) + windows_s
                end_s = max(now + seconds, storage if ops_s else 0.0, teacher if windows_s else 0.0)
                loss_s = now + rng.exponential(3600.0 / on.worker_losses_h) if on.worker_losses_h else NEVER
                in_hand[worker] = now, seconds, attempt
                heapq.heappush(queue, (min(end_s, loss_s), finished if end_s <= loss_s else broken, worker, of_epoch))
            elif in_hand:  # an item may come back
                heapq.heappush(queue, (now + 5.0, free, worker, of_epoch))
    count, total = len(items_s), now + on.finish_s * len(items_s)
    names = ("heartbeats", "journal and hand-out", "storage", "teacher", "the stage's end")
    used_s = beats * total, count * on.hand_out_s, count * ops_s, count * windows_s, total - now
    busy = {name: seconds / total for name, seconds in zip(names, used_s, strict=True)}
    return Result(total, lost, given_up, busy)


@dataclass(frozen=True)
class Profile:
    """A run of one town: frames of each flight; by stage seconds of each item, a frame (plan: a flight), and until a
    worker begins."""

    frames: list[int]
    seconds: dict[str, list[float]]
    start_s: dict[str, float]

    @classmethod
    def of(cls, run: Path) -> "Profile":
        frames, seconds, start_s = list[int](), {}, {}
        for name in STAGES:
            events = read_events(run / name) or read_events(run.parent / name)  # one release of several towns
            done = [event for event in events if event.event == "item_done"]
            frames = [event.steps or 0 for event in done] if name == "render" else frames
            # Plan tells no steps, inspect two a frame, caption its windows.
            sizes = {"plan": 1.0, "caption": float(np.mean(frames or [1]))}
            scale = 2.0 if name == "inspect" else 1.0
            seconds[name] = [(e.seconds or 0.0) / sizes.get(name, (e.steps or 0) / scale) for e in done]
            began_s = next(event.at_s for event in events if event.event == "began")
            start_s[name] = max(0.0, min(event.at_s - (event.seconds or 0.0) for event in done) - began_s)
        return cls(frames, seconds, start_s)

    def drawn(self, stage: str, count: int, rng: np.random.Generator, spread: float) -> np.ndarray:
        """Draw items, s: lengths of flights and paces among those of the run, the paces' spread stretched."""
        paces = np.array(self.seconds[stage])
        paces = np.maximum(paces.mean() + spread * (paces - paces.mean()), 0.05 * paces.mean())
        faster = NODE_WORKERS / NODE_FPS / paces.mean() if stage == "render" else 1.0
        return (1.0 if stage == "plan" else rng.choice(self.frames, count)) * rng.choice(paces, count) * faster


def nothing() -> Work:
    return lambda item: Outcome({"folder": item.item_id, "num_frames": 100})


def driver(engines: dict[str, Watch]) -> dict[str, float]:
    """Measure what an item takes of the driver's processor, by engine, and a line of a journal until it is on the disk,
    s."""
    import simulate_cluster  # by its name: workers on Ray know no __main__

    with tempfile.TemporaryDirectory(dir=Path.cwd()) as root, Journal(Path(root) / "items.jsonl") as journal:

        def used_s(count: int, watch: Watch) -> float:
            folder = StageFolder.open(Path(tempfile.mkdtemp(dir=root)), "demo", config=Config(), inputs={}, seed=0)
            items, begun_s = [Item(f"i{k}") for k in range(count)], time.process_time()
            run_items(folder, items, simulate_cluster.nothing, workers=2, watch=watch)
            return time.process_time() - begun_s

        found = {name: (used_s(2200, watch) - used_s(200, watch)) / 2000 for name, watch in engines.items()}
        lines_s = timeit.repeat(lambda: journal.append({"id": "path_00000/ORI"}), number=500, repeat=3)
        return found | {"journal": min(lines_s) / 500}


def paper_rows(rng: np.random.Generator) -> list[list]:
    """Simulate its four nodes and 47 workers (tab:machine_configs): the pace from its pilot, the losses from machine B,
    whose attempts took 36 minutes in the mean, from which follows what a restart takes. A, C and D are predicted."""

    def completed(workers: int, gpus: int, hours: float, restart_s: float) -> int:
        full_s = PILOT_FRAMES * workers / gpus / np.interp(workers / gpus, [*PILOT], [*PILOT.values()])
        chances = rng.random((2, workers, 3000))  # more attempts than there is time for
        is_kept = chances[0] < COMPLETED
        took_s = np.where(is_kept, full_s, full_s * chances[1] + RESTARTS * restart_s)
        return int((is_kept & (took_s.cumsum(axis=1) <= 3600.0 * hours)).sum())

    attempt_s, full_s = 12 * 91.5 * 3600 * COMPLETED / 497, PILOT_FRAMES * 12 / PILOT[6]
    restart_s = ((attempt_s - COMPLETED * full_s) / (1 - COMPLETED) - full_s / 2) / RESTARTS
    rows = [
        [*one[:1], *one[1], np.mean([completed(*one[1][:3], restart_s) for _ in range(20)])] for one in PAPER.items()
    ]
    rows.append(["all", 47, 6, "-", sum(row[4] for row in rows), sum(row[5] for row in rows)])
    return [[*row[:5], round(row[5]), f"{100 * (row[5] / row[4] - 1):+.0f} %"] for row in rows]


def predicted_s(profile: Profile, run: Path, rng: np.random.Generator) -> tuple[float, float]:
    """Render another run's flights with two workers at the pace of the fitted one; predicted and measured, s."""
    events = read_events(run / "render")
    began_s, ended_s = (next(e.at_s for e in events if e.event == kind) for kind in ("began", "ended"))
    frames = np.array([event.steps or 0 for event in events if event.event == "item_done"])
    on = Cluster(1, 2, start_s=profile.start_s["render"])
    tries = [simulate(frames * rng.choice(profile.seconds["render"], len(frames)), on, rng) for _ in range(200)]
    return float(np.mean([one.seconds for one in tries])), ended_s - began_s


def whole_run(profile: Profile, on: Cluster, flights: int, rng: np.random.Generator, spread: float = 1.0):
    """Do one run, each stage when the one before is done; gives what came of each."""
    found, mean = {}, float(np.mean(profile.frames))
    for stage in STAGES:
        items_s = profile.drawn(stage, flights, rng, spread).tolist()
        of_stage = replace(on, start_s=profile.start_s[stage], finish_s=on.finish_s if stage == "render" else 0.0)
        of_stage = replace(of_stage, teachers=on.teachers if stage == "caption" else 0)
        found[stage] = simulate(items_s, of_stage, rng, mean * OPS.get(stage, 0.0), mean)
    return found


def many_runs(profile: Profile, on: Cluster, flights: int, rng: np.random.Generator, size: int = 200):
    """Do the same flights as runs of `size`, each on one node with files on its own disk: a run is an item."""
    alone = Cluster(1, hand_out_s=on.hand_out_s, worker_losses_h=on.worker_losses_h)
    few_s = [sum(one.seconds for one in whole_run(profile, alone, size, rng).values()) for _ in range(10)]
    on = Cluster(on.nodes, 1, hand_out_s=on.hand_out_s, node_losses_h=on.node_losses_h, resumes=True)
    return {"runs": simulate(rng.choice(few_s, max(1, flights // size)).tolist(), on, rng)}


def row_of(name: str, on: Cluster, found: dict[str, Result]) -> list:
    hours = sum(one.seconds for one in found.values()) / 3600
    usd = on.nodes * hours * NODE_USD_H
    if on.teachers and "caption" in found:
        usd += on.teachers * found["caption"].seconds / 3600 * TEACHER_USD_H
    shares = [
        (s * min(one.seconds, 1e9), s, f"{who} in {stage}")
        for stage, one in found.items()
        for who, s in one.busy.items()
    ]
    _, share, what = max(shares)
    lost, given_up = (sum(getattr(one, kind) for one in found.values()) for kind in ("lost", "given_up"))
    return [name, on.nodes, hours, on.nodes * hours, usd, lost, given_up, f"{what}: {100 * share:.0f} %"]


def asked(profile: Profile, rng: np.random.Generator) -> dict[str, list[float]]:
    mean, found = float(np.mean(profile.frames)), list[dict[str, float]]()
    for nodes in (1, 4, 10, 40, 100, 400, 1000):
        results, workers = whole_run(profile, Cluster(nodes), 100 * nodes, rng), nodes * NODE_WORKERS
        flights_s = {stage: 100 * nodes / one.seconds for stage, one in results.items()}
        shares = {f"{stage}: journal and hand-out": flights_s[stage] * RAY_S for stage in ("plan", "render")}
        shares["heartbeats"] = workers / BEAT_S * RAY_S
        shares |= {f"{s}: storage": flights_s[s] * mean * OPS[s] / STORAGE_OPS_S for s in ("render", "inspect")}
        shares["one teacher that keeps up with render"] = flights_s["render"] * mean / WINDOWS_S
        found.append({"nodes": nodes} | shares)
    return {name: [one[name] for one in found] for name in found[0]}


def draw(told: dict[str, list[float]], path: Path) -> None:
    from matplotlib.figure import Figure

    axes = (figure := Figure((10, 4.5), layout="constrained")).subplots()
    for name, marker in zip([*told][1:], "osv^D*", strict=True):
        axes.loglog(told["nodes"], told[name], marker=marker, markersize=5, label=name)
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--")
    axes.set(xlabel=f"nodes of {NODE_WORKERS} workers, one run", ylabel="asked / can be done")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="of one town: the first is fitted, others are predicted")
    parser.add_argument("--flights", type=int, default=1_000_000)
    parser.add_argument("--ray", action="store_true", help="also measure the driver of a Ray cluster of this machine")
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    engines = {"item": Watch()} | ({"item on Ray": Watch(ray=RayConfig())} if given.ray else {})
    rng, profile, costs = np.random.default_rng(0), Profile.of(given.runs[0]), driver(engines)
    paces = {name: f"{np.mean(each):.4f} +- {np.std(each):.4f}" for name, each in profile.seconds.items()}
    print(f"a frame (plan: a flight), s: {json.dumps(paces)}; driver, s: {json.dumps(costs)}")
    items_s = rng.lognormal(0.0, 0.5, 200_000)
    off = simulate(items_s, Cluster(10, 16), rng).seconds / (items_s.sum() / 160) - 1.0
    print(f"one stage, no losses: {100 * off:+.2f} % off work / workers")
    for run in given.runs:
        told_s = predicted_s(profile, run, rng)
        print("{}: render, two workers: predicted {:.1f} s, measured {:.1f} s".format(run.name, *told_s))
    names = ["machine", "workers", "GPUs", "h", "trajectories", "simulated", "off"]
    scenes.print_table("The paper's four nodes", names, paper_rows(rng))

    # At the end of render two files of each flight are hashed.
    free, rows = Cluster(1, hand_out_s=RAY_S, beat_s=RAY_S, finish_s=2 * STORAGE_S), list[list]()
    losses = {"worker_losses_h": WORKER_LOSSES_H, "node_losses_h": NODE_LOSSES_H}
    for nodes in (4, 100, 1000):
        on = replace(free, nodes=nodes, **losses)
        rows.append(row_of("one run, storage without limit", on, whole_run(profile, on, given.flights, rng)))
        on = replace(on, ops_s=STORAGE_OPS_S)
        rows.append(row_of("one run", on, whole_run(profile, on, given.flights, rng)))
        on = replace(on, teachers=max(1, nodes // 4))
        rows.append(row_of(f"one run, {on.teachers} teachers", on, whole_run(profile, on, given.flights, rng)))
        alone = Cluster(nodes, hand_out_s=costs["item"] + costs["journal"], **losses)
        rows.append(row_of("runs of 200 flights, a node each", alone, many_runs(profile, alone, given.flights, rng)))
    names = ["", "nodes", "h", "node hours", "USD", "lost", "given up", "busiest of what is there once"]
    scenes.print_table(f"{given.flights:,} flights", names, rows)

    rows, few = [], given.flights // 10
    for spread, times in ((0, 1), (1, 1), (2, 1), (1, 0), (1, 100), (1, 1000)):
        on = replace(free, nodes=max(1, few // 1000), **{name: times * rate for name, rate in losses.items()})
        rows.append([spread, times, *row_of("", on, whole_run(profile, on, few, rng, spread))[1:-1]])
    names = ["spread, times", "losses, times", "nodes", "h", "node hours", "USD", "lost", "given up"]
    scenes.print_table(f"{few:,} flights, storage without limit", names, rows)
    told = asked(profile, rng)
    scenes.print_table("Asked / can be done, one run", [*told], [list(row) for row in zip(*told.values(), strict=True)])
    if given.figure:
        draw(told, given.figure)


if __name__ == "__main__":
    main()
