"""What every planner must keep (cosfly/planners/contract.py), over every entry of PLANNERS and several worlds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from specimens_planning import CANYON, WORLDS, assert_safe, town_of, walk_along

from cosfly.errors import NoPathError
from cosfly.geometry import look_at
from cosfly.planners import contract
from cosfly.planners.contract import PLANNERS, Plan, PlanConfig, load_planner
from cosfly.planners.stage import make_scenario, plan_flight
from cosfly.space import kernels
from cosfly.work.chance import rng_for

UP_M = 30.0
ON_A_HILL = {"on_a_hill": (town_of(*CANYON), [(0, 0), (40, 0)])}  # lifted by UP_M, walk and all
TWO_POINTS = {"two_points": (town_of(((10, 9, 5), (2, 2, 5))), [(0, 0), (0.7, 0)])}
ALL = WORLDS | ON_A_HILL | TWO_POINTS


@pytest.fixture(scope="module", params=[(name, world) for name in PLANNERS for world in ALL], ids="-".join)
def flown(request):
    """(walk, obstacles, settings, the planner's own plan, the stage's trace) of one planner in one world."""
    name, world = request.param
    box_map, corners = ALL[world]
    walk, up = walk_along(world, corners), np.array([0.0, 0.0, UP_M * (world in ON_A_HILL)])
    walk = replace(walk, positions_m=walk.positions_m + up)
    obstacles = kernels.obstacle_index(replace(box_map, centers=box_map.centers + up))
    cfg = PlanConfig(planner=name)
    scenario = make_scenario(walk, obstacles, cfg)
    before = scenario.targets_m.copy(), [part.copy() for part in obstacles]
    plan = load_planner(name)(scenario, obstacles, cfg, rng_for(0, "plan", walk.path_id))
    np.testing.assert_array_equal(scenario.targets_m, before[0])  # what a planner gets it leaves as it is
    for part, was in zip(obstacles, before[1], strict=True):
        np.testing.assert_array_equal(part, was)
    return walk, obstacles, cfg, plan, plan_flight(walk, obstacles, cfg, 0)


def test_one_finite_position_for_each_target(flown):
    walk, _, _, plan, _ = flown
    assert plan.positions_m.shape == (len(walk.time_s), 3)
    assert np.isfinite(plan.positions_m).all()
    json.dumps(plan.solver, allow_nan=False)


def test_the_flight_keeps_speed_altitude_and_distance_and_hits_nothing(flown):
    walk, obstacles, cfg, plan, _ = flown
    assert_safe(plan.positions_m, obstacles, cfg, ground_m=walk.positions_m[0, 2])


def test_the_same_seed_gives_the_same_flight_and_facts(flown):
    _, _, cfg, plan, trace = flown  # planned twice: alone, and by the stage with a generator of the same seed
    np.testing.assert_array_equal(trace.positions_m, np.round(plan.positions_m, 4))
    assert json.dumps(trace.solver) == json.dumps(plan.solver)
    assert trace.planner == cfg.planner


def test_the_flight_is_smooth_and_sees_and_the_camera_looks_at_the_target(flown):
    _, _, cfg, _, trace = flown
    assert trace.drop_reason is None
    assert trace.metrics["accel_rms_mps2"] <= cfg.accel_rms_max_mps2
    assert trace.metrics["jerk_rms_mps3"] <= cfg.jerk_rms_max_mps3
    assert trace.metrics["clearance_min_m"] >= cfg.relaxed_safety_m
    assert trace.visibility.mean() >= 0.88
    assert trace.metrics["five_ray_mean"] == pytest.approx(trace.visibility.mean(), abs=1e-4)
    assert np.isfinite(trace.clearances_m).all()
    pitch, yaw = look_at(trace.positions_m, trace.targets_m)
    np.testing.assert_allclose(trace.rotations_deg, np.degrees(np.stack([pitch, yaw, 0 * yaw], axis=1)))
    assert (trace.rotations_deg[:, 0] < -20).all()
    np.testing.assert_allclose(np.linalg.norm(trace.positions_m - trace.targets_m, axis=1), 28, atol=8)


@pytest.mark.parametrize("dt_s", [0.25, 1.0])
@pytest.mark.parametrize("name", PLANNERS)
def test_the_time_step_is_the_walks(name, dt_s):
    """Speed limit, metrics and duration count in the walk's own step."""
    box_map, corners = WORLDS["corner"]
    walk = walk_along("w", corners, dt_s=dt_s)
    cfg = PlanConfig(planner=name, speed_max_mps=3.0)
    trace = plan_flight(walk, kernels.obstacle_index(box_map), cfg, 0)
    steps_m = np.linalg.norm(np.diff(trace.positions_m, axis=0), axis=1)
    assert steps_m.max() <= 3.0 * dt_s + 1e-3
    assert trace.metrics["speed_max_mps"] == pytest.approx(steps_m.max() / dt_s, abs=1e-3)
    assert trace.metrics["duration_s"] == pytest.approx((len(walk.time_s) - 1) * dt_s)
    accel = np.linalg.norm(np.diff(trace.positions_m, n=2, axis=0), axis=1) / dt_s**2
    assert trace.metrics["accel_rms_mps2"] == pytest.approx(np.sqrt((accel**2).mean()), abs=1e-3)


@pytest.mark.parametrize("name", PLANNERS)
def test_where_there_is_no_way_it_says_so(name):
    roof = kernels.obstacle_index(town_of(((0, 0, 60), (300, 300, 50))))
    scenario = make_scenario(walk_along("w", [(0, 0), (50, 0)]), roof, PlanConfig())
    with pytest.raises(NoPathError, match="no free") as caught:
        load_planner(name)(scenario, roof, PlanConfig(planner=name), np.random.default_rng(0))
    assert caught.value.where == "w"


def fly_low_and_straight(scenario, obstacles, cfg, rng):
    return Plan(scenario.targets_m - np.array([20.0, 0.0, -20.0]))


def test_a_planner_that_flies_into_a_tower_is_found_out(monkeypatch):
    monkeypatch.setitem(contract.PLANNERS, "low", f"{__name__}:fly_low_and_straight")
    box_map, corners = WORLDS["tower_behind"]
    with pytest.raises(NoPathError, match="planner low found no flight that is free of collisions"):
        plan_flight(walk_along("w", corners), kernels.obstacle_index(box_map), PlanConfig(planner="low"), 0)


def test_an_unknown_planner_is_named():
    with pytest.raises(ValueError, match="did you mean 'muco'"):
        PlanConfig(planner="mucco")
