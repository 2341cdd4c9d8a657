"""`cosfly fly --relabel`, DAgger's data (Ross, Gordon and Bagnell 2011): what the planner does from where a student
led itself.

The planner knows the whole walk: it plans anew from the pose and the velocity that the student had reached, and
that plan is flown as the ceiling flies (`pilots.Ceiling`). A decision is a mistake where it is ruled out by that
motion, or where the student was about to lose the person; the others are kept too, unless the settings say otherwise.
Each is a short flight: the student's observed frames, then the planner's, with the teacher's captions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from caption.run import stage as captioning
from caption.schema import FutureMotion
from caption.truth.actions import TABLE, measure
from cosfly.closed_loop.measures import LOSS_S
from cosfly.closed_loop.pilots import Ceiling
from cosfly.closed_loop.stage import PLAN, TRACES, TREE, ClosedLoopConfig, flown_trace
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, as_drawn
from cosfly.formats.boxes import read_boxes
from cosfly.formats.flight_scores import read_score
from cosfly.formats.pursuits import Pursuit, PursuitFrame, pursuit_file, read_pursuit
from cosfly.formats.traces import ARRAYS, DroneTrace, Excerpt, read_traces, write_traces
from cosfly.geometry.axes import look_at, step_s
from cosfly.geometry.kernels import signed_distances, swept_distances
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_on
from cosfly.render import stage as rendering
from cosfly.runtime.errors import ConfigError, InputError, NoPathError
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, flattened, read_stage_record
from cosfly.runtime.worker import Item, Outcome, Work, advance

CAPTIONS = "caption"


def run(
    cfg: ClosedLoopConfig,
    flown: Path,
    boxes: Path,
    simplified: Path,
    out: Path,
    *,
    workers: int = 1,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Reads a folder of `cosfly fly` and its map; writes `drone_trace.json`, the playback tree `render/` of what the
    planner does from where the student was, and the teacher's `caption/` of it. Gives the folder.

    Raises:
        InputError: a file is not what it must be. ConfigError: another planner than foresight, or pictures that
            are not what the student saw. NothingKept: nothing can be learnt from it.
    """
    inputs = {"flown": flown, "boxes": boxes, "simplified": simplified}
    seed = _seed_of(flown, cfg)
    planners = {plan.planner for plan in read_traces(flown / PLAN / TRACES)} | {cfg.plan.planner}
    if planners != {"foresight"}:
        what, where = "foresight alone plans on from where a drone is", f"plan.planner, and {flown / PLAN}"
        raise ConfigError(what, where=where, got=", ".join(sorted(planners)), fix="fly with plan.planner=foresight")
    stage = StageFolder.open(
        out, "relabel", config=cfg, inputs=inputs, seed=seed, resume=resume, begun=(TREE, CAPTIONS)
    )
    if not stage.is_complete:
        items = []
        for episode in sorted(flight.episode for flight in read_score(flown).flights):
            pursuit = read_pursuit(pursuit_file(flown, episode))
            places = range(pursuit.num_lead, len(pursuit.frames) - 1, cfg.fly.relabel.stride)
            items += [Item(f"{episode}_f{i:05d}", (episode, i)) for i in places]
        done = run_items(stage, items, make_worker, (cfg, flown, boxes, simplified, seed), workers=workers, watch=watch)
        traces, reasons = [], Counter[str]()
        for record in done.kept:
            traces.append(DroneTrace.from_json(record.result["trace"], "relabel"))
            reasons.update(record.result["reasons"])
        write_traces(stage.path / TRACES, traces, {"round": cfg.fly.relabel.round, "seed": seed})
        stage.finish([stage.path / TRACES], done.tally, reasons=dict(sorted(reasons.items())))
    how: dict[str, Any] = {"seed": seed, "workers": workers, "watch": watch, "resume": resume}
    rendering.run(as_drawn(cfg.render, seed), boxes, simplified, out / TRACES, out / TREE, **how)
    captioning.run(cfg.caption, out / TREE, out / CAPTIONS, **how)
    return out


def _seed_of(flown: Path, cfg: ClosedLoopConfig) -> int:
    """Return the seed of a flown folder, by which clothes and weather were drawn; see that the pictures are the
    same."""
    begun, fix = read_stage_record(flown), "give the settings that it was flown with"
    if begun.stage != "fly":
        raise InputError("not what `cosfly fly --map --paths` wrote", where=flown, got=f"stage {begun.stage}")
    if "others" in begun.inputs:
        raise InputError("flown among others, whom --relabel does not draw", where=flown, fix="fly without --others")
    was, now = (flattened(part, "render") for part in (begun.config["render"], cfg.recorded()["render"]))
    if changed := [f"{key} was {was.get(key)!r}, is {value!r}" for key, value in now.items() if was.get(key) != value]:
        raise ConfigError("pictures that the student did not see", where=flown, got="; ".join(changed), fix=fix)
    return begun.seed


def make_worker(cfg: ClosedLoopConfig, flown: Path, boxes: Path, simplified: Path, seed: int) -> Work:
    """Open a map in this process, and give the function that judges one window of a student's flight."""
    plans = {plan.path_id: (n, plan) for n, plan in enumerate(read_traces(flown / PLAN / TRACES))}
    space = Airspace(cfg.render, read_boxes(boxes), read_boxes(simplified), seed=seed)
    fly, num = cfg.fly, cfg.caption.window

    def work(item: Item) -> Outcome:
        episode, i = item.payload
        pursuit = read_pursuit(pursuit_file(flown, episode))
        number, plan = plans[pursuit.walk]
        begin, end = i - num.num_frames + 1, i + fly.relabel.future_frames + 1
        if begin < 0 or end > len(plan.time_s):
            return Outcome(drop_reason="walk_ends")
        own = pursuit.frames[: i + 1]
        if not any(frame.visible for frame in own[begin:]):
            return Outcome(drop_reason="long_lost")  # no picture tells where the person is
        here_m = np.array([own[-1].pose[:3]])
        if signed_distances(space.surroundings.obstacles, here_m)[0][0] < cfg.plan.relaxed_safety_m:
            return Outcome(drop_reason="too_near")  # no plan begins there
        try:
            planned = _planned_on(plan, own, space, cfg.plan)
        except NoPathError:
            return Outcome(drop_reason="no_path")
        cut: Any = {name: getattr(planned, name)[begin:end] for name in (*ARRAYS, "clearances_m")}
        part_of = Excerpt(plan.path_id, number, plan.targets_m[: begin + 1])
        planned = replace(planned, **cut, part_of=part_of)
        flight = ClosedLoopTrajectory(space, planned, number=number, num_lead=num.num_frames)
        moments = [*flight.reset()]
        while flight.ended is None:
            moments.append(flight.step(Ceiling.to_next(flight, moments[-1])))
            advance()
        if flight.ended != "finished":
            return Outcome(drop_reason="crashes")
        after = moments[num.num_frames - 1 :][: num.future_frames + 1]
        before_m = moments[num.num_frames - 1].position_m - moments[num.num_frames - 2].position_m
        future = FutureMotion(
            indices=tuple(moment.index for moment in after[1:]),
            time_s=np.array([moment.time_s for moment in after]),
            positions_m=np.array([moment.position_m for moment in after]),
            yaw_deg=np.array([moment.rotation_deg[1] for moment in after]),
            targets_m=np.array([moment.target_m for moment in after]),
            visible=np.array([moment.target.visible for moment in after]),
            speed_before_mps=float(np.linalg.norm(before_m)) / flight.dt_s,
        )
        motion = measure(future)
        reasons = _reasons(pursuit, i, pursuit.frames[i].action, TABLE.verdict_of, motion, TABLE.label_of(motion))
        if fly.relabel.mistakes_only and not reasons:
            return Outcome(drop_reason="no_mistake")
        solver = {"source": episode, "frame": i, "student": pursuit.student, "round": fly.relabel.round}
        solver |= {"decision": pursuit.frames[i].action, "reasons": reasons}
        trace = flown_trace(
            item.item_id,
            f"replanned from frame {i} of {pursuit.student}, round {fly.relabel.round}",
            np.array([moment.time_s for moment in moments]),
            np.hstack([flight.poses.positions_m, flight.poses.rotations_deg]),
            flight.poses.targets_m,
            flight.poses.clearances_m,
            np.array([moment.position_m[2] - moment.height_m for moment in moments]),
            space.surroundings.obstacles,
            solver,
            pursuit.style.pace,
        )
        return Outcome({"trace": replace(trace, part_of=part_of).as_json(), "reasons": reasons})

    return work


def _planned_on(plan: DroneTrace, flown: Sequence[PursuitFrame], space: Airspace, cfg: PlanConfig) -> DroneTrace:
    """Return a plan for the walk that begins with what a student has flown; raises as `plan_on`."""
    poses, obstacles = np.array([frame.pose for frame in flown]), space.surroundings.obstacles
    positions_m = plan_on(plan.path_id, plan.targets_m, step_s(plan.time_s), poses[:, :3], obstacles, cfg)
    pitch_rad, yaw_rad = look_at(positions_m, plan.targets_m)
    rotations_deg = np.degrees(np.stack([pitch_rad, yaw_rad, 0.0 * yaw_rad], axis=1))
    rotations_deg[: len(poses)] = poses[:, 3:]
    clearances_m = swept_distances(obstacles, positions_m, CLEARANCE_CAP_M)[0]
    clearances_m[: len(poses)] = [frame.clearance_m for frame in flown]
    return replace(plan, positions_m=positions_m, rotations_deg=rotations_deg, clearances_m=clearances_m)


def _reasons(
    pursuit: Pursuit, i: int, action: str | None, verdict_of: Any, motion: Any, label: str | None
) -> list[str]:
    """Return what was wrong at frame i, if anything."""
    soon = pursuit.frames[i : i + round(LOSS_S / pursuit.dt_s) + 1]
    found = ["nearly_lost"] if not all(frame.visible for frame in soon) else []
    conflicts = action is not None and verdict_of(action, motion, label) == "HARD_CONFLICT"
    return found + (["hard_conflict"] if conflicts else [])
