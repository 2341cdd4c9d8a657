"""TrajOpt with L-BFGS-B: smoothness and a hinge on the distance to boxes, whose weight rises (Schulman et al. 2014, Zhu
et al. 1997).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from cosfly.planners.reference.task import Task, planner

ITERATIONS = 80  # for each weight of the hinge
HINGE_WEIGHTS = (1.0, 10.0, 100.0)
BEYOND_M = 0.5  # the hinge begins so far beyond the clearance
DIFFERENCES = ((1.0, 1), (5.0, 2))  # weight and order of squared differences


def optimized(task: Task) -> np.ndarray:
    """Return the flight at the last weight, (num, 3), whatever still stands in its way."""
    points = task.line()
    bounds = list(zip(np.tile(task.low, task.num - 2), np.tile(task.high, task.num - 2), strict=True))
    for weight in HINGE_WEIGHTS if bounds else ():
        found = minimize(
            _loss, points[1:-1].ravel(), (task, weight), method="L-BFGS-B", jac=True, bounds=bounds,
            options={"maxiter": ITERATIONS},
        )  # fmt: skip
        points[1:-1] = found.x.reshape(-1, 3)
    return points


def _loss(inner: np.ndarray, task: Task, weight: float) -> tuple[float, np.ndarray]:
    """Return the loss of the points between both ends, (3 n,), and its gradient."""
    points = np.vstack([task.start, inner.reshape(-1, 3), task.goal])
    loss, slopes = 0.0, np.zeros_like(points)
    for share, order in DIFFERENCES:
        changes = np.diff(points, n=order, axis=0)
        loss += share * float((changes**2).sum())
        for k, coefficient in enumerate(((-1.0, 1.0), (1.0, -2.0, 1.0))[order - 1]):
            slopes[k : k + len(changes)] += 2.0 * share * coefficient * changes
    gaps_m, away = task.near(points, task.clearance_m + BEYOND_M)
    intrusions_m = task.clearance_m + BEYOND_M - gaps_m
    loss += weight * float((intrusions_m**2).sum())
    slopes -= 2.0 * weight * intrusions_m[:, None] * away
    return loss, slopes[1:-1].ravel()


plan = planner(optimized)
