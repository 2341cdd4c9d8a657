"""Minimum jerk: the polynomial of fifth degree from rest to rest (Kyriakopoulos and Saridis 1988), then repair."""

from __future__ import annotations

import numpy as np

from cosfly.planners.reference.task import Task, planner


def from_rest_to_rest(task: Task) -> np.ndarray:
    """Return the flight, (num, 3), whatever stands in its way."""
    share = np.linspace(0.0, 1.0, task.num)[:, None]
    return task.start + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * (task.goal - task.start)


plan = planner(from_rest_to_rest)
