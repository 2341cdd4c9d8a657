"""Where the camera looks: at the target; on the way home where the drone flies; and where nobody is seen, where it was lost."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry import look_at
from cosfly.planners.intent import Intent

TURNS_S = 0.8  # standard deviation of the smoothing of a turn while it searches
HOME_PITCH_DEG, HOME_TURN_DPS = -15.0, 45.0  # how fast the view turns at most, on the way home
STANDING_MPS = 0.5  # slower than this the direction of flight says nothing
# While it searches the camera looks where the target would be had it gone on for a while, and to both sides of that.
GOES_ON_S, SWEEP_DEG, SWEEP_S = 2.0, 18.0, 6.0


def view_of(
    intent: Intent, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Give pitch and yaw of the camera, (n,) each, radians.

    Args:
        positions_m, targets_m: (n, 3). seen: (n,) five-ray visibility.
    """
    pitch, yaw = look_at(positions_m, targets_m)
    if intent.mission is not None:
        return _turned_home(pitch, yaw, positions_m, intent.mission.at_frame, dt_s)
    if intent.searches:
        return _searching(pitch, yaw, positions_m, targets_m, seen, dt_s)
    return pitch, yaw


def _turned_home(
    pitch: np.ndarray, yaw: np.ndarray, positions_m: np.ndarray, at: int, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Turn into the direction of flight from frame `at` on, no faster than a drone turns."""
    flown, step = np.gradient(positions_m[:, :2], dt_s, axis=0), np.radians(HOME_TURN_DPS) * dt_s
    pitch, yaw = pitch.copy(), yaw.copy()
    for i in range(at + 1, len(yaw)):
        is_flying = np.hypot(*flown[i]) >= STANDING_MPS
        wanted = np.arctan2(flown[i, 1], flown[i, 0]) if is_flying else yaw[i - 1]
        yaw[i] = yaw[i - 1] + np.clip(_wrapped(wanted - yaw[i - 1]), -step, step)
        pitch[i] = pitch[i - 1] + np.clip(np.radians(HOME_PITCH_DEG) - pitch[i - 1], -step, step)
    return pitch, _wrapped(yaw)


def _searching(
    pitch: np.ndarray, yaw: np.ndarray, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Look where the target was lost while nobody sees it: what the drone does not see it does not know."""
    aims, since, last = targets_m.copy(), np.zeros(len(seen)), 0
    speeds = np.gradient(targets_m, dt_s, axis=0) if len(targets_m) > 1 else np.zeros_like(targets_m)
    for i in range(len(seen)):
        last = i if seen[i] > 0 else last
        since[i] = (i - last) * dt_s
        aims[i] = targets_m[last] + speeds[last] * min(since[i], GOES_ON_S)
    pitch, yaw = look_at(positions_m, aims)
    sweep = np.radians(SWEEP_DEG) * np.sin(2.0 * np.pi * np.maximum(since - GOES_ON_S, 0.0) / SWEEP_S)
    return _eased(pitch, since > 0, dt_s), _wrapped(_eased(np.unwrap(yaw) + sweep, since > 0, dt_s))


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angles), np.cos(angles))


def _eased(angles: np.ndarray, where: np.ndarray, dt_s: float) -> np.ndarray:
    """Smooth angles (n,) where a view is not the plain one, up to the frames before and after."""
    return np.where(where, gaussian_filter1d(angles, TURNS_S / dt_s, mode="nearest"), angles)
