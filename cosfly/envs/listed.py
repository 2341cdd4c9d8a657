"""`cosfly fly --env`: a policy, or another student, through a fixed list of episodes, to the same records and score as
`cosfly fly` of walks of one's own.
"""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path

from cosfly.closed_loop.stage import ClosedLoopConfig, Fleet, finish_flights
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.envs.episodes import (
    EPISODES_FILE,
    HELD_OUT,
    NUM_DECISIONS,
    BenchmarkWorld,
    episode_id,
    episode_of,
    read_list,
    world_of,
)
from cosfly.runtime.errors import InputError
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder
from cosfly.runtime.worker import Item, Outcome, Work


class ListConfig(ClosedLoopConfig):
    """What decides how a list is flown. env: as `read_list` takes it."""

    env: str


def run(
    cfg: ListConfig, out: Path, *, seed: int = 0, workers: int = 1, watch: Watch = Watch(), resume: Resume = "if-same"
) -> Path:
    """Flies each episode of a list; writes `pursuits/` and `score.json`. Gives the folder.

    Raises:
        InputError: there is no such environment, list or policy. TeacherError: the student's engine cannot be used.
    """
    _, episodes, _ = read_list(cfg.env)
    files = {"controller": cfg.fly.table, "episodes": EPISODES_FILE}
    stage = StageFolder.open(out, "fly", config=cfg, inputs={}, seed=seed, resume=resume, package_files=files)
    if not stage.is_complete:
        num, items = 1 if cfg.fly.asks_model else workers, []
        for town, walks in groupby(episodes, key=lambda one: one[0]):
            numbers = [number for _, number in walks]
            flocks = [numbers[k : k + cfg.fly.flock] for k in range(0, len(numbers), cfg.fly.flock)]
            items += [Item(f"{town} {one[0]}", (town, one), NUM_DECISIONS * len(one)) for one in flocks]
        run_items(stage, items, make_worker, (cfg, stage.path, seed, num), workers=num, watch=watch)
        finish_flights(stage, cfg.fly, seed, [episode_id(*episode) for episode in episodes])
    return out


def make_worker(cfg: ListConfig, out: Path, seed: int, num: int) -> Work:
    """Return the function that flies some episodes of a town."""
    task, _, digest = read_list(cfg.env)
    fleet = Fleet(cfg, out, seed, num, list_sha256=digest)

    @lru_cache(maxsize=1)
    def place_of(town: str) -> tuple[BenchmarkWorld, Airspace]:
        world = world_of(HELD_OUT[town])
        return world, world.airspace(task)

    def opened(town: str, number: int) -> ClosedLoopTrajectory:
        world, space = place_of(town)
        if (episode := episode_of(task, world, number)) is None:
            raise InputError("an episode that cannot be flown", where=f"{cfg.env}: {episode_id(town, number)}")
        return episode.flight(space)

    def work(item: Item) -> Outcome:
        town, numbers = item.payload
        flights = {episode_id(town, number): partial(opened, town, number) for number in numbers}
        return fleet.fly(flights, place_of(town)[0].sha256)

    return work
