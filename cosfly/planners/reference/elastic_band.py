"""Elastic band: the way of A*, drawn tight from within and pushed away by boxes (Quinlan and Khatib 1993)."""

from __future__ import annotations

import numpy as np

from cosfly.planners.reference.grid_search import along_voxels
from cosfly.planners.reference.task import Task, planner

ITERATIONS = 200
CONTRACTION, REPULSION = 0.4, 0.3  # of the way to the middle of both neighbours; of the intrusion
INFLUENCE_M = 2.0  # beyond the clearance


def tightened(task: Task) -> np.ndarray | None:
    """Return the band at rest, or as it is after ITERATIONS, (num, 3); None if A* finds no way."""
    band = along_voxels(task)
    if band is None:
        return None
    for _ in range(ITERATIONS):
        inner, reach_m = band[1:-1], task.clearance_m + INFLUENCE_M
        gaps_m, away = task.near(inner, reach_m)
        drawn = CONTRACTION * (0.5 * (band[:-2] + band[2:]) - inner)
        band[1:-1] = np.clip(inner + drawn + REPULSION * (reach_m - gaps_m)[:, None] * away, task.low, task.high)
    return band


plan = planner(tightened)
