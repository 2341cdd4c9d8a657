"""Smoothing that keeps what a raw flight sees: least squares, drawn to it where it loses sight or comes too near.

The smoothed flight p of a raw flight r minimises the sum over waypoints of pull (p - r)^2 + velocity^2 + acceleration^2
+ jerk^2, each with its weight: one band system, the same for x, y and z. Waypoints that see less than their raw ones
are pulled harder, up to a limit, and those that come too near a box or fly too fast without one, until none is left.

`within_limits` mends a flight of any planner by the same system: what breaks a limit is let go, what is too near a box
is drawn away from it, and the rest stays where it is.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry.kernels import BoxIndex, normals, swept_distances, visibility
from cosfly.geometry.trajectory_metrics import CLEARANCE_TOLERANCE_M
from cosfly.planners.contract import PlanConfig, Scenario

# Weights of the squared distance to the raw flight: where any bearing will do; where the wished one counts, and there
# at wished places, whose halts are part of what is wished; at most for the sake of sight.
PULL_ANY_BEARING, PULL, PULL_AS_WISHED, PULL_FOR_SIGHT_MAX, PULL_RISE = 0.2, 20.0, 1000.0, 300.0, 4.0
AS_WISHED_M = 0.5  # from the wished place
# Weights of squared derivatives with respect to time: that of velocity draws the flight tight.
VELOCITY_S2, ACCELERATION_S4, JERK_S6 = 8.0, 30.0, 100.0
DIFFERENCES = ((VELOCITY_S2, (-1.0, 1.0)), (ACCELERATION_S4, (1.0, -2.0, 1.0)), (JERK_S6, (-1.0, 3.0, -3.0, 1.0)))
SPREAD_S = 1.0  # neighbours are pulled along
ROUNDS, ROUNDS_MAX = 12, 24  # for the sake of sight; for the sake of safety
MENDS_MAX = 120  # rounds for a flight that breaks limits: between two boxes they draw it to and fro
SIGHT_LOSS = 0.01  # of a waypoint that is no loss: the five rays count in fifths
ASTRAY_SHARE = 0.3  # of the wished distance: farther from the raw flight is not the flight that was searched
PULL_STAYS = 1e6  # of a flight that is right: within a centimetre
PULL_FLOWN = 1e9  # of what is flown already
SETTLES = 4  # times as long as the drone takes to change to the raw flight's velocity
AWAY_M = 0.05  # beyond what is asked for, so that rounds end
ROUNDING_M = 1e-9


def smooth_trajectory(
    raw: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, clearance_m: float
) -> tuple[np.ndarray, dict]:
    """Smooth a raw flight that keeps all bounds; give it back as it is if no smooth one does.

    Args:
        raw: (n, 3). clearance_m: that it keeps.
    Returns:
        (n, 3), and facts: visibility of the raw flight, rounds, whether a smooth flight was found.
    """
    reference, dt_s = scenario.reference, scenario.dt_s
    ahead, settled = slice(scenario.start, None), 0
    if scenario.turns_round:  # and is on its way: before it can neither follow the raw flight nor see as much
        change_m = np.linalg.norm(np.diff(raw[scenario.start - 1 : scenario.start + 2], n=2, axis=0))
        settled = scenario.start + SETTLES * int(np.ceil(change_m / (cfg.accel_max_mps2 * dt_s**2)))
    seen_raw, astray_m = visibility(obstacles, raw, scenario.targets_m), ASTRAY_SHARE * reference.distance_m
    band, pulls = smoothness_band(len(raw), dt_s), first_pulls(raw, scenario)
    for tried in range(1, ROUNDS_MAX + 1):
        points, blocked = _drawn_to(raw, pulls, band, scenario), np.zeros(len(raw), dtype=bool)
        blocked[ahead] = unsafe(points[ahead], obstacles, clearance_m, cfg.speed_max_mps * dt_s)
        lost = np.maximum(seen_raw - visibility(obstacles, points, scenario.targets_m), 0.0) * reference.keeps_sight
        lost = np.maximum(lost, np.linalg.norm(points - raw, axis=1) > astray_m)
        lost[(lost < SIGHT_LOSS) | (pulls >= PULL_FOR_SIGHT_MAX)] = 0.0
        lost[:settled] = 0.0
        is_smooth = not blocked.any()
        if is_smooth and (tried >= ROUNDS or not lost.any()):
            break
        pulls = pulls * PULL_RISE ** _spread(np.maximum(lost, blocked), SPREAD_S / dt_s)
    facts = {"raw_visibility": round(float(seen_raw.mean()), 4), "rounds": tried, "smooth": is_smooth}
    return within_limits(points if is_smooth else raw, scenario, obstacles, cfg), facts


def within_limits(points: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig) -> np.ndarray:
    """Return a flight (n, 3) that keeps the limits of speed, acceleration and clearance as it will be written; itself
    where it keeps them.
    """
    goal, pulls, band = points.copy(), np.full(len(points), PULL_STAYS), smoothness_band(len(points), scenario.dt_s)
    least_m = cfg.relaxed_safety_m - CLEARANCE_TOLERANCE_M
    for _ in range(MENDS_MAX):
        written = np.round(points, 4)
        hurried = hurries(written, cfg, scenario.dt_s, len(scenario.flown_m))
        gaps_m, shares, boxes = swept_distances(obstacles, written, cfg.relaxed_safety_m + AWAY_M)
        gaps_m[: scenario.start] = np.inf
        if not (hurried.any() or (gaps_m < least_m).any()):
            return points
        near = np.flatnonzero((gaps_m < cfg.relaxed_safety_m + AWAY_M) & (boxes >= 0))
        after = np.minimum(near + 1, len(points) - 1)
        places = written[near] + shares[near, None] * (written[after] - written[near])
        away = normals(obstacles, places, boxes[near]) * (cfg.relaxed_safety_m + AWAY_M - gaps_m[near])[:, None]
        for ends in (near, after):
            np.add.at(goal, ends, away)
        pulls = pulls / PULL_RISE ** _spread(hurried, SPREAD_S / scenario.dt_s)
        points = _drawn_to(goal, pulls, band, scenario)
    raise scenario.no_way("no flight within the limits of speed and acceleration", cfg.relaxed_safety_m)


def _drawn_to(goal: np.ndarray, pulls: np.ndarray, band: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the smooth flight, (n, 3), that is drawn to a goal, (n, 3), with pulls (n,), within the wished
    altitudes."""
    system, goal = band.copy(), scenario.as_flown(goal)
    low, high = (
        scenario.ground_m + bound for bound in (scenario.reference.altitude_min_m, scenario.reference.altitude_max_m)
    )
    pulls = np.where(np.arange(len(pulls)) < len(scenario.flown_m), PULL_FLOWN, pulls)
    system[0] += pulls
    points = solveh_banded(system, pulls[:, None] * goal, lower=True)
    points[:, 2] = np.clip(points[:, 2], low, high)
    return scenario.as_flown(points)


def hurries(points: np.ndarray, cfg: PlanConfig, dt_s: float, num_flown: int = 0) -> np.ndarray:
    """Return which waypoints (n, 3) are at an end of a step too fast or of a change of speed too great, (n,) bool.
    Those among the first `num_flown` are past."""
    found = np.zeros(len(points), dtype=bool)
    for order, most in ((1, cfg.speed_max_mps), (2, cfg.accel_max_mps2)):
        over = np.linalg.norm(np.diff(points, n=order, axis=0), axis=1) > most * dt_s**order + 1e-9
        over[: max(num_flown - order, 0)] = False
        for k in range(order + 1):
            found[k : k + len(over)] |= over
    return found


def first_pulls(raw: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the pull of each waypoint of a raw flight (n, 3) before anything is lost, (n,)."""
    if scenario.reference.any_bearing:
        return np.full(len(raw), PULL_ANY_BEARING)
    off_m = np.linalg.norm(raw - scenario.reference.places_m(scenario.targets_m, scenario.ground_m), axis=1)
    return np.where(off_m <= AS_WISHED_M, PULL_AS_WISHED, PULL)


def smoothness_band(num_points: int, dt_s: float) -> np.ndarray:
    """Return the lower band of the matrix of squared derivatives of n points `dt_s` apart, (4, n)."""
    band = np.zeros((4, num_points))
    for weight, coefficients in DIFFERENCES:
        order, num = len(coefficients) - 1, max(num_points - len(coefficients) + 1, 0)
        for k, one in enumerate(coefficients):
            for m, other in enumerate(coefficients[: k + 1]):
                band[k - m, m : m + num] += weight / dt_s ** (2 * order) * one * other
    return band


def unsafe(points: np.ndarray, obstacles: BoxIndex, clearance_m: float, step_max_m: float) -> np.ndarray:
    """Return which waypoints are at an end of a step too long or too near a box, (n,) bool."""
    found = swept_distances(obstacles, points, clearance_m)[0] < clearance_m - ROUNDING_M
    steps = found[:-1] | (np.linalg.norm(np.diff(points, axis=0), axis=1) > step_max_m * (1.0 + ROUNDING_M))
    found[:-1] |= steps
    found[1:] |= steps
    return found


def _spread(amounts: np.ndarray, sigma: float) -> np.ndarray:
    """Spread amounts over neighbours by a bell that is 1 at its top; at most 1 each."""
    return np.minimum(
        gaussian_filter1d(amounts.astype(np.float64), sigma, mode="nearest") * sigma * np.sqrt(2.0 * np.pi), 1.0
    )
