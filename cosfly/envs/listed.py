"""`cosfly fly --env`: a student in a fixed list of episodes, with the records and the score of `cosfly fly`."""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from cosfly.closed_loop.stage import ClosedLoopConfig, EpisodeRunner, finish_episodes, watch_of
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.envs import episodes as benchmark
from cosfly.runtime.errors import InputError
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder
from cosfly.runtime.worker import Item, Outcome, Work


class ListConfig(ClosedLoopConfig):
    """The settings of `cosfly fly --env`."""

    env: str  # environment and list, as in `read_list`


def run(
    cfg: ListConfig, out: Path, *, seed: int = 0, workers: int = 1, watch: Watch = Watch(), resume: Resume = "if-same"
) -> Path:
    """Fly each episode of a list; write `episodes/` and `score.json`. Return the output directory."""
    _, episodes, _ = benchmark.read_list(cfg.env)
    files = {"controller": cfg.fly.table, "episodes": benchmark.EPISODES_FILE}
    stage = StageFolder.open(out, "fly", config=cfg, inputs={}, seed=seed, resume=resume, package_files=files)
    if not stage.is_complete:
        # A model answers all towns as one batch; otherwise a worker opens one town at a time.
        by_town = [list(own) for _, own in groupby(episodes, key=itemgetter(0))]
        items = []
        for group in [list(episodes)] if cfg.fly.asks_model else by_town:
            for begin in range(0, len(group), cfg.fly.batch):
                batch = group[begin : begin + cfg.fly.batch]
                name = benchmark.episode_id(*batch[0])
                items.append(Item(f"{name} and {len(batch) - 1}", batch, benchmark.NUM_DECISIONS * len(batch)))
        num_workers = 1 if cfg.fly.asks_model else workers
        worker_args = (cfg, stage.path, seed, num_workers)
        run_items(stage, items, make_worker, worker_args, workers=num_workers, watch=watch_of(cfg.fly, watch))
        finish_episodes(stage, cfg.fly, seed, [benchmark.episode_id(*episode) for episode in episodes])
    return out


def make_worker(cfg: ListConfig, out: Path, seed: int, num_workers: int) -> Work:
    """Open an engine in this process; return the function that flies some episodes of a town."""
    task, _, digest = benchmark.read_list(cfg.env)
    runner = EpisodeRunner(cfg, out, seed, num_workers, list_sha256=digest)

    @lru_cache(maxsize=len(benchmark.HELD_OUT) if cfg.fly.asks_model else 1)
    def airspace_of(town: str) -> tuple[benchmark.BenchmarkWorld, Airspace]:
        world = benchmark.world_of(benchmark.HELD_OUT[town])
        return world, world.airspace(task)

    def open_episode(town: str, number: int) -> ClosedLoopTrajectory:
        world, airspace = airspace_of(town)
        episode = benchmark.episode_of(task, world, number)
        if episode is None:
            raise InputError(benchmark.UNSUITABLE, where=f"{cfg.env}: {town}, pedestrian trajectory {number}")
        return episode.simulation(airspace)

    def work(item: Item) -> Outcome:
        episodes = {benchmark.episode_id(*episode): partial(open_episode, *episode) for episode in item.payload}
        maps = {benchmark.episode_id(town, number): airspace_of(town)[0].sha256 for town, number in item.payload}
        return runner.fly(episodes, maps)

    return work
