"""`cosfly fly --relabel`, the data of DAgger (Ross, Gordon and Bagnell 2011): the planner continues where a
student was.

The planner knows the whole pedestrian trajectory. It plans from the pose and velocity that the student had reached, and
`PlannerEngine` flies that plan. Each decision gives a short trajectory: the student's observed frames, then the
planner's, with captions.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from caption.stage import stage as captioning
from cosfly.closed_loop.engines import PlannerEngine
from cosfly.closed_loop.stage import PLAN, TRACES, TREE, ClosedLoopConfig, flown_trace
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, as_drawn
from cosfly.formats.boxes import read_boxes
from cosfly.formats.episodes import EpisodeFrame, episode_file, read_episode, read_score
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.axes import look_at, step_s
from cosfly.geometry.kernels import signed_distances, swept_distances
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_on
from cosfly.render import stage as rendering
from cosfly.runtime.errors import ConfigError, InputError, NoPathError
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import StageFolder, read_stage_record
from cosfly.runtime.worker import Item, Outcome, Work, advance

CAPTIONS = "caption"


def run(
    cfg: ClosedLoopConfig, flown: Path, boxes: Path, simplified: Path, out: Path, *, workers: int = 1,
    watch: Watch = Watch(),
) -> Path:  # fmt: skip
    """Read a folder of `cosfly fly` and its map; write `drone_trace.json`, the playback tree `render/` of the planner's
    continuations, and the teacher's `caption/` of it. Return the output directory.
    """
    inputs = {"flown": flown, "boxes": boxes, "simplified": simplified}
    seed = _seed_of(flown, cfg)
    plans = read_traces(flown / PLAN / TRACES)
    if (planners := {plan.planner for plan in plans} | {cfg.plan.planner}) != {"foresight"}:
        raise ConfigError(
            "relabeling needs the planner `foresight`, because no other planner can start at the pose of a student",
            where=f"plan.planner and {flown / PLAN}",
            got=f"the planners {', '.join(sorted(planners))}",
            fix="fly the student again with --set plan.planner=foresight, and relabel with the same setting",
        )
    begun = (TREE, CAPTIONS)
    stage = StageFolder.open(out, "relabel", config=cfg, inputs=inputs, seed=seed, begun=begun)
    if not stage.is_complete:
        items = []
        for episode in sorted(score.episode for score in read_score(flown).flights):
            record = read_episode(episode_file(flown, episode))
            decisions = range(record.num_lead, len(record.frames) - 1, cfg.fly.relabel.stride)
            items += [Item(f"{episode}_f{i:05d}", (episode, i)) for i in decisions]
        done = run_items(stage, items, make_worker, (cfg, flown, boxes, simplified, seed), workers=workers, watch=watch)
        traces = [DroneTrace.from_json(outcome.result["trace"], "relabel") for outcome in done.kept]
        write_traces(stage.path / TRACES, traces, {"round": cfg.fly.relabel.round, "seed": seed})
        stage.finish([stage.path / TRACES], done.tally)
    common: dict[str, Any] = {"seed": seed, "workers": workers, "watch": watch}
    rendering.run(as_drawn(cfg.render, seed), boxes, simplified, out / TRACES, out / TREE, **common)
    captioning.run(cfg.caption, out / TREE, out / CAPTIONS, **common)
    return out


def _seed_of(flown: Path, cfg: ClosedLoopConfig) -> int:
    """Return the seed of a flown folder, which decides clothes and weather; check that the pictures are the same."""
    begun = read_stage_record(flown)
    if begun.stage != "fly":
        what = "the folder to relabel is not the output directory of `cosfly fly --map --paths`"
        fix = "pass the output directory of that command"
        raise InputError(what, where=flown, got=f"the output of the stage `{begun.stage}`", fix=fix)
    if "others" in begun.inputs:
        raise InputError(
            "the recorded episodes have bystanders, but --relabel cannot render bystanders",
            where=flown,
            fix="fly the student again without --others",
        )
    if begun.config["render"] != cfg.recorded()["render"]:
        raise ConfigError(
            "the render settings differ from those of the recorded episodes",
            where=flown,
            fix="use the render settings that stage.json in this folder records",
        )
    return begun.seed


def make_worker(cfg: ClosedLoopConfig, flown: Path, boxes: Path, simplified: Path, seed: int) -> Work:
    """Open a map in this process; return the function that relabels one decision of a student."""
    plans = {plan.path_id: (n, plan) for n, plan in enumerate(read_traces(flown / PLAN / TRACES))}
    airspace = Airspace(cfg.render, read_boxes(boxes), read_boxes(simplified), seed=seed)
    relabel = cfg.fly.relabel
    window = cfg.caption.window

    def work(item: Item) -> Outcome:
        episode, i = item.payload
        record = read_episode(episode_file(flown, episode))
        number, plan = plans[record.walk]
        begin = i - window.num_frames + 1
        end = i + relabel.future_frames + 1
        if begin < 0 or end > len(plan.time_s):
            return Outcome(drop_reason="walk_ends")
        flown_frames = record.frames[: i + 1]
        if not any(frame.visible for frame in flown_frames[begin:]):
            return Outcome(drop_reason="long_lost")  # no picture shows where the target is
        position_m = np.array([flown_frames[-1].pose[:3]])
        if signed_distances(airspace.surroundings.obstacles, position_m)[0][0] < cfg.plan.relaxed_safety_m:
            return Outcome(drop_reason="too_near")  # no plan begins there
        try:
            planned = _planned_on(plan, flown_frames, airspace, cfg.plan)
        except NoPathError:
            return Outcome(drop_reason="no_path")
        planned = planned.part(number, begin, end)
        simulation = ClosedLoopTrajectory(airspace, planned, number=number, num_lead=window.num_frames)
        trace = _fly_plan(
            simulation, path_id=item.item_id, pace=record.pace, part_of=planned.part_of,
            planner=f"replanned from frame {i} of {record.student}, round {relabel.round}",
            solver={"source": episode, "frame": i, "student": record.student, "round": relabel.round,
                    "decision": record.frames[i].action},
        )  # fmt: skip
        return Outcome(drop_reason="crashes") if trace is None else Outcome({"trace": trace.as_json()})

    return work


def _fly_plan(simulation: ClosedLoopTrajectory, **fields: Any) -> DroneTrace | None:
    """Fly a plan as the upper bound does; return the drone trajectory with further fields, None if it crashes."""
    moments = [*simulation.reset()]
    while simulation.ended is None:
        moments.append(simulation.step(PlannerEngine.to_next(simulation, moments[-1])))
        advance()
    if simulation.ended != "finished":
        return None
    poses = simulation.poses
    return flown_trace(
        simulation.airspace.surroundings.obstacles, time_s=np.array([moment.time_s for moment in moments]),
        poses=np.hstack([poses.positions_m, poses.rotations_deg]), targets_m=poses.targets_m,
        clearances_m=poses.clearances_m,
        ground_m=np.array([moment.position_m[2] - moment.height_m for moment in moments]), **fields,
    )  # fmt: skip


def _planned_on(plan: DroneTrace, flown: Sequence[EpisodeFrame], airspace: Airspace, cfg: PlanConfig) -> DroneTrace:
    """Return a plan that begins with the flown frames of a student; raises as `plan_on`."""
    poses = np.array([frame.pose for frame in flown])
    obstacles = airspace.surroundings.obstacles
    positions_m = plan_on(plan.path_id, plan.targets_m, step_s(plan.time_s), poses[:, :3], obstacles, cfg)
    pitch_rad, yaw_rad = look_at(positions_m, plan.targets_m)
    rotations_deg = np.degrees(np.stack([pitch_rad, yaw_rad, 0.0 * yaw_rad], axis=1))
    rotations_deg[: len(poses)] = poses[:, 3:]
    clearances_m = swept_distances(obstacles, positions_m, CLEARANCE_CAP_M)[0]
    clearances_m[: len(poses)] = [frame.clearance_m for frame in flown]
    return replace(plan, positions_m=positions_m, rotations_deg=rotations_deg, clearances_m=clearances_m)
