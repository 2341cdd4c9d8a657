"""MuCO: one trajectory, optimised as a whole against seven terms (subsec:appendix_planner_muco).

The paper's plain gradient step overshoots with its own weights: 0.05 times a curvature of several hundred is far beyond two. The
default step here solves the band system of the Gauss-Newton model instead, caps it per waypoint, projects, and is shortened until
the loss falls; `step: paper` keeps the plain step for comparison. Every accepted trajectory is feasible, so the last one is.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.errors import NoPathError
from cosfly.kernels import BoxIndex, visibility
from cosfly.planners import MucoConfig, Plan, PlanConfig, Scenario
from cosfly.planners.loss import (
    TERM_NAMES,
    Problem,
    difference_gradient,
    evaluate,
    hold_bounds,
    is_feasible,
    make_state,
    project,
    remember_boxes,
    try_step,
)
from cosfly.planners.nearby import nothing_nearby
from cosfly.planners.start import behind, search_start, smoothed_headings
from cosfly.schema import DT_S

TRIES, TRIES_WITH_VISIBILITY = 10, 3  # of one step
REST_MAX = 8  # iterations at most without the visibility slope after it has led nowhere
DAMPING_LEAST = 1e-3  # keeps the band system positive definite where no term has curvature
DAMPING_FIRST, DAMPING_RISE, DAMPING_FALL = 5.0, 10.0, 0.5  # of a waypoint whose rough terms rise


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one flight (the planner signature of cosfly/planners/__init__.py); nothing here is random.

    Raises:
        NoPathError: no free trajectory round this walk was found.
    """
    headings = smoothed_headings(scenario.targets_m, cfg.heading_smoothing_s)
    problem = make_problem(scenario, headings, cfg)
    start, kind = start_trajectory(scenario, headings, problem, obstacles, cfg)
    points, solver = optimize(start, problem, obstacles, cfg.muco)
    del solver["loss_history"]  # for tests and plots; a product does not need it
    return Plan(points, {"start": kind, **solver})


def make_problem(scenario: Scenario, headings_rad: np.ndarray, cfg: PlanConfig) -> Problem:
    """Bring settings and scenario into the form of the compiled loss."""
    muco, ground = cfg.muco, scenario.ground_m
    weights = np.array([getattr(muco, f"weight_{name}") for name in TERM_NAMES[:7]])
    low, high = np.radians(muco.pitch_band_deg)
    return Problem(
        targets=np.ascontiguousarray(scenario.targets_m),
        headings_rad=headings_rad,
        weights=weights,
        altitudes=ground + np.array([cfg.altitude_min_m, cfg.altitude_preferred_m, cfg.altitude_max_m]),
        altitude_weights=np.array([muco.weight_below, muco.weight_above, muco.weight_oscillation]),
        distance_m=muco.track_distance_m,
        influence_m=muco.influence_m,
        difference_m=muco.difference_m,
        pitch_rad=np.radians(muco.pitch_deg),
        pitch_low_rad=low,
        pitch_high_rad=high,
        pitch_weight=muco.weight_pitch,
        safety_m=cfg.safety_distance_m,
        floor_m=cfg.relaxed_safety_m,
        step_max_m=cfg.speed_max_mps * DT_S,
        pushes_max=muco.pushes_max,
    )


# --- start ------------------------------------------------------------------------------------------------------------


def start_trajectory(
    scenario: Scenario, headings_rad: np.ndarray, problem: Problem, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[np.ndarray, str]:
    """Give a feasible trajectory to start from and its kind: `behind`, or `search` where behind is blocked or blind.

    Raises:
        NoPathError: neither is feasible.
    """
    targets = problem.targets
    plain = behind(targets, headings_rad, cfg.behind_distance_m, float(problem.altitudes[1]))
    plain_is_free = bool(project(plain, problem, obstacles, 0, len(plain), nothing_nearby(len(plain))))
    if plain_is_free and visibility(obstacles, plain, targets).mean() >= cfg.muco.start_visibility:
        return plain, "behind"
    for climbing, clearance_m in (
        (False, cfg.safety_distance_m),
        (True, cfg.safety_distance_m),
        (True, cfg.relaxed_safety_m),
    ):
        found = search_start(
            targets,
            headings_rad,
            obstacles,
            distance_m=cfg.behind_distance_m,
            altitudes_m=tuple(problem.altitudes),
            climbing=climbing,
            clearance_m=clearance_m,
            speed_max_mps=cfg.speed_max_mps,
        )
        if found is not None and is_feasible(found, problem, obstacles):
            return _rounded_off(found, problem, obstacles), "search"
    if plain_is_free:
        return plain, "behind"
    raise NoPathError(
        "no free drone trajectory round this walk",
        where=scenario.path_id,
        expected=f"places from {cfg.altitude_min_m:g} to {cfg.altitude_max_m:g} m up, {cfg.relaxed_safety_m:g} m from all boxes",
        fix="is the walk roofed over? raise altitude_max_m or leave the path out",
    )


def _rounded_off(found: np.ndarray, problem: Problem, obstacles: BoxIndex) -> np.ndarray:
    """Smooth the corners of a searched trajectory as far as it stays feasible: that saves many capped steps."""
    for smoothing_s in (3.0, 1.5, 0.75):
        smooth = gaussian_filter1d(found, smoothing_s / DT_S, axis=0, mode="nearest")
        if project(smooth, problem, obstacles, 0, len(smooth), nothing_nearby(len(smooth))):
            return smooth
    return found


# --- optimisation -----------------------------------------------------------------------------------------------------


def optimize(start: np.ndarray, problem: Problem, obstacles: BoxIndex, cfg: MucoConfig) -> tuple[np.ndarray, dict]:
    """Improve a feasible trajectory; its ends stay.

    Args:
        start: (n, 3), feasible.
    Returns:
        (n, 3) and the solver's facts: iterations, loss at start and end and by term, why it stopped, the loss history.
    """
    descent = Descent(np.array(start, dtype=np.float64), problem, obstacles, cfg)
    take_step = descent.paper_step if cfg.step == "paper" else descent.newton_step
    history, small_changes = [descent.loss], 0
    reason = "iteration_limit" if len(start) > 2 else "no_interior_waypoint"
    for _ in range(cfg.iterations_max if len(start) > 2 else 0):
        if not take_step():
            reason = "no_step_lowers_the_loss" if cfg.step == "newton" else "projection_refused"
            break
        history.append(descent.loss)
        change = abs(history[-2] - history[-1])
        small_changes = small_changes + 1 if change < cfg.tolerance * max(abs(history[-1]), 1.0) else 0
        if small_changes == 2:  # one small change may be a graze of the staircase that visibility is
            reason = "converged"
            break
    facts = {
        "iterations": len(history) - 1,
        "evaluations": descent.num_tried,
        "stopped": reason,
        "loss_start": round(history[0], 6),
        "loss_end": round(history[-1], 6),
        "terms": {name: round(float(value), 6) for name, value in zip(TERM_NAMES, descent.now.terms, strict=True)},
        "num_masked": int(descent.masked.sum()),
        "loss_history": history,
    }
    return descent.points, facts


def low_visibility_runs(fractions: np.ndarray, threshold: float, frames: int) -> np.ndarray:
    """Mark the waypoints in runs of at least `frames` neighbours that all see less than `threshold`, (n,) bool."""
    is_low = np.asarray(fractions) < threshold
    if is_low.sum() < frames:
        return np.zeros(len(is_low), dtype=np.bool_)
    low = np.concatenate([[False], is_low, [False]])
    begins, ends = np.flatnonzero(~low[:-1] & low[1:]), np.flatnonzero(low[:-1] & ~low[1:])
    marked = np.zeros(len(low) - 2, dtype=np.bool_)
    for begin, end in zip(begins, ends, strict=True):
        marked[begin:end] = end - begin >= frames
    return marked


class Descent:
    """One optimisation on its way: the trajectory kept, its evaluation, and room for the next one."""

    def __init__(self, points: np.ndarray, problem: Problem, obstacles: BoxIndex, cfg: MucoConfig) -> None:
        self.points, self.problem, self.obstacles, self.cfg = points, problem, obstacles, cfg
        self.now = make_state(len(points), obstacles.num_boxes)
        self.next = make_state(len(points), obstacles.num_boxes)._replace(nearby=self.now.nearby)
        remember_boxes(points, problem, obstacles, self.now.nearby)
        self.masked = np.zeros(len(points), dtype=np.bool_)
        self.damping = np.zeros(len(points))  # of single waypoints, Levenberg's way
        self.rest, self.rest_next = 0, 1  # iterations without the visibility slope, now and after its next failure
        self.num_tried = 0
        self.loss = evaluate(points, problem, obstacles, self.masked, self.now)
        self._mask()

    def newton_step(self) -> bool:
        """Move against the model's gradient so that the loss falls; False if no such step is found.

        The visibility term is a staircase that the model does not see: where its slope leads nowhere, the step is tried
        without it.
        """
        smooth, pulls = self._gradient(), self.now.visibility_gradient
        if pulls.any() and self.rest == 0:
            if self._descend(smooth + pulls, TRIES_WITH_VISIBILITY):
                self.rest_next = 1
                return True
            self.rest, self.rest_next = self.rest_next, min(2 * self.rest_next, REST_MAX)
        self.rest = max(self.rest - 1, 0)
        return self._descend(smooth, TRIES)

    def paper_step(self) -> bool:
        """Move by learning rate times gradient, whatever that does to the loss; False if projection is refused."""
        gradient = self._gradient() + self.now.visibility_gradient
        trial, steps = self.points.copy(), -self.cfg.learning_rate * gradient[1:-1]
        lengths = np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
        trial[1:-1] += steps * np.minimum(1.0, self.cfg.step_cap_m / lengths)
        if not project(trial, self.problem, self.obstacles, 1, len(trial) - 1, self.now.nearby):
            return False
        self.num_tried += 1
        self._keep(trial, evaluate(trial, self.problem, self.obstacles, self.masked, self.next))
        return True

    def _descend(self, gradient: np.ndarray, num_tries: int) -> bool:
        """Solve, cap, project, compare. A trial that fails only for what the rough terms of some waypoints rose by is solved
        again with these damped; any other failure shortens the step, first as a whole where single waypoints were capped: a
        capped step may be no descent, because neighbours move apart.
        """
        band = self.now.band.copy()
        hold_bounds(self.points, self.problem, self.now.contacts, band, gradient)
        scale, damping, as_a_whole = 1.0, self.damping.copy(), False
        for _ in range(num_tries):
            trial = np.empty_like(self.points)
            loss, is_capped = try_step(
                self.points, band, gradient, damping + DAMPING_LEAST, scale, self.cfg.step_cap_m, as_a_whole,
                self.problem, self.obstacles, self.masked, self.next, trial,
            )  # fmt: skip
            self.num_tried += 1
            if loss < self.loss:
                self.damping = np.where(damping > DAMPING_FIRST / 10, damping * DAMPING_FALL, 0.0)
                self._keep(trial, loss)
                return True
            rise = np.maximum(self.next.rough - self.now.rough, 0.0)
            if np.isfinite(loss) and rise.sum() > loss - self.loss:
                worse = rise > 0.0
                damping[worse] = np.maximum(DAMPING_RISE * damping[worse], DAMPING_FIRST)
            elif not as_a_whole and is_capped:
                as_a_whole = True
            else:
                scale *= 0.25
        return False

    def _gradient(self) -> np.ndarray:
        """Give the gradient without the visibility term's, (n, 3), in memory of its own."""
        if self.cfg.gradient == "analytic":
            return self.now.gradient.copy()
        gradient = np.empty_like(self.points)
        difference_gradient(self.points, self.problem, self.obstacles, self.masked, self.next, gradient)
        return gradient

    def _keep(self, trial: np.ndarray, loss: float) -> None:
        self.points, self.loss = trial, loss
        self.now, self.next = self.next, self.now
        remember_boxes(trial, self.problem, self.obstacles, self.now.nearby)
        self._mask()

    def _mask(self) -> None:
        """Find the low-visibility runs; the loss does not change with them, gradient and model do."""
        masked = low_visibility_runs(self.now.visibility, self.cfg.low_visibility, self.cfg.low_visibility_frames)
        if (masked != self.masked).any():
            self.masked = masked
            evaluate(self.points, self.problem, self.obstacles, masked, self.now)
