"""`cosfly fly --env`: a student in a fixed list of episodes, with the records and the score of `cosfly fly`."""

from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path

from cosfly.closed_loop.settings import CONTROLLER_FILE
from cosfly.closed_loop.stage import ClosedLoopConfig, EpisodeOpener, ListedEpisode, finish_episodes, fly_episodes
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.envs import episodes as benchmark
from cosfly.runtime.errors import InputError
from cosfly.runtime.pool import Watch
from cosfly.runtime.run_dir import StageFolder


class ListConfig(ClosedLoopConfig):
    """The settings of `cosfly fly --env`."""

    env: str  # environment and list, as in `read_list`


def run(cfg: ListConfig, out: Path, *, seed: int = 0, workers: int = 1, watch: Watch = Watch()) -> Path:
    """Fly each episode of a list; write `episodes/` and `score.json`. Return the output directory."""
    task, episodes, digest = benchmark.read_list(cfg.env)
    files = {"controller": CONTROLLER_FILE, "episodes": benchmark.EPISODES_FILE}
    stage = StageFolder.open(out, "fly", config=cfg, inputs={}, seed=seed, package_files=files)
    if not stage.is_complete:
        num_decisions = cfg.fly.most_decisions or benchmark.NUM_DECISIONS
        flown = [ListedEpisode(benchmark.episode_id(*episode), episode, num_decisions) for episode in episodes]
        # A worker opens one town at a time. But a model answers all towns as one batch.
        groups = [list(of_town) for _, of_town in groupby(flown, key=lambda listed: listed.argument[0])]
        num_open, num_workers = 1, workers
        if cfg.fly.asks_model:
            groups = [flown]
            num_open, num_workers = len(benchmark.HELD_OUT), 1
        start = partial(open_towns, task, num_open, num_decisions)
        fly_episodes(stage, cfg, groups, cfg.fly.batch, start, seed, num_workers, watch, digest)
        finish_episodes(stage, cfg.fly, seed, [listed.name for listed in flown])
    return out


def open_towns(task: str, num_open: int, num_decisions: int) -> EpisodeOpener:
    """Return the function that opens the episode of a town and trajectory; the last num_open renderers are kept."""

    @lru_cache(maxsize=num_open)
    def airspace_of(town: str) -> Airspace:
        return benchmark.world_of(benchmark.HELD_OUT[town]).airspace(task)

    def open_episode(key: tuple[str, int]) -> ClosedLoopTrajectory:
        town, number = key
        episode = benchmark.episode_of(task, benchmark.world_of(benchmark.HELD_OUT[town]), number)
        if episode is None:
            raise InputError(benchmark.UNSUITABLE, where=f"{task}: {town}, pedestrian trajectory {number}")
        episode = replace(episode, plan=episode.plan.until(episode.num_lead + num_decisions))
        return episode.simulation(airspace_of(town))

    return open_episode
