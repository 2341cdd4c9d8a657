"""Artificial potential field: drawn to the goal, pushed away by the nearest box (Khatib 1986).

Where both are even it stands still, as it does behind a wall: then it finds nothing.
"""

from __future__ import annotations

import numpy as np

from cosfly.planners.reference.task import Task, planner

STEP_M, ITERATIONS = 0.5, 4000
INFLUENCE_M = 8.0
REPULSION_M3 = 40.0  # against an attraction of 1: even 3.4 m from a box


def downhill(task: Task) -> np.ndarray | None:
    """Go down the potential in steps, (num, 3) of even speed; None if the goal is not reached in ITERATIONS."""
    route = [task.start]
    for _ in range(ITERATIONS):
        here = route[-1]
        left = task.goal - here
        left_m = float(np.linalg.norm(left))
        if left_m <= STEP_M:
            return task.along(np.array([*route, task.goal]))
        gaps_m, away = task.near(here[None], INFLUENCE_M)
        gap_m = max(float(gaps_m[0]), 0.1)
        push = REPULSION_M3 * (1.0 / gap_m - 1.0 / INFLUENCE_M) / gap_m**2 * away[0]
        force = left / left_m + push
        route.append(np.clip(here + STEP_M * force / max(float(np.linalg.norm(force)), 1e-9), task.low, task.high))
    return None


plan = planner(downhill)
