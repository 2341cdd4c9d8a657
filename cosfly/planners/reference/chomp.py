"""CHOMP-lite: covariant gradient descent from the straight flight (Ratliff et al. 2009).

Lite: the cost of a place counts once for each waypoint, not for each body part and metre of the way. In the metric of
the smoothness A, the gradient of the smoothness is the way back to the straight flight, which is its minimum.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from cosfly.planners.reference.task import Task, planner
from cosfly.planners.smoothing import PULL_STAYS, smoothness_band

ITERATIONS, RATE = 200, 0.1
OBSTACLE_WEIGHT = 400.0
BEYOND_M = 2.0  # the cost of a place begins so far beyond the clearance


def descended(task: Task) -> np.ndarray:
    """Return the flight after ITERATIONS, (num, 3), whatever still stands in its way."""
    line, reach_m = task.line(), task.clearance_m + BEYOND_M
    metric = smoothness_band(task.num, task.dt_s)
    metric[0, [0, -1]] += PULL_STAYS  # both ends stay
    points = line.copy()
    for _ in range(ITERATIONS):
        gaps_m, away = task.near(points, reach_m)
        slopes = np.clip(1.0 - gaps_m / reach_m, 0.0, 1.0)[:, None] * away
        slopes[[0, -1]] = 0.0
        points = points - RATE * (points - line - OBSTACLE_WEIGHT * solveh_banded(metric, slopes, lower=True))
        points = np.clip(points, task.low, task.high)
    return points


plan = planner(descended)
