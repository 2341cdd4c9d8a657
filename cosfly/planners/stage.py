"""Step 4: a drone flight for every walk.

A planner is one function, named in PLANNERS, with the signature

    plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan

It gives one drone position for each target position, keeps to the shared settings (tab:drone_params), draws chance from `rng` only,
and raises NoPathError where it finds nothing. What it gives is measured, checked and filtered here, the same for all planners.
Compiled code is imported by the functions that need it: settings are read without it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, model_validator

from cosfly.chance import rng_for
from cosfly.config import Config
from cosfly.errors import InputError, NoPathError
from cosfly.flight_metrics import ACCEL_RMS_MAX_MPS2, FIVE_RAY_MEAN_MIN, JERK_RMS_MAX_MPS3, flight_metrics
from cosfly.geometry import DT_S, look_at
from cosfly.products.boxes import BoxMap, read_boxes
from cosfly.products.traces import DroneTrace, write_traces
from cosfly.products.walks import TARGET_HEIGHT_M, Walk, read_paths
from cosfly.runner import Item, Outcome, Work, run_items
from cosfly.stage_folder import Dropped, Failed, Kept, Resume, StageFolder
from cosfly.store import write_bytes

if TYPE_CHECKING:
    from cosfly.kernels import BoxIndex

PLANNERS = {"muco": "cosfly.planners.muco:plan", "track_astar": "cosfly.planners.track_astar:plan"}

CLEARANCE_CAP_M = 100.0  # a product holds finite numbers: obstacles farther away than this count as this far
COORDINATE_MAX_M = 1e6  # beyond, float32 depth and four decimals of a metre in the files lose their meaning
CHECK_TOLERANCE_M = 1e-3  # files keep a tenth of a millimetre


# --- settings ---------------------------------------------------------------------------------------------------------


class MucoConfig(Config):
    """Settings of the MuCO optimiser (subsec:appendix_planner_muco)."""

    track_distance_m: float = Field(28.0, gt=0, description="wanted distance to the target, m")
    weight_tracking: float = Field(2.0, ge=0, description="weight of (distance - track_distance_m)^2")
    weight_smoothness: float = Field(4.0, ge=0, description="weight of the squared second difference")
    weight_jerk: float = Field(3.0, ge=0, description="weight of the squared third difference")
    weight_safety: float = Field(2.0, ge=0, description="weight of half the squared intrusion into influence_m")
    weight_visibility: float = Field(2.0, ge=0, description="weight of (1 - five-ray visibility)^2")
    weight_view_angle: float = Field(1.0, ge=0, description="weight of squared pitch and azimuth deviation, per rad^2")
    weight_path_length: float = Field(2.0, ge=0, description="weight of a tenth of the path length")
    weight_below: float = Field(50.0, ge=0, description="weight of squared altitude below altitude_min_m")
    weight_above: float = Field(20.0, ge=0, description="weight of squared altitude above altitude_preferred_m")
    weight_oscillation: float = Field(8.0, ge=0, description="weight of the squared change of altitude per step")
    weight_pitch: float = Field(
        20.0, ge=0, description="weight of squared pitch outside pitch_band_deg, per rad^2 (the paper names none)"
    )
    influence_m: float = Field(8.0, gt=0, description="obstacles nearer than this add to the safety term, m")
    pitch_deg: float = Field(45.0, gt=0, lt=90, description="wanted downward pitch of the camera, degrees")
    pitch_band_deg: tuple[float, float] = Field(
        (30.0, 60.0), description="pitch outside this band costs extra, degrees"
    )
    low_visibility: float = Field(0.3, ge=0, le=1, description="visibility below this is low")
    low_visibility_frames: int = Field(
        20, ge=1, description="so many low frames in a row take visibility and view angle out of the gradient"
    )
    step: Literal["newton", "paper"] = Field(
        "newton", description="newton: band-matrix step, halved until the loss falls; paper: plain step, may overshoot"
    )
    gradient: Literal["analytic", "finite_difference"] = Field(
        "analytic", description="of all terms but visibility, whose gradient is always a difference"
    )
    difference_m: float = Field(0.5, gt=0, description="half width of the difference window, m")
    learning_rate: float = Field(0.05, gt=0, description="of the paper's step; the newton step has none")
    step_cap_m: float = Field(0.5, gt=0, description="longest move of a waypoint in one iteration, m")
    iterations_max: int = Field(1500, ge=0, description="iterations at most")
    tolerance: float = Field(1e-5, gt=0, description="converged when the loss changes by less than this part of it")
    pushes_max: int = Field(10, ge=1, description="pushes out of obstacles per waypoint and projection, at most")
    start_visibility: float = Field(
        0.95,
        ge=0,
        le=1,
        description="search for a better start when flying plainly behind sees less than this; 0: never",
    )

    @model_validator(mode="after")
    def _check(self) -> MucoConfig:
        low, high = self.pitch_band_deg
        if not 0 <= low < high <= 90:
            raise ValueError("pitch_band_deg must be two angles from 0 to 90, the lower one first")
        return self


class TrackAStarConfig(Config):
    """Settings of TA*+Smooth (subsec:appendix_planner_tastar); what the terms are stands in track_astar.py."""

    voxel_m: float = Field(4.0, gt=0, description="voxel size in the plane, m")
    voxel_height_m: float = Field(4.0, gt=0, description="voxel height, m")
    corridor_m: float = Field(45.0, gt=0, description="horizontal margin of the grid round the walk, m")
    beam: int = Field(2048, ge=1, description="places kept per time layer")
    weight_tracking: float = Field(2.0, ge=0, description="weight of the distance to the preferred ring, in voxels")
    weight_visibility: float = Field(18.0, ge=0, description="weight of the blocked part of the five rays")
    weight_path: float = Field(1.0, ge=0, description="weight of the way, in voxels")
    weight_safety: float = Field(8.0, ge=0, description="weight of the squared intrusion into influence_m")
    weight_smoothness: float = Field(0.15, ge=0, description="weight of the squared change of the move, in voxels")
    influence_m: float = Field(8.0, gt=0, description="obstacles nearer than this add to the safety term, m")
    shortcut_frames: int = Field(12, ge=0, description="longest run replaced by a straight line, frames; 0: none")
    elastic_iterations: int = Field(30, ge=0, description="iterations of the elastic band at most; 0: none")
    elastic_step: float = Field(0.35, gt=0, le=1, description="step towards the middle of the neighbours")
    elastic_step_min: float = Field(0.02, gt=0, le=1, description="a step that is not valid is halved down to this")
    anchor_visibility: float = Field(0.999, ge=0, le=1, description="visibility above this counts as full")
    visibility_loss_point: float = Field(0.05, ge=0, le=1, description="visibility that one change may cost a frame")
    visibility_loss_frame: float = Field(0.10, ge=0, le=1, description="visibility that smoothing may cost a frame")
    visibility_loss_mean: float = Field(0.05, ge=0, le=1, description="mean visibility that smoothing may cost")


class PlanConfig(Config):
    """Settings of step 4, shared by all planners (tab:drone_params); altitudes count from the ground under the walk."""

    planner: Literal["muco", "track_astar"] = Field("muco", description="which planner flies")
    safety_distance_m: float = Field(3.0, gt=0, description="nominal distance to obstacles, m")
    relaxed_safety_m: float = Field(2.5, gt=0, description="distance that must be kept where the nominal one cannot, m")
    altitude_min_m: float = Field(20.0, gt=0, description="least altitude, m")
    altitude_preferred_m: float = Field(20.0, gt=0, description="preferred altitude, m")
    altitude_max_m: float = Field(100.0, gt=0, description="greatest altitude, m")
    behind_distance_m: float = Field(20.0, gt=0, description="horizontal distance behind the target at the start, m")
    speed_max_mps: float = Field(10.0, gt=0, description="greatest speed between two waypoints, m/s")
    heading_smoothing_s: float = Field(
        4.0, ge=0, description="standard deviation of the smoothing of the walking direction, s; 0: none"
    )
    five_ray_mean_min: float = Field(
        FIVE_RAY_MEAN_MIN, ge=0, le=1, description="drop a flight whose mean five-ray visibility is below this; 0: never",
        json_schema_extra={"formerly": "visibility_min"},
    )  # fmt: skip
    accel_rms_max_mps2: float = Field(
        ACCEL_RMS_MAX_MPS2, gt=0, description="drop a flight of greater RMS acceleration, m/s^2"
    )
    jerk_rms_max_mps3: float = Field(JERK_RMS_MAX_MPS3, gt=0, description="drop a flight of greater RMS jerk, m/s^3")
    muco: MucoConfig = Field(default_factory=MucoConfig, description="the MuCO optimiser")
    track_astar: TrackAStarConfig = Field(default_factory=TrackAStarConfig, description="TA*+Smooth")

    @model_validator(mode="after")
    def _check(self) -> PlanConfig:
        if self.relaxed_safety_m > self.safety_distance_m:
            raise ValueError("relaxed_safety_m may not exceed safety_distance_m")
        if not self.altitude_min_m <= self.altitude_preferred_m <= self.altitude_max_m:
            raise ValueError("altitude_min_m, altitude_preferred_m and altitude_max_m must be in ascending order")
        return self


# --- one walk ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scenario:
    """What a planner gets to know. targets_m: (n, 3) hip points, n >= 2, DT_S apart. ground_m: height of the ground below."""

    path_id: str
    targets_m: np.ndarray
    ground_m: float


@dataclass(frozen=True)
class Plan:
    """What a planner gives. positions_m: (n, 3), one per target. solver: JSON-able facts, no times (they would differ)."""

    positions_m: np.ndarray
    solver: dict = field(default_factory=dict)


Planner = Callable[[Scenario, "BoxIndex", PlanConfig, np.random.Generator], Plan]


def load_planner(name: str) -> Planner:
    """Import a planner of PLANNERS."""
    module, _, function = PLANNERS[name].partition(":")
    return getattr(importlib.import_module(module), function)


def make_scenario(walk: Walk, obstacles: BoxIndex) -> Scenario:
    """Check a walk and give the scenario of it.

    Raises:
        NoPathError: nobody can walk or follow this: one point, uneven times, huge coordinates, or a way through a box.
    """
    from cosfly.kernels import segments_hit

    targets = walk.positions_m + np.array([0.0, 0.0, TARGET_HEIGHT_M])
    if len(targets) < 2:
        raise NoPathError("a walk of one point cannot be followed", where=walk.path_id, expected="two points or more")
    uneven = np.abs(np.diff(walk.time_s) - DT_S) > 1e-3
    if uneven.any():
        raise NoPathError(
            "uneven time stamps",
            where=f"{walk.path_id}: t[{int(np.argmax(uneven)) + 1}]",
            got=f"a step of {np.diff(walk.time_s)[uneven][0]:g} s",
            expected=f"{DT_S:g} s",
        )
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
    return Scenario(walk.path_id, targets, float(np.median(walk.positions_m[:, 2])))


def plan_flight(walk: Walk, obstacles: BoxIndex, cfg: PlanConfig, seed: int) -> DroneTrace:
    """Plan, measure and check one flight.

    Raises:
        NoPathError: the walk cannot be followed, or the planner's flight is not free of collisions.
    """
    from cosfly.kernels import segments_hit, signed_distances, visibility

    scenario = make_scenario(walk, obstacles)
    made = load_planner(cfg.planner)(scenario, obstacles, cfg, rng_for(seed, "plan", walk.path_id))
    positions = np.round(made.positions_m, 4)  # measured as it is written
    targets = np.round(scenario.targets_m, 4)
    clearances, _ = signed_distances(obstacles, positions, CLEARANCE_CAP_M)
    if (
        clearances.min() < cfg.relaxed_safety_m - CHECK_TOLERANCE_M
        or segments_hit(obstacles, positions[:-1], positions[1:]).any()
    ):
        raise NoPathError(
            f"planner {cfg.planner} found no flight that is free of collisions", where=walk.path_id,
            got=f"a least clearance of {clearances.min():.2f} m", expected=f"{cfg.relaxed_safety_m:g} m and no segment in a box",
        )  # fmt: skip
    pitch, yaw = look_at(positions, targets)
    rotations = np.degrees(np.stack([pitch, yaw, np.zeros_like(yaw)], axis=1))
    seen = visibility(obstacles, positions, targets)
    metrics = flight_metrics(positions, targets, seen, clearances, scenario.ground_m)
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
        drop_reason=drop_reason(metrics, cfg),
    )


def drop_reason(metrics: dict[str, float], cfg: PlanConfig) -> str | None:
    """Give why the prefilter before rendering rejects a flight, None if it passes (sec:step6)."""
    if metrics["five_ray_mean"] < cfg.five_ray_mean_min:
        return "low_visibility"
    if metrics["accel_rms_mps2"] > cfg.accel_rms_max_mps2:
        return "high_acceleration"
    if metrics["jerk_rms_mps3"] > cfg.jerk_rms_max_mps3:
        return "high_jerk"
    return None


# --- stage ------------------------------------------------------------------------------------------------------------


def make_worker(cfg: PlanConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; give the function that plans one walk."""
    from cosfly.kernels import obstacle_index

    obstacles = obstacle_index(read_boxes(simplified_map))
    _warm_up(cfg)

    def work(item: Item) -> Outcome:
        trace = plan_flight(item.payload, obstacles, cfg, seed)
        return Outcome(trace.as_json(), trace.drop_reason)

    return work


def _warm_up(cfg: PlanConfig) -> None:
    """Compile or load compiled code before the first walk, so that times per walk are planning times."""
    from cosfly.kernels import index_boxes

    walk = np.arange(8.0)
    positions = np.column_stack([0.5 * walk, np.zeros(8), np.zeros(8)])
    in_the_way = (
        np.array([[-10.0, 0.0, 15.0]]),
        np.array([[1.0, 3.0, 15.0]]),
    )  # hides the walk from behind: search runs too
    obstacles = index_boxes(*in_the_way, np.eye(3)[None])
    plan_flight(Walk("warm-up", positions[:, :2], DT_S * walk, positions, np.ones(8)), obstacles, cfg, 0)


def run(
    cfg: PlanConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 1,
    resume: Resume = "if-same",
) -> Path:
    """Reads a simplified map and `path.json`, writes `drone_trace.json` and `plan.png`; gives the former's path.

    Flights that the prefilter drops are written too, with their reason; a walk without a flight is a counted failure.

    Raises:
        InputError: a file is not what it must be.
        NothingKept: not one walk has a flight, or the prefilter dropped them all.
    """
    from cosfly.planners.overview import draw_flights

    stage = StageFolder.open(
        out, "plan", config=cfg, inputs={"map": simplified_map, "paths": paths}, seed=seed, resume=resume
    )  # fmt: skip
    product, picture = out / "drone_trace.json", out / "plan.png"
    if stage.is_complete:
        return product
    box_map, walks = read_boxes(simplified_map), read_paths(paths)
    _check_ids(walks, paths)
    items = [Item(walk.path_id, walk) for walk in walks]
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers)
    planned = [record for record in finished.records if not isinstance(record, Failed)]
    if not planned:
        raise stage.nothing_kept(finished.tally)
    traces = [DroneTrace.from_json(record.result, f"{stage.path}/items.jsonl: {record.id}") for record in planned]
    header = {"map": box_map.name, "planner": cfg.planner, "seed": seed, "settings": cfg.model_dump(mode="json")}
    write_traces(product, traces, header)
    write_bytes(picture, draw_flights(box_map, walks, traces))
    stage.finish([product, picture], finished.tally, **_facts(box_map, traces, planned))
    return product


def _facts(box_map: BoxMap, traces: list[DroneTrace], records: list[Kept | Dropped]) -> dict:
    """What the manifest says beyond the counts; planning times stand here and not in the product."""
    times_ms = np.array([1000.0 * record.seconds for record in records])
    names = ("five_ray_mean", "clearance_min_m", "altitude_mean_m", "target_distance_mean_m", "smoothness_score")
    return {
        "num_boxes": len(box_map),
        "planning_ms": {"mean": round(float(times_ms.mean()), 1), "max": round(float(times_ms.max()), 1)},
        "means": {name: round(float(np.mean([trace.metrics[name] for trace in traces])), 4) for name in names},
    }


def _check_ids(walks: list[Walk], paths: Path) -> None:
    if not walks:
        raise InputError("there are no paths", where=f"{paths}: paths", fix="run the pedestrians stage again")
    known: set[str] = set()
    for walk in walks:
        if walk.path_id in known:
            raise InputError("a path id occurs more than once", where=f"{paths}: paths", got=walk.path_id)
        known.add(walk.path_id)
