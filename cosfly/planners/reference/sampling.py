"""RRT*, PRM and B-spline PRM, by OMPL (extra `ompl`), limited by numbers of samples, not by time.

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

RRT_CALLS, PRM_CALLS = 4000, 6000  # of the condition to stop, one or two for each sample
RRT_RANGE_M = 15.0
CONTROL_M = 8.0  # between control points
EXACT_M = 1e-6


def sampled(task: Task, method: str, *, is_spline: bool = False) -> np.ndarray | None:
    """Return the trajectory along the path that OMPL finds, (num, 3); None if it does not reach the goal."""
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise EnvironmentMissing("OMPL is not installed", got=str(error), fix='pip install "cosfly[ompl]"') from None
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(int(task.rng.integers(1, 2**31)))
    space, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(task.low[axis]))
        bounds.setHigh(axis, float(max(task.high[axis], task.low[axis] + EXACT_M)))
    space.setBounds(bounds)
    about = base.SpaceInformation(space)

    def are_joined(one: Any, other: Any) -> bool:
        ends = np.array([[state[axis] for axis in range(3)] for state in (one, other)])
        return not task.hits(ends[:1], ends[1:])[0]

    class Motions(base.MotionValidator):  # type: ignore[name-defined]  # imported as a value
        def checkMotion(self, one: Any, other: Any, *_: Any) -> bool:
            return are_joined(one, other)

    about.setStateValidityChecker(lambda state: are_joined(state, state))
    about.setMotionValidator(Motions(about))
    about.setup()
    problem, ends = base.ProblemDefinition(about), [space.allocState(), space.allocState()]
    for state, place in zip(ends, (task.start, task.goal), strict=True):
        for axis in range(3):
            state[axis] = float(place[axis])
    problem.setStartAndGoalStates(*ends)
    problem.setOptimizationObjective(base.PathLengthOptimizationObjective(about))
    search, calls = getattr(geometric, method)(about), itertools.count()
    search.setProblemDefinition(problem)
    if method == "RRTstar":
        search.setRange(RRT_RANGE_M)
        search.setInformedSampling(True)
        search.setTreePruning(True)
        search.setup()
        search.solve(base.PlannerTerminationCondition(lambda: next(calls) >= RRT_CALLS))
    else:  # a roadmap first: PRM's own loop counts seconds, and asks the finished map when it must stop at once
        search.setup()
        search.growRoadmapPtc(base.PlannerTerminationCondition(lambda: next(calls) >= PRM_CALLS))
        search.solve(base.plannerAlwaysTerminatingCondition())
    path = problem.getSolutionPath()
    states = [] if path is None else [path.getState(k) for k in range(path.getStateCount())]
    route = np.array([[state[axis] for axis in range(3)] for state in states]).reshape(-1, 3)
    if not len(route) or np.linalg.norm(route[-1] - task.goal) > EXACT_M:
        return None
    return task.along(splined(route) if is_spline else route)


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
