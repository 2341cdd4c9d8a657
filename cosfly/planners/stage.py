"""Step 4: a drone flight for every walk.

What a planner gives (contract.py) is measured, checked and filtered here, the same for all planners.
Compiled code is imported by the functions that need it: `cosfly --help` goes without.
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
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M, PedestrianTrajectory, read_paths
from cosfly.formats.segments import FOLLOW
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.geometry.axes import DT_S, step_s
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M, CLEARANCE_TOLERANCE_M, trajectory_metrics
from cosfly.planners.contract import PlanConfig, Scenario, load_planner
from cosfly.runtime.errors import InputError, NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Resume, StageFolder
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex
    from cosfly.planners.maneuver_plan import Intent

log = logging.getLogger(__name__)

TRIES = 6  # of a flight that does not hold its styles: places in their ranges are drawn anew
COORDINATE_MAX_M = 1e6  # beyond, float32 depth and four decimals of a metre in the files lose their meaning


# --- one walk ---------------------------------------------------------------------------------------------------------


def make_scenario(walk: PedestrianTrajectory, obstacles: BoxIndex, cfg: PlanConfig) -> Scenario:
    """Check a walk and give the scenario of it, with the paper's wish."""
    from cosfly.geometry.kernels import segments_hit
    from cosfly.planners.reference_trajectory import follow

    targets = walk.positions_m + np.array([0.0, 0.0, TARGET_HEIGHT_M])
    if len(targets) < 2:
        raise NoPathError("a walk of one point cannot be followed", where=walk.path_id, expected="two points or more")
    dt_s = step_s(walk.time_s)
    uneven = np.abs(np.diff(walk.time_s) - dt_s) > 1e-3
    if dt_s <= 0:
        raise NoPathError("time does not increase", where=walk.path_id, got=f"steps of {dt_s:g} s")
    if uneven.any():
        where, got = f"{walk.path_id}: t[{int(np.argmax(uneven)) + 1}]", f"{np.diff(walk.time_s)[uneven][0]:g} s"
        raise NoPathError("uneven time stamps", where=where, got=f"a step of {got}", expected=f"{dt_s:g} s, as most")
    if np.abs(targets).max() > COORDINATE_MAX_M:
        raise NoPathError(
            "a coordinate is too large", where=walk.path_id, got=f"{np.abs(targets).max():g} m",
            expected=f"at most {COORDINATE_MAX_M:g} m", fix="move the map's origin near the walks",
        )  # fmt: skip
    hits = segments_hit(obstacles, targets[:-1], targets[1:])
    if hits.any():
        place = targets[int(np.argmax(hits))]
        raise NoPathError(
            "the walk leads through an obstacle", where=walk.path_id,
            got=f"{int(hits.sum())} steps inside a box, the first at ({place[0]:.1f}, {place[1]:.1f})",
            fix="was it planned on this map?",
        )  # fmt: skip
    return Scenario(walk.path_id, targets, np.array(walk.positions_m[:, 2]), follow(targets, cfg, dt_s), dt_s)


def draw_styles_of(walks: Sequence[PedestrianTrajectory], cfg: PlanConfig, seed: int) -> list[list[str]]:
    """Draw the styles of the flights of a run, for each walk in order; by the first one's begin too: walks of other
    maps have the same ids.
    """
    from cosfly.planners.maneuver_plan import draw_styles

    return draw_styles(walks, cfg, style_rng(walks[0], seed))


def plan_trajectory(
    walk: PedestrianTrajectory, obstacles: BoxIndex, cfg: PlanConfig, seed: int, screens: BoxIndex | None = None,
    styles: Sequence[str] = (),
) -> DroneTrace:  # fmt: skip
    """Plan, measure and check one flight in styles drawn for it; in that of the paper instead where it fails and the
    settings say so.

    Args:
        screens: the obstacles that hide a person for certain, for a search; None: all do. styles: of its parts; none:
            drawn as those of a first flight.
    Raises:
        NoPathError: the walk cannot be followed, or the planner's flight is not free of collisions.
    """
    from cosfly.planners.maneuver_plan import Intent, draw_intent, mirrored

    scenario = make_scenario(walk, obstacles, cfg)
    screens = obstacles if screens is None else screens
    styles = styles or draw_styles_of([walk], cfg, seed)[0]
    for attempt in range(TRIES):
        intent = draw_intent(styles, scenario, obstacles, screens, cfg, style_rng(walk, seed, attempt))
        flown: DroneTrace | NoPathError
        try:
            flown = _fly(walk, scenario, intent, obstacles, screens, cfg, seed)
        except NoPathError as error:
            flown = error
        if not intent.segments or (isinstance(flown, DroneTrace) and flown.drop_reason is None):
            break
        styles = mirrored(styles)  # a wall may stand on the one side alone
    is_last = not intent.segments or cfg.styles_fallback == "drop"
    if isinstance(flown, DroneTrace) and (is_last or flown.drop_reason is None):
        return flown
    if isinstance(flown, NoPathError) and is_last:
        raise flown
    reason, not_held = ("no_path", None) if isinstance(flown, NoPathError) else (flown.drop_reason, flown.not_held)
    follows = _fly(walk, scenario, Intent(scenario.reference), obstacles, screens, cfg, seed)
    return replace(follows, instead_of=f"{intent.styles}: {reason}", not_held=not_held)


def plan_on(
    path_id: str, targets_m: np.ndarray, dt_s: float, flown_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig
) -> np.ndarray:
    """Plan a flight of the style `follow` on from where a drone is, with foresight.

    Args:
        targets_m: (n, 3) hip points of the whole walk. flown_m: (k, 3), 3 <= k < n, where the drone was at the first.
    Returns:
        (n, 3), which begins with `flown_m`; from there on it keeps all limits of the settings.
    """
    from cosfly.planners.reference_trajectory import follow, going_on
    from cosfly.planners.foresight import plan

    ground_m = targets_m[:, 2] - TARGET_HEIGHT_M
    scenario = Scenario(path_id, targets_m, ground_m, follow(targets_m, cfg, dt_s), dt_s, flown_m)
    scenario = replace(scenario, reference=going_on(scenario, cfg))
    try:
        return plan(scenario, obstacles, cfg, rng_for(0, "plan", path_id)).positions_m
    except NoPathError:
        turning = replace(scenario, turns_round=True)
        return plan(turning, obstacles, cfg, rng_for(0, "plan", path_id)).positions_m


def style_rng(walk: PedestrianTrajectory, seed: int, attempt: int = 0) -> np.random.Generator:
    """Return the generator of how a flight's styles are flown, by the walk's begin too."""
    x_m, y_m = np.round(walk.positions_m[0, :2], 2) + 0.0
    return rng_for(seed, "style", f"{walk.path_id}/{x_m:.2f}/{y_m:.2f}" + (f"/{attempt}" if attempt else ""))


def _fly(
    walk: PedestrianTrajectory,
    scenario: Scenario,
    intent: Intent,
    obstacles: BoxIndex,
    screens: BoxIndex,
    cfg: PlanConfig,
    seed: int,
) -> DroneTrace:
    from cosfly.geometry.kernels import swept_distances, visibility
    from cosfly.planners.maneuver_plan import NOT_HELD, ended_by_order, tell_not_held, view_of, why_not_held

    scenario = replace(scenario, reference=intent.reference)
    made = load_planner(cfg.planner)(scenario, obstacles, cfg, rng_for(seed, "plan", walk.path_id))
    positions = made.positions_m
    if intent.order is not None:
        intent, positions = ended_by_order(intent, positions, scenario, obstacles, cfg)
    positions = np.round(positions, 4)  # measured as it is written
    targets = np.round(scenario.targets_m, 4)
    clearances, _, _ = swept_distances(obstacles, positions, CLEARANCE_CAP_M)
    if clearances.min() < cfg.relaxed_safety_m - CLEARANCE_TOLERANCE_M:
        raise NoPathError(
            f"planner {cfg.planner} found no flight that is free of collisions", where=walk.path_id,
            got=f"a least clearance of {clearances.min():.2f} m",
            expected=f"{cfg.relaxed_safety_m:g} m all the way",
        )  # fmt: skip
    seen, judged = visibility(obstacles, positions, targets), intent.reference.keeps_sight
    seen_past_screens = visibility(screens, positions, targets) if intent.searches else seen
    pitch, yaw = view_of(intent, positions, targets, seen_past_screens, scenario.dt_s)
    rotations = np.degrees(np.stack([pitch, yaw, np.zeros_like(yaw)], axis=1))
    counted = seen[judged] if judged.any() else seen
    metrics = trajectory_metrics(positions, targets, counted, clearances, scenario.ground_m, scenario.dt_s)
    reason = drop_reason(metrics, cfg, made.is_converged, is_judged_by_sight=bool(judged.any()))
    reason = reason or why_not_held(intent, scenario, positions, seen_past_screens)
    return DroneTrace(
        path_id=walk.path_id,
        planner=cfg.planner,
        time_s=walk.time_s,
        positions_m=positions,
        rotations_deg=rotations,
        targets_m=targets,
        visibility=seen,
        clearances_m=clearances,
        metrics=metrics,
        solver=made.solver,
        drop_reason=reason,
        not_held=tell_not_held(intent, scenario, positions, obstacles, cfg) if reason == NOT_HELD else None,
        segments=intent.segments,
        mission=intent.mission,
        pace=walk.pace,
    )


def drop_reason(
    metrics: dict[str, float], cfg: PlanConfig, is_converged: bool, *, is_judged_by_sight: bool = True
) -> str | None:
    """Return why the prefilter before rendering rejects a flight, None if it passes (sec:step6, sec:dataset_stats)."""
    if not is_converged:
        return "not_converged"
    if is_judged_by_sight and metrics["five_ray_mean"] < cfg.five_ray_mean_min:
        return "low_visibility"
    if metrics["accel_rms_mps2"] > cfg.accel_rms_max_mps2:
        return "high_acceleration"
    if metrics["jerk_rms_mps3"] > cfg.jerk_rms_max_mps3:
        return "high_jerk"
    return None


# --- stage ------------------------------------------------------------------------------------------------------------


def make_worker(cfg: PlanConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; give the function that plans one walk."""
    from cosfly.geometry.kernels import obstacle_index
    from cosfly.planners.reacquire import screens_of

    box_map = read_boxes(simplified_map)
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    warm_up(cfg)

    def work(item: Item) -> Outcome:
        walk, styles = item.payload
        trace = plan_trajectory(walk, obstacles, cfg, seed, screens, styles)
        return Outcome(trace.as_json(), trace.drop_reason)

    return work


def warm_up(cfg: PlanConfig) -> None:
    """Compile or load compiled code before the first walk, so that times per walk are planning times."""
    from cosfly.geometry.kernels import index_boxes

    walk = np.arange(8.0)
    positions = np.column_stack([0.5 * walk, np.zeros(8), np.zeros(8)])
    # One box that hides the walk from behind: the search for a start runs too.
    obstacles = index_boxes(np.array([[-10.0, 0.0, 15.0]]), np.array([[1.0, 3.0, 15.0]]), np.eye(3)[None])
    cfg = cfg.model_copy(update={"styles": {FOLLOW: 1.0}})
    plan_trajectory(
        PedestrianTrajectory("warm-up", positions[:, :2], DT_S * walk, positions, np.ones(8)), obstacles, cfg, 0
    )


def run(
    cfg: PlanConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Reads a simplified map and `path.json`, writes `drone_trace.json` and `plan.png`; gives the former's path.

    Flights that the prefilter drops are written too, with their reason; a walk without a flight is a counted failure.

    Raises:
        InputError: a file is not what it must be.
        NothingKept: not one walk has a flight, or the prefilter dropped them all.
    """
    from cosfly.planners.overview import draw_trajectories

    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product, picture = out / "drone_trace.json", out / "plan.png"
    if stage.is_complete:
        return product
    box_map, walks = read_boxes(simplified_map), read_paths(paths)
    check_ids(walks, paths)
    for remark in cfg.remarks():
        log.warning("%s", remark)
    items = [Item(w.path_id, (w, styles)) for w, styles in zip(walks, draw_styles_of(walks, cfg, seed), strict=True)]
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    traces, seconds = [], []
    for record in finished.records:
        if not isinstance(record, Failed):
            traces.append(DroneTrace.from_json(record.result, f"{stage.path}/items.jsonl: {record.id}"))
            seconds.append(record.seconds)
    if not traces:
        raise stage.nothing_kept(finished.tally)
    header = {"map": box_map.name, "planner": cfg.planner, "seed": seed, "settings": cfg.recorded()}
    for trace in traces:
        if trace.not_held:
            log.warning("%s: style_not_held: %s", trace.path_id, trace.not_held)
    write_traces(product, traces, header)
    write_bytes(picture, draw_trajectories(box_map, walks, traces))
    stage.finish([product, picture], finished.tally, **_facts(box_map, traces, seconds))
    return product


def _facts(box_map: BoxMap, traces: list[DroneTrace], seconds: list[float]) -> dict:
    """What the manifest says beyond the counts; planning times stand here and not in the product."""
    times_ms = 1000.0 * np.array(seconds)
    names = ("five_ray_mean", "clearance_min_m", "altitude_mean_m", "target_distance_mean_m", "smoothness_score")
    return {
        "num_boxes": len(box_map),
        "planning_ms": {"mean": round(float(times_ms.mean()), 1), "max": round(float(times_ms.max()), 1)},
        **_styles_flown(traces),
        "means": {name: round(float(np.mean([trace.metrics[name] for trace in traces])), 4) for name in names},
    }


def _styles_flown(traces: list[DroneTrace]) -> dict:
    """Count the parts of kept flights by style, and those that the map did not hold; nothing where all follow."""
    styled = [trace for trace in traces if trace.segments or trace.instead_of]
    if not styled:
        return {}
    parts = [part.style for trace in traces if not trace.drop_reason for part in trace.segments]
    not_held = [trace.instead_of for trace in styled if trace.instead_of]
    dropped = [f"{', '.join(p.style for p in t.segments)}: {t.drop_reason}" for t in styled if t.drop_reason]
    return {
        "styles": dict(sorted(Counter(parts).items())),
        "styles_flown_as_follow": dict(sorted(Counter(not_held).items())),
        "styles_dropped": dict(sorted(Counter(dropped).items())),
        "styles_not_held": {trace.path_id: trace.not_held for trace in styled if trace.not_held},
    }


def check_ids(walks: list[PedestrianTrajectory], paths: Path) -> None:
    """Raise InputError where there is no walk, or two of one id."""
    if not walks:
        raise InputError("there are no paths", where=f"{paths}: paths", fix="run the pedestrians stage again")
    (path_id, count), *_ = Counter(walk.path_id for walk in walks).most_common(1)
    if count > 1:
        raise InputError("a path id occurs more than once", where=f"{paths}: paths", got=path_id)
