"""Remembered boxes answer as the index; a flight does not depend on the memory."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cosfly.geometry import kernels
from cosfly.planners.contract import PlanConfig, Scenario
from cosfly.planners.muco import muco, nearby, step
from cosfly.planners.reference_trajectory import follow


def random_boxes(rng, count, size_m=40.0):
    turn = rng.uniform(-np.pi, np.pi, count)
    rotations = np.zeros((count, 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(turn)
    rotations[:, 1, 0], rotations[:, 0, 1], rotations[:, 2, 2] = np.sin(turn), -np.sin(turn), 1.0
    return kernels.index_boxes(
        rng.uniform(-size_m, size_m, (count, 3)) * [1, 1, 0.3] + [0, 0, 10], rng.uniform(0.2, 6, (count, 3)), rotations
    )


@settings(max_examples=40)
# The corner of a grown box, in a cell that the segment is further from than it grows.
@example(seed=11876, count=400, far=False)
@given(seed=st.integers(0, 10**6), count=st.sampled_from([0, 1, 8, 40, 400]), far=st.booleans())
def test_memory_answers_as_the_index_does(seed, count, far):
    rng = np.random.default_rng(seed)
    index = random_boxes(rng, count)  # 400 boxes: more round a waypoint than there is room for
    places, targets = rng.uniform(-40, 40, (2, 6, 3)) * [1, 1, 0.3] + [0, 0, 10]
    memory = nearby.nothing_nearby(len(places))
    assert nearby.num_cached(memory.anchors, memory.num_around, 0, *places[0]) == -1, "it knows nothing yet"
    nearby.remember(memory, index, places, targets, 8.0, 0.8)
    moves = rng.normal(size=places.shape)
    moves *= (4.0 if far else rng.uniform(0, nearby.MARGIN_M)) / np.linalg.norm(moves, axis=1, keepdims=True)
    room = np.empty(max(count, 1), dtype=np.int64)
    for i, (p, x) in enumerate(zip(places + moves, targets, strict=True)):
        gap, box = nearby.nearest_of(memory, i, index, *p, 8.0)
        expected, nearest = kernels.nearest_box(index, *p, 8.0)
        assert (gap, box < 0) == (expected, nearest < 0)
        number = nearby.num_cached(memory.anchors, memory.num_on_view, i, *p)
        wanted = set(room[: kernels.collect_hits(index, *x, *p, 0.8, room)].tolist())
        if number >= 0:
            assert not far
            hits = nearby.hits_among(index.rows, memory.on_view, i, number, *x, *p, 0.8, room)
            assert set(room[:hits].tolist()) == wanted


def test_a_flight_does_not_depend_on_the_memory(monkeypatch):
    cfg, rng = PlanConfig(), np.random.default_rng(0)
    obstacles = random_boxes(rng, 60)
    obstacles.rows[:, 2] = 0.0  # low boxes: some hide the walk, some stand in the way
    obstacles = kernels.index_boxes(
        obstacles.rows[:, :3], obstacles.rows[:, 3:6] * [1, 1, 4], obstacles.rows[:, 6:15].reshape(-1, 3, 3)
    )
    targets = np.column_stack([np.linspace(-30, 30, 80), np.full(80, 2.0), np.full(80, 1.0)])
    scenario = Scenario("w", targets, np.zeros(len(targets)), follow(targets, cfg))
    problem = muco.make_problem(scenario, cfg)
    first, _ = muco.start_trajectory(scenario, problem, obstacles, cfg)
    points, solver = muco.optimize(first, problem, obstacles, cfg.muco)
    monkeypatch.setattr(step, "remember_boxes", lambda *_: None)
    monkeypatch.setattr(muco, "descend", step.descend.py_func)  # the loop in Python, so that it calls what is set above
    without, solver_without = muco.optimize(first, problem, obstacles, cfg.muco)
    np.testing.assert_array_equal(points, without)
    np.testing.assert_array_equal(solver.pop("loss_history"), solver_without.pop("loss_history"))
    assert solver == solver_without
    assert solver["iterations"] > 5
    assert solver["terms"]["visibility"] > 0
