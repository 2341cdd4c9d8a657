"""The direction of the camera: its limit of yaw rate, and a gimbal that follows the target imperfectly.

The gimbal is a second-order loop per axis. It turns to where the target was `delay_s` ago, plus an aiming error that
varies smoothly with time. The faster the target moves through the picture, the farther the camera lags behind it.
"""

from typing import ClassVar

import numpy as np
from pydantic import Field

from cosfly.geometry.axes import wrap_deg
from cosfly.runtime.config import Config
from cosfly.runtime.seeding import draw_smooth

LOWEST_PITCH_DEG, HIGHEST_PITCH_DEG = -89.0, 89.0
STEP_S = 0.05  # of the integration of the loop
STEEP_COS = 0.5  # a steeper view needs more yaw for the same error in the picture, at most twice as much


class GimbalConfig(Config):
    """The gimbal's loop and aiming error."""

    bandwidth_hz: float = Field(
        0.0, ge=0, le=2, description="natural frequency of the loop, Hz; 0: the camera is aimed exactly"
    )
    delay_s: float = Field(0.2, ge=0, le=2, description="age of the target's direction that the loop turns to, s")
    error_deg: float = Field(
        0.0, ge=0, le=15, description="standard deviation of the aiming error across the picture, degrees; half upwards"
    )
    damping: ClassVar[float] = 0.7
    correlation_s: ClassVar[float] = 5.0  # of the aiming error


def slew(values: np.ndarray, steps_max: np.ndarray) -> np.ndarray:
    """Return values that follow `values`, (n,), from the first on with steps of at most `steps_max`, (n,)."""
    followed = [float(values[0])]
    for value, step_max in zip(values[1:].tolist(), steps_max[1:].tolist(), strict=True):
        followed.append(followed[-1] + min(max(value - followed[-1], -step_max), step_max))
    return np.array(followed)


def limit_yaw_rate(
    pitch: np.ndarray, yaw: np.ndarray, rate_max_degps: float, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a direction, (n,) radians each, whose yaw keeps the limit; the same if it does already.

    A turn that is too fast begins before and ends after the requested one. Meanwhile the camera keeps looking down at
    a target that it passes overhead: the pitch is the best one for its heading.
    """
    unwrapped = np.unwrap(yaw)
    steps_max = np.full(len(yaw), np.radians(rate_max_degps) * dt_s)
    if (np.abs(np.diff(unwrapped)) <= steps_max[1:]).all():
        return pitch, yaw
    held = (slew(unwrapped, steps_max) + slew(unwrapped[::-1], steps_max)[::-1]) / 2.0
    ahead = np.cos(pitch) * np.maximum(np.cos(held - unwrapped), 0.0)
    pitch = np.maximum(np.arctan2(np.sin(pitch), ahead), np.radians(LOWEST_PITCH_DEG))
    return pitch, np.radians(wrap_deg(np.degrees(held)))


def follow_direction(
    pitch: np.ndarray, yaw: np.ndarray, gimbal: GimbalConfig, rate_max_degps: float, dt_s: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the direction of a gimbal that follows a direction, (n,) radians each, at times `dt_s` apart."""
    num_parts = max(1, round(dt_s / STEP_S))
    part_s = dt_s / num_parts
    frames_s = np.arange(len(yaw)) * dt_s
    times_s = np.arange((len(yaw) - 1) * num_parts + 1) * part_s
    errors = np.radians(gimbal.error_deg) * draw_smooth(len(yaw), 2, dt_s, gimbal.correlation_s, rng)
    errors *= np.column_stack([np.full(len(yaw), 0.5), 1.0 / np.maximum(np.cos(pitch), STEEP_COS)])
    stiffness = (2.0 * np.pi * gimbal.bandwidth_hz) ** 2
    friction = 4.0 * np.pi * gimbal.bandwidth_hz * gimbal.damping
    rate_max = np.radians(rate_max_degps)
    axes_deg = []
    for target, error in zip((pitch, np.unwrap(yaw)), errors.T, strict=True):
        aims = np.interp(times_s - gimbal.delay_s, frames_s, target) + np.interp(times_s, frames_s, error)
        angle = float(aims[0])
        rate = 0.0
        angles = [angle]
        for aim in aims[1:].tolist():
            rate += (stiffness * (aim - angle) - friction * rate) * part_s
            rate = min(max(rate, -rate_max), rate_max)
            angle += rate * part_s
            angles.append(angle)
        axes_deg.append(np.degrees(angles[::num_parts]))
    pitch_deg, yaw_deg = axes_deg
    return np.radians(np.clip(pitch_deg, LOWEST_PITCH_DEG, HIGHEST_PITCH_DEG)), np.radians(wrap_deg(yaw_deg))
