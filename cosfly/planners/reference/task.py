"""The task of the generic planners: start, goal, free space, and the repair of their trajectories.

A generic planner knows no target: it goes from the first reference position to the last one in the duration of the
pedestrian trajectory, free of boxes. The repair is `repair_to_limits` of smoothing.py for all planners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cosfly.geometry.kernels import BoxIndex, normals, segments_hit, signed_distances
from cosfly.geometry.trajectory_metrics import distances_along_m
from cosfly.planners.contract import Plan, PlanConfig, Planner, Scenario
from cosfly.planners.smoothing import repair_to_limits

FREE_STEP_M, FREE_REACH_M = 2.0, 40.0  # of the search for a free place near a blocked one


@dataclass(frozen=True)
class Task:
    """A path to find from a start to a goal in a volume."""

    start: np.ndarray  # (3,) m
    goal: np.ndarray  # (3,) m
    low: np.ndarray  # (3,) m, corner of the volume
    high: np.ndarray  # (3,) m, corner of the volume
    obstacles: BoxIndex
    clearance_m: float  # by which boxes are enlarged on every side
    num: int  # points of the trajectory
    dt_s: float
    rng: np.random.Generator

    def hits(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return which segments between (n, 3) points are blocked, (n,) bool."""
        return segments_hit(self.obstacles, starts, ends, self.clearance_m)

    def near(self, points: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of points, (n, 3), to boxes and the directions away from the nearest box.

        Returns:
            (n,) m, at most `reach_m`, and (n, 3) unit vectors, zero where no box is in reach.
        """
        gaps_m, boxes = signed_distances(self.obstacles, points, reach_m)
        away = np.zeros_like(points)
        is_near = boxes >= 0
        away[is_near] = normals(self.obstacles, points[is_near], boxes[is_near])
        return gaps_m, away

    def line(self) -> np.ndarray:
        """Return the straight trajectory of even speed, (num, 3)."""
        return self.start + np.linspace(0.0, 1.0, self.num)[:, None] * (self.goal - self.start)

    def along(self, route: np.ndarray) -> np.ndarray:
        """Return the trajectory of even speed along a route (m, 3), (num, 3)."""
        along_m = distances_along_m(route)
        wanted_m = np.linspace(0.0, along_m[-1], self.num)
        return np.stack([np.interp(wanted_m, along_m, route[:, axis]) for axis in range(3)], axis=1)


def make_task(
    scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator, clearance_m: float
) -> Task | None:
    """Return the task of a scenario; None where no free place is near its first or last reference position."""
    reference = scenario.reference
    targets = scenario.targets_m
    margin_m = cfg.track_astar.corridor_m
    low_z = (scenario.ground_m + reference.altitude_min_m).max()
    high_z = (scenario.ground_m + reference.altitude_max_m).min()
    low = np.array([*(targets[:, :2].min(axis=0) - margin_m), low_z])
    high = np.array([*(targets[:, :2].max(axis=0) + margin_m), high_z])
    requested = reference.places_m(targets, scenario.ground_m)[[0, -1]]
    ends = [_free_place(place, low, high, obstacles, clearance_m) for place in requested]
    if ends[0] is None or ends[1] is None:
        return None
    return Task(ends[0], ends[1], low, high, obstacles, clearance_m, len(targets), scenario.dt_s, rng)


def _free_place(
    place: np.ndarray, low: np.ndarray, high: np.ndarray, obstacles: BoxIndex, clearance_m: float
) -> np.ndarray | None:
    """Return the free place on a grid around `place` that is nearest to it, (3,); None if there is none in reach."""
    steps = np.arange(-FREE_REACH_M, FREE_REACH_M + 1e-9, FREE_STEP_M)
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[np.argsort((offsets**2).sum(axis=1), kind="stable")]
    places = np.clip(place, low, high) + offsets
    places = places[((places >= low) & (places <= high)).all(axis=1)]
    for begin in range(0, len(places), 1024):
        batch = places[begin : begin + 1024]
        is_free = ~segments_hit(obstacles, batch, batch, clearance_m)
        if is_free.any():
            return batch[int(np.argmax(is_free))]
    return None


def planner(find: Callable[[Task], np.ndarray | None]) -> Planner:
    """Return a planner that finds a path at the nominal distance to boxes, else at the relaxed one, and repairs it.

    Args:
        find: Returns the trajectory, (num, 3), of a task, or None.
    """

    def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
        for clearance_m in (cfg.safety_distance_m, cfg.relaxed_safety_m):
            task = make_task(scenario, obstacles, cfg, rng, clearance_m)
            points = None if task is None else find(task)
            if task is not None and points is not None:
                points = np.clip(points, task.low, task.high)
                repaired = repair_to_limits(points, scenario, obstacles, cfg)
                moved_m = float(np.linalg.norm(repaired - points, axis=1).max())
                return Plan(repaired, {"clearance_m": clearance_m, "repaired_m": round(moved_m, 4)})
        raise scenario.no_path_error(
            "no collision-free path connects the first reference position with the last", cfg.relaxed_safety_m
        )

    return plan
