"""`cosfly fly`: a student after many walkers, several flights side by side.

A worker has one renderer and, where nobody else can be asked, one engine; an item of it is some flights, which it flies
in step: the frames of all that are open, then one batch to the student. A flight is on the disk once it has ended.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from caption.run.own_files import vocabulary_of
from caption.schema import CaptionConfig
from cosfly.closed_loop.controller import CONTROLLER_FILE, Control, Controller, read_controls
from cosfly.closed_loop.measures import score_pursuits
from cosfly.closed_loop.pilots import Outlook, Pilot, PilotAnswer, open_pilot
from cosfly.closed_loop.settings import FlyConfig
from cosfly.closed_loop.stepper import Airspace, ClosedLoopFlight, Moment, as_drawn
from cosfly.errors import ConfigError
from cosfly.geometry import headings_of, step_s
from cosfly.planners import stage as planning
from cosfly.planners.contract import PlanConfig
from cosfly.products.boxes import read_boxes
from cosfly.products.flight_scores import SCORE, SCORE_FORMAT
from cosfly.products.motion import PlannedMotion
from cosfly.products.pursuits import Pursuit, PursuitFrame, WalkStyle, pursuit_file, read_pursuit, write_pursuit
from cosfly.products.traces import ARRAYS, DroneTrace, read_traces, write_traces
from cosfly.reading.files import sha256_file
from cosfly.render import stage as rendering
from cosfly.render.settings import RenderConfig
from cosfly.space.flight_metrics import flight_metrics
from cosfly.space.kernels import BoxIndex, obstacle_index, visibility
from cosfly.work.config import Config
from cosfly.work.runner import Item, Outcome, Watch, Work, advance, run_items
from cosfly.work.stage_folder import Kept, Resume, StageFolder, Tally
from cosfly.work.store import write_model
from distill.inference.stage import InferConfig

log = logging.getLogger(__name__)

PLAN, TRACES, TREE, ANSWERS = "plan", "drone_trace.json", "render", "answers"
HALF_SEEN = 0.5  # of the five rays


class FlightsConfig(Config):
    """All that decides what is flown."""

    fly: FlyConfig
    plan: PlanConfig
    render: RenderConfig
    caption: CaptionConfig
    infer: InferConfig


@dataclass
class OpenFlight:
    """A flight under way: the moments that its student may look at, and all frames' records, but for clearances."""

    episode: str
    flight: ClosedLoopFlight
    controller: Controller
    moments: deque[Moment]
    frames: list[dict] = field(default_factory=list)

    def note(self, moment: Moment, decision: PilotAnswer, command: np.ndarray | None) -> None:
        target = moment.target
        self.frames.append({
            "time_s": moment.time_s, "answer": decision.answer, "action": decision.action, "words": decision.words,
            "answer_s": None if decision.answer_s is None else round(decision.answer_s, 4),
            "command": None if command is None else tuple(np.round(command, 4).tolist()),
            "in_view": target.in_view, "visible": target.visible, "visibility": target.visibility,
            "num_pixels": target.num_pixels, "distance_m": round(moment.distance_m, 4),
            "height_m": round(moment.height_m, 4),
            "speed_mps": round(float(np.linalg.norm(moment.velocity_mps)), 4),
            "pose": tuple(np.round([*moment.position_m, *moment.rotation_deg], 4).tolist()),
            "target_m": tuple(np.round(moment.target_m, 4).tolist()),
        })  # fmt: skip

    def step(self, decision: PilotAnswer) -> None:
        """Fly what was decided; what cannot be flown is the student's failure, and the drone hovers."""
        now, command = self.moments[-1], decision.command
        if command is not None and self.flight.drone.problem_of(command):
            decision, command = replace(decision, answer="invalid", action=None, command=None), None
        if command is None:
            command = self.controller.command(decision.action if decision.answer == "ok" else None, now)
        self.note(now, decision, command)
        self.moments.append(self.flight.step(command))
        if self.flight.ended is not None:
            self.note(self.moments[-1], PilotAnswer("end"), None)


def run(
    cfg: FlightsConfig,
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
    if cfg.render.effects.is_on or cfg.render.frame_stride != 1:
        what, got = "a camera that cannot be flown with", "render.effects, or render.frame_stride beyond 1"
        raise ConfigError(what, where="render", got=got, fix="leave them out: frames are drawn plain, each pose")
    table = cfg.fly.controller or CONTROLLER_FILE
    read_controls(table, vocabulary_of(cfg.caption).actions.tokens)
    how: dict[str, Any] = {"seed": seed, "workers": workers, "watch": watch, "resume": resume}
    inputs = {"boxes": boxes, "simplified": simplified, "paths": paths} | ({"others": others} if others else {})
    begun = (PLAN, TREE)
    stage = StageFolder.open(
        out,
        "fly",
        config=cfg,
        inputs=inputs,
        seed=seed,
        resume=resume,
        package_files={"controller": table},
        begun=begun,
    )
    if not stage.is_complete:
        plans = planning.run(cfg.plan, simplified, paths, out / PLAN, **how)
        _fly_all(stage, cfg, (boxes, simplified, plans, others), seed, workers, watch)
    if cfg.fly.tree:
        rendering.run(as_drawn(cfg.render, seed), boxes, simplified, out / TRACES, out / TREE, others=others, **how)
    return out


Inputs = tuple[Path, Path, Path, Path | None]


def _fly_all(stage: StageFolder, cfg: FlightsConfig, inputs: Inputs, seed: int, workers: int, watch: Watch) -> None:
    traces = read_traces(inputs[2])
    numbers = [
        n for n, trace in enumerate(traces) if trace.drop_reason is None and len(trace.time_s) > cfg.fly.lead_frames
    ]
    left_out = [trace for n, trace in enumerate(traces) if n not in numbers]
    dropped = Counter(trace.drop_reason or "too_short" for trace in left_out)
    if not numbers:
        expected = f"a plan of more than fly.lead_frames={cfg.fly.lead_frames} frames that is not dropped"
        raise stage.nothing_kept(Tally(input=len(traces), dropped=dropped), expected=expected)
    lit = {n: Airspace.area_of(traces[n].targets_m) for n in numbers}
    num = 1 if cfg.fly.asks_model else workers
    ordered, most = sorted(numbers, key=lambda n: (lit[n], n)), min(cfg.fly.side_by_side, -(-len(numbers) // num))
    flocks = [ordered[k : k + most] for k in range(0, len(ordered), most)]
    steps = [sum(len(_cut(traces[n], cfg.fly).time_s) - cfg.fly.lead_frames for n in flock) for flock in flocks]
    items = [Item(f"{traces[f[0]].path_id} and {len(f) - 1}", f, steps[k]) for k, f in enumerate(flocks)]
    begun_s = time.monotonic()
    done = run_items(stage, items, make_worker, (cfg, *inputs, stage.path, seed, num), workers=num, watch=watch)
    seconds = time.monotonic() - begun_s
    flown = [
        n for item, record in zip(items, done.records, strict=True) if isinstance(record, Kept) for n in item.payload
    ]
    files = [pursuit_file(stage.path, traces[n].path_id) for n in sorted(flown)]
    obstacles, facts = obstacle_index(read_boxes(inputs[1])), Counter[str]()
    written = []
    for path in files:
        pursuit = read_pursuit(path)
        written.append(trace_of(pursuit, obstacles))
        facts.update({pursuit.ended: 1, "frames": pursuit.num_walk_frames, "decisions": len(pursuit.decisions)})
        facts["in_view"] += sum(frame.in_view for frame in pursuit.flown)
        facts["seen"] += sum(frame.visible for frame in pursuit.flown)
    lost = Counter({"flights": len(numbers) - len(flown)} if len(flown) < len(numbers) else {})
    tally = Tally(input=len(traces), kept=len(flown), dropped=dropped, failed=lost)
    if not files:
        raise stage.nothing_kept(tally)
    write_traces(stage.path / TRACES, written, {"student": cfg.fly.student, "seed": seed})
    score = score_pursuits(map(read_pursuit, files), trained_on=cfg.fly.trained_on, seed=seed)
    write_model(stage.path / SCORE, score, SCORE_FORMAT)
    files.append(stage.path / SCORE)
    stage.finish([stage.path / TRACES, *files], tally, flown=dict(sorted(facts.items())))
    log.info(
        "fly: %s: the person in view in %.1f %%, seen in %.1f %% of %d frames; %s; %.1f decisions/s",
        cfg.fly.student, 100 * facts["in_view"] / facts["frames"], 100 * facts["seen"] / facts["frames"],
        facts["frames"], ", ".join(f"{facts[how]} {how}" for how in ("finished", "crashed", "lost", "left")),
        facts["decisions"] / max(seconds, 1e-9),
    )  # fmt: skip


def make_worker(
    cfg: FlightsConfig, boxes: Path, simplified: Path, plans: Path, others: Path | None, out: Path, seed: int, num: int
) -> Work:
    """Open a renderer and a student in this process, and give the function that flies some flights side by side."""
    os.environ.setdefault("LP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // num)))
    traces = read_traces(plans)
    companies = rendering.companies_of(others, traces)
    num_others = rendering.num_others_of(companies)
    space = Airspace(cfg.render, read_boxes(boxes), read_boxes(simplified), seed=seed, num_others=num_others)
    student = open_pilot(cfg.fly, cfg.caption, cfg.infer, seed, out / ANSWERS)
    table = cfg.fly.controller or CONTROLLER_FILE
    controls = read_controls(table, vocabulary_of(cfg.caption).actions.tokens)
    about = {
        "student": student.name, "engine": cfg.fly.engine, "town": space.town, "map_sha256": sha256_file(boxes),
        "seed": seed, "controller_sha256": None if cfg.fly.engine == "planner" else sha256_file(table),
    }  # fmt: skip

    bounds: dict[str, Any] = {"num_lead": cfg.fly.lead_frames, "drone": cfg.fly.drone, "lost_s": cfg.fly.lost_s}

    def work(item: Item) -> Outcome:
        flights = list[OpenFlight]()
        for n in item.payload:
            if not pursuit_file(out, traces[n].path_id).exists():  # else of before a kill
                company, plan = companies.get(traces[n].path_id), _cut(traces[n], cfg.fly)
                others = () if company is None else company.others
                flight = ClosedLoopFlight(space, plan, number=n, **bounds, others=others)
                flights.append(begin_flight(flight, controls, student.num_frames, plan.path_id))
        fly_side_by_side(flights, student, out, about)
        return Outcome({"flights": [traces[n].path_id for n in item.payload]})

    return work


def fly_side_by_side(flights: list[OpenFlight], student: Pilot, out: Path, about: dict[str, Any]) -> None:
    """Fly flights to their ends, and write the record of each as it ends. about: what their records say alike."""
    while flights:
        outlooks = [Outlook(one.episode, one.flight, tuple(one.moments)) for one in flights]
        for one, decision in zip(flights, student.decide(outlooks), strict=True):
            one.step(decision)
            advance()
        for one in [one for one in flights if one.flight.ended is not None]:
            write_pursuit(pursuit_file(out, one.episode), _record(one, about))
            flights.remove(one)


def _cut(trace: DroneTrace, cfg: FlyConfig) -> DroneTrace:
    """Give a plan as far as it is flown."""
    end = cfg.lead_frames + cfg.most_decisions if cfg.most_decisions else len(trace.time_s)
    return replace(trace, **{name: getattr(trace, name)[:end] for name in (*ARRAYS, "clearances_m")})


def begin_flight(flight: ClosedLoopFlight, controls: dict[str, Control], num_frames: int, episode: str) -> OpenFlight:
    """Begin an episode with what nobody is asked about."""
    plan = flight.planned
    lead = flight.reset()
    begun = OpenFlight(episode, flight, Controller(controls, flight.drone, lead[-1]), deque(lead, num_frames))
    poses = np.hstack([plan.positions_m, plan.rotations_deg])
    between = np.empty((len(poses), 0, 6))
    flown = PlannedMotion(plan.time_s, poses, between, plan.rotations_deg[:, 1], plan.positions_m).action
    for moment, command in zip(lead[:-1], flown, strict=False):
        begun.note(moment, PilotAnswer("lead"), command)
    return begun


def _record(one: OpenFlight, about: dict) -> Pursuit:
    flight, plan = one.flight, one.flight.planned
    obstacles = flight.airspace.surroundings.obstacles
    gaps = np.round(flight.poses.clearances_m, 4).tolist()
    frames = [PursuitFrame(**frame, clearance_m=gap) for frame, gap in zip(one.frames, gaps, strict=False)]
    return Pursuit(
        **about, episode=one.episode, walk=plan.path_id, style=style_of(plan, flight.num_lead - 1, obstacles),
        dt_s=flight.dt_s, camera_px=(flight.camera.width_px, flight.camera.height_px), fov_deg=flight.camera.fov_deg,
        drone_radius_m=flight.drone.radius_m, ended=flight.ended, num_walk_frames=len(plan.time_s) - flight.num_lead,
        frames=tuple(frames),
    )  # fmt: skip


def style_of(plan: DroneTrace, start: int, obstacles: BoxIndex) -> WalkStyle:
    """Tell how hard a walk is to follow; of its plan only the pose counts at which the student takes over."""
    headings = headings_of(plan.targets_m, plan.time_s)
    turn_rad = np.abs(np.diff(np.unwrap(headings))).sum()
    away = plan.positions_m[start] - plan.targets_m[start]
    back = np.stack([np.cos(headings), np.sin(headings)], axis=1) * -np.hypot(*away[:2])
    seen = visibility(obstacles, plan.targets_m + np.column_stack([back, np.full(len(back), away[2])]), plan.targets_m)
    turn_degps = float(np.degrees(turn_rad) / (plan.time_s[-1] - plan.time_s[0]))
    hidden_share = round(float((seen < HALF_SEEN).mean()), 4)
    return WalkStyle(pace=plan.pace, turn_degps=round(turn_degps, 4), hidden_share=hidden_share)


def trace_of(pursuit: Pursuit, obstacles: BoxIndex) -> DroneTrace:
    """Give what was flown as step 4 gives a plan, for `render` and `inspect`."""
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
    """Give a flight of n frames as step 4 gives a plan. poses: (n, 6); targets_m: (n, 3); others (n,)."""
    seen = visibility(obstacles, poses[:, :3], targets_m)
    metrics = flight_metrics(poses[:, :3], targets_m, seen, clearances_m, ground_m, step_s(time_s))
    return DroneTrace(
        path_id, planner, time_s, poses[:, :3], poses[:, 3:], targets_m, seen, clearances_m, metrics, solver, pace=pace
    )
