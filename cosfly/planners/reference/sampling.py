"""RRT*, PRM and B-spline PRM from OMPL (extra `ompl`), limited by numbers of samples, not by time.

Sources: Karaman and Frazzoli 2011; Kavraki et al. 1996; Koyuncu and Inalhan 2008 (the vertices of PRM's path are the
control points of a cubic B-spline).
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import numpy as np

from cosfly.planners.reference.task import Task, planner
from cosfly.runtime.errors import EnvironmentMissing

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
    from scipy.interpolate import BSpline

    counts = np.maximum(np.ceil(np.linalg.norm(np.diff(route, axis=0), axis=1) / CONTROL_M), 1).astype(int)
    shares = np.concatenate([k + np.arange(count) / count for k, count in enumerate(counts)] + [[len(counts)]])
    control = np.stack([np.interp(shares, np.arange(len(route)), route[:, axis]) for axis in range(3)], axis=1)
    degree = min(3, len(control) - 1)
    if degree < 1:
        return route
    knots = np.concatenate([[0.0] * degree, np.linspace(0.0, 1.0, len(control) - degree + 1), [1.0] * degree])
    return BSpline(knots, control, degree)(np.linspace(0.0, 1.0, 10 * len(control)))


plan_rrt_star = planner(partial(sampled, method="RRTstar"))
plan_prm = planner(partial(sampled, method="PRM"))
plan_bspline_prm = planner(partial(sampled, method="PRM", is_spline=True))
