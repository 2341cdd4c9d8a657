"""3D A*, weighted A* and Theta* on voxels: one search, with a weight of the heuristic and, for Theta*, any angle.

Sources: Hart, Nilsson and Raphael 1968; Pohl 1970 (the weight); Daniel et al. 2010 (a cell takes the parent of its
neighbour where that parent sees it).
"""

from __future__ import annotations

import heapq
from functools import partial

import numpy as np

from cosfly.geometry.kernels import collect_hits
from cosfly.planners.reference.task import Task, planner
from cosfly.planners.track_astar import MOVES
from cosfly.runtime.compiled import njit

VOXEL_M = 4.0  # as for TA*
WEIGHT = 2.0  # of weighted A*


def along_voxels(task: Task, *, weight: float = 1.0, any_angle: bool = False) -> np.ndarray | None:
    """Search the voxels of a task's volume; return the trajectory, (num, 3), None if there is no path."""
    below = np.floor((task.start - task.low) / VOXEL_M + 1e-9).astype(np.int64)
    shape = below + np.floor((task.high - task.start) / VOXEL_M + 1e-9).astype(np.int64) + 1
    cells = np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape)), axis=1)
    places = np.vstack([task.start + (cells - below) * VOXEL_M, task.goal])
    start = int(np.ravel_multi_index(tuple(below), tuple(shape)))
    way = _search(places, shape, start, VOXEL_M, task.obstacles, task.clearance_m, weight, any_angle)
    return task.along(places[way]) if len(way) else None


@njit(cache=True)
def _search(places, shape, start, voxel_m, index, clearance_m, weight, any_angle):
    """Return the numbers of the places on the path from `start` to the last one, the goal, (m,); empty if none."""
    goal, one = len(places) - 1, np.empty(1, dtype=np.int64)
    cost, done = np.full(goal + 1, np.inf), np.zeros(goal + 1, dtype=np.bool_)
    parent = np.full(goal + 1, -1, dtype=np.int64)
    cost[start], parent[start] = 0.0, start
    queue = [(0.0, start)]
    while len(queue) > 0 and not done[goal]:
        _, cell = heapq.heappop(queue)
        if done[cell]:
            continue
        done[cell] = True
        ix, iy, iz = cell // (shape[1] * shape[2]), (cell // shape[2]) % shape[1], cell % shape[2]
        for move in range(len(MOVES) + 1):
            there = goal  # a neighbour of the cells round it
            if move < len(MOVES):
                jx, jy, jz = ix + MOVES[move, 0], iy + MOVES[move, 1], iz + MOVES[move, 2]
                if not (0 <= jx < shape[0] and 0 <= jy < shape[1] and 0 <= jz < shape[2]):
                    continue
                there = (jx * shape[1] + jy) * shape[2] + jz
            elif _apart(places, cell, goal) > 2.0 * voxel_m:
                continue
            if done[there]:
                continue
            via = cell
            if any_angle and parent[cell] != cell and _are_joined(places, parent[cell], there, index, clearance_m, one):
                via = parent[cell]
            longer = cost[via] + _apart(places, via, there)
            if longer < cost[there] and (via != cell or _are_joined(places, via, there, index, clearance_m, one)):
                cost[there], parent[there] = longer, via
                heapq.heappush(queue, (longer + weight * _apart(places, there, goal), there))
    way = np.empty(0, dtype=np.int64)
    if done[goal]:
        cells = [goal]
        while cells[-1] != start:
            cells.append(parent[cells[-1]])
        way = np.array(cells)[::-1]
    return way


@njit(cache=True, inline="always")
def _are_joined(places, a, b, index, clearance_m, one):
    p, q = places[a], places[b]
    return collect_hits(index, p[0], p[1], p[2], q[0], q[1], q[2], clearance_m, one) == 0


@njit(cache=True, inline="always")
def _apart(places, a, b):
    p, q = places[a], places[b]
    return np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


plan_astar = planner(along_voxels)
plan_weighted = planner(partial(along_voxels, weight=WEIGHT))
plan_theta = planner(partial(along_voxels, any_angle=True))
