"""Trajectory metrics: dynamics by discrete differentiation, distances, visibility (sec:step6)."""

import numpy as np

from cosfly.formats.episodes import Figure
from cosfly.geometry.axes import DT_S

ACCEL_SCALE_MPS2, JERK_SCALE_MPS3 = 5.0, 10.0  # eq:smoothness_score

# Bounds of a trajectory (sec:step6), for the filter of `plan` and for `inspect`.
FIVE_RAY_MEAN_MIN, ACCEL_RMS_MAX_MPS2, JERK_RMS_MAX_MPS3 = 0.40, 5.0, 10.0
YAW_RATE_MAX_DEGPS = 60.0  # of plans; the drone of the closed loop turns no faster

# Distances to obstacles (tab:drone_params): of plans and perturbed frames, and the floor where a plan cannot keep it.
SAFETY_DISTANCE_M, RELAXED_SAFETY_M = 3.0, 2.5
CLEARANCE_CAP_M = 100.0  # of clearances in files, which hold finite numbers
CLEARANCE_TOLERANCE_M = 1e-3  # files keep a tenth of a millimetre


def derivative_rms(positions_m: np.ndarray, order: int, dt_s: float = DT_S) -> float:
    """Return the root mean square of the length of a discrete derivative of a path, (n, 3) m; 0 for a shorter path.

    order: 1 speed (m/s), 2 acceleration (m/s^2), 3 jerk (m/s^3); it needs more than `order` points.
    """
    differences = np.diff(positions_m, n=order, axis=0)
    return float(np.sqrt((differences**2).sum(axis=1).mean())) / dt_s**order if len(differences) else 0.0


def smoothness_score(accel_rms_mps2: float, jerk_rms_mps3: float) -> float:
    """Return S in (0, 1], 1 for uniform motion (eq:smoothness_score)."""
    return float(np.exp(-0.5 * (accel_rms_mps2 / ACCEL_SCALE_MPS2 + jerk_rms_mps3 / JERK_SCALE_MPS3)))


def length_m(positions_m: np.ndarray) -> float:
    """Return the length of the polyline through (n, 3) points."""
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum())


def distances_along_m(points_m: np.ndarray) -> np.ndarray:
    """Return the distance along a polyline to each of its points, (n, 2 or 3) m, as (n,) m from 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])


def speed_max_mps(positions_m: np.ndarray, dt_s: float = DT_S) -> float:
    """Return the largest speed between neighbouring waypoints, (n, 3) m, in m/s; 0 for one point."""
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).max(initial=0.0)) / dt_s


def trajectory_metrics(
    positions_m: np.ndarray,
    targets_m: np.ndarray,
    visibility: np.ndarray,
    clearances_m: np.ndarray,
    ground_m: np.ndarray,
    dt_s: float,
) -> dict[str, float]:
    """Return all metrics of one trajectory as JSON, rounded to four decimals.

    Args:
        positions_m, targets_m: (n, 3).
        visibility, clearances_m: (n,).
        ground_m: (n,) height of the ground, from which altitudes count.
        dt_s: Time between two positions.
    """
    accel, jerk = (derivative_rms(positions_m, order, dt_s) for order in (2, 3))
    altitudes = positions_m[:, 2] - ground_m
    distances = np.linalg.norm(positions_m - targets_m, axis=1)
    figures = {
        "num_points": len(positions_m),
        "length_m": length_m(positions_m),
        "duration_s": (len(positions_m) - 1) * dt_s,
        "speed_max_mps": speed_max_mps(positions_m, dt_s),
        "five_ray_mean": float(visibility.mean()),
        "five_ray_min": float(visibility.min()),
        "blocked_fraction": float((visibility == 0).mean()),
        "target_distance_mean_m": float(distances.mean()),
        "target_distance_std_m": float(distances.std()),
        "altitude_mean_m": float(altitudes.mean()),
        "altitude_min_m": float(altitudes.min()),
        "altitude_max_m": float(altitudes.max()),
        "accel_rms_mps2": accel,
        "jerk_rms_mps3": jerk,
        "smoothness_score": smoothness_score(accel, jerk),
        "clearance_min_m": float(clearances_m.min()),
    }
    return {name: round(value, 4) for name, value in figures.items()}


# --- intervals --------------------------------------------------------------------------------------------------------


def draw_pedestrians(num_walks: int, resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Draw as many walks as there are, with replacement, `resamples` times: (resamples, walks) counts."""
    return rng.multinomial(num_walks, np.full(num_walks, 1.0 / num_walks), size=resamples).astype(float)


def figure_of_draws(value: float, drawn: np.ndarray, count: int, num_walks: int, confidence: float) -> Figure:
    """Return a figure with its interval from the values on the draws, (draws,); NaN: nothing of the kind occurs.

    The interval holds the share `confidence` of the draws; one trajectory has none.
    """
    if count == 0 or np.isnan(value):
        return Figure(value=None, low=None, high=None, count=count)
    known = drawn[~np.isnan(drawn)]
    if num_walks < 2 or not len(known):
        return Figure(value=value, low=None, high=None, count=count)
    low, high = np.quantile(known, [(1 - confidence) / 2, (1 + confidence) / 2]).tolist()
    return Figure(value=value, low=low, high=high, count=count)
