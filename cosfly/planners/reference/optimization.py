"""Generic planners that move points: minimum jerk, potential field, elastic band, CHOMP-lite and TrajOpt.

Sources: Kyriakopoulos and Saridis 1988 (minimum jerk), Khatib 1986 (potential field), Quinlan and Khatib 1993 (elastic
band), Ratliff et al. 2009 (CHOMP), Schulman et al. 2014 and Zhu et al. 1997 (TrajOpt by L-BFGS-B). Each returns its
trajectory, (num, 3), even where a box still blocks it; task.py repairs it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import minimize

from cosfly.planners.reference.graph_search import along_voxels
from cosfly.planners.reference.task import Task, planner
from cosfly.planners.smoothing import PULL_FIXED, smoothness_band


def minimum_jerk(task: Task) -> np.ndarray:
    """Return the polynomial of fifth degree from rest to rest."""
    share = np.linspace(0.0, 1.0, task.num)[:, None]
    return task.start + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * (task.goal - task.start)


# --- potential field --------------------------------------------------------------------------------------------------

STEP_M = 0.5
STEPS_MAX = 4000
FIELD_REACH_M = 8.0
FIELD_M3 = 40.0  # repulsion against an attraction of 1: they balance 3.4 m from a box


def potential_field(task: Task) -> np.ndarray | None:
    """Follow the potential downhill at even speed; None if the goal is not reached, as behind a wall."""
    route = [task.start]
    for _ in range(STEPS_MAX):
        here = route[-1]
        to_goal = task.goal - here
        to_goal_m = float(np.linalg.norm(to_goal))
        if to_goal_m <= STEP_M:
            return task.along(np.array([*route, task.goal]))
        gaps_m, away = task.near(here[None], FIELD_REACH_M)
        gap_m = max(float(gaps_m[0]), 0.1)
        push = FIELD_M3 * (1.0 / gap_m - 1.0 / FIELD_REACH_M) / gap_m**2 * away[0]
        force = to_goal / to_goal_m + push
        route.append(np.clip(here + STEP_M * force / max(float(np.linalg.norm(force)), 1e-9), task.low, task.high))
    return None


# --- elastic band -----------------------------------------------------------------------------------------------------

BAND_ITERATIONS = 200
CONTRACTION = 0.4  # share of the way to the middle of both neighbours
REPULSION = 0.3  # share of the intrusion
INFLUENCE_M = 2.0  # beyond the clearance


def elastic_band(task: Task) -> np.ndarray | None:
    """Smooth the path of A* and push it away from boxes; None if A* finds no path."""
    band = along_voxels(task)
    if band is None:
        return None
    for _ in range(BAND_ITERATIONS):
        inner = band[1:-1]
        reach_m = task.clearance_m + INFLUENCE_M
        gaps_m, away = task.near(inner, reach_m)
        drawn = CONTRACTION * (0.5 * (band[:-2] + band[2:]) - inner)
        band[1:-1] = np.clip(inner + drawn + REPULSION * (reach_m - gaps_m)[:, None] * away, task.low, task.high)
    return band


# --- CHOMP-lite -------------------------------------------------------------------------------------------------------

DESCENTS = 200
RATE = 0.1
OBSTACLE_WEIGHT = 400.0
OBSTACLE_BEYOND_M = 2.0  # the obstacle cost begins this far beyond the clearance


def chomp(task: Task) -> np.ndarray:
    """Optimize the straight line along the covariant gradient.

    Lite: the cost of a position counts once for each waypoint, not for each body part and metre. In the metric of the
    smoothness, the gradient of the smoothness is the difference from the straight line, which is its minimum.
    """
    line = task.line()
    reach_m = task.clearance_m + OBSTACLE_BEYOND_M
    metric = smoothness_band(task.num, task.dt_s)
    metric[0, [0, -1]] += PULL_FIXED  # both ends stay
    points = line.copy()
    for _ in range(DESCENTS):
        gaps_m, away = task.near(points, reach_m)
        slopes = np.clip(1.0 - gaps_m / reach_m, 0.0, 1.0)[:, None] * away
        slopes[[0, -1]] = 0.0
        points = points - RATE * (points - line - OBSTACLE_WEIGHT * solveh_banded(metric, slopes, lower=True))
        points = np.clip(points, task.low, task.high)
    return points


# --- TrajOpt ----------------------------------------------------------------------------------------------------------

ITERATIONS = 80  # for each weight of the hinge
HINGE_WEIGHTS = (1.0, 10.0, 100.0)
HINGE_BEYOND_M = 0.5  # the hinge begins this far beyond the clearance
DIFFERENCES = ((1.0, 1), (5.0, 2))  # weight and order of squared differences


def trajopt(task: Task) -> np.ndarray:
    """Minimize smoothness and a hinge on the distance to boxes, of rising weight, by L-BFGS-B."""
    points = task.line()
    bounds = list(zip(np.tile(task.low, task.num - 2), np.tile(task.high, task.num - 2), strict=True))
    for weight in HINGE_WEIGHTS if bounds else ():
        result = minimize(
            _loss, points[1:-1].ravel(), (task, weight), method="L-BFGS-B", jac=True, bounds=bounds,
            options={"maxiter": ITERATIONS},
        )  # fmt: skip
        points[1:-1] = result.x.reshape(-1, 3)
    return points


def _loss(inner: np.ndarray, task: Task, weight: float) -> tuple[float, np.ndarray]:
    """Return the loss of the points between both ends, (3 n,), and its gradient."""
    points = np.vstack([task.start, inner.reshape(-1, 3), task.goal])
    loss = 0.0
    slopes = np.zeros_like(points)
    for share, order in DIFFERENCES:
        changes = np.diff(points, n=order, axis=0)
        loss += share * float((changes**2).sum())
        for k, coefficient in enumerate(((-1.0, 1.0), (1.0, -2.0, 1.0))[order - 1]):
            slopes[k : k + len(changes)] += 2.0 * share * coefficient * changes
    gaps_m, away = task.near(points, task.clearance_m + HINGE_BEYOND_M)
    intrusions_m = task.clearance_m + HINGE_BEYOND_M - gaps_m
    loss += weight * float((intrusions_m**2).sum())
    slopes -= 2.0 * weight * intrusions_m[:, None] * away
    return loss, slopes[1:-1].ravel()


plan_minimum_jerk = planner(minimum_jerk)
plan_potential_field = planner(potential_field)
plan_elastic_band = planner(elastic_band)
plan_chomp = planner(chomp)
plan_trajopt = planner(trajopt)
