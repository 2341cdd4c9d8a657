"""The controller: turns a decision into a command by a table with one row per action (controller.yaml).

It knows the drone's pose, its home position and its height, but never the target's position. The camera keeps its aim:
the point ahead of the drone, at hip height, at which it looks when the episode begins.
"""

from typing import Literal

import numpy as np
from pydantic import Field

from cosfly.closed_loop.settings import CONTROLLER_FILE, Drone
from cosfly.closed_loop.stepper import Moment
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import look_at, wrap_deg
from cosfly.geometry.motion import in_axes_of
from cosfly.runtime.config import Config, build, read_yaml

AIM_MOST_M = 100.0  # greatest distance of the aim, for a camera that looks at the horizon
LEAST_DOWN_DEG = 0.1  # least downward pitch that the aim is computed from
LEAST_HEIGHT_M = 1.0  # least height over the aim that the aim is computed from
AT_HOME_M = 1.0  # nearer to home the drone does not turn towards it


class Control(Config):
    """One row of the table; the head of controller.yaml explains the fields."""

    ahead_mps: float = Field(0.0, ge=-20, le=20, description="velocity ahead")
    left_mps: float = Field(0.0, ge=-20, le=20, description="velocity to the left")
    up_mps: float = Field(0.0, ge=-20, le=20, description="velocity upwards")
    with_pace: bool = Field(False, description="the pace is added to ahead_mps")
    pace_step_mps: float = Field(0.0, ge=-20, le=20, description="lasting change of the pace")
    stops: bool = Field(False, description="the pace becomes 0")
    yaw_rate_degps: float = Field(0.0, ge=-180, le=180, description="turn, positive to the left")
    turn: Literal["rate", "orbit", "search", "home"] = Field("rate", description="how the drone turns")
    source: str = Field(min_length=1, description="source of the figures")


def read_controls() -> dict[str, Control]:
    """Read the table."""
    rows = read_yaml(CONTROLLER_FILE)
    return {token: build(Control, row, CONTROLLER_FILE) for token, row in rows.items()}


class Controller:
    """The controller of one episode."""

    def __init__(self, controls: dict[str, Control], drone: Drone, start: Moment) -> None:
        self.controls = controls
        self.drone = drone
        self._home_m = start.position_m
        self._height_m = start.height_m - TARGET_HEIGHT_M  # over the target's hip
        slope = np.tan(np.radians(max(-start.rotation_deg[0], LEAST_DOWN_DEG)))
        self.aim_m = float(min(max(self._height_m, LEAST_HEIGHT_M) / slope, AIM_MOST_M))  # over ground
        self.pace_mps = max(0.0, float(in_axes_of(start.rotation_deg[1], start.velocity_mps)[0]))
        self._search_side = 1.0  # the side of the last turn: 1 left, -1 right

    def command(self, action: str | None, now: Moment) -> np.ndarray:
        """Return the command of a decision, (5,) as ACTION; without one the drone hovers and the pace is kept."""
        row = self.controls[action] if action is not None else Control(source="hovers")
        self.pace_mps = 0.0 if row.stops else max(0.0, self.pace_mps + row.pace_step_mps)
        self.pace_mps = min(self.pace_mps, self.drone.speed_max_mps)
        ahead_mps = row.ahead_mps + (self.pace_mps if row.with_pace else 0.0)
        left_mps = row.left_mps
        yaw_rate_degps = row.yaw_rate_degps
        if row.turn == "rate" and yaw_rate_degps:
            self._search_side = float(np.sign(yaw_rate_degps))
        elif row.turn == "orbit":
            yaw_rate_degps = -float(np.degrees(left_mps / self.aim_m))
        elif row.turn == "search":
            yaw_rate_degps *= self._search_side
        elif row.turn == "home":
            ahead_mps, left_mps, yaw_rate_degps = self._home_velocity(row, now)
        over_aim_m = self._height_m + now.position_m[2] - self._home_m[2]
        pitch_deg = -float(np.degrees(np.arctan2(over_aim_m, self.aim_m)))
        command = np.clip([ahead_mps, left_mps, row.up_mps, yaw_rate_degps, pitch_deg], *self.drone.bounds)
        return self.drone.within_speed(command)

    def _home_velocity(self, row: Control, now: Moment) -> tuple[float, float, float]:
        """Return the velocities ahead and to the left (m/s) and the yaw rate (degrees/s) of the way home."""
        yaw_deg = now.rotation_deg[1]
        offset_m = self._home_m - now.position_m
        distance_m = float(np.hypot(*offset_m[:2]))
        ahead_mps, left_mps, _ = in_axes_of(yaw_deg, offset_m * min(row.ahead_mps / max(distance_m, 1e-9), 1.0))
        turn_deg = 0.0
        if distance_m > AT_HOME_M:
            _, bearing = look_at(now.position_m, self._home_m)
            turn_deg = float(wrap_deg(np.degrees(bearing) - yaw_deg))
        yaw_rate_degps = float(np.clip(turn_deg, -row.yaw_rate_degps, row.yaw_rate_degps))
        return float(ahead_mps), float(left_mps), yaw_rate_degps
