"""3D A*, weighted A* and Theta* on voxels: one search, with a weight of the heuristic and, for Theta*, any angle.

Sources: Hart, Nilsson and Raphael 1968; Pohl 1970 (the weight); Daniel et al. 2010 (a cell's parent is its own parent's
where that one sees it).
"""

from __future__ import annotations

import heapq

import numpy as np

from cosfly.planners.contract import Plan, PlanConfig, Scenario
from cosfly.planners.reference.task import Task, fly
from cosfly.planners.track_astar import MOVES
from cosfly.space.kernels import BoxIndex, collect_hits
from cosfly.work.compiled import njit

VOXEL_M = 4.0  # as for TA*
WEIGHT = 2.0  # of weighted A*


def plan_astar(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan with 3D A* (the signature of `planners.contract`); nothing here is random."""
    return fly(lambda task: along_voxels(task), scenario, obstacles, cfg)


def plan_weighted(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan with weighted A* (the signature of `planners.contract`); nothing here is random."""
    return fly(lambda task: along_voxels(task, weight=WEIGHT), scenario, obstacles, cfg)


def plan_theta(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan with Theta* (the signature of `planners.contract`); nothing here is random."""
    return fly(lambda task: along_voxels(task, any_angle=True), scenario, obstacles, cfg)


def along_voxels(task: Task, *, weight: float = 1.0, any_angle: bool = False) -> np.ndarray | None:
    """Search the voxels of a task's volume, of which one holds its start; (num, 3), None if there is no way."""
    below = np.floor((task.start - task.low) / VOXEL_M + 1e-9)
    shape = (below + np.floor((task.high - task.start) / VOXEL_M + 1e-9) + 1).astype(np.int64)
    low = task.start - below * VOXEL_M
    route = _search(
        low, shape, VOXEL_M, below.astype(np.int64), task.goal, task.obstacles, task.clearance_m, weight, any_angle
    )
    return task.along(route) if len(route) else None


@njit(cache=True)
def _search(low, shape, voxel_m, first, goal, index, clearance_m, weight, any_angle):
    """Give the route, (m, 3) m from the place of cell `first` to `goal`, (0, 3) if there is none."""
    num, one = shape[0] * shape[1] * shape[2], np.empty(1, dtype=np.int64)
    cost, parent, done = (
        np.full(num + 1, np.inf),
        np.full(num + 1, -1, dtype=np.int64),
        np.zeros(num + 1, dtype=np.bool_),
    )
    start = (first[0] * shape[1] + first[1]) * shape[2] + first[2]
    cost[start], parent[start] = 0.0, start
    queue = [(0.0, start)]
    while len(queue) > 0:
        _, cell = heapq.heappop(queue)
        if done[cell]:
            continue
        done[cell] = True
        if cell == num:
            break
        here = _place(cell, low, shape, voxel_m, goal)
        ix, iy, iz = cell // (shape[1] * shape[2]), (cell // shape[2]) % shape[1], cell % shape[2]
        for move in range(len(MOVES) + 1):
            there = num  # the goal is a neighbour of the cells round it
            if move < len(MOVES):
                jx, jy, jz = ix + MOVES[move, 0], iy + MOVES[move, 1], iz + MOVES[move, 2]
                if not (0 <= jx < shape[0] and 0 <= jy < shape[1] and 0 <= jz < shape[2]):
                    continue
                there = (jx * shape[1] + jy) * shape[2] + jz
            elif _apart(here, goal) > 2.0 * voxel_m:
                continue
            if done[there]:
                continue
            place, via = _place(there, low, shape, voxel_m, goal), cell
            if any_angle and parent[cell] != cell:
                p = _place(parent[cell], low, shape, voxel_m, goal)
                if collect_hits(index, p[0], p[1], p[2], place[0], place[1], place[2], clearance_m, one) == 0:
                    via = parent[cell]
            q = _place(via, low, shape, voxel_m, goal)
            longer = cost[via] + _apart(q, place)
            if longer >= cost[there]:
                continue
            if (
                via == cell
                and collect_hits(index, q[0], q[1], q[2], place[0], place[1], place[2], clearance_m, one) > 0
            ):
                continue
            cost[there], parent[there] = longer, via
            heapq.heappush(queue, (longer + weight * _apart(place, goal), there))
    route = np.empty((0, 3))
    if cost[num] == np.inf:
        return route
    cells = [num]
    while parent[cells[-1]] != cells[-1]:
        cells.append(parent[cells[-1]])
    route = np.empty((len(cells), 3))
    for k in range(len(cells)):
        x, y, z = _place(cells[len(cells) - 1 - k], low, shape, voxel_m, goal)
        route[k, 0], route[k, 1], route[k, 2] = x, y, z
    return route


@njit(cache=True, inline="always")
def _place(cell, low, shape, voxel_m, goal):
    if cell == shape[0] * shape[1] * shape[2]:
        return goal[0], goal[1], goal[2]
    ix, iy, iz = cell // (shape[1] * shape[2]), (cell // shape[2]) % shape[1], cell % shape[2]
    return low[0] + ix * voxel_m, low[1] + iy * voxel_m, low[2] + iz * voxel_m


@njit(cache=True, inline="always")
def _apart(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
