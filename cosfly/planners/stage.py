"""Step 4: a drone trajectory for every pedestrian trajectory.

The result of a planner (contract.py) is measured, checked and filtered here, in the same way for all planners.
Compiled code is imported by the functions that need it, so that `cosfly --help` does not load it.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M, PedestrianTrajectory, read_paths
from cosfly.formats.segments import FOLLOW
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.geometry.axes import DT_S, step_s
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M, CLEARANCE_TOLERANCE_M, trajectory_metrics
from cosfly.planners.contract import PlanConfig, Scenario, load_planner
from cosfly.runtime.errors import InputError, NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, StageFolder
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex
    from cosfly.planners.maneuver_plan import ManeuverPlan

log = logging.getLogger(__name__)

TRIES = 6  # if a trajectory does not hold its styles; each try draws new values from their ranges
CROWN_SHARE = 1 / np.sqrt(3.0)  # of a box's half extents: the largest box inside the ellipsoid that the box encloses
COORDINATE_MAX_M = 1e6  # beyond, float32 depth and four decimals of a metre in the files lose their meaning


# --- one trajectory ---------------------------------------------------------------------------------------------------


def make_scenario(pedestrian: PedestrianTrajectory, obstacles: BoxIndex, cfg: PlanConfig) -> Scenario:
    """Check a pedestrian trajectory and return its scenario, with the paper's reference trajectory."""
    from cosfly.geometry.kernels import segments_hit
    from cosfly.planners.reference_trajectory import follow

    path_id = pedestrian.path_id
    targets = pedestrian.positions_m + np.array([0.0, 0.0, TARGET_HEIGHT_M])
    if len(targets) < 2:
        problem = "the pedestrian trajectory has too few points"
        raise NoPathError(problem, where=path_id, got=f"{len(targets)} points", expected="at least 2 points")
    dt_s = step_s(pedestrian.time_s)
    steps_s = np.diff(pedestrian.time_s)
    is_uneven = np.abs(steps_s - max(dt_s, 0.0)) > 1e-3
    if dt_s <= 0 or is_uneven.any():
        first = int(np.argmax(is_uneven))
        raise NoPathError(
            "the time stamps of the pedestrian trajectory do not increase in equal steps",
            where=f"{path_id}: t[{first + 1}]",
            got=f"a step of {steps_s[first]:g} s",
            expected=f"steps of {abs(dt_s):g} s, the median of all steps",
        )
    if (farthest_m := np.abs(targets).max()) > COORDINATE_MAX_M:
        raise NoPathError(
            "the pedestrian trajectory is too far from the origin of the map",
            where=path_id,
            got=f"{farthest_m:g} m",
            expected=f"at most {COORDINATE_MAX_M:g} m",
            fix="move the origin of the map near the pedestrian trajectories",
        )
    hits = segments_hit(obstacles, targets[:-1], targets[1:])
    if hits.any():
        x, y, _ = targets[int(np.argmax(hits))]
        raise NoPathError(
            "the pedestrian trajectory passes through an obstacle",
            where=path_id,
            got=f"{int(hits.sum())} steps through a box, the first at ({x:.1f}, {y:.1f}) m",
            fix="plan on the map that the pedestrian trajectories were made for",
        )
    return Scenario(path_id, targets, np.array(pedestrian.positions_m[:, 2]), follow(targets, cfg, dt_s), dt_s)


def draw_styles_of(pedestrians: Sequence[PedestrianTrajectory], cfg: PlanConfig, seed: int) -> list[list[str]]:
    """Draw the styles of the segments of each drone trajectory of a run, in the order of the pedestrians."""
    from cosfly.planners.maneuver_plan import draw_styles

    return draw_styles(pedestrians, cfg, style_rng(pedestrians[0], seed))


def plan_trajectory(
    pedestrian: PedestrianTrajectory, obstacles: BoxIndex, cfg: PlanConfig, seed: int, screens: BoxIndex | None = None,
    styles: Sequence[str] = (),
) -> DroneTrace:  # fmt: skip
    """Plan, measure and check one drone trajectory in given styles, or in `follow` where the settings allow that.

    Args:
        screens: Obstacles that certainly hide a person, for `reacquire`; None: all do. styles: one per segment; empty:
            drawn as for the first trajectory of a run.
    Raises:
        NoPathError: If the pedestrian trajectory cannot be followed, or the planner's trajectory collides.
    """
    from cosfly.planners.maneuver_plan import ManeuverPlan, draw_maneuvers, mirrored

    scenario = make_scenario(pedestrian, obstacles, cfg)
    screens = obstacles if screens is None else screens
    styles = styles or draw_styles_of([pedestrian], cfg, seed)[0]
    for attempt in range(TRIES):
        maneuvers = draw_maneuvers(styles, scenario, obstacles, screens, cfg, style_rng(pedestrian, seed, attempt))
        trace: DroneTrace | None = None
        no_path: NoPathError | None = None
        try:
            trace = _plan_once(pedestrian, scenario, maneuvers, obstacles, screens, cfg, seed)
        except NoPathError as error:
            no_path = error
        if trace is not None and trace.drop_reason is None:
            return trace
        if not maneuvers.segments:
            break  # `follow` has nothing to draw again
        styles = mirrored(styles)  # a wall may block one side only
    if not maneuvers.segments or cfg.styles_fallback == "drop":
        if no_path is not None:
            raise no_path
        assert trace is not None
        return trace
    follow = _plan_once(pedestrian, scenario, ManeuverPlan(scenario.reference), obstacles, screens, cfg, seed)
    failed_styles = ", ".join(segment.style for segment in maneuvers.segments)
    if trace is None:
        return replace(follow, instead_of=f"{failed_styles}: no_path")
    return replace(follow, instead_of=f"{failed_styles}: {trace.drop_reason}", not_held=trace.not_held)


def plan_on(
    path_id: str, targets_m: np.ndarray, dt_s: float, past_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig
) -> np.ndarray:
    """Continue a drone trajectory in the style `follow` from the drone's position, with the planner foresight.

    Args:
        targets_m: (n, 3) hip points of the whole pedestrian trajectory. past_m: (k, 3), 3 <= k < n, the drone's
            positions at the first k of them.
    Returns:
        (n, 3) m; the first k are `past_m`.
    Raises:
        NoPathError: If no trajectory within the limits of the settings is found.
    """
    from cosfly.planners.foresight import plan
    from cosfly.planners.reference_trajectory import continued_reference, follow

    ground_m = targets_m[:, 2] - TARGET_HEIGHT_M
    rng = rng_for(0, "plan", path_id)  # foresight draws nothing from it
    scenario = Scenario(path_id, targets_m, ground_m, follow(targets_m, cfg, dt_s), dt_s, past_m)
    scenario = replace(scenario, reference=continued_reference(scenario, cfg))
    try:
        return plan(scenario, obstacles, cfg, rng).positions_m
    except NoPathError:
        return plan(replace(scenario, turns_back=True), obstacles, cfg, rng).positions_m


def style_rng(
    pedestrian: PedestrianTrajectory, seed: int, attempt: int = 0, *, purpose: str = "style"
) -> np.random.Generator:
    """Return the random generator of a trajectory's styles or gimbal.

    It depends on where the pedestrian starts, because pedestrian trajectories of different maps have equal ids.
    """
    x_m, y_m = np.round(pedestrian.positions_m[0, :2], 2) + 0.0
    return rng_for(seed, purpose, f"{pedestrian.path_id}/{x_m:.2f}/{y_m:.2f}" + (f"/{attempt}" if attempt else ""))


def _plan_once(
    pedestrian: PedestrianTrajectory, scenario: Scenario, maneuvers: ManeuverPlan, obstacles: BoxIndex,
    screens: BoxIndex, cfg: PlanConfig, seed: int,
) -> DroneTrace:  # fmt: skip
    from cosfly.geometry.kernels import swept_distances, visibility
    from cosfly.planners.maneuver_plan import NOT_HELD, describe_not_held, end_with_order, view_of, why_not_held

    scenario = replace(scenario, reference=maneuvers.reference)
    plan = load_planner(cfg.planner)(scenario, obstacles, cfg, rng_for(seed, "plan", pedestrian.path_id))
    positions = plan.positions_m
    if positions.shape != scenario.targets_m.shape or not np.isfinite(positions).all():
        raise ValueError(f"the planner {cfg.planner} must return {len(scenario.targets_m)} finite positions, (n, 3)")
    if maneuvers.order is not None:
        maneuvers, positions = end_with_order(maneuvers, positions, scenario, obstacles, cfg)
    positions = np.round(positions, 4)  # as in the file, so that the metrics are those of the file
    targets = np.round(scenario.targets_m, 4)
    clearances, _, _ = swept_distances(obstacles, positions, CLEARANCE_CAP_M)
    if clearances.min() < cfg.relaxed_safety_m - CLEARANCE_TOLERANCE_M:
        raise NoPathError(
            f"the planner {cfg.planner} found no drone trajectory with enough clearance",
            where=pedestrian.path_id,
            got=f"a clearance of {clearances.min():.2f} m at the narrowest place",
            expected=f"at least {cfg.relaxed_safety_m:g} m everywhere (plan.relaxed_safety_m)",
        )
    seen = visibility(obstacles, positions, targets)
    seen_past_screens = visibility(screens, positions, targets) if maneuvers.searches else seen
    gimbal_rng = style_rng(pedestrian, seed, purpose="gimbal")
    pitch, yaw = view_of(maneuvers, positions, targets, seen_past_screens, scenario.dt_s, cfg, gimbal_rng)
    # Only frames in which the target must be visible are judged by it; without such frames, all are measured.
    keeps_sight = maneuvers.reference.keeps_sight
    measured = seen[keeps_sight] if keeps_sight.any() else seen
    metrics = trajectory_metrics(positions, targets, measured, clearances, scenario.ground_m, scenario.dt_s)
    reason = drop_reason(metrics, cfg, plan.is_converged, checks_visibility=bool(keeps_sight.any()))
    reason = reason or why_not_held(maneuvers, scenario, positions, seen_past_screens)
    return DroneTrace(
        path_id=pedestrian.path_id, planner=cfg.planner, time_s=pedestrian.time_s, positions_m=positions,
        rotations_deg=np.degrees(np.stack([pitch, yaw, np.zeros_like(yaw)], axis=1)), targets_m=targets,
        visibility=seen, clearances_m=clearances, metrics=metrics, solver=plan.solver, drop_reason=reason,
        not_held=describe_not_held(maneuvers, scenario, positions) if reason == NOT_HELD else None,
        segments=maneuvers.segments, mission=maneuvers.mission, pace=pedestrian.pace,
    )  # fmt: skip


def drop_reason(
    metrics: dict[str, float], cfg: PlanConfig, is_converged: bool, *, checks_visibility: bool = True
) -> str | None:
    """Return why the filter before rendering rejects a trajectory, None if it passes (sec:step6, sec:dataset_stats)."""
    reasons = {
        "not_converged": not is_converged,
        "low_visibility": checks_visibility and metrics["five_ray_mean"] < cfg.five_ray_mean_min,
        "high_acceleration": metrics["accel_rms_mps2"] > cfg.accel_rms_max_mps2,
        "high_jerk": metrics["jerk_rms_mps3"] > cfg.jerk_rms_max_mps3,
    }
    return next((reason for reason, applies in reasons.items() if applies), None)


# --- stage ------------------------------------------------------------------------------------------------------------


def screens_of(box_map: BoxMap) -> BoxIndex:
    """Index the boxes that certainly hide a person: obstacles, with tree crowns shrunk by CROWN_SHARE."""
    from cosfly.geometry.kernels import obstacle_index

    is_crown = box_map.is_any_of({KINDS["Vegetation"]})
    half_extents = np.where(is_crown[:, None], CROWN_SHARE * box_map.half_extents, box_map.half_extents)
    return obstacle_index(replace(box_map, half_extents=half_extents))


def load_obstacles(simplified_map: Path) -> tuple[BoxIndex, BoxIndex]:
    """Read a map; return its obstacles and its screens (`screens_of`)."""
    from cosfly.geometry.kernels import obstacle_index

    box_map = read_boxes(simplified_map)
    return obstacle_index(box_map), screens_of(box_map)


def make_worker(cfg: PlanConfig, simplified_map: Path, seed: int) -> Work:
    """Load the map once; return the function that plans for one pedestrian trajectory."""
    obstacles, screens = load_obstacles(simplified_map)
    warm_up(cfg)

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        trace = plan_trajectory(pedestrian, obstacles, cfg, seed, screens, styles)
        return Outcome(trace.as_json(), trace.drop_reason)

    return work


def warm_up(cfg: PlanConfig) -> None:
    """Compile or load compiled code before the first item, so that its time is planning time only."""
    from cosfly.geometry.kernels import index_boxes

    steps = np.arange(8.0)
    positions = np.column_stack([0.5 * steps, 0.0 * steps, 0.0 * steps])
    # One box hides the pedestrian from behind, so that the search for a start is compiled too.
    obstacles = index_boxes(np.array([[-10.0, 0.0, 15.0]]), np.array([[1.0, 3.0, 15.0]]), np.eye(3)[None])
    pedestrian = PedestrianTrajectory("warm-up", positions[:, :2], DT_S * steps, positions, np.ones(8))
    plan_trajectory(pedestrian, obstacles, cfg.model_copy(update={"styles": {FOLLOW: 1.0}}), 0)


def read_inputs(simplified_map: Path, paths: Path) -> tuple[BoxMap, list[PedestrianTrajectory]]:
    """Read a map and its pedestrian trajectories; raise InputError if there are none, or two have one id."""
    box_map, pedestrians = read_boxes(simplified_map), read_paths(paths)
    where = f"{paths}: paths"
    if not pedestrians:
        raise InputError(
            "the file contains no pedestrian trajectories", where=where, fix="run the pedestrians stage again"
        )
    (path_id, count), *_ = Counter(pedestrian.path_id for pedestrian in pedestrians).most_common(1)
    if count > 1:
        what = "several pedestrian trajectories have the same id"
        fix = "run the pedestrians stage again"
        raise InputError(what, where=where, got=path_id, expected="a different id for each of them", fix=fix)
    return box_map, pedestrians


def make_items(pedestrians: Sequence[PedestrianTrajectory], cfg: PlanConfig, seed: int) -> list[Item]:
    """Return the work items of a run: each has a pedestrian trajectory and the styles drawn for it."""
    styles = draw_styles_of(pedestrians, cfg, seed)
    pairs = zip(pedestrians, styles, strict=True)
    return [Item(pedestrian.path_id, (pedestrian, names)) for pedestrian, names in pairs]


def run(
    cfg: PlanConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(),
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `drone_trace.json` and `plan.png`.

    Trajectories that the filter drops are written too, with their reason; a pedestrian trajectory without a drone
    trajectory is a counted failure. Return the path of `drone_trace.json`.
    """
    from cosfly.planners.overview import draw_trajectories

    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan", config=cfg, inputs=inputs, seed=seed)
    product = out / "drone_trace.json"
    picture = out / "plan.png"
    if stage.is_complete:
        return product
    box_map, pedestrians = read_inputs(simplified_map, paths)
    for remark in cfg.remarks():
        log.warning("%s", remark)
    items = make_items(pedestrians, cfg, seed)
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    records = [record for record in finished.records if not isinstance(record, Failed)]
    traces = [DroneTrace.from_json(record.result, f"{stage.path}/items.jsonl: {record.id}") for record in records]
    if not traces:
        raise stage.nothing_kept(finished.tally)
    header = {"map": box_map.name, "planner": cfg.planner, "seed": seed, "settings": cfg.recorded()}
    for trace in traces:
        if trace.not_held:
            fallback = f", planned in the style {cfg.styles_fallback} instead" if trace.instead_of else ""
            outcome = f"dropped ({trace.drop_reason})" if trace.drop_reason else "kept"
            words = "%s: the drone does not hold its style (%s)%s; %s"
            log.warning(words, trace.path_id, trace.not_held, fallback, outcome)
    write_traces(product, traces, header)
    write_bytes(picture, draw_trajectories(box_map, pedestrians, traces))
    times_ms = 1000.0 * np.array([record.seconds for record in records])  # not in the product, which is reproducible
    names = ("five_ray_mean", "clearance_min_m", "altitude_mean_m", "target_distance_mean_m", "smoothness_score")
    stage.finish(
        [product, picture], finished.tally, num_boxes=len(box_map),
        planning_ms={"mean": round(float(times_ms.mean()), 1), "max": round(float(times_ms.max()), 1)},
        **_styles_flown(traces),
        means={name: round(float(np.mean([trace.metrics[name] for trace in traces])), 4) for name in names},
    )  # fmt: skip
    return product


def _styles_flown(traces: list[DroneTrace]) -> dict:
    """Count the segments of kept trajectories by style, and those not held; empty where all are `follow`."""
    styled = [trace for trace in traces if trace.segments or trace.instead_of]
    if not styled:
        return {}
    kept, as_follow, dropped = Counter[str](), Counter[str](), Counter[str]()
    for trace in styled:
        styles = [segment.style for segment in trace.segments]
        if trace.drop_reason:
            dropped[f"{', '.join(styles)}: {trace.drop_reason}"] += 1
        else:
            kept.update(styles)
        if trace.instead_of:
            as_follow[trace.instead_of] += 1
    return {
        "styles": dict(sorted(kept.items())),
        "styles_flown_as_follow": dict(sorted(as_follow.items())),
        "styles_dropped": dict(sorted(dropped.items())),
        "styles_not_held": {trace.path_id: trace.not_held for trace in styled if trace.not_held},
    }
