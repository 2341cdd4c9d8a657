"""Visibility-A*: A* over the corners of grown boxes that see each other (Lozano-Perez and Wesley 1979).

In three dimensions the shortest path also bends along edges; corners at the heights of both ends and above each roof
approximate it.
"""

from __future__ import annotations

import heapq

import numpy as np

from cosfly.geometry.kernels import HALF_X, HALF_Y, HIGH_X, HIGH_Y, HIGH_Z, LOW_X, LOW_Y, XU, YW
from cosfly.planners.reference.task import Task, planner

BEYOND_M = 0.05  # distance of corners from the grown boxes
MOST_CORNERS = 6000
SIDES = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])


def over_corners(task: Task) -> np.ndarray | None:
    """Search the corners; return the trajectory, (num, 3), None if there is no path."""
    places = np.vstack([task.start, task.goal, _corners(task)])
    to_goal_m = np.linalg.norm(places - task.goal, axis=1)
    cost, parent, done = np.full(len(places), np.inf), np.full(len(places), -1), np.zeros(len(places), dtype=bool)
    cost[0], queue = 0.0, [(to_goal_m[0], 0)]
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
    rows, beyond_m = task.obstacles.rows, task.clearance_m + BEYOND_M
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


plan = planner(over_corners)
