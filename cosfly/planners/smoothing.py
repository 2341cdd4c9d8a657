"""Least-squares smoothing that keeps the visibility of a raw trajectory, and the repair of trajectories to the limits.

The smoothed trajectory p of a raw trajectory r minimises the sum over waypoints of pull (p - r)^2 + velocity^2 +
acceleration^2 + jerk^2, each with its weight: one band system for x, y and z. Waypoints that see less than their raw
ones are pulled harder, up to a limit; those too near a box or too fast are pulled harder without a limit.

`repair_to_limits` uses the same system for a trajectory of any planner: waypoints that break a limit are released,
those too near a box are moved away from it, and the others stay.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry.kernels import BoxIndex, normals, swept_distances, visibility
from cosfly.geometry.trajectory_metrics import CLEARANCE_TOLERANCE_M
from cosfly.planners.contract import PlanConfig, Scenario

# Weights (pulls) of the squared distance to the raw trajectory.
PULL_ANY_BEARING = 0.2  # where any bearing is allowed
PULL = 20.0  # where the reference bearing counts
PULL_AS_REQUESTED = 1000.0  # and the raw waypoint is within AS_REQUESTED_M of it, so that halts stay halts
PULL_FOR_VISIBILITY_MAX = 300.0  # no pull rises beyond this because of visibility
PULL_RISE = 4.0  # factor per round
AS_REQUESTED_M = 0.5
# Weights of squared derivatives with respect to time: that of velocity shortens the trajectory.
VELOCITY_S2, ACCELERATION_S4, JERK_S6 = 8.0, 30.0, 100.0
DIFFERENCES = ((VELOCITY_S2, (-1.0, 1.0)), (ACCELERATION_S4, (1.0, -2.0, 1.0)), (JERK_S6, (-1.0, 3.0, -3.0, 1.0)))
SPREAD_S = 1.0  # standard deviation in time over which neighbours are pulled too
ROUNDS, ROUNDS_MAX = 12, 24  # rounds at most for visibility, and for safety
REPAIRS_MAX = 120  # rounds of a repair; between two boxes a trajectory oscillates
VISIBILITY_LOSS = 0.01  # smaller losses are ignored; the five rays count in fifths
ASTRAY_SHARE = 0.3  # of the reference distance: largest distance from the raw trajectory
PULL_FIXED = 1e6  # of waypoints within the limits: they move by less than a centimetre
PULL_PAST = 1e9  # of past positions
SETTLES = 4  # times the duration of the change to the raw trajectory's velocity
AWAY_M = 0.05  # margin on the clearance, so that rounds end
ROUNDING_M = 1e-9


def smooth_trajectory(
    raw: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, clearance_m: float
) -> tuple[np.ndarray, dict]:
    """Smooth a raw trajectory that keeps all bounds; return it unsmoothed if no smooth one keeps them.

    Args:
        raw: (n, 3). clearance_m: of the raw trajectory.
    Returns:
        (n, 3), and facts: visibility of the raw trajectory, rounds, whether a smooth trajectory was found.
    """
    reference = scenario.reference
    dt_s = scenario.dt_s
    ahead = slice(scenario.start, None)
    first_judged = 0  # the drone cannot see as much as the raw trajectory before this waypoint
    if scenario.turns_back:
        change_m = np.linalg.norm(np.diff(raw[scenario.start - 1 : scenario.start + 2], n=2, axis=0))
        first_judged = scenario.start + SETTLES * int(np.ceil(change_m / (cfg.accel_max_mps2 * dt_s**2)))
    seen_raw = visibility(obstacles, raw, scenario.targets_m)
    astray_m = ASTRAY_SHARE * reference.distance_m
    band = smoothness_band(len(raw), dt_s)
    pulls = first_pulls(raw, scenario)
    for num_rounds in range(1, ROUNDS_MAX + 1):
        points = _pulled_to(raw, pulls, band, scenario)
        blocked = np.zeros(len(raw), dtype=bool)
        blocked[ahead] = unsafe(points[ahead], obstacles, clearance_m, cfg.speed_max_mps * dt_s)
        # How much each waypoint has to be pulled, from 0 to 1: by its loss of visibility, or fully if it is astray.
        lost = np.maximum(seen_raw - visibility(obstacles, points, scenario.targets_m), 0.0) * reference.keeps_sight
        lost = np.maximum(lost, np.linalg.norm(points - raw, axis=1) > astray_m)
        lost[(lost < VISIBILITY_LOSS) | (pulls >= PULL_FOR_VISIBILITY_MAX)] = 0.0
        lost[:first_judged] = 0.0
        is_smooth = not blocked.any()
        if is_smooth and (num_rounds >= ROUNDS or not lost.any()):
            break
        pulls = pulls * PULL_RISE ** _spread(np.maximum(lost, blocked), SPREAD_S / dt_s)
    facts = {"raw_visibility": round(float(seen_raw.mean()), 4), "rounds": num_rounds, "smooth": is_smooth}
    return repair_to_limits(points if is_smooth else raw, scenario, obstacles, cfg), facts


def repair_to_limits(points: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig) -> np.ndarray:
    """Return a trajectory, (n, 3), whose rounded form keeps the limits of speed, acceleration and clearance.

    Raises:
        NoPathError: If no such trajectory is found.
    """
    goal = points.copy()
    pulls = np.full(len(points), PULL_FIXED)
    band = smoothness_band(len(points), scenario.dt_s)
    least_m = cfg.relaxed_safety_m - CLEARANCE_TOLERANCE_M
    required_m = cfg.relaxed_safety_m + AWAY_M
    for _ in range(REPAIRS_MAX):
        written = np.round(points, 4)  # as in the file
        exceeding = exceeds_limits(written, cfg, scenario.dt_s, len(scenario.past_m))
        gaps_m, shares, boxes = swept_distances(obstacles, written, required_m)
        gaps_m[: scenario.start] = np.inf
        if not (exceeding.any() or (gaps_m < least_m).any()):
            return points
        near = np.flatnonzero((gaps_m < required_m) & (boxes >= 0))  # steps, by their first waypoint
        after = np.minimum(near + 1, len(points) - 1)
        nearest_places = written[near] + shares[near, None] * (written[after] - written[near])
        away = normals(obstacles, nearest_places, boxes[near]) * (required_m - gaps_m[near])[:, None]
        for ends in (near, after):
            np.add.at(goal, ends, away)
        pulls = pulls / PULL_RISE ** _spread(exceeding, SPREAD_S / scenario.dt_s)
        points = _pulled_to(goal, pulls, band, scenario)
    raise scenario.no_path_error(
        "smoothing found no trajectory within the limits of speed and acceleration", cfg.relaxed_safety_m
    )


def _pulled_to(goal: np.ndarray, pulls: np.ndarray, band: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the smooth trajectory, (n, 3), pulled to a goal, (n, 3), with weights (n,), within the altitude bounds."""
    system = band.copy()
    goal = scenario.with_past(goal)
    reference = scenario.reference
    low, high = (scenario.ground_m + bound for bound in (reference.altitude_min_m, reference.altitude_max_m))
    pulls = np.where(np.arange(len(pulls)) < len(scenario.past_m), PULL_PAST, pulls)
    system[0] += pulls
    points = solveh_banded(system, pulls[:, None] * goal, lower=True)
    points[:, 2] = np.clip(points[:, 2], low, high)
    return scenario.with_past(points)


def exceeds_limits(points: np.ndarray, cfg: PlanConfig, dt_s: float, num_past: int = 0) -> np.ndarray:
    """Return which waypoints, (n, 3), after the first `num_past` belong to a step that is too fast or abrupt."""
    exceeding = np.zeros(len(points), dtype=bool)
    for order, limit in ((1, cfg.speed_max_mps), (2, cfg.accel_max_mps2)):
        is_over = np.linalg.norm(np.diff(points, n=order, axis=0), axis=1) > limit * dt_s**order + 1e-9
        is_over[: max(num_past - order, 0)] = False
        for k in range(order + 1):
            exceeding[k : k + len(is_over)] |= is_over
    return exceeding


def first_pulls(raw: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the initial pull of each waypoint of a raw trajectory, (n, 3): (n,)."""
    if scenario.reference.any_bearing:
        return np.full(len(raw), PULL_ANY_BEARING)
    off_m = np.linalg.norm(raw - scenario.reference.places_m(scenario.targets_m, scenario.ground_m), axis=1)
    return np.where(off_m <= AS_REQUESTED_M, PULL_AS_REQUESTED, PULL)


def smoothness_band(num_points: int, dt_s: float) -> np.ndarray:
    """Return the lower band of the matrix of squared derivatives of n points `dt_s` apart, (4, n)."""
    band = np.zeros((4, num_points))
    for weight, coefficients in DIFFERENCES:
        order = len(coefficients) - 1
        num = max(num_points - order, 0)
        for k, row_coefficient in enumerate(coefficients):
            for m, column_coefficient in enumerate(coefficients[: k + 1]):
                band[k - m, m : m + num] += weight / dt_s ** (2 * order) * row_coefficient * column_coefficient
    return band


def unsafe(points: np.ndarray, obstacles: BoxIndex, clearance_m: float, step_max_m: float) -> np.ndarray:
    """Return which waypoints belong to a step that is too long or too near a box, (n,) bool."""
    is_unsafe = swept_distances(obstacles, points, clearance_m)[0] < clearance_m - ROUNDING_M
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    unsafe_steps = is_unsafe[:-1] | (lengths_m > step_max_m * (1.0 + ROUNDING_M))
    is_unsafe[:-1] |= unsafe_steps
    is_unsafe[1:] |= unsafe_steps
    return is_unsafe


def _spread(amounts: np.ndarray, sigma: float) -> np.ndarray:
    """Spread amounts over neighbours by a Gaussian of height 1; at most 1 each."""
    spread = gaussian_filter1d(amounts.astype(np.float64), sigma, mode="nearest")
    return np.minimum(spread * sigma * np.sqrt(2.0 * np.pi), 1.0)
