"""Settings of the closed loop: the drone, and `cosfly fly`."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cosfly.products.motion import ACTION
from cosfly.work.config import Config


class DroneConfig(Config):
    """What the drone can do; a command beyond its bounds is none."""

    speed_max_mps: float = Field(10.0, gt=0, description="greatest speed over ground (tab:drone_params), m/s")
    climb_max_mps: float = Field(4.0, gt=0, description="greatest speed up and down, m/s")
    accel_max_mps2: float = Field(5.0, gt=0, description="greatest change of velocity (sec:step6), m/s^2")
    yaw_rate_max_degps: float = Field(60.0, gt=0, description="greatest turn, degrees/s")
    yaw_accel_max_degps2: float = Field(120.0, gt=0, description="greatest change of it, degrees/s^2")
    gimbal_rate_max_degps: float = Field(60.0, gt=0, description="how fast the camera tilts, degrees/s")
    gimbal_deg: tuple[float, float] = Field((-90.0, 30.0), description="least and greatest pitch of the camera")
    radius_m: float = Field(0.5, gt=0, description="of the drone: nearer to an obstacle or the ground it has crashed")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest command, (5,) each as ACTION."""
        high = [self.speed_max_mps, self.speed_max_mps, self.climb_max_mps, self.yaw_rate_max_degps, self.gimbal_deg[1]]
        return np.array([*[-value for value in high[:4]], self.gimbal_deg[0]]), np.array(high)

    def problem_of(self, command: np.ndarray) -> str | None:
        """Say what of a command cannot be flown, None where all can."""
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (len(ACTION),) or not np.isfinite(command).all():
            return f"a command is {len(ACTION)} finite numbers: {', '.join(ACTION)}"
        low, high = self.bounds
        if (outside := (command < low) | (command > high)).any():
            k = int(np.argmax(outside))
            return f"{ACTION[k]} {command[k]:g} is outside {low[k]:g} to {high[k]:g}"
        if (speed_mps := float(np.hypot(*command[:2]))) > self.speed_max_mps:
            return f"a speed of {speed_mps:g} m/s over ground is more than {self.speed_max_mps:g}"
        return None
