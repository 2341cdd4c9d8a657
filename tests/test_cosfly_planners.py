"""MuCO's terms and the pedestrians' search against plain versions, whole flights over hand-made maps, the plan stage."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from specimens_planning import CANYON, WORLDS, assert_safe, scenario_of, solved_by_scipy, town_of, walk_along, written

import cosfly.planners.stage as planners
from cosfly.formats.traces import read_traces
from cosfly.geometry import kernels, trajectory_metrics
from cosfly.geometry.axes import look_at
from cosfly.geometry.grid import connected_parts
from cosfly.pedestrians.astar import find_route, route_cost
from cosfly.planners import foresight, smoothing
from cosfly.planners.contract import PlanConfig, Scenario
from cosfly.planners.muco import loss, muco, step
from cosfly.planners.reference_trajectory import follow
from cosfly.planners.stage import make_scenario, plan_on

CFG = PlanConfig()


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


def shaken(world):
    scenario, obstacles = scenario_of(world)
    problem = muco.make_problem(scenario, CFG)
    points = replace(scenario.reference, ground_distance_m=np.full(len(scenario.targets_m), 18.0)).places_m(
        scenario.targets_m, scenario.ground_m + 1.0
    )
    points += np.random.default_rng(3).normal(0, 2.5, points.shape)
    return points, problem, obstacles


@pytest.mark.parametrize("world", ["empty", "canyon", "corner", "tower_behind"])
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


@pytest.mark.parametrize("world", WORLDS)
def test_the_loss_never_rises_to_near_that_of_a_general_solver_and_the_flight_is_safe(world):
    scenario, obstacles = scenario_of(world)
    problem = muco.make_problem(scenario, CFG)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, CFG)
    assert_safe(first, obstacles)
    points, solver, history = muco.optimize(first, problem, obstacles, CFG.muco)
    assert_safe(points, obstacles)
    assert (np.diff(history) < 0).all()
    assert solver["stopped"] in ("converged", "no_step")
    assert history[-1] == pytest.approx(sum(plain_terms(points, problem, obstacles).values()))
    if len(points) > 20:
        assert history[-1] < 0.8 * history[0]
    np.testing.assert_array_equal(points[[0, -1]], first[[0, -1]])
    if world in ("corner", "tower_midway"):
        assert history[-1] <= 1.05 * solved_by_scipy(first, problem, obstacles, maxiter=400, maxfun=800).fun


@pytest.mark.parametrize("name", ["five_ray_mean", "accel_rms_mps2", "jerk_rms_mps3"])
def test_the_prefilter_has_three_rules_of_motion_and_sight(name):
    fine = {"five_ray_mean": 0.40, "accel_rms_mps2": 5.0, "jerk_rms_mps3": 10.0}
    assert planners.drop_reason(fine, CFG, True) is None
    worse = {**fine, name: fine[name] + (-0.01 if name == "five_ray_mean" else 0.01)}
    expected = {"five_ray_mean": "low_visibility", "accel_rms_mps2": "high_acceleration", "jerk_rms_mps3": "high_jerk"}
    assert planners.drop_reason(worse, CFG, True) == expected[name]


def test_stage_counts_failures_and_does_the_others(tmp_path):
    inputs = written(
        tmp_path, town_of(*CANYON, ((60, -40, 20), (5, 5, 20))), a=[(0, 0), (40, 0)],
        b=[(30, 2), (70, 2), (72, -2)], into_wall=[(60, -50), (60, -30)], c=[(90, 0), (50, 0)],
    )  # fmt: skip
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


def random_town(seed):
    """Forty turned boxes round the origin, some taller than a drone flies, none where the walker goes."""
    rng = np.random.default_rng(seed)
    side = np.where(rng.random(40) < 0.5, -1.0, 1.0)
    centers = np.column_stack([rng.uniform(-70, 90, 40), side * rng.uniform(16, 60, 40), rng.uniform(0, 15, 40)])
    halves = np.column_stack([rng.uniform(0.5, 8, (40, 2)), rng.uniform(0.5, 15, 40)])
    return kernels.obstacle_index(town_of(*zip(centers, halves, rng.uniform(-180, 180, 40), strict=True)))


@pytest.mark.parametrize("seed", range(3))
def test_smoothing_keeps_sight_and_safety_and_takes_the_jerk(seed):
    obstacles = random_town(seed)
    scenario = make_scenario(walk_along("w", [(0, 0), (60, 0)]), obstacles, CFG)
    raw = foresight.search_trajectory(scenario, foresight.make_lattice(scenario, climbing=False), obstacles, CFG, 3.0)
    points, facts = smoothing.smooth_trajectory(raw, scenario, obstacles, CFG, 3.0)
    assert facts["smooth"]
    assert not smoothing.unsafe(points, obstacles, 3.0, CFG.speed_max_mps * scenario.dt_s).any()
    assert (points[:, 2] >= 20.0).all()
    seen, seen_raw = (kernels.visibility(obstacles, flight, scenario.targets_m).mean() for flight in (points, raw))
    assert seen >= seen_raw - 0.01
    assert facts["raw_visibility"] == pytest.approx(seen_raw, abs=1e-4)
    assert trajectory_metrics.derivative_rms(points, 3) <= max(0.3 * trajectory_metrics.derivative_rms(raw, 3), 0.05)


@pytest.mark.parametrize(
    ("place_m", "velocity_mps"),
    [((-20, 0, 20), (1.2, 0, 0)), ((45, 3, 24), (-6, 0, 2)), ((-60, 0, 30), (-9, 0, 0)), ((5, 2, 12), (0, 0, -2))],
)
def test_a_flight_is_planned_on_from_a_place_and_a_velocity(place_m, velocity_mps):
    box_map, corners = WORLDS["canyon"]
    walk, obstacles = walk_along("canyon", corners), kernels.obstacle_index(box_map)
    targets = walk.positions_m + np.array([0, 0, 0.9])
    flown = np.array(place_m) + np.arange(-9, 1)[:, None] * 0.5 * np.array(velocity_mps, dtype=float)
    points = plan_on("canyon", targets, 0.5, flown, obstacles, CFG)
    np.testing.assert_array_equal(points[: len(flown)], flown)
    ahead, dt_s = points[len(flown) - 3 :], 0.5
    assert np.linalg.norm(np.diff(ahead[2:], axis=0), axis=1).max() <= CFG.speed_max_mps * dt_s + 1e-3
    assert np.linalg.norm(np.diff(ahead, n=2, axis=0), axis=1).max() <= CFG.accel_max_mps2 * dt_s**2 + 1e-3
    assert kernels.swept_distances(obstacles, ahead[2:], 20.0)[0].min() >= CFG.relaxed_safety_m - 0.02
    assert ahead[-1, 2] >= CFG.altitude_min_m - 1e-6
    late = slice(len(flown) + 40, None)  # 20 s later it is where a flight of this style is, and sees the walker
    assert np.linalg.norm((points - targets)[late], axis=1).max() < 40
    assert kernels.visibility(obstacles, points, targets)[late].mean() > 0.95


def shortest_costs(free: np.ndarray, start: tuple[int, int], classes: np.ndarray, costs: np.ndarray) -> np.ndarray:
    (num_y, num_x), edges = free.shape, []
    for (y, x), (dx, dy) in itertools.product(np.ndindex(free.shape), ((1, 0), (0, 1), (1, 1), (-1, 1))):
        a, b = x + dx, y + dy
        if 0 <= a < num_x and b < num_y and free[y, x] and free[b, a] and free[y, a] and free[b, x]:
            cost = np.hypot(dx, dy) * (costs[classes[y, x]] + costs[classes[b, a]]) / 2
            edges.append((y * num_x + x, b * num_x + a, cost))
    rows, columns, weights = np.array(edges).reshape(-1, 3).T
    graph = coo_matrix((weights, (rows, columns)), shape=(free.size, free.size)).tocsr()
    return dijkstra(graph, directed=False, indices=start[1] * num_x + start[0]).reshape(free.shape)


def problems(free: np.ndarray, route: np.ndarray) -> list[str]:
    found = []
    for (x0, y0), (x1, y1) in zip(route[:-1].tolist(), route[1:].tolist(), strict=True):
        if max(abs(x1 - x0), abs(y1 - y0)) != 1:
            found.append(f"not neighbours: {(x0, y0)} {(x1, y1)}")
        elif not (free[y0, x1] and free[y1, x0]):
            found.append(f"cuts a corner: {(x0, y0)} {(x1, y1)}")
    return found + [f"blocked: {(x, y)}" for x, y in route.tolist() if not free[y, x]]


@settings(max_examples=80)
@given(st.integers(0, 10**9), st.integers(1, 22), st.integers(1, 22), st.floats(0.0, 0.55), st.booleans())
def test_costs_are_the_optimum_of_another_library(seed, num_x, num_y, density, is_uniform):
    rng = np.random.default_rng(seed)
    free = rng.random((num_y, num_x)) >= density
    classes = rng.integers(0, 3, free.shape).astype(np.uint8)
    costs = np.ones(3, np.int64) if is_uniform else rng.integers(1, 30, 3)
    start, goal = (tuple(rng.integers((num_x, num_y)).tolist()) for _ in range(2))
    free[start[1], start[0]] = free[goal[1], goal[0]] = True
    optimum = shortest_costs(free, start, classes, costs)[goal[1], goal[0]]
    route = find_route(free, start, goal, classes, costs)
    parts, _ = connected_parts(free, 4)
    assert (route is not None) == (parts[start[1], start[0]] == parts[goal[1], goal[0]])
    if route is None:
        assert np.isinf(optimum)
        return
    assert problems(free, route) == []
    steps = np.diff(route, axis=0)
    of_cells = costs[classes[route[:, 1], route[:, 0]]]
    assert ((of_cells[:-1] + of_cells[1:]) / 2 * np.linalg.norm(steps, axis=1)).sum() == pytest.approx(
        optimum, abs=1e-9
    )
    if is_uniform:
        assert route_cost(route) == pytest.approx(optimum, abs=1e-9)
        assert route_cost(find_route(free, goal, start)) == pytest.approx(optimum, abs=1e-9)


def test_a_flight_does_not_depend_on_the_memory(monkeypatch):
    rng = np.random.default_rng(1)  # low boxes: some hide the walk, some stand in the way
    rows = [
        ((*rng.uniform(-40, 40, 2), 0), rng.uniform(0.2, 6, 3) * [1, 1, 4], rng.uniform(-180, 180)) for _ in range(120)
    ]
    obstacles = kernels.obstacle_index(town_of(*rows))
    targets = np.column_stack([np.linspace(-30, 30, 80), np.full(80, 2.0), np.full(80, 1.0)])
    scenario = Scenario("w", targets, np.zeros(len(targets)), follow(targets, CFG))
    problem = muco.make_problem(scenario, CFG)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, CFG)
    points, solver, history = muco.optimize(first, problem, obstacles, CFG.muco)
    monkeypatch.setattr(step, "remember_boxes", lambda *_: None)
    monkeypatch.setattr(muco, "descend", step.descend.py_func)  # the loop in Python, so that it calls what is set above
    without, solver_without, history_without = muco.optimize(first, problem, obstacles, CFG.muco)
    np.testing.assert_array_equal(points, without)
    np.testing.assert_array_equal(history, history_without)
    assert solver == solver_without
    assert solver["iterations"] > 5
    assert solver["terms"]["visibility"] > 0
