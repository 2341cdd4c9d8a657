"""`cosfly fly`: a student after many walkers, several flights side by side.

A worker has one renderer and, where nobody else can be asked, one engine; an item of it is some flights, which it flies
in step: the frames of all that are open, then one batch to the student. A flight is on the disk once it has ended.
"""

from __future__ import annotations

import logging
import os
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from caption.schema import CaptionConfig
from cosfly.closed_loop.controller import Control, Controller, read_controls
from cosfly.closed_loop.measures import score_pursuits
from cosfly.closed_loop.pilots import Outlook, PilotAnswer, open_pilot
from cosfly.closed_loop.settings import FlyConfig
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, Moment, as_drawn
from cosfly.formats.boxes import read_boxes
from cosfly.formats.captions import TOKENS
from cosfly.formats.flight_scores import SCORE, SCORE_FORMAT
from cosfly.formats.pursuits import Pursuit, PursuitFrame, WalkStyle, pursuit_file, read_pursuit, write_pursuit
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.axes import headings_of, step_s
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
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.worker import Item, Outcome, Work, advance
from distill.inference.stage import InferConfig

log = logging.getLogger(__name__)

PLAN, TRACES, TREE, ANSWERS = "plan", "drone_trace.json", "render", "answers"
HALF_SEEN = 0.5  # of the five rays


class ClosedLoopConfig(Config):
    """All that decides what is flown."""

    fly: FlyConfig
    plan: PlanConfig
    render: RenderConfig
    caption: CaptionConfig
    infer: InferConfig


@dataclass
class OpenFlight:
    """A flight under way: the moments that its student may look at, and the records of all frames but the last."""

    episode: str
    flight: ClosedLoopTrajectory
    controller: Controller
    moments: deque[Moment]
    frames: list[PursuitFrame] = field(default_factory=list)

    @classmethod
    def begin(cls, episode: str, flight: ClosedLoopTrajectory, controls: dict[str, Control], num_frames: int) -> Self:
        """Begin an episode with what nobody is asked about."""
        plan, lead = flight.planned, flight.reset()
        begun = cls(episode, flight, Controller(controls, flight.drone, lead[-1]), deque(lead, num_frames))
        poses = np.hstack([plan.positions_m, plan.rotations_deg])
        between = np.empty((len(poses), 0, 6))
        flown = PlannedMotion(plan.time_s, poses, between, plan.rotations_deg[:, 1], plan.positions_m).action
        for moment, command in zip(lead[:-1], flown, strict=False):
            begun.note(moment, PilotAnswer("lead"), command, float(plan.clearances_m[moment.index]))
        return begun

    def note(self, moment: Moment, decision: PilotAnswer, command: np.ndarray | None, clearance_m: float) -> None:
        target = moment.target
        self.frames.append(PursuitFrame(
            time_s=moment.time_s, answer=decision.answer, action=decision.action, words=decision.words,
            answer_s=None if decision.answer_s is None else round(decision.answer_s, 4),
            command=None if command is None else tuple(np.round(command, 4).tolist()),
            in_view=target.in_view, visible=target.visible, visibility=target.visibility,
            num_pixels=target.num_pixels, distance_m=round(moment.distance_m, 4), height_m=round(moment.height_m, 4),
            clearance_m=round(clearance_m, 4), speed_mps=round(float(np.linalg.norm(moment.velocity_mps)), 4),
            pose=tuple(np.round([*moment.position_m, *moment.rotation_deg], 4).tolist()),
            target_m=tuple(np.round(moment.target_m, 4).tolist()),
        ))  # fmt: skip

    def step(self, decision: PilotAnswer) -> None:
        """Fly what was decided; what cannot be flown is the student's failure, and the drone hovers."""
        now, command = self.moments[-1], decision.command
        if command is not None and self.flight.drone.problem_of(command):
            decision, command = replace(decision, answer="invalid", action=None, command=None), None
        if command is None:
            command = self.controller.command(decision.action if decision.answer == "ok" else None, now)
        seen = self.flight.step(command)
        self.note(now, decision, command, seen.clearance_m)
        self.moments.append(seen)

    def record(self, about: dict[str, Any]) -> Pursuit:
        """End it; gives its record. about: what those of all flights say alike."""
        flight, plan, last = self.flight, self.flight.planned, self.moments[-1]
        camera = flight.script.cameras[0]
        self.note(last, PilotAnswer("end"), None, last.clearance_m)
        return Pursuit(
            **about, episode=self.episode, town=flight.airspace.town, walk=plan.path_id,
            style=style_of(plan, flight.num_lead - 1, flight.airspace.surroundings.obstacles), dt_s=flight.dt_s,
            camera_px=(camera.width_px, camera.height_px), fov_deg=camera.fov_deg,
            drone_radius_m=flight.drone.radius_m, ended=flight.ended, frames=tuple(self.frames),
            num_walk_frames=len(plan.time_s) - flight.num_lead,
        )  # fmt: skip


class Fleet:
    """The student of this process, which flies several flights side by side. Made before a renderer is opened."""

    def __init__(
        self, cfg: ClosedLoopConfig, out: Path, seed: int, num_workers: int, list_sha256: str | None = None
    ) -> None:
        os.environ.setdefault("LP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // num_workers)))
        self.out, self.student = out, open_pilot(cfg.fly, cfg.caption, cfg.infer, seed, out / ANSWERS)
        self.controls = read_controls(cfg.fly.table, TOKENS)
        self.about = {
            "student": self.student.name, "engine": cfg.fly.engine, "seed": seed, "list_sha256": list_sha256,
            "controller_sha256": None if cfg.fly.engine == "planner" else sha256_file(cfg.fly.table),
        }  # fmt: skip

    def fly(self, episodes: Mapping[str, Callable[[], ClosedLoopTrajectory]], map_sha256: str) -> Outcome:
        """Fly episodes to their ends, and write the record of each as it ends; those of before a kill stay."""
        waiting = {name: opened for name, opened in episodes.items() if not pursuit_file(self.out, name).exists()}
        how = self.controls, self.student.num_frames
        flights = [OpenFlight.begin(name, opened(), *how) for name, opened in waiting.items()]
        while flights:
            outlooks = [Outlook(one.episode, one.flight, tuple(one.moments)) for one in flights]
            for one, decision in zip(flights, self.student.decide(outlooks), strict=True):
                one.step(decision)
                advance()
            for one in [one for one in flights if one.flight.ended is not None]:
                write_pursuit(pursuit_file(self.out, one.episode), one.record(self.about | {"map_sha256": map_sha256}))
                flights.remove(one)
        return Outcome({"flights": list(episodes)})


def run(
    cfg: ClosedLoopConfig,
    boxes: Path,
    simplified: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 1,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
    others: Path | None = None,
) -> Path:
    """Reads a map as it is drawn and as it is flown in, walks and, where others move, `others.json`; writes `plan/`,
    with whose first frames each flight begins, `pursuits/`, the flown `drone_trace.json`, `score.json` and, if it is
    asked for, the playback tree `render/`. Gives the folder.

    Raises:
        ConfigError: settings that cannot be flown. InputError: a file is not what it must be. NothingKept: no walk has
            a plan. TeacherError: the student's engine cannot be used.
    """
    if cfg.render.frame_stride != 1:
        what, got = "a camera that cannot be flown with", "render.frame_stride beyond 1"
        raise ConfigError(what, where="render", got=got, fix="leave it out: every pose is drawn")
    read_controls(cfg.fly.table, TOKENS)
    how: dict[str, Any] = {"seed": seed, "workers": workers, "watch": watch, "resume": resume}
    inputs = {"boxes": boxes, "simplified": simplified, "paths": paths} | ({"others": others} if others else {})
    more: dict[str, Any] = {"package_files": {"controller": cfg.fly.table}, "begun": (PLAN, TREE)}
    stage = StageFolder.open(out, "fly", config=cfg, inputs=inputs, seed=seed, resume=resume, **more)
    if not stage.is_complete:
        plans = planning.run(cfg.plan, simplified, paths, out / PLAN, **how)
        _fly_all(stage, cfg, (boxes, simplified, plans, others), seed, workers, watch)
    if cfg.fly.tree:
        rendering.run(as_drawn(cfg.render, seed), boxes, simplified, out / TRACES, out / TREE, others=others, **how)
    return out


Inputs = tuple[Path, Path, Path, Path | None]


def _fly_all(stage: StageFolder, cfg: ClosedLoopConfig, inputs: Inputs, seed: int, workers: int, watch: Watch) -> None:
    traces, num = read_traces(inputs[2]), 1 if cfg.fly.asks_model else workers
    why_not = [trace.drop_reason or (len(trace.time_s) <= cfg.fly.lead_frames and "too_short") for trace in traces]
    numbers, dropped = [n for n, why in enumerate(why_not) if not why], Counter(why for why in why_not if why)
    if not numbers:
        expected = f"a plan of more than fly.lead_frames={cfg.fly.lead_frames} frames that is not dropped"
        raise stage.nothing_kept(Tally(input=len(traces), dropped=dropped), expected=expected)
    ordered = sorted(numbers, key=lambda n: (Airspace.area_of(traces[n].targets_m), n))
    items, most = [], min(cfg.fly.flock, -(-len(numbers) // num))
    for flock in [ordered[k : k + most] for k in range(0, len(ordered), most)]:
        steps = sum(len(_cut(traces[n], cfg.fly).time_s) - cfg.fly.lead_frames for n in flock)
        items.append(Item(f"{traces[flock[0]].path_id} and {len(flock) - 1}", flock, steps))
    run_items(stage, items, make_worker, (cfg, *inputs, stage.path, seed, num), workers=num, watch=watch)
    obstacles = obstacle_index(read_boxes(inputs[1]))
    finish_flights(stage, cfg.fly, seed, [traces[n].path_id for n in numbers], dropped, obstacles)


def finish_flights(
    stage: StageFolder,
    fly: FlyConfig,
    seed: int,
    episodes: Sequence[str],
    dropped: Counter[str] | None = None,
    obstacles: BoxIndex | None = None,
) -> None:
    """Write the score of the episodes that were flown and, of one map, `drone_trace.json`; and end the stage."""
    files = [path for name in episodes if (path := pursuit_file(stage.path, name)).exists()]
    dropped, failed = dropped or Counter(), +Counter({"flights": len(episodes) - len(files)})
    tally = Tally(input=len(episodes) + dropped.total(), kept=len(files), dropped=dropped, failed=failed)
    if not files:
        raise stage.nothing_kept(tally)
    outputs = [*files, stage.path / SCORE]
    if obstacles is not None:
        flown = [trace_of(read_pursuit(path), obstacles) for path in files]
        write_traces(stage.path / TRACES, flown, {"student": fly.student, "seed": seed})
        outputs.append(stage.path / TRACES)
    score = score_pursuits(map(read_pursuit, files), trained_on=fly.trained_on, seed=seed)
    write_model(stage.path / SCORE, score, SCORE_FORMAT)
    ended = Counter[str](flight.ended for flight in score.flights)
    decisions = sum(sum(flight.answers.values()) for flight in score.flights)
    stage.finish(outputs, tally, flown=dict(sorted(ended.items())) | {"decisions": decisions})
    log.info(
        "fly: %s: the person in view in %.1f %%, seen in %.1f %% of the walks; %s; %d decisions",
        fly.student, *(100 * (score.figures[name].value or 0.0) for name in ("in_picture", "in_view")),
        ", ".join(f"{count} {how}" for how, count in sorted(ended.items())), decisions,
    )  # fmt: skip


def make_worker(
    cfg: ClosedLoopConfig,
    boxes: Path,
    simplified: Path,
    plans: Path,
    others: Path | None,
    out: Path,
    seed: int,
    num: int,
) -> Work:
    """Open a renderer and a student in this process, and give the function that flies some flights side by side."""
    fleet, traces = Fleet(cfg, out, seed, num), read_traces(plans)
    companions = rendering.bystanders_by_path(others, traces)
    num_others = rendering.num_others_of(companions)
    space = Airspace(cfg.render, read_boxes(boxes), read_boxes(simplified), seed=seed, num_others=num_others)
    bounds: dict[str, Any] = {"num_lead": cfg.fly.lead_frames, "lost_s": cfg.fly.lost_s}
    map_sha256 = sha256_file(boxes)

    def opened(n: int) -> ClosedLoopTrajectory:
        bystanders = companions.get(traces[n].path_id)
        around = () if bystanders is None else bystanders.others
        return ClosedLoopTrajectory(space, _cut(traces[n], cfg.fly), number=n, **bounds, others=around)

    return lambda item: fleet.fly({traces[n].path_id: partial(opened, n) for n in item.payload}, map_sha256)


def _cut(trace: DroneTrace, cfg: FlyConfig) -> DroneTrace:
    """Return a plan as far as it is flown."""
    return trace.until(cfg.lead_frames + cfg.most_decisions) if cfg.most_decisions else trace


def style_of(plan: DroneTrace, start: int, obstacles: BoxIndex) -> WalkStyle:
    """Return how hard a walk is to follow; of its plan only the pose counts at which the student takes over."""
    headings = headings_of(plan.targets_m, plan.time_s)
    turn_rad = np.abs(np.diff(np.unwrap(headings))).sum()
    away = plan.positions_m[start] - plan.targets_m[start]
    back = np.stack([np.cos(headings), np.sin(headings)], axis=1) * -np.hypot(*away[:2])
    seen = visibility(obstacles, plan.targets_m + np.column_stack([back, np.full(len(back), away[2])]), plan.targets_m)
    turn_degps = float(np.degrees(turn_rad) / (plan.time_s[-1] - plan.time_s[0]))
    hidden_share = round(float((seen < HALF_SEEN).mean()), 4)
    return WalkStyle(pace=plan.pace, turn_degps=round(turn_degps, 4), hidden_share=hidden_share)


def trace_of(pursuit: Pursuit, obstacles: BoxIndex) -> DroneTrace:
    """Return what was flown as step 4 gives a plan, for `render` and `inspect`."""
    time_s = np.array([frame.time_s for frame in pursuit.frames])
    poses = np.array([frame.pose for frame in pursuit.frames])
    targets_m = np.array([frame.target_m for frame in pursuit.frames])
    clearances_m = np.array([frame.clearance_m for frame in pursuit.frames])
    ground_m = np.array([frame.pose[2] - frame.height_m for frame in pursuit.frames])
    return flown_trace(
        pursuit.walk, f"flown by {pursuit.student}", time_s, poses, targets_m, clearances_m, ground_m, obstacles,
        {"ended": pursuit.ended}, pursuit.style.pace,
    )  # fmt: skip


def flown_trace(
    path_id: str,
    planner: str,
    time_s: np.ndarray,
    poses: np.ndarray,
    targets_m: np.ndarray,
    clearances_m: np.ndarray,
    ground_m: np.ndarray,
    obstacles: BoxIndex,
    solver: dict,
    pace: str,
) -> DroneTrace:
    """Return a flight of n frames as step 4 gives a plan. poses: (n, 6); targets_m: (n, 3); others (n,)."""
    seen = visibility(obstacles, poses[:, :3], targets_m)
    metrics = trajectory_metrics(poses[:, :3], targets_m, seen, clearances_m, ground_m, step_s(time_s))
    return DroneTrace(
        path_id, planner, time_s, poses[:, :3], poses[:, 3:], targets_m, seen, clearances_m, metrics, solver, pace=pace
    )
