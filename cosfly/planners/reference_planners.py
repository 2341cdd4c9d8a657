"""The paper's reference planners (app:three_axis_eval): generic ones, without a visibility term.

A generic planner knows no target: it goes from the first reference position to the last one in the duration of the
pedestrian trajectory, free of boxes. `repair_to_limits` of smoothing.py repairs its trajectory, as for all planners.

3D A*, weighted A* and Theta* are one search on voxels, with a weight of the heuristic and, for Theta*, any angle: a
cell takes the parent of its neighbour where that parent sees it. Visibility-A* goes over the corners of grown boxes
that see each other. In three dimensions the shortest path also bends along edges; corners at the heights of both ends
and above each roof approximate it. Minimum jerk, potential field, elastic band, CHOMP-lite and TrajOpt move points and
return their trajectory even where a box still blocks it. RRT*, PRM and B-spline PRM are OMPL's (extra `ompl`), limited
by numbers of samples, not by time; the vertices of PRM's path are the control points of a cubic B-spline.

Sources: Hart, Nilsson and Raphael 1968; Pohl 1970 (the weight); Daniel et al. 2010 (Theta*); Lozano-Perez and Wesley
1979 (visibility-A*); Kyriakopoulos and Saridis 1988 (minimum jerk); Khatib 1986 (potential field); Quinlan and Khatib
1993 (elastic band); Ratliff et al. 2009 (CHOMP); Schulman et al. 2014 and Zhu et al. 1997 (TrajOpt by L-BFGS-B);
Karaman and Frazzoli 2011 (RRT*); Kavraki et al. 1996 (PRM); Koyuncu and Inalhan 2008 (B-spline PRM).
"""

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.optimize import minimize

from cosfly.geometry import kernels
from cosfly.geometry.kernels import BoxIndex, collect_hits, normals, segments_hit, signed_distances
from cosfly.geometry.trajectory_metrics import distances_along_m
from cosfly.planners.contract import Plan, PlanConfig, Planner, Scenario
from cosfly.planners.smoothing import PULL_FIXED, repair_to_limits, smoothness_band
from cosfly.planners.track_astar import MOVES
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import EnvironmentMissing

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
        route_m = distances_along_m(route)
        points_m = np.linspace(0.0, route_m[-1], self.num)
        return np.stack([np.interp(points_m, route_m, route[:, axis]) for axis in range(3)], axis=1)


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


# --- A* family --------------------------------------------------------------------------------------------------------

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
    cost[start] = 0.0
    parent[start] = start
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
            has_shortcut = any_angle and parent[cell] != cell
            if has_shortcut and _are_joined(places, parent[cell], there, index, clearance_m, first_hit):
                via = parent[cell]
            new_cost = cost[via] + _apart(places, via, there)
            if new_cost >= cost[there]:
                continue
            if via != cell or _are_joined(places, via, there, index, clearance_m, first_hit):
                cost[there] = new_cost
                parent[there] = via
                heapq.heappush(queue, (new_cost + weight * _apart(places, there, goal), there))
    if not done[goal]:
        return np.empty(0, dtype=np.int64)
    cells = [goal]
    while cells[-1] != start:
        cells.append(parent[cells[-1]])
    return np.array(cells)[::-1]


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
    start, goal = 0, 1
    places = np.vstack([task.start, task.goal, _corners(task)])
    to_goal_m = np.linalg.norm(places - task.goal, axis=1)
    cost_m = np.full(len(places), np.inf)
    parent = np.full(len(places), -1)
    done = np.zeros(len(places), dtype=bool)
    cost_m[start] = 0.0
    queue = [(to_goal_m[start], start)]
    while queue and not done[goal]:
        here = heapq.heappop(queue)[1]
        if done[here]:
            continue
        done[here] = True
        new_cost_m = cost_m[here] + np.linalg.norm(places - places[here], axis=1)
        # Places that cannot be on a shorter path to the goal than the known one are ignored.
        may_help = ~done & (new_cost_m < cost_m) & (new_cost_m + to_goal_m < cost_m[goal] + 1e-9)
        nexts = np.flatnonzero(may_help)
        nexts = nexts[~task.hits(np.broadcast_to(places[here], (len(nexts), 3)), places[nexts])]
        cost_m[nexts] = new_cost_m[nexts]
        parent[nexts] = here
        for there in nexts.tolist():
            heapq.heappush(queue, (cost_m[there] + to_goal_m[there], there))
    if not np.isfinite(cost_m[goal]):
        return None
    way = [goal]
    while way[-1] != start:
        way.append(int(parent[way[-1]]))
    return task.along(places[way[::-1]])


def _corners(task: Task) -> np.ndarray:
    """Return the free corners of boxes in the volume, (m, 3), those nearest to the straight line first."""
    rows = task.obstacles.rows
    beyond_m = task.clearance_m + BEYOND_M
    is_in_volume = rows[:, kernels.HIGH_Z] + task.clearance_m > task.low[2]
    is_in_volume &= (rows[:, [kernels.HIGH_X, kernels.HIGH_Y]] >= task.low[:2]).all(axis=1)
    is_in_volume &= (rows[:, [kernels.LOW_X, kernels.LOW_Y]] <= task.high[:2]).all(axis=1)
    rows = rows[is_in_volume]
    turns = rows[:, kernels.XU : kernels.YW].reshape(-1, 5)[:, [0, 1, 3, 4]].reshape(-1, 2, 2)  # x and y of the frame
    offsets = SIDES * (rows[:, None, [kernels.HALF_X, kernels.HALF_Y]] + beyond_m)
    xy = rows[:, None, :2] + np.einsum("kij,ksj->ksi", turns, offsets)
    # Each corner at the heights of the start, of the goal, and above its box.
    heights = (task.start[2:], task.goal[2:], rows[:, kernels.HIGH_Z, None] + beyond_m)
    layers = [np.dstack([xy, np.broadcast_to(z, xy.shape[:2])]) for z in heights]
    places = np.concatenate([layer.reshape(-1, 3) for layer in layers])
    places = np.unique(places[((places >= task.low) & (places <= task.high)).all(axis=1)], axis=0)
    places = places[~task.hits(places, places)]
    aside_m = np.linalg.norm(places - task.start, axis=1) + np.linalg.norm(places - task.goal, axis=1)
    return places[np.argsort(aside_m, kind="stable")[:MOST_CORNERS]]


# --- minimum jerk -----------------------------------------------------------------------------------------------------


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
DIFFERENCES = ((1.0, (-1.0, 1.0)), (5.0, (1.0, -2.0, 1.0)))  # weights and coefficients of squared differences


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
    for share, coefficients in DIFFERENCES:
        changes = np.diff(points, n=len(coefficients) - 1, axis=0)
        loss += share * float((changes**2).sum())
        for k, coefficient in enumerate(coefficients):
            slopes[k : k + len(changes)] += 2.0 * share * coefficient * changes
    gaps_m, away = task.near(points, task.clearance_m + HINGE_BEYOND_M)
    intrusions_m = task.clearance_m + HINGE_BEYOND_M - gaps_m
    loss += weight * float((intrusions_m**2).sum())
    slopes -= 2.0 * weight * intrusions_m[:, None] * away
    return loss, slopes[1:-1].ravel()


# --- sampling ---------------------------------------------------------------------------------------------------------

# OMPL asks the termination condition once or twice per sample; the search ends after this many questions.
RRT_TERMINATION_CALLS = 4000
PRM_TERMINATION_CALLS = 6000
RRT_RANGE_M = 15.0  # longest edge of the tree
CONTROL_M = 8.0  # greatest distance between control points
EXACT_M = 1e-6  # least size of the volume, and greatest distance of the last state from the goal


def sampled(task: Task, method: str, *, is_spline: bool = False) -> np.ndarray | None:
    """Return the trajectory along the path that OMPL finds, (num, 3); None if it does not reach the goal."""
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        fix = 'pip install -e ".[ompl]", or leave out the planners rrt_star, prm and bspline_prm'
        raise EnvironmentMissing("OMPL is not installed", got=str(error), fix=fix) from None
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(int(task.rng.integers(1, 2**31)))
    space_information = _space_information(base, task)
    problem = _problem_definition(base, space_information, task)
    search = getattr(geometric, method)(space_information)
    search.setProblemDefinition(problem)
    if method == "RRTstar":
        search.setRange(RRT_RANGE_M)
        search.setInformedSampling(True)
        search.setTreePruning(True)
        search.setup()
        search.solve(_stop_after(base, RRT_TERMINATION_CALLS))
    else:  # PRM's own loop counts seconds, so the roadmap grows first and `solve` only queries it
        search.setup()
        search.growRoadmapPtc(_stop_after(base, PRM_TERMINATION_CALLS))
        search.solve(base.plannerAlwaysTerminatingCondition())
    path = problem.getSolutionPath()
    states = [] if path is None else [path.getState(k) for k in range(path.getStateCount())]
    route = np.array([_coordinates(state) for state in states]).reshape(-1, 3)
    if not len(route) or np.linalg.norm(route[-1] - task.goal) > EXACT_M:
        return None
    return task.along(splined(route) if is_spline else route)


def _space_information(base: Any, task: Task) -> Any:
    """Return OMPL's description of the free volume of a task; base: the module `ompl.base`."""
    space = base.RealVectorStateSpace(3)
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(task.low[axis]))
        bounds.setHigh(axis, float(max(task.high[axis], task.low[axis] + EXACT_M)))
    space.setBounds(bounds)
    space_information = base.SpaceInformation(space)

    def is_free(start: Any, end: Any) -> bool:
        ends = np.array([_coordinates(start), _coordinates(end)])
        return not task.hits(ends[:1], ends[1:])[0]

    class FreeMotions(base.MotionValidator):  # type: ignore[name-defined]  # imported as a value
        def checkMotion(self, start: Any, end: Any, *_: Any) -> bool:
            return is_free(start, end)

    space_information.setStateValidityChecker(lambda state: is_free(state, state))
    space_information.setMotionValidator(FreeMotions(space_information))
    space_information.setup()
    return space_information


def _problem_definition(base: Any, space_information: Any, task: Task) -> Any:
    """Return OMPL's shortest-path problem from the start of a task to its goal."""
    problem = base.ProblemDefinition(space_information)
    ends = [space_information.allocState(), space_information.allocState()]
    for state, point in zip(ends, (task.start, task.goal), strict=True):
        for axis in range(3):
            state[axis] = float(point[axis])
    problem.setStartAndGoalStates(*ends)
    problem.setOptimizationObjective(base.PathLengthOptimizationObjective(space_information))
    return problem


def _stop_after(base: Any, num_calls: int) -> Any:
    """Return a termination condition that holds from its call number `num_calls` on, counted from 0."""
    calls = itertools.count()
    return base.PlannerTerminationCondition(lambda: next(calls) >= num_calls)


def _coordinates(state: Any) -> list[float]:
    return [state[axis] for axis in range(3)]


def splined(route: np.ndarray) -> np.ndarray:
    """Return the cubic B-spline whose control points lie on a route (m, 3), CONTROL_M apart at most."""
    counts = np.maximum(np.ceil(np.linalg.norm(np.diff(route, axis=0), axis=1) / CONTROL_M), 1).astype(int)
    shares = np.concatenate([k + np.arange(count) / count for k, count in enumerate(counts)] + [[len(counts)]])
    control = np.stack([np.interp(shares, np.arange(len(route)), route[:, axis]) for axis in range(3)], axis=1)
    degree = min(3, len(control) - 1)
    if degree < 1:
        return route
    knots = np.concatenate([[0.0] * degree, np.linspace(0.0, 1.0, len(control) - degree + 1), [1.0] * degree])
    return BSpline(knots, control, degree)(np.linspace(0.0, 1.0, 10 * len(control)))


plan_astar = planner(along_voxels)
plan_weighted_astar = planner(partial(along_voxels, weight=WEIGHT))
plan_theta_star = planner(partial(along_voxels, any_angle=True))
plan_visibility_astar = planner(_over_corners)
plan_minimum_jerk = planner(minimum_jerk)
plan_potential_field = planner(potential_field)
plan_elastic_band = planner(elastic_band)
plan_chomp = planner(chomp)
plan_trajopt = planner(trajopt)
plan_rrt_star = planner(partial(sampled, method="RRTstar"))
plan_prm = planner(partial(sampled, method="PRM"))
plan_bspline_prm = planner(partial(sampled, method="PRM", is_spline=True))
