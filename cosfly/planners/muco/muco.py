"""MuCO: one trajectory, optimised as a whole against seven terms (subsec:appendix_planner_muco).

The paper's plain gradient step overshoots with its own weights: 0.05 times a curvature of several hundred is far beyond two, so its
waypoints end up jumping to and fro by the step cap. The default step here solves the band system of the Gauss-Newton model instead,
caps it per waypoint, projects, and is shortened until the loss falls; `step: paper` is the paper's optimizer as it is printed.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.errors import NoPathError
from cosfly.planners.contract import MucoConfig, Plan, PlanConfig, Scenario
from cosfly.planners.muco.loss import TERM_NAMES, Problem, make_state
from cosfly.planners.muco.nearby import nothing_nearby
from cosfly.planners.muco.start import search_start
from cosfly.planners.muco.step import STOP_REASONS, Rules, descend, descend_as_the_paper, is_feasible, project
from cosfly.space.kernels import BoxIndex, visibility

# Where no step of any length lowers the loss, it changes by nothing: that is within the tolerance.
AT_REST = ("converged", "no_step", "no_interior_waypoint")


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one flight (the signature of `planners.contract`); nothing here is random.

    Raises:
        NoPathError: no free trajectory round this walk was found.
    """
    problem = make_problem(scenario, cfg)
    start, kind = start_trajectory(scenario, problem, obstacles, cfg)
    points, solver = optimize(start, problem, obstacles, cfg.muco)
    del solver["loss_history"]  # for tests and plots; a product does not need it
    return Plan(points, {"start": kind, **solver}, is_converged=solver["stopped"] in AT_REST)


def make_problem(scenario: Scenario, cfg: PlanConfig) -> Problem:
    """Bring settings and scenario into the form of the compiled loss."""
    muco, wish = cfg.muco, scenario.wish
    weights = np.array([getattr(muco, f"weight_{name}") for name in TERM_NAMES[:7]])
    # The band stands round the settings' pitch; it goes where the wish goes.
    shift = wish.pitch_rad - np.radians(muco.pitch_deg)
    low, high = (edge + shift for edge in np.radians(muco.pitch_band_deg))
    bounds = (wish.altitude_min_m, wish.altitude_m, wish.altitude_max_m)
    return Problem(
        targets=np.ascontiguousarray(scenario.targets_m),
        views_rad=wish.view_rad,
        distances=wish.distance_m,
        weights=weights,
        altitudes=scenario.ground_m[:, None] + np.stack(bounds, axis=1),
        keeps_sight=wish.keeps_sight,
        bearing_weight=muco.weight_view_angle if wish.any_bearing else muco.weight_bearing,
        altitude_weights=np.array(
            [
                muco.weight_below,
                muco.weight_above,
                muco.weight_oscillation,
                0.0 if wish.any_bearing else muco.weight_beneath,
            ]
        ),
        pitches_rad=np.stack([low, wish.pitch_rad, high], axis=1),
        influence_m=muco.influence_m,
        difference_m=muco.difference_m,
        pitch_weight=muco.weight_pitch,
        safety_m=cfg.safety_distance_m,
        floor_m=cfg.relaxed_safety_m,
        step_max_m=cfg.speed_max_mps * scenario.dt_s,
        pushes_max=muco.pushes_max,
        dt_s=scenario.dt_s,
    )


# --- start ------------------------------------------------------------------------------------------------------------


def start_trajectory(
    scenario: Scenario, problem: Problem, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[np.ndarray, str]:
    """Give a feasible trajectory to start from and its kind: `behind`, the wished places, or `search` where they are blocked or blind.

    Raises:
        NoPathError: neither is feasible.
    """
    targets = problem.targets
    plain = scenario.wish.places_m(targets, scenario.ground_m)
    plain_is_free = bool(project(plain, problem, obstacles, 0, len(plain), nothing_nearby(len(plain))))
    seen = np.where(problem.keeps_sight, visibility(obstacles, plain, targets), 1.0)
    if plain_is_free and seen.mean() >= cfg.muco.start_visibility:
        return plain, "behind"
    safety_m, relaxed_m = cfg.safety_distance_m, cfg.relaxed_safety_m
    for climbing, clearance_m in ((False, safety_m), (True, safety_m), (True, relaxed_m)):
        found = search_start(problem, scenario.wish, obstacles, cfg, climbing=climbing, clearance_m=clearance_m)
        if found is not None and is_feasible(found, problem, obstacles, nothing_nearby(len(found))):
            return _rounded_off(found, problem, obstacles), "search"
    if plain_is_free:
        return plain, "behind"
    low_m, high_m = scenario.wish.altitude_min_m.min(), scenario.wish.altitude_max_m.max()
    raise NoPathError(
        "no free drone trajectory round this walk",
        where=scenario.path_id,
        expected=f"places from {low_m:g} to {high_m:g} m up, {cfg.relaxed_safety_m:g} m from all boxes",
        fix="is the walk roofed over? raise altitude_max_m or leave the path out",
    )


def _rounded_off(found: np.ndarray, problem: Problem, obstacles: BoxIndex) -> np.ndarray:
    """Smooth the corners of a searched trajectory as far as it stays feasible: that saves many capped steps."""
    for smoothing_s in (3.0, 1.5, 0.75):
        smooth = gaussian_filter1d(found, smoothing_s / problem.dt_s, axis=0, mode="nearest")
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
    points, history = np.array(start, dtype=np.float64), np.zeros(cfg.iterations_max + 1)
    rules = Rules(
        learning_rate=cfg.learning_rate,
        step_cap_m=cfg.step_cap_m,
        tolerance=cfg.tolerance,
        low_visibility=cfg.low_visibility,
        low_visibility_frames=cfg.low_visibility_frames,
    )
    state, spare = (make_state(len(points), len(obstacles.rows)) for _ in range(2))
    spare = spare._replace(nearby=state.nearby)
    # A flight of two points has nothing to move; only its loss is wanted.
    history = history if len(points) > 2 else history[:1]
    optimizer = descend_as_the_paper if cfg.step == "paper" else descend
    points, state, masked, num_iterations, num_tried, reason = optimizer(
        points, problem, obstacles, rules, (state, spare), history
    )
    facts = {
        "iterations": num_iterations,
        "evaluations": num_tried,
        "stopped": STOP_REASONS[reason] if len(points) > 2 else "no_interior_waypoint",
        "loss_start": round(float(history[0]), 6),
        "loss_end": round(float(state.terms.sum()), 6),
        "terms": {name: round(float(value), 6) for name, value in zip(TERM_NAMES, state.terms, strict=True)},
        "num_masked": int(masked.sum()),
        "loss_history": history[: num_iterations + 1],
    }
    return points, facts
