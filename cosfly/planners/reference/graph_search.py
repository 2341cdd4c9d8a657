"""3D A*, weighted A*, Theta* and visibility-A*.

The first three are one search on voxels, with a weight of the heuristic and, for Theta*, any angle: a cell takes the
parent of its neighbour where that parent sees it. Visibility-A* goes over the corners of grown boxes that see each
other. In three dimensions the shortest path also bends along edges; corners at the heights of both ends and above each
roof approximate it.

Sources: Hart, Nilsson and Raphael 1968; Pohl 1970 (the weight); Daniel et al. 2010 (Theta*); Lozano-Perez and Wesley
1979 (visibility-A*).
"""

from __future__ import annotations

import heapq
from functools import partial

import numpy as np

from cosfly.geometry.kernels import HALF_X, HALF_Y, HIGH_X, HIGH_Y, HIGH_Z, LOW_X, LOW_Y, XU, YW, collect_hits
from cosfly.planners.reference.task import Task, planner
from cosfly.planners.track_astar import MOVES
from cosfly.runtime.compiled import njit

VOXEL_M = 4.0  # as for TA*
WEIGHT = 2.0  # of weighted A*
BEYOND_M = 0.05  # distance of corners from the grown boxes
MOST_CORNERS = 6000
SIDES = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])


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
    goal = len(places) - 1
    first_hit = np.empty(1, dtype=np.int64)
    cost = np.full(goal + 1, np.inf)
    done = np.zeros(goal + 1, dtype=np.bool_)
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
            there = goal  # the last move: from cells near the goal to the goal
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
            if (
                any_angle
                and parent[cell] != cell
                and _are_joined(places, parent[cell], there, index, clearance_m, first_hit)
            ):
                via = parent[cell]
            longer = cost[via] + _apart(places, via, there)
            if longer < cost[there] and (via != cell or _are_joined(places, via, there, index, clearance_m, first_hit)):
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
def _are_joined(places, a, b, index, clearance_m, first_hit):
    p, q = places[a], places[b]
    return collect_hits(index, p[0], p[1], p[2], q[0], q[1], q[2], clearance_m, first_hit) == 0


@njit(cache=True, inline="always")
def _apart(places, a, b):
    p, q = places[a], places[b]
    return np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


def _over_corners(task: Task) -> np.ndarray | None:
    """Search the corners; return the trajectory, (num, 3), None if there is no path."""
    places = np.vstack([task.start, task.goal, _corners(task)])
    to_goal_m = np.linalg.norm(places - task.goal, axis=1)
    cost = np.full(len(places), np.inf)
    parent = np.full(len(places), -1)
    done = np.zeros(len(places), dtype=bool)
    cost[0] = 0.0
    queue = [(to_goal_m[0], 0)]
    while queue and not done[1]:
        here = heapq.heappop(queue)[1]
        if done[here]:
            continue
        done[here] = True
        longer_m = cost[here] + np.linalg.norm(places - places[here], axis=1)
        # Places that cannot be on a shorter path to the goal than the known one are ignored.
        open_ = np.flatnonzero(~done & (longer_m < cost) & (longer_m + to_goal_m < cost[1] + 1e-9))
        open_ = open_[~task.hits(np.broadcast_to(places[here], (len(open_), 3)), places[open_])]
        cost[open_], parent[open_] = longer_m[open_], here
        for there in open_.tolist():
            heapq.heappush(queue, (cost[there] + to_goal_m[there], there))
    if not np.isfinite(cost[1]):
        return None
    way = [1]
    while way[-1] != 0:
        way.append(int(parent[way[-1]]))
    return task.along(places[way[::-1]])


def _corners(task: Task) -> np.ndarray:
    """Return the free corners of boxes in the volume, (m, 3), those nearest to the straight line first."""
    rows = task.obstacles.rows
    beyond_m = task.clearance_m + BEYOND_M
    keep = rows[:, HIGH_Z] + task.clearance_m > task.low[2]
    keep &= (rows[:, [HIGH_X, HIGH_Y]] >= task.low[:2]).all(axis=1)
    keep &= (rows[:, [LOW_X, LOW_Y]] <= task.high[:2]).all(axis=1)
    rows = rows[keep]
    turns = rows[:, XU:YW].reshape(-1, 5)[:, [0, 1, 3, 4]].reshape(-1, 2, 2)
    out = SIDES * (rows[:, None, [HALF_X, HALF_Y]] + beyond_m)
    xy = rows[:, None, :2] + np.einsum("kij,ksj->ksi", turns, out)
    same = np.ones(len(rows))
    heights = (task.start[2] * same, task.goal[2] * same, rows[:, HIGH_Z] + beyond_m)
    layers = [np.dstack([xy, np.broadcast_to(z[:, None], xy.shape[:2])]) for z in heights]
    places = np.concatenate([layer.reshape(-1, 3) for layer in layers])
    places = np.unique(places[((places >= task.low) & (places <= task.high)).all(axis=1)], axis=0)
    places = places[~task.hits(places, places)]
    aside_m = np.linalg.norm(places - task.start, axis=1) + np.linalg.norm(places - task.goal, axis=1)
    return places[np.argsort(aside_m, kind="stable")[:MOST_CORNERS]]


plan_astar = planner(along_voxels)
plan_weighted_astar = planner(partial(along_voxels, weight=WEIGHT))
plan_theta_star = planner(partial(along_voxels, any_angle=True))
plan_visibility_astar = planner(_over_corners)
