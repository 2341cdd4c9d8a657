"""MuCO: one trajectory, optimised as a whole against seven terms (subsec:appendix_planner_muco).

The loss is the paper's. Its plain gradient step overshoots with its own weights: 0.05 times a curvature of several
hundred is far beyond two, so its waypoints oscillate by the step cap. Our step solves the band system of the
Gauss-Newton model instead, caps it per waypoint, projects, and is shortened until the loss falls; then the trajectory
is repaired to `plan.accel_max_mps2`.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry.kernels import RAY_SPREAD_M, BoxIndex, collect_hits, free_rays, nearest_box, visibility
from cosfly.planners.contract import MucoConfig, Plan, PlanConfig, Scenario
from cosfly.planners.foresight import SPEED_SHARE, cheapest_way, places_on_rings
from cosfly.planners.muco.loss import TERM_NAMES, Problem, make_state
from cosfly.planners.muco.nearby import nothing_nearby
from cosfly.planners.muco.step import STOP_REASONS, Rules, descend, is_feasible, project
from cosfly.planners.smoothing import repair_to_limits
from cosfly.runtime.compiled import njit

# --- start ------------------------------------------------------------------------------------------------------------
# The reference positions (the paper: 20 m behind the target and as high) can be inside towers and behind corners.
# Pushing each waypoint out of a tower on its own would put neighbours on opposite sides of it; the search chooses
# places that can be reached from each other: dynamic programming over time, places on rings around the target, edges
# that keep their distance to boxes.

# Places around the target: NUM_AZIMUTHS on each ring. The first ring is the normal one, the second is steeper (into
# canyons). The others climb over obstacles and are tried only if the first two do not suffice.
STEEP_RADIUS, STEEP_CLIMB_M = 0.6, 6.0
NUM_CLIMBS, LEAST_CLIMB_M = 5, 8.0
WIDEN = 0.2  # metres that a ring is farther from the target per metre of climb
NUM_AZIMUTHS = 18
MAX_TURN = 3  # azimuths between one key frame and the next: 60 degrees, 21 m on the normal ring in 3 s
BETWEEN_KEYS_S = 3.0

# Costs of the search, in units of "the target fully hidden for one key frame" = 1.
TURN_COST = 0.5  # of the bearing opposite to the reference
TURN_COST_OF_STYLES = 8.0  # where the bearing is the purpose: 64 degrees cost as much as a hidden target
CLIMB_COST, CLIMB_SCALE_M = 0.6, 20.0  # climb / scale, above the preferred altitude
STEEP_COST = 0.1  # a ring other than the normal one
MOVE_COST, MOVE_SCALE_MPS = 0.25, 3.0  # (speed / scale)^2


def search_start(
    problem: Problem, scenario: Scenario, index: BoxIndex, cfg: PlanConfig, *, climbing: bool, clearance_m: float
) -> np.ndarray | None:
    """Find a free trajectory that sees the target well, by dynamic programming over key frames.

    Args:
        climbing: Try places above the normal and the steep ring too.
    Returns:
        (n, 3), straight between key frames, all of it `clearance_m` from all boxes; None if there is none.
    """
    reference = scenario.reference
    keys, _, preferred_m, greatest_m = scenario.key_frames(max(1, round(BETWEEN_KEYS_S / problem.dt_s)))
    rings = _rings(reference.ground_distance_m[keys], preferred_m, greatest_m, climbing)  # (m, rings, 2)
    azimuths_rad = np.arange(NUM_AZIMUTHS) * (2.0 * np.pi / NUM_AZIMUTHS)
    places_m = places_on_rings(scenario, keys, rings[:, :, 0], rings[:, :, 1], azimuths_rad).reshape(len(keys), -1, 3)
    # Costs, (rings, azimuths): the rings climb by almost the same at all key frames, so the first stands for all.
    turns = np.minimum(azimuths_rad, 2.0 * np.pi - azimuths_rad) / np.pi
    climbs = np.maximum(rings[0, :, 1] - preferred_m[0], 0.0)[:, None] / CLIMB_SCALE_M
    turn_cost = TURN_COST if reference.any_bearing else TURN_COST_OF_STYLES
    costs = turn_cost * turns[None] ** 2 + CLIMB_COST * climbs + STEEP_COST * (np.arange(rings.shape[1]) > 0)[:, None]
    chosen = _search(
        places_m, problem.targets[keys], keys * problem.dt_s, costs, reference.keeps_sight[keys], index, clearance_m,
        SPEED_SHARE * cfg.speed_max_mps,
    )  # fmt: skip
    return None if chosen[0] < 0 else scenario.between(keys, places_m[np.arange(len(keys)), chosen])


def _rings(distances_m: np.ndarray, preferred_m: np.ndarray, greatest_m: np.ndarray, climbing: bool) -> np.ndarray:
    """Return (m, r, 2): horizontal distance and z of the rings of each key frame, the normal one first."""
    all_rings = []
    for distance_m, preferred, greatest in np.stack([distances_m, preferred_m, greatest_m], axis=1).tolist():
        rings = [(distance_m, preferred), (STEEP_RADIUS * distance_m, min(preferred + STEEP_CLIMB_M, greatest))]
        climbs = np.geomspace(LEAST_CLIMB_M, max(greatest - preferred, LEAST_CLIMB_M), NUM_CLIMBS if climbing else 0)
        all_rings.append(rings + [(distance_m + WIDEN * climb, min(preferred + climb, greatest)) for climb in climbs])
    return np.array(all_rings)


@njit(cache=True)
def _search(places, targets, times_s, costs, keeps_sight, index, clearance_m, limit_mps):
    """Return the chosen place of each key frame, (m,), all -1 if no sequence of places is free.

    Args:
        places: (m, c, 3), c = rings * azimuths. targets: (m, 3). times_s: (m,).
        costs: (rings, azimuths) of a place apart from visibility.
        keeps_sight: (m,) bool, whether visibility counts.
    """
    num_keys, num_places = len(places), places.shape[1]
    way_costs = np.full((num_keys, num_places), np.inf)
    came_from = np.full((num_keys, num_places), -1, dtype=np.int64)
    blockers = np.empty(len(index.rows), dtype=np.int64)
    guesses = np.empty(num_places)
    for key in range(num_keys):
        place_costs = _place_costs(places[key], targets[key], costs, keeps_sight[key], index, clearance_m, blockers)
        if key == 0:
            way_costs[0] = place_costs
            continue
        step_s = times_s[key] - times_s[key - 1]
        for c in range(num_places):
            if place_costs[c] < np.inf:
                came_from[key, c], way_cost = _cheapest_predecessor(
                    places[key], c, places[key - 1], way_costs[key - 1], step_s, index, clearance_m, limit_mps, guesses
                )
                way_costs[key, c] = way_cost + place_costs[c]
    return cheapest_way(way_costs, came_from)


@njit(cache=True)
def _place_costs(places, target, costs, keeps_sight, index, clearance_m, blockers):
    """Return the costs of the places of one key frame with visibility, (c,), infinite where a box is too near."""
    place_costs = np.full(len(places), np.inf)
    for c in range(len(places)):
        x, y, z = places[c, 0], places[c, 1], places[c, 2]
        if nearest_box(index, x, y, z, clearance_m)[0] >= clearance_m:
            visible_share = 1.0
            if keeps_sight:
                num_hits = collect_hits(index, target[0], target[1], target[2], x, y, z, RAY_SPREAD_M, blockers)
                visible_share = free_rays(index, blockers, num_hits, x, y, z, target)
            place_costs[c] = costs[c // NUM_AZIMUTHS, c % NUM_AZIMUTHS] + 1.0 - visible_share
    return place_costs


@njit(cache=True)
def _cheapest_predecessor(places, c, previous, way_costs, step_s, index, clearance_m, limit_mps, guesses):
    """Return the place of the previous key frame from which place c is reached at least cost, and the cost; or -1, inf.

    places, previous: (c, 3) of this and of the previous key frame.
    way_costs: (c,) of the cheapest way to each previous place.
    guesses: (c,), written.
    """
    x, y, z = places[c, 0], places[c, 1], places[c, 2]
    for before in range(len(previous)):
        guesses[before] = np.inf
        turn = abs(c % NUM_AZIMUTHS - before % NUM_AZIMUTHS)
        if way_costs[before] < np.inf and min(turn, NUM_AZIMUTHS - turn) <= MAX_TURN:
            x0, y0, z0 = previous[before, 0], previous[before, 1], previous[before, 2]
            speed_mps = np.sqrt((x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2) / step_s
            if speed_mps <= limit_mps:
                guesses[before] = way_costs[before] + MOVE_COST * (speed_mps / MOVE_SCALE_MPS) ** 2
    first_hit = np.empty(1, dtype=np.int64)
    while True:  # until a segment is free; most often the first
        before = int(np.argmin(guesses))
        if guesses[before] == np.inf:
            return -1, np.inf
        x0, y0, z0 = previous[before, 0], previous[before, 1], previous[before, 2]
        if collect_hits(index, x0, y0, z0, x, y, z, clearance_m, first_hit) == 0:
            return before, guesses[before]
        guesses[before] = np.inf


# --- planner ----------------------------------------------------------------------------------------------------------

# Reasons to stop that count as converged. If no step of any length lowers the loss, its change is 0.
CONVERGED_REASONS = ("converged", "no_step", "no_interior_waypoint")
ROUNDINGS_S = (3.0, 1.5, 0.75)  # standard deviations of the smoothing of a searched start, tried in this order


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one trajectory (the signature of `planners.contract`); nothing here is random."""
    problem = make_problem(scenario, cfg)
    start, kind = start_trajectory(scenario, problem, obstacles, cfg)
    points, solver, _ = optimize(start, problem, obstacles, cfg.muco)
    points = repair_to_limits(points, scenario, obstacles, cfg)
    return Plan(points, {"start": kind, **solver}, is_converged=solver["stopped"] in CONVERGED_REASONS)


def make_problem(scenario: Scenario, cfg: PlanConfig) -> Problem:
    """Convert settings and scenario to the form of the compiled loss."""
    muco = cfg.muco
    reference = scenario.reference
    weights = np.array([getattr(muco, f"weight_{name}") for name in TERM_NAMES[:7]])
    # The band is relative to the settings' pitch and moves with the reference.
    shift = reference.pitch_rad - np.radians(muco.pitch_deg)
    low, high = (edge + shift for edge in np.radians(muco.pitch_band_deg))
    bounds = (reference.altitude_min_m, reference.altitude_m, reference.altitude_max_m)
    beneath = 0.0 if reference.any_bearing else muco.weight_beneath
    return Problem(
        targets=np.ascontiguousarray(scenario.targets_m), views_rad=reference.view_rad,
        distances=reference.distance_m, weights=weights,
        altitudes=scenario.ground_m[:, None] + np.stack(bounds, axis=1), keeps_sight=reference.keeps_sight,
        bearing_weight=muco.weight_view_angle if reference.any_bearing else muco.weight_bearing,
        altitude_weights=np.array([muco.weight_below, muco.weight_above, muco.weight_oscillation, beneath]),
        pitches_rad=np.stack([low, reference.pitch_rad, high], axis=1), influence_m=muco.influence_m,
        difference_m=muco.difference_m, pitch_weight=muco.weight_pitch, safety_m=cfg.safety_distance_m,
        floor_m=cfg.relaxed_safety_m, step_max_m=cfg.speed_max_mps * scenario.dt_s, pushes_max=muco.pushes_max,
        dt_s=scenario.dt_s,
    )  # fmt: skip


def start_trajectory(
    scenario: Scenario, problem: Problem, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[np.ndarray, str]:
    """Return a feasible trajectory to start from, (n, 3), and its kind.

    The kind is `behind` for the projected reference, or `search` where the reference is blocked or does not see enough
    of the target.
    """
    targets = problem.targets
    behind = scenario.reference.places_m(targets, scenario.ground_m)
    behind_is_free = bool(project(behind, problem, obstacles, 0, len(behind), nothing_nearby(len(behind))))
    seen = np.where(problem.keeps_sight, visibility(obstacles, behind, targets), 1.0)
    if behind_is_free and seen.mean() >= cfg.muco.start_visibility:
        return behind, "behind"
    safety_m, relaxed_m = cfg.safety_distance_m, cfg.relaxed_safety_m
    for climbing, clearance_m in ((False, safety_m), (True, safety_m), (True, relaxed_m)):
        searched = search_start(problem, scenario, obstacles, cfg, climbing=climbing, clearance_m=clearance_m)
        if searched is not None and is_feasible(searched, problem, obstacles, nothing_nearby(len(searched))):
            return _rounded_off(searched, problem, obstacles), "search"
    if behind_is_free:
        return behind, "behind"
    raise scenario.no_path_error("MuCO found no collision-free trajectory to start with", cfg.relaxed_safety_m)


def _rounded_off(points: np.ndarray, problem: Problem, obstacles: BoxIndex) -> np.ndarray:
    """Smooth the corners of a searched trajectory, (n, 3), as far as it stays feasible; saves many capped steps."""
    for smoothing_s in ROUNDINGS_S:
        smooth = gaussian_filter1d(points, smoothing_s / problem.dt_s, axis=0, mode="nearest")
        if project(smooth, problem, obstacles, 0, len(smooth), nothing_nearby(len(smooth))):
            return smooth
    return points


# --- optimisation -----------------------------------------------------------------------------------------------------


def optimize(
    start: np.ndarray, problem: Problem, obstacles: BoxIndex, cfg: MucoConfig
) -> tuple[np.ndarray, dict, np.ndarray]:
    """Optimize a feasible trajectory; its ends do not move.

    Args:
        start: (n, 3), feasible.
    Returns:
        (n, 3); the solver's facts for the product; the loss at the start and after each iteration.
    """
    points = np.array(start, dtype=np.float64)
    has_interior = len(points) > 2  # otherwise only the loss is computed
    history = np.zeros(cfg.iterations_max + 1 if has_interior else 1)
    rules = Rules(*(getattr(cfg, name) for name in Rules._fields))  # compiled code takes no models
    state, spare = (make_state(len(points), len(obstacles.rows)) for _ in range(2))
    spare = spare._replace(nearby=state.nearby)  # both evaluate trajectories near each other: one cache of boxes
    points, state, masked, num_iterations, num_tried, reason = descend(
        points, problem, obstacles, rules, (state, spare), history
    )
    facts = {
        "iterations": num_iterations, "evaluations": num_tried,
        "stopped": STOP_REASONS[reason] if has_interior else "no_interior_waypoint",
        "loss_start": round(float(history[0]), 6), "loss_end": round(float(state.terms.sum()), 6),
        "terms": {name: round(float(value), 6) for name, value in zip(TERM_NAMES, state.terms, strict=True)},
        "num_masked": int(masked.sum()),
    }  # fmt: skip
    return points, facts, history[: num_iterations + 1]
