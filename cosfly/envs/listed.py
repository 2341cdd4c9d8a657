"""`cosfly fly --env`: a policy, or a student, through a fixed list of episodes, to the same records and score as
`cosfly fly` of walks of one's own.
"""

from __future__ import annotations

import os
from itertools import groupby
from pathlib import Path
from typing import Any

from caption.run.own_files import vocabulary_of
from cosfly.closed_loop.controller import CONTROLLER_FILE, read_controls
from cosfly.closed_loop.measures import score_pursuits
from cosfly.closed_loop.pilots import Pilot, open_pilot
from cosfly.closed_loop.stage import ANSWERS, FlightsConfig, begin_flight, fly_side_by_side
from cosfly.envs.episodes import EPISODES_FILE, HELD_OUT, NUM_DECISIONS, episode_id, episode_of, read_list, world_of
from cosfly.envs.policy import Policy
from cosfly.errors import InputError
from cosfly.products.flight_scores import SCORE, SCORE_FORMAT
from cosfly.products.pursuits import pursuit_file, read_pursuit
from cosfly.reading.files import sha256_file
from cosfly.work.config import Config
from cosfly.work.runner import Item, Outcome, Watch, Work, run_items
from cosfly.work.stage_folder import Resume, StageFolder
from cosfly.work.store import write_model


class ListConfig(Config):
    """What decides how a list is flown. env: as `read_list` takes it. policy: module:Class, None where fly.student
    decides."""

    flights: FlightsConfig
    env: str
    policy: str | None = None


def run(
    cfg: ListConfig, out: Path, *, seed: int = 0, workers: int = 1, watch: Watch = Watch(), resume: Resume = "if-same"
) -> Path:
    """Flies each episode of a list; writes `pursuits/` and `score.json`. Gives the folder.

    Raises:
        InputError: there is no such environment, list or policy. TeacherError: the student's engine cannot be used.
    """
    _, episodes, _ = read_list(cfg.env)
    package_files = {"controller": CONTROLLER_FILE, "episodes": EPISODES_FILE}
    stage = StageFolder.open(out, "fly", config=cfg, inputs={}, seed=seed, resume=resume, package_files=package_files)
    if stage.is_complete:
        return out
    if cfg.policy:
        Policy(cfg.policy, cfg.flights.fly.answer_limit_s, seed, str).close()  # tells what is wrong with it, at once
    num = 1 if not cfg.policy and cfg.flights.fly.asks_model else workers
    items = [
        Item(town, [number for _, number in walks], NUM_DECISIONS * len(walks))
        for town, walks in ((town, list(found)) for town, found in groupby(episodes, key=lambda one: one[0]))
    ]
    done = run_items(stage, items, make_worker, (cfg, stage.path, seed, num), workers=num, watch=watch)
    files = [pursuit_file(out, episode_id(*episode)) for episode in episodes]
    files = [path for path in files if path.exists()]
    if not files:
        raise stage.nothing_kept(done.tally)
    score = score_pursuits(map(read_pursuit, files), trained_on=cfg.flights.fly.trained_on, seed=seed)
    write_model(out / SCORE, score, SCORE_FORMAT)
    stage.finish([out / SCORE, *files], done.tally)
    return out


def make_worker(cfg: ListConfig, out: Path, seed: int, num: int) -> Work:
    """Give the function that flies the episodes of one town."""
    os.environ.setdefault("LP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // num)))
    fly, (task, _, digest) = cfg.flights.fly, read_list(cfg.env)
    goals: dict[str, str] = {}
    student: Pilot = (
        Policy(cfg.policy, fly.answer_limit_s, seed, goals.__getitem__)
        if cfg.policy
        else open_pilot(fly, cfg.flights.caption, cfg.flights.infer, seed, out / ANSWERS)
    )
    is_ceiling = not cfg.policy and fly.engine == "planner"  # which commands, and decides nothing
    controls = read_controls(CONTROLLER_FILE, vocabulary_of(cfg.flights.caption).actions.tokens)

    def work(item: Item) -> Outcome:
        world = world_of(HELD_OUT[item.item_id])
        space = world.airspace(task)
        about: dict[str, Any] = {
            "student": student.name, "engine": "policy" if cfg.policy else fly.engine, "town": space.town,
            "map_sha256": world.sha256, "seed": seed, "list_sha256": digest,
            "controller_sha256": None if is_ceiling else sha256_file(CONTROLLER_FILE),
        }  # fmt: skip
        flights = []
        for number in item.payload:
            name = episode_id(item.item_id, number)
            if pursuit_file(out, name).exists():  # of before a kill
                continue
            if (episode := episode_of(task, world, number)) is None:
                raise InputError("an episode that cannot be flown", where=f"{cfg.env}: {name}")
            flight = episode.flight(space)
            goals[name] = episode.goal(flight)
            flights.append(begin_flight(flight, controls, student.num_frames, name))
            if cfg.policy:
                fly_side_by_side(flights, student, out, about)
        fly_side_by_side(flights, student, out, about)
        space.renderer.close()
        return Outcome({"flights": len(item.payload)})

    return work
