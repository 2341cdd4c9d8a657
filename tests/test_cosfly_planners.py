"""Metrics on analytic curves, MuCO's terms against plain versions, whole flights over hand-made maps, and the plan
stage.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from specimens_planning import CANYON, WORLDS, assert_safe, first_points, scenario_of, town_of, walk_along
from tables import each

import cosfly.planners.stage as planners
from cosfly.formats.boxes import write_boxes
from cosfly.formats.pedestrian_paths import write_paths
from cosfly.formats.traces import read_traces
from cosfly.geometry import kernels
from cosfly.geometry import trajectory_metrics as metrics
from cosfly.geometry.axes import look_at
from cosfly.planners.contract import MucoConfig, PlanConfig
from cosfly.planners.muco import loss, muco, step
from cosfly.planners.muco.nearby import nothing_nearby
from cosfly.runtime.errors import ResumeError

CFG = PlanConfig()


def test_uniform_motion_is_perfectly_smooth():
    line = np.outer(np.arange(50), [0.5, -0.2, 0.1])
    assert metrics.derivative_rms(line, 2) == pytest.approx(0, abs=1e-12)
    assert metrics.derivative_rms(line, 3) == pytest.approx(0, abs=1e-11)
    assert metrics.smoothness_score(0, 0) == 1
    assert metrics.length_m(line) == pytest.approx(49 * np.sqrt(0.3))
    assert metrics.speed_max_mps(line) == pytest.approx(2 * np.sqrt(0.3))


def plain_terms(points, problem, obstacles):
    """Every term of the loss, straight from its definition, one waypoint at a time."""
    targets, weights = problem.targets, problem.weights
    terms = dict.fromkeys(loss.TERM_NAMES, 0.0)
    for i, (p, x) in enumerate(zip(points, targets, strict=True)):
        terms["tracking"] += weights[0] * (np.linalg.norm(p - x) - problem.distances[i]) ** 2
        gap = kernels.signed_distances(obstacles, p[None])[0][0]
        if gap < 8.0:
            terms["safety"] += weights[3] * 0.5 * (8.0 - gap) ** 2
        window = [p] + [p + sign * 0.5 * axis for axis in np.eye(3) for sign in (1, -1)]
        seen = kernels.visibility(obstacles, np.array(window), np.repeat(x[None], 7, axis=0)).mean()
        terms["visibility"] += weights[4] * (1 - seen) ** 2 * problem.keeps_sight[i]
        pitch, yaw = look_at(p, x)
        turn = np.angle(np.exp(1j * (yaw - problem.views_rad[i])))
        terms["view_angle"] += weights[5] * ((-pitch - problem.pitches_rad[i, 1]) ** 2)
        terms["view_angle"] += problem.bearing_weight * turn**2
        outside = max(problem.pitches_rad[i, 0] + pitch, 0) + max(-pitch - problem.pitches_rad[i, 2], 0)
        terms["pitch"] += 20 * outside**2
        terms["altitude"] += 50 * max(problem.altitudes[i, 0] - p[2], 0) ** 2
        terms["altitude"] += problem.altitude_weights[3] * max(problem.altitudes[i, 1] - p[2], 0) ** 2
        terms["altitude"] += 20 * max(p[2] - problem.altitudes[i, 1], 0) ** 2
    terms["smoothness"] = weights[1] * (np.diff(points, n=2, axis=0) ** 2).sum()
    terms["jerk"] = weights[2] * (np.diff(points, n=3, axis=0) ** 2).sum()
    terms["path_length"] = weights[6] * 0.1 * np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    terms["altitude"] += 8 * (np.diff(points[:, 2]) ** 2).sum()
    return terms


def shaken(world, seed=3):
    scenario, obstacles = scenario_of(world)
    problem = muco.make_problem(scenario, CFG)
    points = replace(scenario.reference, ground_distance_m=np.full(len(scenario.targets_m), 18.0)).places_m(
        scenario.targets_m, scenario.ground_m + 1.0
    )
    points += np.random.default_rng(seed).normal(0, 2.5, points.shape)
    return points, problem, obstacles


@each("world", ["empty", "canyon", "corner", "tower_behind"])
def test_terms_agree_with_their_definitions(world):
    points, problem, obstacles = shaken(world)
    state = loss.make_state(len(points), len(obstacles.rows))
    total = loss.evaluate(points, problem, obstacles, np.zeros(len(points), dtype=bool), state)
    expected = plain_terms(points, problem, obstacles)
    np.testing.assert_allclose(state.terms, list(expected.values()), rtol=1e-9, atol=1e-9)
    assert total == pytest.approx(sum(expected.values()))
    if world == "tower_behind":
        assert min(expected.values()) > 0  # every term is at work somewhere


def test_gradient_is_the_derivative_of_the_loss():
    points, problem, obstacles = shaken("corner")
    problem = problem._replace(weights=problem.weights * np.array([1, 1, 1, 1, 0, 1, 1]))  # visibility is a staircase
    state, unmasked = loss.make_state(len(points), len(obstacles.rows)), np.zeros(len(points), dtype=bool)
    loss.evaluate(points, problem, obstacles, unmasked, state)
    gradient, scratch = state.gradient.copy(), loss.make_state(len(points), len(obstacles.rows))
    for i, axis in np.ndindex(len(points), 3):
        if i % 17:
            continue
        ends = []
        for sign in (1, -1):
            moved = points.copy()
            moved[i, axis] += sign * 1e-5
            ends.append(loss.evaluate(moved, problem, obstacles, unmasked, scratch))
        assert gradient[i, axis] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-3)


@each("world", WORLDS)
def test_the_loss_never_rises_and_the_flight_is_safe(world):
    scenario, obstacles = scenario_of(world)
    problem = muco.make_problem(scenario, CFG)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, CFG)
    assert_safe(first, obstacles)
    points, solver = muco.optimize(first, problem, obstacles, CFG.muco)
    assert_safe(points, obstacles)
    history = np.array(solver["loss_history"])
    assert (np.diff(history) < 0).all()
    assert solver["stopped"] in ("converged", "no_step")
    assert history[-1] == pytest.approx(sum(plain_terms(points, problem, obstacles).values()))
    if len(points) > 20:
        assert history[-1] < 0.8 * history[0]
    np.testing.assert_array_equal(points[[0, -1]], first[[0, -1]])


def papers_losses(points, problem, obstacles, cfg, num_steps):
    """The paper's outer loop, slowly: central differences of the whole loss, capped steps, the projection, whatever the
    loss does.
    """
    points, low = points.copy(), problem.altitudes[0, 0]
    losses, num_infeasible = [sum(plain_terms(points, problem, obstacles).values())], 0

    def smooth_loss(places):
        return sum(value for name, value in plain_terms(places, problem, obstacles).items() if name != "visibility")

    for _ in range(num_steps):
        state = loss.make_state(len(points), len(obstacles.rows))
        loss.evaluate(points, problem, obstacles, np.zeros(len(points), dtype=bool), state)
        slope = state.visibility_gradient.copy()  # a central difference over the same window
        for i in range(1, len(points) - 1):
            for axis in range(3):
                ends = [points.copy(), points.copy()]
                for side, end in zip((-1, 1), ends, strict=True):
                    end[i, axis] += side * cfg.difference_m
                    end[i, 2] = max(end[i, 2], low)
                slope[i, axis] += (smooth_loss(ends[1]) - smooth_loss(ends[0])) / (ends[1] - ends[0])[i, axis]
        steps = -cfg.learning_rate * slope[1:-1]
        lengths = np.linalg.norm(steps, axis=1, keepdims=True)
        points[1:-1] += steps * np.minimum(1.0, cfg.step_cap_m / np.maximum(lengths, 1e-12))
        num_infeasible += not step.project(points, problem, obstacles, 1, len(points) - 1, nothing_nearby(len(points)))
        losses.append(sum(plain_terms(points, problem, obstacles).values()))
    return np.array(losses), num_infeasible


@pytest.mark.slow
@pytest.mark.parametrize("world", ["corner", "tower_midway"])
def test_the_papers_optimizer_is_the_one_that_is_printed(world, monkeypatch):
    """It overshoots, goes on all the same, over infeasible trajectories too, and gives the last feasible one, not
    converged.
    """
    scenario, obstacles = scenario_of(world)
    scenario = first_points(scenario, 16)
    problem = muco.make_problem(scenario, CFG)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, CFG)
    monkeypatch.setattr(MucoConfig, "iterations_max", 5)
    cfg = MucoConfig(step="paper")
    points, plain = muco.optimize(first, problem, obstacles, cfg)
    expected, _ = papers_losses(first, problem, obstacles, cfg, 5)
    np.testing.assert_allclose(plain["loss_history"], expected, rtol=1e-6)
    assert (np.diff(expected) > 0).any()
    assert (plain["stopped"], plain["iterations"]) == ("iteration_limit", 5)
    assert_safe(points, obstacles)


@pytest.mark.parametrize("world", ["corner", "tower_midway"])
def test_the_end_is_within_five_percent_of_a_general_solver(world):
    scenario, obstacles = scenario_of(world)
    problem = muco.make_problem(scenario, CFG)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, CFG)
    _, solver = muco.optimize(first, problem, obstacles, CFG.muco)
    state, unmasked = loss.make_state(len(first), len(obstacles.rows)), np.zeros(len(first), dtype=bool)

    def loss_and_gradient(interior):
        points = np.vstack([first[:1], interior.reshape(-1, 3), first[-1:]])
        value = loss.evaluate(points, problem, obstacles, unmasked, state)
        return value, (state.gradient + state.visibility_gradient)[1:-1].reshape(-1)

    bounds = [(None, None), (None, None), (20.0, 100.0)] * (len(first) - 2)
    settings = {"maxiter": 400, "maxfun": 800}
    general = minimize(
        loss_and_gradient, first[1:-1].reshape(-1), jac=True, method="L-BFGS-B", bounds=bounds, options=settings
    )
    assert solver["loss_end"] <= 1.05 * general.fun


@each("name", ["five_ray_mean", "accel_rms_mps2", "jerk_rms_mps3"])
def test_the_prefilter_has_three_rules_of_motion_and_sight(name):
    fine = {"five_ray_mean": 0.40, "accel_rms_mps2": 5.0, "jerk_rms_mps3": 10.0}
    assert planners.drop_reason(fine, CFG, True) is None
    worse = {**fine, name: fine[name] + (-0.01 if name == "five_ray_mean" else 0.01)}
    expected = {"five_ray_mean": "low_visibility", "accel_rms_mps2": "high_acceleration", "jerk_rms_mps3": "high_jerk"}
    assert planners.drop_reason(worse, CFG, True) == expected[name]


def test_stage_counts_failures_and_does_the_others(tmp_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    write_boxes(folder / "map.json", town_of(*CANYON, ((60, -40, 20), (5, 5, 20))))
    walks = [
        walk_along("a", [(0, 0), (40, 0)]), walk_along("b", [(30, 2), (70, 2), (72, -2)]),
        walk_along("into_wall", [(60, -50), (60, -30)]), walk_along("c", [(90, 0), (50, 0)]),
    ]  # fmt: skip
    write_paths(folder / "path.json", walks, {"map": "hand", "seed": 0})
    inputs = folder / "map.json", folder / "path.json"
    product = planners.run(CFG, *inputs, tmp_path / "plan")
    traces = read_traces(product)
    assert [trace.path_id for trace in traces] == ["a", "b", "c"]
    manifest = json.loads((tmp_path / "plan/manifest.json").read_text())
    assert manifest["counts"] == {"input": 4, "kept": 3, "dropped": {}, "failed": {"no_path": 1}}
    assert manifest["planning_ms"]["mean"] > 0
    failure = json.loads((tmp_path / "plan/failures.jsonl").read_text())
    assert failure["id"] == "into_wall"
    assert "through an obstacle" in failure["message"]
    assert (tmp_path / "plan/plan.png").read_bytes().startswith(b"\x89PNG")
    before = product.read_bytes()
    assert planners.run(CFG, *inputs, tmp_path / "plan") == product  # the failed walk is tried again, to the same end
    assert product.read_bytes() == before
    assert json.loads((tmp_path / "plan/manifest.json").read_text())["counts"] == manifest["counts"]
    with pytest.raises(ResumeError, match="safety_distance_m"):
        planners.run(PlanConfig(safety_distance_m=3.5), *inputs, tmp_path / "plan")
