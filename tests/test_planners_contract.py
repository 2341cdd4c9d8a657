"""What every planner must keep (cosfly/planners/contract.py), over every entry of ALL_PLANNERS and several worlds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from specimens_planning import CANYON, WORLDS, assert_safe, town_of, walk_along
from tables import each

from cosfly.geometry import kernels
from cosfly.geometry.axes import DT_S, look_at
from cosfly.planners import contract
from cosfly.planners.contract import ALL_PLANNERS, REFERENCES, Plan, PlanConfig, load_planner
from cosfly.planners.stage import make_scenario, plan_trajectory
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.seeding import rng_for

UP_M = 30.0
ON_A_HILL = {"on_a_hill": (town_of(*CANYON), [(0, 0), (40, 0)])}  # lifted by UP_M, walk and all
TWO_POINTS = {"two_points": (town_of(((10, 9, 5), (2, 2, 5))), [(0, 0), (0.7, 0)])}
ALL = WORLDS | ON_A_HILL | TWO_POINTS
# Straight through the middle of a block: repair of what knows no way round it does not come to an end.
NOT_REPAIRED = {("minimum_jerk", "corner"), ("trajopt", "corner")}


# The planners that a run flies with; those of the comparison take longer.
EACH_PLANNER = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in REFERENCES else ()) for name in ALL_PLANNERS]
)


@EACH_PLANNER
def test_a_flight_is_whole_safe_and_smooth_and_sees_the_target_it_looks_at(name, subtests):
    for world in ALL:
        with subtests.test(world=world):
            check_flight(name, world)


def check_flight(name: str, world: str) -> None:
    box_map, corners = ALL[world]
    walk, up = walk_along(world, corners), np.array([0.0, 0.0, UP_M * (world in ON_A_HILL)])
    walk = replace(walk, positions_m=walk.positions_m + up)
    obstacles = kernels.obstacle_index(replace(box_map, centers=box_map.centers + up))
    cfg = PlanConfig(planner=name)
    if (name, world) in NOT_REPAIRED:
        with pytest.raises(NoPathError, match=f"{world}: .*no trajectory within the limits"):
            plan_trajectory(walk, obstacles, cfg, 0)
        return
    trace = plan_trajectory(walk, obstacles, cfg, 0)
    assert trace.positions_m.shape == (len(walk.time_s), 3)
    assert_safe(trace.positions_m, obstacles, cfg, ground_m=up[2])
    json.dumps(trace.solver, allow_nan=False)
    assert trace.planner == cfg.planner
    assert trace.metrics["accel_rms_mps2"] <= cfg.accel_rms_max_mps2
    assert trace.metrics["jerk_rms_mps3"] <= cfg.jerk_rms_max_mps3
    assert trace.metrics["clearance_min_m"] >= cfg.relaxed_safety_m
    assert trace.metrics["five_ray_mean"] == pytest.approx(trace.visibility.mean(), abs=1e-4)
    assert np.isfinite(trace.clearances_m).all()
    pitch, yaw = look_at(trace.positions_m, trace.targets_m)
    flown_deg = np.degrees(np.unwrap(np.radians(trace.rotations_deg[:, 1])))
    most_degps = np.abs(np.diff(flown_deg)).max() / DT_S
    assert most_degps <= cfg.yaw_rate_max_degps + 0.01
    if np.abs(np.diff(np.unwrap(yaw))).max() <= np.radians(cfg.yaw_rate_max_degps) * DT_S:  # else it turns more slowly
        np.testing.assert_allclose(trace.rotations_deg, np.degrees(np.stack([pitch, yaw, 0 * yaw], axis=1)))
    if name in REFERENCES:
        return  # it knows nothing of sight, and goes by itself
    assert trace.drop_reason is None
    assert trace.visibility.mean() >= 0.88
    assert (trace.rotations_deg[:, 0] < -20).all()
    np.testing.assert_allclose(np.linalg.norm(trace.positions_m - trace.targets_m, axis=1), 28, atol=8)
    if name == "foresight":  # it sees at least as well as from where it would best like to be
        scenario = make_scenario(walk, obstacles, cfg)
        requested = scenario.reference.places_m(scenario.targets_m, scenario.ground_m)
        seen = kernels.visibility(obstacles, requested, scenario.targets_m).mean()
        assert trace.visibility.mean() >= min(seen, 0.99) - 0.01
    if name == "track_astar" and world in WORLDS:  # it keeps the nominal distance
        assert trace.metrics["clearance_min_m"] >= cfg.safety_distance_m - 1e-3
        assert trace.visibility.mean() >= 0.95
        assert trace.solver["smooth"]


@EACH_PLANNER
def test_the_same_seed_gives_the_same_flight_and_inputs_stay_as_they_are(name):
    box_map, corners = WORLDS["tower_midway"]
    walk, obstacles, cfg = walk_along("w", corners), kernels.obstacle_index(box_map), PlanConfig(planner=name)
    scenario = make_scenario(walk, obstacles, cfg)
    before = [part.copy() for part in (scenario.targets_m, *obstacles)]
    plan = load_planner(name)(scenario, obstacles, cfg, rng_for(0, "plan", walk.path_id))
    for part, was in zip((scenario.targets_m, *obstacles), before, strict=True):
        np.testing.assert_array_equal(part, was)
    trace = plan_trajectory(walk, obstacles, cfg, 0)
    np.testing.assert_array_equal(trace.positions_m, np.round(plan.positions_m, 4))
    assert json.dumps(trace.solver) == json.dumps(plan.solver)


@EACH_PLANNER
def test_the_time_step_is_the_pedestrians(name, subtests):
    for dt_s in (0.25, 1.0):
        with subtests.test(dt_s=dt_s):
            check_time_step(name, dt_s)


def check_time_step(name: str, dt_s: float) -> None:
    box_map, corners = WORLDS["canyon"]
    walk = walk_along("w", corners, dt_s=dt_s)
    cfg = PlanConfig(planner=name, speed_max_mps=3.0)
    trace = plan_trajectory(walk, kernels.obstacle_index(box_map), cfg, 0)
    steps_m = np.linalg.norm(np.diff(trace.positions_m, axis=0), axis=1)
    assert steps_m.max() <= 3.0 * dt_s + 1e-3
    assert trace.metrics["speed_max_mps"] == pytest.approx(steps_m.max() / dt_s, abs=1e-3)
    assert trace.metrics["duration_s"] == pytest.approx((len(walk.time_s) - 1) * dt_s)
    accel = np.linalg.norm(np.diff(trace.positions_m, n=2, axis=0), axis=1) / dt_s**2
    assert trace.metrics["accel_rms_mps2"] == pytest.approx(np.sqrt((accel**2).mean()), abs=1e-3)


@each("name", ALL_PLANNERS)
def test_where_there_is_no_way_it_says_so(name):
    roof = kernels.obstacle_index(town_of(((0, 0, 60), (300, 300, 50))))
    scenario = make_scenario(walk_along("w", [(0, 0), (50, 0)]), roof, PlanConfig())
    with pytest.raises(NoPathError, match=r"no (free|collision-free) ") as caught:
        load_planner(name)(scenario, roof, PlanConfig(planner=name), np.random.default_rng(0))
    assert caught.value.where == "w"


def fly_low_and_straight(scenario, obstacles, cfg, rng):
    return Plan(scenario.targets_m - np.array([20.0, 0.0, -20.0]))


def test_a_planner_that_flies_into_a_tower_is_found_out(monkeypatch):
    monkeypatch.setitem(contract.ALL_PLANNERS, "low", f"{__name__}:fly_low_and_straight")
    box_map, corners = WORLDS["tower_behind"]
    with pytest.raises(NoPathError, match="planner low found no drone trajectory with enough clearance"):
        plan_trajectory(walk_along("w", corners), kernels.obstacle_index(box_map), PlanConfig(planner="low"), 0)


def test_an_unknown_planner_is_named():
    with pytest.raises(ValueError, match="did you mean 'muco'"):
        PlanConfig(planner="mucco")
