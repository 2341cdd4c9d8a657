"""`cosfly fly`: lets a student follow many pedestrians, several episodes at once.

A worker has one renderer and one engine. It flies the episodes of an item in step: the frames of all open episodes are
one batch to the student. An episode is on the disk once it has ended.
"""

import logging
import math
import os
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from caption.schema import CaptionConfig
from cosfly.closed_loop.controller import Control, Controller, read_controls
from cosfly.closed_loop.engines import EngineDecision, Observation, open_engine
from cosfly.closed_loop.measures import score_episodes
from cosfly.closed_loop.settings import CONTROLLER_FILE, FlyConfig
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, Moment, as_drawn
from cosfly.formats.boxes import read_boxes
from cosfly.formats.episodes import (
    SCORE,
    SCORE_FORMAT,
    Episode,
    EpisodeFrame,
    episode_file,
    read_episode,
    write_episode,
)
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.axes import step_s
from cosfly.geometry.kernels import BoxIndex, obstacle_index, visibility
from cosfly.geometry.motion import PlannedMotion
from cosfly.geometry.trajectory_metrics import trajectory_metrics
from cosfly.planners import stage as planning
from cosfly.planners.contract import PlanConfig
from cosfly.render import stage as rendering
from cosfly.render.settings import RenderConfig
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.json_io import write_model
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.runtime.worker import Item, Outcome, Work, advance
from distill.inference.samples import InferConfig

log = logging.getLogger(__name__)

EpisodeOpener = Callable[[Any], ClosedLoopTrajectory]
PLAN, TRACES, TREE, ANSWERS = "plan", "drone_trace.json", "render", "answers"
MOST_HANGS = 2  # workers that a policy may hang, in addition to one per finished item
STEP_S = 60.0  # for drawing a step, and for opening an episode


class ClosedLoopConfig(Config):
    """The settings of `cosfly fly` and of the stages that it uses."""

    fly: FlyConfig
    plan: PlanConfig
    render: RenderConfig
    caption: CaptionConfig
    infer: InferConfig


class OpenEpisode:
    """An episode in progress."""

    def __init__(
        self, episode: str, simulation: ClosedLoopTrajectory, controls: dict[str, Control], num_frames: int
    ) -> None:
        """Start an episode and record its lead frames."""
        plan = simulation.planned
        lead = simulation.reset()
        self.episode = episode
        self.simulation = simulation
        self.frames = list[EpisodeFrame]()  # the record so far
        self.controller = Controller(controls, simulation.drone, lead[-1])
        self.moments = deque(lead, num_frames)  # as many as the student sees
        poses = np.hstack([plan.positions_m, plan.rotations_deg])
        motion = PlannedMotion(plan.time_s, poses, plan.rotations_deg[:, 1], plan.positions_m)
        for moment, command in zip(lead[:-1], motion.action, strict=False):
            self.note(moment, EngineDecision("lead"), command, float(plan.clearances_m[moment.index]))

    def note(self, moment: Moment, decision: EngineDecision, command: np.ndarray | None, clearance_m: float) -> None:
        """Record a frame."""
        target = moment.target
        self.frames.append(EpisodeFrame(
            time_s=moment.time_s, answer=decision.answer, action=decision.action, words=decision.words,
            answer_s=None if decision.answer_s is None else round(decision.answer_s, 4),
            command=None if command is None else tuple(np.round(command, 4).tolist()),
            in_view=target.in_view, visible=target.visible, visibility=target.visibility,
            num_pixels=target.num_pixels, distance_m=round(moment.distance_m, 4), height_m=round(moment.height_m, 4),
            clearance_m=round(clearance_m, 4), speed_mps=round(float(np.linalg.norm(moment.velocity_mps)), 4),
            pose=tuple(np.round([*moment.position_m, *moment.rotation_deg], 4).tolist()),
            target_m=tuple(np.round(moment.target_m, 4).tolist()),
        ))  # fmt: skip

    def step(self, decision: EngineDecision) -> None:
        """Fly a decision; an invalid command counts as the student's failure, and the drone hovers."""
        now = self.moments[-1]
        command = decision.command
        if command is not None and self.simulation.drone.problem_of(command):
            decision = replace(decision, answer="invalid", action=None, command=None)
            command = None
        if command is None:
            command = self.controller.command(decision.action if decision.answer == "ok" else None, now)
        reached = self.simulation.step(command)
        self.note(now, decision, command, reached.clearance_m)
        self.moments.append(reached)

    def record(self, shared: dict[str, Any]) -> Episode:
        """Record the last frame and return the record. shared: fields that all episodes have in common."""
        simulation = self.simulation
        plan = simulation.planned
        last = self.moments[-1]
        camera = simulation.script.cameras[0]
        self.note(last, EngineDecision("end"), None, last.clearance_m)
        return Episode(
            **shared, episode=self.episode, town=simulation.airspace.town, map_sha256=simulation.airspace.map_sha256,
            walk=plan.path_id, pace=plan.pace, dt_s=simulation.dt_s, camera_px=(camera.width_px, camera.height_px),
            fov_deg=camera.fov_deg,
            drone_radius_m=simulation.drone.radius_m, ended=simulation.ended, frames=tuple(self.frames),
            num_walk_frames=len(plan.time_s) - simulation.num_lead,
        )  # fmt: skip


def run(
    cfg: ClosedLoopConfig, boxes: Path, simplified: Path, paths: Path, out: Path, *, seed: int = 0, workers: int = 1,
    watch: Watch = Watch(), others: Path | None = None,
) -> Path:  # fmt: skip
    """Read a map, its obstacles, pedestrian trajectories and bystanders; write `plan/`, `episodes/`, the flown
    `drone_trace.json`, `score.json` and, if set, the playback tree `render/`. Return the output directory.
    """
    if cfg.render.frame_stride != 1:
        raise ConfigError(
            "an episode renders every frame, so render.frame_stride must be 1",
            where="render",
            got=f"render.frame_stride={cfg.render.frame_stride}",
            fix="remove the setting render.frame_stride",
        )
    common: dict[str, Any] = {"seed": seed, "workers": workers, "watch": watch}
    inputs = {"boxes": boxes, "simplified": simplified, "paths": paths} | ({"others": others} if others else {})
    stage = StageFolder.open(
        out, "fly", config=cfg, inputs=inputs, seed=seed, package_files={"controller": CONTROLLER_FILE},
        begun=(PLAN, TREE),
    )  # fmt: skip
    if not stage.is_complete:
        plans = planning.run(cfg.plan, simplified, paths, out / PLAN, **common)
        num_workers = 1 if cfg.fly.asks_model else workers
        traces = read_traces(plans)
        num_lead = cfg.fly.lead_frames
        reasons = [trace.drop_reason or ("too_short" if len(trace.time_s) <= num_lead else None) for trace in traces]
        flown = [n for n, reason in enumerate(reasons) if reason is None]
        dropped = Counter(reason for reason in reasons if reason is not None)
        if not flown:
            expected = f"at least one accepted trajectory of more than {num_lead} frames (fly.lead_frames)"
            raise stage.nothing_kept(Tally(input=len(traces), dropped=dropped), expected=expected)
        # Neighbours in one batch share the lit area of the renderer.
        ordered = sorted(flown, key=lambda n: (Airspace.area_of(traces[n].targets_m), n))
        num_frames = {n: len(_cut(traces[n], cfg.fly).time_s) for n in flown}
        episodes = [ListedEpisode(traces[n].path_id, n, num_frames[n] - num_lead) for n in ordered]
        batch = min(cfg.fly.batch, math.ceil(len(flown) / num_workers))
        start = partial(open_map, cfg, seed, boxes, simplified, plans, others)
        fly_episodes(stage, cfg, [episodes], batch, start, seed, num_workers, watch)
        names = [traces[n].path_id for n in flown]
        finish_episodes(stage, cfg.fly, seed, names, dropped, obstacle_index(read_boxes(simplified)))
    if cfg.fly.tree:
        rendering.run(as_drawn(cfg.render, seed), boxes, simplified, out / TRACES, out / TREE, others=others, **common)
    return out


class ListedEpisode(NamedTuple):
    """An episode to fly."""

    name: str
    argument: Any  # of the EpisodeOpener
    num_steps: int


def fly_episodes(
    stage: StageFolder, cfg: ClosedLoopConfig, groups: Sequence[Sequence[ListedEpisode]], batch: int,
    start: Callable[[], EpisodeOpener], seed: int, num_workers: int, watch: Watch, list_sha256: str | None = None,
) -> None:  # fmt: skip
    """Fly episodes to their ends and write each record; episodes with a record are skipped.

    Args:
        groups: Episodes that may be in one batch.
        batch: Number of episodes that a worker flies at once.
        start: A partial of a module-level function, which a worker calls once to get its EpisodeOpener.
    """
    items = []
    for group in groups:
        for begin in range(0, len(group), batch):
            episodes = group[begin : begin + batch]
            payload = {episode.name: episode.argument for episode in episodes}
            num_steps = sum(episode.num_steps for episode in episodes)
            items.append(Item(f"{episodes[0].name} and {len(episodes) - 1}", payload, num_steps))
    worker_args = (cfg, start, stage.path, seed, num_workers, list_sha256)
    watch = watch_of(cfg.fly, watch)
    run_items(stage, items, make_worker, worker_args, workers=num_workers, watch=watch, label="fly: decisions")


def make_worker(
    cfg: ClosedLoopConfig, start: Callable[[], EpisodeOpener], out: Path, seed: int, num_workers: int,
    list_sha256: str | None,
) -> Work:  # fmt: skip
    """Open an engine in this process, then a renderer; return the function that flies the episodes of an item."""
    os.environ.setdefault("LP_NUM_THREADS", str(max(1, num_cpus() // num_workers)))
    engine = open_engine(cfg.fly, cfg.caption, cfg.infer, seed, out / ANSWERS)
    controls = read_controls()
    shared = {  # fields of every record
        "student": engine.name, "engine": cfg.fly.engine, "seed": seed, "list_sha256": list_sha256,
        "controller_sha256": None if cfg.fly.engine == "planner" else sha256_file(CONTROLLER_FILE),
    }  # fmt: skip
    open_episode = start()

    def work(item: Item) -> Outcome:
        active = [
            OpenEpisode(name, open_episode(argument), controls, engine.num_frames)
            for name, argument in item.payload.items()
            if not episode_file(out, name).exists()
        ]
        while active:
            observations = [
                Observation(episode.episode, episode.simulation, tuple(episode.moments)) for episode in active
            ]
            for episode, decision in zip(active, engine.decide(observations), strict=True):
                episode.step(decision)
                advance()
                if episode.simulation.ended is not None:
                    write_episode(episode_file(out, episode.episode), episode.record(shared))
            active = [episode for episode in active if episode.simulation.ended is None]
        return Outcome({"flights": list(item.payload)})

    return work


def watch_of(fly: FlyConfig, watch: Watch) -> Watch:
    """Return the limits of workers: one whose policy Python cannot interrupt is stopped, and its episode has failed."""
    if fly.engine != "policy":
        return watch
    limit_s = fly.answer_limit_s + STEP_S if watch.item_limit_s is None else watch.item_limit_s
    return replace(watch, item_limit_s=limit_s, retries=0, restarts=MOST_HANGS)


def finish_episodes(
    stage: StageFolder, fly: FlyConfig, seed: int, episodes: Sequence[str],
    dropped: Counter[str] | None = None, obstacles: BoxIndex | None = None,
) -> None:  # fmt: skip
    """Write the score of the flown episodes and, with the obstacles of one map, `drone_trace.json`; end the stage."""
    files = [path for name in episodes if (path := episode_file(stage.path, name)).exists()]
    dropped = dropped or Counter()
    failed = +Counter({"flights": len(episodes) - len(files)})  # + removes a count of 0
    tally = Tally(input=len(episodes) + dropped.total(), kept=len(files), dropped=dropped, failed=failed)
    if not files:
        raise stage.nothing_kept(tally)
    outputs = [*files, stage.path / SCORE]
    if obstacles is not None:
        flown = [trace_of(read_episode(path), obstacles) for path in files]
        write_traces(stage.path / TRACES, flown, {"student": fly.student, "seed": seed})
        outputs.append(stage.path / TRACES)
    score = score_episodes(map(read_episode, files), seed=seed, most_decisions=fly.most_decisions)
    write_model(stage.path / SCORE, score, SCORE_FORMAT)
    ended = Counter[str](episode.ended for episode in score.flights)
    decisions = sum(sum(episode.answers.values()) for episode in score.flights)
    stage.finish(outputs, tally, flown=dict(sorted(ended.items())) | {"decisions": decisions})
    log.info(
        "fly: %s: target in the picture in %.1f %%, visible in %.1f %% of the frames; %s; %d decisions%s; see %s",
        fly.student, *(100 * (score.figures[name].value or 0.0) for name in ("in_view", "visible")),
        ", ".join(f"{count} {end}" for end, count in sorted(ended.items())), decisions,
        f" (episodes shortened by fly.most_decisions={fly.most_decisions})" if score.most_decisions else "",
        stage.path / SCORE,
    )  # fmt: skip


def open_map(
    cfg: ClosedLoopConfig, seed: int, boxes: Path, simplified: Path, plans: Path, others: Path | None
) -> EpisodeOpener:
    """Open a renderer of a map in this process; return the function that opens the episode of a plan's index."""
    traces = read_traces(plans)
    bystanders, num_others = rendering.bystanders_of(others, traces)
    airspace = Airspace(
        cfg.render, read_boxes(boxes), read_boxes(simplified), map_sha256=sha256_file(boxes), seed=seed,
        num_others=num_others,
    )  # fmt: skip

    def open_episode(n: int) -> ClosedLoopTrajectory:
        plan = _cut(traces[n], cfg.fly)
        others = [bystander.until(len(plan.time_s)) for bystander in bystanders.get(plan.path_id, ())]
        return ClosedLoopTrajectory(
            airspace, plan, number=n, num_lead=cfg.fly.lead_frames, lost_s=cfg.fly.lost_s, others=others
        )

    return open_episode


def _cut(trace: DroneTrace, cfg: FlyConfig) -> DroneTrace:
    """Return the part of a plan that is flown."""
    return trace.until(cfg.lead_frames + cfg.most_decisions) if cfg.most_decisions else trace


def trace_of(record: Episode, obstacles: BoxIndex) -> DroneTrace:
    """Return a flown episode as a drone trajectory, for `render` and `inspect`."""
    frames = record.frames
    return flown_trace(
        obstacles, time_s=np.array([frame.time_s for frame in frames]),
        poses=np.array([frame.pose for frame in frames]), targets_m=np.array([frame.target_m for frame in frames]),
        clearances_m=np.array([frame.clearance_m for frame in frames]),
        ground_m=np.array([frame.pose[2] - frame.height_m for frame in frames]), path_id=record.walk,
        planner=f"flown by {record.student}", solver={"ended": record.ended}, pace=record.pace,
    )  # fmt: skip


def flown_trace(
    obstacles: BoxIndex, time_s: np.ndarray, poses: np.ndarray, targets_m: np.ndarray, clearances_m: np.ndarray,
    ground_m: np.ndarray, **fields: Any,
) -> DroneTrace:  # fmt: skip
    """Return n flown frames as a drone trajectory.

    Args:
        poses: (n, 6) position in m and rotation in degrees.
        targets_m: (n, 3). The other arrays are (n,).
        fields: Further fields of the trajectory.
    """
    seen = visibility(obstacles, poses[:, :3], targets_m)
    metrics = trajectory_metrics(poses[:, :3], targets_m, seen, clearances_m, ground_m, step_s(time_s))
    return DroneTrace(
        time_s=time_s, positions_m=poses[:, :3], rotations_deg=poses[:, 3:], targets_m=targets_m, visibility=seen,
        clearances_m=clearances_m, metrics=metrics, **fields,
    )  # fmt: skip
