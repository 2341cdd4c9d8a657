"""One contract for every planner; the gimbal; the comparison with the paper's tables as known answers."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from specimens_planning import CANYON, WORLDS, assert_safe, town_of, walk_along, written

from cosfly.formats.frames import Camera
from cosfly.formats.traces import read_traces
from cosfly.geometry import kernels
from cosfly.geometry.axes import DT_S, intrinsic_matrix, look_at, project, world_from_camera, wrap_deg
from cosfly.pipeline.reproduce import read_paper
from cosfly.planners import compare, contract
from cosfly.planners.compare import CRITERIA, CompareConfig, PlannedItem
from cosfly.planners.contract import ALL_PLANNERS, REFERENCES, Plan, PlanConfig, load_planner, title_of
from cosfly.planners.gimbal import GimbalConfig, follow_direction, limit_yaw_rate
from cosfly.planners.stage import make_scenario, plan_trajectory
from cosfly.runtime.errors import EnvironmentMissing, NoPathError
from cosfly.runtime.journal import Journal
from cosfly.runtime.run_dir import read_item, result_of
from cosfly.runtime.seeding import draw_smooth, rng_for

UP_M = 30.0
ON_A_HILL = {"on_a_hill": (town_of(*CANYON), [(0, 0), (40, 0)])}  # lifted by UP_M, walk and all
ALL = WORLDS | ON_A_HILL | {"two_points": (town_of(((10, 9, 5), (2, 2, 5))), [(0, 0), (0.7, 0)])}
# Straight through the middle of a block: repair of what knows no way round it does not come to an end.
NOT_REPAIRED = {("minimum_jerk", "corner"), ("trajopt", "corner")}


# The planners that a run flies with; those of the comparison take longer.
EACH_PLANNER = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in REFERENCES else ()) for name in ALL_PLANNERS]
)


@EACH_PLANNER
@pytest.mark.parametrize("world", ALL)
def test_a_flight_is_whole_safe_and_smooth_and_sees_the_target_it_looks_at(name, world):
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
@pytest.mark.parametrize("dt_s", [0.25, 1.0])
def test_the_time_step_is_the_pedestrians(name, dt_s):
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


@pytest.mark.parametrize("name", ALL_PLANNERS)
def test_where_there_is_no_way_it_says_so(name):
    roof = kernels.obstacle_index(town_of(((0, 0, 60), (300, 300, 50))))
    scenario = make_scenario(walk_along("w", [(0, 0), (50, 0)]), roof, PlanConfig())
    with pytest.raises(NoPathError) as caught:
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


OPEN = kernels.obstacle_index(town_of())
STRAIGHT = walk_along("straight", [(0, 0), (90, 0)])
CAMERA = Camera(640, 360, intrinsic_matrix(640, 360, 60.0))
GIMBAL = GimbalConfig(bandwidth_hz=0.2, delay_s=0.2, error_deg=4.0)


def overhead(aside_m):
    """A target that passes under a drone at 2 m/s: drone and target, (n, 3)."""
    target = np.column_stack([np.arange(-20.0, 21.0), np.full(41, aside_m), np.zeros(41)])
    return np.tile([0.0, 0.0, 21.0], (41, 1)), target


def pixels(drone, target, pitch, yaw):
    poses = np.degrees(np.column_stack([pitch, yaw, 0.0 * yaw]))
    views = [world_from_camera(place, pose) for place, pose in zip(drone, poses, strict=True)]
    return np.array([project(at[None], view, CAMERA.intrinsic)[0][0] for at, view in zip(target, views, strict=True)])


def rates_degps(yaw):
    return np.abs(wrap_deg(np.degrees(np.diff(yaw)))) / DT_S


@pytest.mark.parametrize("aside_m", [0.5, -0.5, 1.0])
def test_a_camera_that_passes_over_its_target_turns_slowly_and_keeps_it_in_the_picture(aside_m):
    drone, target = overhead(aside_m)
    pitch, yaw = look_at(drone, target)
    assert rates_degps(yaw).max() > 60.0
    limited = limit_yaw_rate(pitch, yaw, 60.0, DT_S)
    assert rates_degps(limited[1]).max() <= 60.0 + 1e-9
    uv = pixels(drone, target, *limited)
    assert ((uv > 0) & (uv < [CAMERA.width_px, CAMERA.height_px])).all()
    np.testing.assert_allclose(limited[1][[0, -1]], yaw[[0, -1]])


def test_the_gimbal_lags_behind_a_target_that_moves_through_the_picture():
    yaw = np.radians(10.0 * DT_S * np.arange(60))
    exact = GIMBAL.model_copy(update={"error_deg": 0.0})
    pitch, followed = follow_direction(0.0 * yaw, yaw, exact, 60.0, DT_S, np.random.default_rng(0))
    # A loop without feed-forward lags by rate x (2 x damping / natural frequency + delay).
    lag_s = 2.0 * GIMBAL.damping / (2.0 * np.pi * GIMBAL.bandwidth_hz) + GIMBAL.delay_s
    assert wrap_deg(np.degrees(yaw - followed))[-1] == pytest.approx(10.0 * lag_s, rel=0.05)
    assert np.abs(pitch).max() < 1e-9


def test_the_aiming_error_has_its_standard_deviation_and_is_smooth():
    still = np.zeros(20_000)
    pitch, yaw = follow_direction(still, still, GIMBAL, 60.0, DT_S, np.random.default_rng(0))
    assert np.degrees(yaw.std()) == pytest.approx(4.0, rel=0.1)
    assert np.degrees(pitch.std()) == pytest.approx(2.0, rel=0.1)
    assert rates_degps(yaw).max() < 5.0


def test_the_gimbal_turns_no_faster_than_the_limit():
    yaw = np.where(np.arange(40) < 20, 0.0, 2.5)
    _, followed = follow_direction(0.0 * yaw, yaw, GIMBAL, 30.0, DT_S, np.random.default_rng(0))
    assert 25.0 < rates_degps(followed).max() <= 30.0 + 1e-9


def test_a_plan_with_a_gimbal_flies_the_same_way_and_looks_elsewhere():
    exact, loose, again, other = (
        plan_trajectory(STRAIGHT, OPEN, PlanConfig(gimbal=gimbal), seed)
        for gimbal, seed in ((GimbalConfig(), 0), (GIMBAL, 0), (GIMBAL, 0), (GIMBAL, 1))
    )
    np.testing.assert_array_equal(exact.positions_m, loose.positions_m)
    np.testing.assert_array_equal(loose.rotations_deg, again.rotations_deg)
    assert np.abs(wrap_deg(loose.rotations_deg - exact.rotations_deg)[:, 1]).max() > 3.0
    assert np.abs(wrap_deg(loose.rotations_deg - other.rotations_deg)[:, 1]).max() > 3.0


def test_new_settings_are_recorded_only_where_they_are_set():
    assert not {"gimbal", "yaw_rate_max_degps"} & PlanConfig().recorded().keys()
    recorded = PlanConfig(gimbal=GIMBAL, yaw_rate_max_degps=90.0).recorded()
    assert recorded["yaw_rate_max_degps"] == 90.0
    assert recorded["gimbal"]["bandwidth_hz"] == 0.2


@pytest.mark.parametrize("correlation_s", [1.0, 6.0])
def test_smooth_draws_have_the_stated_covariance(correlation_s):
    drawn = draw_smooth(100_000, 2, DT_S, correlation_s, np.random.default_rng(0))
    np.testing.assert_allclose(drawn.std(axis=0), 1.0, rtol=0.03)
    steps = round(correlation_s / DT_S)
    found = (drawn[steps:] * drawn[:-steps]).mean(axis=0)
    np.testing.assert_allclose(found, np.exp(-0.5), atol=0.05)
    assert abs((drawn[:, 0] * drawn[:, 1]).mean()) < 0.05


FEW = ("foresight", "track_astar", "muco", "minimum_jerk", "theta_star")


def test_the_weights_are_those_of_the_papers_printed_scores_and_every_planner_has_its_group():
    rows = read_paper().tables["tab:appendix_h_extended_ranking"].paper_rows
    assert set(rows) == {title_of(name) for name in ALL_PLANNERS} - {"foresight"}
    for score, *normalized in rows.values():
        assert np.dot(normalized, [weight for *_, weight in CRITERIA.values()]) == pytest.approx(score, abs=1e-4)
    assert list(CRITERIA) == ["visibility", "collision", "clearance"]
    assert sorted(compare.GROUP_OF) == sorted(ALL_PLANNERS)


def test_what_is_not_flown_is_counted_and_stays_in_every_table(tmp_path):
    """A walk round a corner, through whose block minimum jerk finds no way, one along a wall, and one into a wall."""
    (box_map, corners), made = WORLDS["corner"], tmp_path / "compare"
    inputs = written(tmp_path, box_map, round=corners, along=[(-30, 0), (0, 0)], into_wall=[(0, 0), (0, 20)])
    compare.run(CompareConfig(planners=FEW), *inputs, made)
    found = json.loads((made / "compare.json").read_text())
    assert ([one["id"] for one in found["scenarios"]], list(found["infeasible"])) == (["round", "along"], ["round"])
    assert "no trajectory within the limits" in found["infeasible"]["round"]["minimum_jerk"]
    assert found["scenarios"][0]["minimum_jerk"] is None
    means, manifest = found["means"], json.loads((made / "manifest.json").read_text())
    assert manifest["counts"] == {"input": 3, "kept": 2, "dropped": {}, "failed": {"no_path": 1}}
    for planner in FEW:
        traces, flown = read_traces(made / f"drone_trace_{planner}.json"), 1 if planner == "minimum_jerk" else 2
        assert [trace.path_id for trace in traces] == ["round", "along"][-flown:]
        seen = sum(trace.visibility.mean() for trace in traces) / 2
        assert means[planner]["five_ray_mean"] == pytest.approx(seen, abs=1e-4)
        assert means[planner]["blocked_rays"] == pytest.approx(1 - seen, abs=1e-3)
        assert means[planner]["collision_fraction"] == 1 - flown / 2
        assert manifest["timings"][planner]["mean_ms"] > 0
        if planner != FEW[0]:
            free = {"count": flown, "of": flown, "rate": 1.0}
            assert found["win_rates"][planner]["both_collision_free"] == free
    along = found["scenarios"][1]["minimum_jerk"]
    assert means["minimum_jerk"]["clearance_min_m"] == pytest.approx(along["clearance_min_m"] / 2, abs=1e-4)
    assert means["minimum_jerk"]["length_m"] == pytest.approx(along["length_m"], abs=1e-4)
    assert found["ranking"]["minimum_jerk"]["normalized"]["collision"] == 0.0
    for table in (found["axes"], found["ranking"], means):
        assert set(table) == set(FEW)
    sight, *_ = tables = list(compare.text_tables(made / "compare.json"))
    assert ["minimum jerk", "1 of 2", "1 of 2"] in [row[:3] for row in sight.rows]
    assert all(len(row) == len(table.columns) for table in tables for row in table.rows)
    assert [len(table.rows) for table in tables] == [5, 5, 5, 5, 4, 4, 4]
    pair = found["groups"]["target-aware"]
    change = means["foresight"]["length_m"] - means["muco"]["length_m"]
    assert found["deltas"]["muco"]["length_m"]["delta"] == pytest.approx(change, abs=1e-3)
    mean = (means["track_astar"]["five_ray_mean"] + means["muco"]["five_ray_mean"]) / 2
    assert (pair["num_planners"], pair["figures"]["five_ray_mean"]) == (2, pytest.approx(mean, abs=1e-4))
    records = [record for record in Journal(made / "items.jsonl").read_as(read_item) if record.status == "kept"]
    flown = [result_of(record, PlannedItem) for record in records]
    assert [set(one.traces) | set(one.errors) for one in flown] == [set(FEW)] * 2


def test_without_ompl_the_error_names_the_extra_and_the_planners_to_leave_out(tmp_path, monkeypatch):
    inputs = written(tmp_path, town_of(), along=[(-30, 0), (0, 0)])
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(EnvironmentMissing, match="OMPL is not installed") as caught:
        compare.run(CompareConfig(planners=("theta_star", "rrt_star")), *inputs, tmp_path / "out")
    assert caught.value.fix == 'pip install -e ".[ompl]", or leave out the planners rrt_star, prm and bspline_prm'


# tab:appendix_h_tastar_muco_delta and tab:appendix_h_four_axis_scores of the paper.
DELTAS_OF_PAPER = {
    "track_astar": {"five_ray_mean": 0.979, "length_m": 104.479, "accel_rms_mps2": 0.673, "jerk_rms_mps3": 0.919,
        "clearance_min_m": 4.029},
    "muco": {"five_ray_mean": 0.894, "length_m": 108.838, "accel_rms_mps2": 0.738, "jerk_rms_mps3": 0.773,
        "clearance_min_m": 2.754},
    "spline": {"five_ray_mean": 0.618, "length_m": 85.73, "jerk_rms_mps3": 1.433, "clearance_min_m": 1.775},
    "jerk": {"five_ray_mean": 0.624, "length_m": 84.4, "jerk_rms_mps3": 1.732, "collision_fraction": 0.002,
        "clearance_min_m": 1.137},
}  # fmt: skip
SCORES = {
    "track_astar": (0.979, 0.821, 0.521, 0.806, 0.782),
    "muco": (0.894, 0.788, 0.564, 0.551, 0.699),
    "spline": (0.618, 1.000, 0.411, 0.355, 0.596),
    "jerk": (0.624, 1.016, 0.366, 0.227, 0.558),
}


def figures(**given):
    return {name: 0.0 for name, _, _ in compare.FIGURES} | given


def test_axis_scores_are_the_papers_and_a_planner_that_collides_sets_no_shortest_path():
    scores = compare.axis_scores({name: figures(**row) for name, row in DELTAS_OF_PAPER.items()})
    for name, expected in SCORES.items():
        assert list(scores[name].values()) == pytest.approx(expected, abs=1e-3)


def test_deltas_are_the_papers():
    table = compare.deltas(figures(**DELTAS_OF_PAPER["track_astar"]), figures(**DELTAS_OF_PAPER["muco"]))
    assert table["length_m"] == {"delta": -4.359, "relative_percent": pytest.approx(-4.005, abs=1e-3)}
    assert table["clearance_min_m"]["relative_percent"] == pytest.approx(46.283, abs=0.02)
    assert table["collision_fraction"] == {"delta": 0.0, "relative_percent": None}
