"""What a flight is wished to be: the paper's, behind the walker; and the heading that wishes are counted from."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry import DT_S
from cosfly.planners.contract import PlanConfig, Wish


def follow(targets_m: np.ndarray, cfg: PlanConfig, dt_s: float = DT_S) -> Wish:
    """The paper's wish: behind the walker, the settings' height, distance and pitch throughout.

    Args:
        targets_m: (n, 3), n >= 2. dt_s: between points.
    """
    num, muco = len(targets_m), cfg.muco
    return Wish(
        heading_rad=smoothed_headings(targets_m, cfg.heading_smoothing_s, dt_s),
        bearing_rad=np.full(num, np.pi),
        distance_m=np.full(num, muco.track_distance_m),
        ground_distance_m=np.full(num, cfg.behind_distance_m),
        pitch_rad=np.full(num, np.radians(muco.pitch_deg)),
        altitude_m=np.full(num, cfg.altitude_preferred_m),
        altitude_min_m=np.full(num, cfg.altitude_min_m),
        altitude_max_m=np.full(num, cfg.altitude_max_m),
        keeps_sight=np.ones(num, dtype=bool),
        any_bearing=True,
    )


def smoothed_headings(targets_m: np.ndarray, smoothing_s: float, dt_s: float = DT_S) -> np.ndarray:
    """Walking direction of each point, radians, continuous, smoothed over time by a Gaussian.

    Args:
        targets_m: (n, 3), n >= 2. smoothing_s: standard deviation; 0 takes the direction as it is. dt_s: between points.
    Returns:
        (n,). A walker who stands keeps the direction before; one who never moves faces east.
    """
    steps = np.diff(targets_m[:, :2], axis=0)
    moves = np.flatnonzero(np.hypot(steps[:, 0], steps[:, 1]) > 1e-6)
    if len(moves) == 0:
        return np.zeros(len(targets_m))
    yaws = np.unwrap(np.arctan2(steps[moves, 1], steps[moves, 0]))
    before = np.searchsorted(moves, np.arange(len(targets_m)), side="right") - 1
    yaws = yaws[np.maximum(before, 0)]
    return gaussian_filter1d(yaws, smoothing_s / dt_s, mode="nearest") if smoothing_s > 0 else yaws
