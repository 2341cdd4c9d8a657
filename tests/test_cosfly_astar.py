import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from cosfly.geometry.grid import connected_parts
from cosfly.pedestrians.astar import UNIFORM, find_route, route_cost

AXES = [(1, 0), (0, 1), (1, 1), (-1, 1)]


def shortest_costs(free: np.ndarray, start: tuple[int, int], classes: np.ndarray, costs: np.ndarray) -> np.ndarray:
    num_y, num_x = free.shape
    rows, columns, weights = [], [], []
    for y in range(num_y):
        for x in range(num_x):
            for axis, (dx, dy) in enumerate(AXES):
                a, b = x + dx, y + dy
                if not (0 <= a < num_x and 0 <= b < num_y and free[y, x] and free[b, a] and free[y, a] and free[b, x]):
                    continue
                rows.append(y * num_x + x)
                columns.append(b * num_x + a)
                weights.append(np.hypot(dx, dy) * (costs[classes[y, x], axis] + costs[classes[b, a], axis]) / 2)
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


def test_a_route_exists_exactly_within_a_part_of_four_neighbours():
    rng = np.random.default_rng(8)
    free = rng.random((30, 30)) < 0.6
    parts, _ = connected_parts(free, 4)
    cells = np.argwhere(free)[:, ::-1]
    outcomes = set()
    for _ in range(200):
        start, goal = (tuple(cells[i].tolist()) for i in rng.integers(len(cells), size=2))
        is_same_part = parts[start[1], start[0]] == parts[goal[1], goal[0]]
        assert (find_route(free, start, goal) is not None) == is_same_part
        outcomes.add(bool(is_same_part))
    assert outcomes == {True, False}


@settings(max_examples=80)
@given(
    st.integers(0, 10**9), st.integers(1, 22), st.integers(1, 22), st.floats(0.0, 0.55), st.booleans()
)  # fmt: skip
def test_costs_are_the_optimum_of_another_library(seed, num_x, num_y, density, is_uniform):
    rng = np.random.default_rng(seed)
    free = rng.random((num_y, num_x)) >= density
    classes = rng.integers(0, 3, free.shape).astype(np.uint8)
    costs = np.tile(UNIFORM, (3, 1)) if is_uniform else rng.integers(1, 30, (3, 4))
    start, goal = (tuple(rng.integers((num_x, num_y)).tolist()) for _ in range(2))
    free[start[1], start[0]] = free[goal[1], goal[0]] = True
    optimum = shortest_costs(free, start, classes, costs)[goal[1], goal[0]]
    route = find_route(free, start, goal, classes, costs)
    if route is None:
        assert np.isinf(optimum)
        return
    assert problems(free, route) == []
    steps = np.diff(route, axis=0)
    forward = np.where((steps[:, 1] > 0) | ((steps[:, 1] == 0) & (steps[:, 0] > 0)), 1, -1)[:, None]
    axes = np.array([AXES.index(tuple(step)) for step in (steps * forward).tolist()], dtype=int)
    of_cells = costs[classes[route[:, 1], route[:, 0]]]
    each = (of_cells[np.arange(len(axes)), axes] + of_cells[np.arange(1, len(route)), axes]) / 2
    assert (each * np.linalg.norm(steps, axis=1)).sum() == pytest.approx(optimum, abs=1e-9)
    if is_uniform:
        assert route_cost(route) == pytest.approx(optimum, abs=1e-9)
        assert route_cost(find_route(free, goal, start)) == pytest.approx(optimum, abs=1e-9)
