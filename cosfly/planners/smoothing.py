"""Smoothing that keeps what a raw flight sees: least squares, drawn to it where it loses sight or comes too near.

The smoothed flight p of a raw flight r minimises the sum over waypoints of pull (p - r)^2 + velocity^2 + acceleration^2
+ jerk^2, each with its weight: one band system, the same for x, y and z. Waypoints that see less than their raw ones
are pulled harder, up to a limit, and those that come too near a box or fly too fast without one, until none is left.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from cosfly.planners.contract import PlanConfig, Scenario
from cosfly.space.kernels import BoxIndex, segments_hit, signed_distances, visibility

# Weights of the squared distance to the raw flight: where any bearing will do; where the wished one counts, and there
# at wished places, whose halts are part of what is wished; at most for the sake of sight.
PULL_ANY_BEARING, PULL, PULL_AS_WISHED, PULL_FOR_SIGHT_MAX, PULL_RISE = 0.2, 20.0, 1000.0, 300.0, 4.0
AS_WISHED_M = 0.5  # from the wished place
# Weights of squared derivatives with respect to time: that of velocity draws the flight tight.
VELOCITY_S2, ACCELERATION_S4, JERK_S6 = 8.0, 30.0, 100.0
DIFFERENCES = ((VELOCITY_S2, (-1.0, 1.0)), (ACCELERATION_S4, (1.0, -2.0, 1.0)), (JERK_S6, (-1.0, 3.0, -3.0, 1.0)))
SPREAD_S = 1.0  # neighbours are pulled along
ROUNDS, ROUNDS_MAX = 12, 24  # for the sake of sight; for the sake of safety
SIGHT_LOSS = 0.01  # of a waypoint that is no loss: the five rays count in fifths
ASTRAY_SHARE = 0.3  # of the wished distance: farther from the raw flight is not the flight that was searched
ROUNDING_M = 1e-9


def smooth_flight(
    raw: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, clearance_m: float
) -> tuple[np.ndarray, dict]:
    """Smooth a raw flight that keeps all bounds; give it back as it is if no smooth one does.

    Args:
        raw: (n, 3). clearance_m: that it keeps.
    Returns:
        (n, 3), and facts: visibility of the raw flight, rounds, whether a smooth flight was found.
    """
    wish, dt_s = scenario.wish, scenario.dt_s
    low, high = (scenario.ground_m + bound for bound in (wish.altitude_min_m, wish.altitude_max_m))
    seen_raw, astray_m = visibility(obstacles, raw, scenario.targets_m), ASTRAY_SHARE * wish.distance_m
    band, pulls = smoothness_band(len(raw), dt_s), first_pulls(raw, scenario)
    for tried in range(1, ROUNDS_MAX + 1):
        system = band.copy()
        system[0] += pulls
        points = solveh_banded(system, pulls[:, None] * raw, lower=True)
        points[:, 2] = np.clip(points[:, 2], low, high)
        blocked = unsafe(points, obstacles, clearance_m, cfg.speed_max_mps * dt_s)
        lost = np.maximum(seen_raw - visibility(obstacles, points, scenario.targets_m), 0.0) * wish.keeps_sight
        lost = np.maximum(lost, np.linalg.norm(points - raw, axis=1) > astray_m)
        lost[(lost < SIGHT_LOSS) | (pulls >= PULL_FOR_SIGHT_MAX)] = 0.0
        is_smooth = not blocked.any()
        if is_smooth and (tried >= ROUNDS or not lost.any()):
            break
        pulls = pulls * PULL_RISE ** _spread(np.maximum(lost, blocked), SPREAD_S / dt_s)
    facts = {"raw_visibility": round(float(seen_raw.mean()), 4), "rounds": tried, "smooth": is_smooth}
    return (points if is_smooth else raw), facts


def first_pulls(raw: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Give the pull of each waypoint of a raw flight (n, 3) before anything is lost, (n,)."""
    if scenario.wish.any_bearing:
        return np.full(len(raw), PULL_ANY_BEARING)
    off_m = np.linalg.norm(raw - scenario.wish.places_m(scenario.targets_m, scenario.ground_m), axis=1)
    return np.where(off_m <= AS_WISHED_M, PULL_AS_WISHED, PULL)


def smoothness_band(num_points: int, dt_s: float) -> np.ndarray:
    """Give the lower band of the matrix of squared derivatives of n points `dt_s` apart, (4, n)."""
    band = np.zeros((4, num_points))
    for weight, coefficients in DIFFERENCES:
        order, num = len(coefficients) - 1, max(num_points - len(coefficients) + 1, 0)
        for k, one in enumerate(coefficients):
            for m, other in enumerate(coefficients[: k + 1]):
                band[k - m, m : m + num] += weight / dt_s ** (2 * order) * one * other
    return band


def unsafe(points: np.ndarray, obstacles: BoxIndex, clearance_m: float, step_max_m: float) -> np.ndarray:
    """Tell which waypoints are too near a box, or at an end of a step too long or through one, (n,) bool."""
    found = signed_distances(obstacles, points, clearance_m)[0] < clearance_m - ROUNDING_M
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1) > step_max_m * (1.0 + ROUNDING_M)
    steps |= segments_hit(obstacles, points[:-1], points[1:])
    found[:-1] |= steps
    found[1:] |= steps
    return found


def _spread(amounts: np.ndarray, sigma: float) -> np.ndarray:
    """Spread amounts over neighbours by a bell that is 1 at its top; at most 1 each."""
    return np.minimum(
        gaussian_filter1d(amounts.astype(np.float64), sigma, mode="nearest") * sigma * np.sqrt(2.0 * np.pi), 1.0
    )
