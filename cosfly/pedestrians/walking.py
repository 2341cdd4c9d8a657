"""How a person walks along a route: slower round corners, with a little unrest, sampled at equal times (sec:step3).

Pure arithmetic on polylines; which route is walked is stage.py's affair.
"""

from __future__ import annotations

import numpy as np

CURVATURE_EPSILON_M3 = 1e-6  # eq:menger: below this product of lengths three points have no curvature
SLOWEST_SPEED_MPS = 0.05  # a walk must arrive: eq:speed alone allows 0, and then a step that takes for ever


def menger_curvature(polyline_m: np.ndarray) -> np.ndarray:
    """Curvature at the waypoints of a polyline (eq:menger).

    Args:
        polyline_m: (k, 2) m.
    Returns:
        (k,) 1/m; 0 at both ends and where the product of the three distances is below CURVATURE_EPSILON_M3.
    """
    curvatures = np.zeros(len(polyline_m))
    if len(polyline_m) < 3:
        return curvatures
    ahead, behind = polyline_m[2:] - polyline_m[1:-1], polyline_m[:-2] - polyline_m[1:-1]
    cross = np.abs(ahead[:, 0] * behind[:, 1] - ahead[:, 1] * behind[:, 0])
    across = polyline_m[2:] - polyline_m[:-2]
    product = np.linalg.norm(ahead, axis=1) * np.linalg.norm(behind, axis=1) * np.linalg.norm(across, axis=1)
    is_safe = product >= CURVATURE_EPSILON_M3
    curvatures[1:-1][is_safe] = 2.0 * cross[is_safe] / product[is_safe]
    return curvatures


def speed_profile(
    curvatures: np.ndarray,
    rng: np.random.Generator,
    *,
    cruise_speed_mps: float = 1.2,
    curvature_gain_m: float = 5.0,
    jitter: float = 0.15,
    min_speed_mps: float = 0.0,
    max_speed_mps: float = 1.6,
) -> np.ndarray:
    """Speeds at waypoints (eq:speed).

    Args:
        curvatures: (k,) 1/m.
        curvature_gain_m: alpha; jitter: beta.
    Returns:
        (k,) m/s within the range, whose lower end is never below SLOWEST_SPEED_MPS. With the defaults eq:speed gives at least
        0.067 m/s (a right angle of two 0.5 m steps), so that the guard changes nothing.
    """
    unrest = 1.0 + jitter * rng.uniform(-1.0, 1.0, size=len(curvatures))
    speeds_mps = cruise_speed_mps / (1.0 + curvature_gain_m * curvatures) * unrest
    return np.clip(speeds_mps, max(min_speed_mps, SLOWEST_SPEED_MPS), max_speed_mps)


def arrival_times(polyline_m: np.ndarray, speeds_mps: np.ndarray) -> np.ndarray:
    """Times at the waypoints, (k,) s from 0: each piece takes its length over the mean of its two speeds.

    Raises:
        ValueError: a piece has a mean speed of 0.
    """
    lengths_m = np.linalg.norm(np.diff(polyline_m, axis=0), axis=1)
    means_mps = 0.5 * (speeds_mps[1:] + speeds_mps[:-1])
    if not (means_mps > 0).all():
        raise ValueError("a piece without speed takes for ever")
    return np.concatenate([[0.0], np.cumsum(lengths_m / means_mps)])


def resample(
    polyline_m: np.ndarray, speeds_mps: np.ndarray, times_s: np.ndarray, step_s: float, stops_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample a timed polyline at equal steps.

    Within a piece the speed changes evenly from one waypoint's to the next one's: the motion for which a piece takes
    its length over the mean of its speeds. The last sample is the goal, reached within the last step.

    Args:
        polyline_m: (k, 2) m, k at least 2, no two neighbours equal; speeds_mps: (k,); times_s: (k,) from arrival_times, which
            knows no stops; stops_s: (k,) how long the person stands at each waypoint, whose speed is 0 there.
    Returns:
        time_s (n,) = 0, step, 2 step ...; positions_m (n, 2); speeds_mps (n,).
    """
    num_samples = int(np.ceil((times_s[-1] + stops_s.sum()) / step_s - 1e-9)) + 1
    time_s = np.arange(num_samples) * step_s
    return time_s, *sample(polyline_m, speeds_mps, times_s, stops_s, time_s)


def sample(
    polyline_m: np.ndarray, speeds_mps: np.ndarray, times_s: np.ndarray, stops_s: np.ndarray, time_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Give positions (n, 2) and speeds (n,) at any times, (n,) s, of a timed polyline as `resample` takes it; after its end, the end."""
    now_s = np.minimum(time_s - stood_s(time_s, times_s, stops_s), times_s[-1])
    piece = np.clip(np.searchsorted(times_s, now_s, side="right") - 1, 0, len(times_s) - 2)
    duration_s = times_s[piece + 1] - times_s[piece]
    since_s = now_s - times_s[piece]
    from_mps, to_mps = speeds_mps[piece], speeds_mps[piece + 1]
    walked_m = from_mps * since_s + 0.5 * (to_mps - from_mps) / duration_s * since_s**2
    along_m = polyline_m[piece + 1] - polyline_m[piece]
    share = np.clip(walked_m / np.linalg.norm(along_m, axis=1), 0.0, 1.0)
    return polyline_m[piece] + share[:, None] * along_m, from_mps + (to_mps - from_mps) * since_s / duration_s


def stood_s(time_s: np.ndarray, times_s: np.ndarray, stops_s: np.ndarray) -> np.ndarray:
    """How long the person has stood still until each time, (n,) s; times_s, stops_s: (k,) as for `resample`."""
    at = np.flatnonzero(stops_s)
    begins_s = times_s[at] + np.cumsum(stops_s[at]) - stops_s[at]
    return np.clip(time_s[:, None] - begins_s, 0.0, stops_s[at]).sum(axis=1)
