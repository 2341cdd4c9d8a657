"""The cheapest route over a grid of free cells: exact A* with octile costs and no corner cutting; and its corners.

A straight step costs 1, a diagonal one sqrt 2, and a diagonal step needs both straight neighbours free (sec:step3).
With several classes of cells, a step costs this times the mean cost of its two cells. Path costs are
kept as two integers, the weighted straight and diagonal steps, so that equal costs compare as equal in any order of
steps: the result is the true optimum, not the optimum up to rounding, and ties break the same way everywhere.
"""

import math
from heapq import heappop, heappush

import numpy as np

from cosfly.runtime.compiled import int64, njit

SQRT2 = math.sqrt(2.0)

# Directions 0-3 straight, 4-7 diagonal.
_STEP_X = np.array([1, 0, -1, 0, 1, -1, -1, 1], dtype=np.int64)
_STEP_Y = np.array([0, 1, 0, -1, 1, 1, -1, -1], dtype=np.int64)

UNIFORM = np.ones(1, dtype=np.int64)

CORNER_COST = 1.0  # of a corner of a straightened route, in cell widths: fewer corners are worth a small detour
LONGEST_LINE = 200  # steps of a route that one straight line may replace

_UNSEEN, _OPEN, _CLOSED = 0, 1, 2
STRAIGHT, DIAGONAL = range(2)  # columns of the steps


def find_route(
    free: np.ndarray, start: tuple[int, int], goal: tuple[int, int], classes: np.ndarray | None = None,
    costs: np.ndarray = UNIFORM,
) -> np.ndarray | None:  # fmt: skip
    """Find a cheapest route between two cells, (k, 2) int64 cells with both ends; None if there is no route.

    Args:
        free: (ny, nx) bool, contiguous.
        start, goal: (x index, y index).
        classes: (ny, nx) uint8, the class of each cell; None: all 0.
        costs: (classes,) int64, the cost of a cell by its class, at least 1.
    """
    num_x = free.shape[1]
    # Zeroed pages are allocated on access, so a search pays for the cells it visits and not for the grid.
    state = np.zeros(free.size, dtype=np.uint8)
    steps = np.empty((free.size, 2), dtype=np.int32)
    from_direction = np.empty(free.size, dtype=np.int8)
    origin = int(start[1]) * num_x + int(start[0])
    target = int(goal[1]) * num_x + int(goal[0])
    classes = np.zeros(free.shape, dtype=np.uint8) if classes is None else classes
    least = 2 * int(costs.min())  # so that the estimate is never above the cost of a route
    if not _search(free, origin, target, state, steps, from_direction, classes, costs, least):
        return None
    cells = [target]
    while cells[-1] != origin:
        direction = from_direction[cells[-1]]
        cells.append(cells[-1] - int(_STEP_Y[direction] * num_x + _STEP_X[direction]))
    rows, columns = np.divmod(np.array(cells[::-1], dtype=np.int64), num_x)
    return np.column_stack([columns, rows])


def route_cost(cells: np.ndarray) -> float:
    """Return the octile length of a route of neighbouring cells, (k, 2), in cell widths: its cost where all cost 1."""
    is_diagonal = (np.diff(cells, axis=0) != 0).all(axis=1)
    num_diagonal = int(np.count_nonzero(is_diagonal))
    return len(is_diagonal) - num_diagonal + num_diagonal * SQRT2


@njit(cache=True)
def _search(free, origin, target, state, steps, from_direction, classes, costs, least):  # pragma: no cover (compiled)
    """Run A* until the target is closed; return whether it was reached.

    The arrays state and from_direction, (cells,), and steps, (cells, 2), are filled. `steps` holds the weighted
    straight and diagonal steps to a cell, times two: a step costs the sum of its two cells.
    """
    num_y, num_x = free.shape
    target_x, target_y = target % num_x, target // num_x
    heap = [(0.0, 0.0, int64(origin))]  # estimated total, then cost to go: depth first in a tie; the cell
    state[origin] = _OPEN
    steps[origin, STRAIGHT] = steps[origin, DIAGONAL] = 0
    from_direction[origin] = -1
    while heap:
        cell = heappop(heap)[2]
        if state[cell] == _CLOSED:
            continue  # an outdated entry of a cell that was improved
        state[cell] = _CLOSED
        if cell == target:
            return True
        x, y = cell % num_x, cell // num_x
        for direction in range(8):
            next_x, next_y = x + _STEP_X[direction], y + _STEP_Y[direction]
            if next_x < 0 or next_y < 0 or next_x >= num_x or next_y >= num_y or not free[next_y, next_x]:
                continue
            if direction >= 4 and not (free[y, next_x] and free[next_y, x]):
                continue
            neighbour = next_y * num_x + next_x
            if state[neighbour] == _CLOSED:
                continue
            cost = costs[classes[y, x]] + costs[classes[next_y, next_x]]
            straight = steps[cell, STRAIGHT] + (cost if direction < 4 else 0)
            diagonal = steps[cell, DIAGONAL] + (cost if direction >= 4 else 0)
            if state[neighbour] == _OPEN:
                open_cost = steps[neighbour, STRAIGHT] + steps[neighbour, DIAGONAL] * SQRT2
                if straight + diagonal * SQRT2 >= open_cost:
                    continue
            state[neighbour] = _OPEN
            steps[neighbour, STRAIGHT], steps[neighbour, DIAGONAL] = straight, diagonal
            from_direction[neighbour] = direction
            apart_x, apart_y = abs(target_x - next_x), abs(target_y - next_y)
            diagonal_to_go = least * min(apart_x, apart_y)
            straight_to_go = least * max(apart_x, apart_y) - diagonal_to_go
            total = (straight + straight_to_go) + (diagonal + diagonal_to_go) * SQRT2
            to_go = straight_to_go + diagonal_to_go * SQRT2
            heappush(heap, (total, to_go, neighbour))
    return False


def corners_of(cells: np.ndarray, free: np.ndarray, classes: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Return the cells of a route, (k, 2), between which it can run straight, (m, 2) with both ends.

    They are those of least cost, by dynamic programming: a line costs its length times the mean cost of the cells that
    it crosses, a corner CORNER_COST. Without this a route in a direction between the eight of a grid is a staircase.

    Args:
        free, classes, costs: As for `find_route`.
    """
    previous = _straighten(cells, free, classes, costs)
    corners = [len(cells) - 1]
    while corners[-1]:
        corners.append(int(previous[corners[-1]]))
    return cells[corners[::-1]]


@njit(cache=True)
def _straighten(cells, free, classes, costs):  # pragma: no cover (compiled)
    """Return for each cell the one from which the cheapest chain of lines reaches it, (k,)."""
    best = np.full(len(cells), np.inf)
    best[0] = 0.0
    previous = np.zeros(len(cells), dtype=np.int64)
    for j in range(1, len(cells)):
        for i in range(max(0, j - LONGEST_LINE), j):
            cost = best[i] + CORNER_COST + _line_cost(cells[i], cells[j], free, classes, costs)
            if cost < best[j] - 1e-9:  # an earlier one in a tie up to rounding
                best[j], previous[j] = cost, i
    return previous


@njit(cache=True)
def _line_cost(start, end, free, classes, costs):  # pragma: no cover (compiled)
    """Return the cost of a straight line between the centres of two cells, infinite if it touches one that is not free.

    Both cells at a corner that it passes through must be free, as for a diagonal step.
    """
    x, y = start
    length_x, length_y = abs(end[0] - x), abs(end[1] - y)
    step_x, step_y = 1 if end[0] > x else -1, 1 if end[1] > y else -1
    total, num_cells = costs[classes[y, x]], 1
    # Border k + 1/2 of the cells along an axis is passed at the share (k + 1/2) / length of the line.
    borders_x = borders_y = 0
    while x != end[0] or y != end[1]:
        next_x, next_y = (1 + 2 * borders_x) * length_y, (1 + 2 * borders_y) * length_x
        if next_x == next_y and not (free[y, x + step_x] and free[y + step_y, x]):
            return np.inf
        if next_x <= next_y:
            x += step_x
            borders_x += 1
        if next_y <= next_x:
            y += step_y
            borders_y += 1
        if not free[y, x]:
            return np.inf
        total += costs[classes[y, x]]
        num_cells += 1
    return total / num_cells * math.sqrt(length_x**2 + length_y**2)
