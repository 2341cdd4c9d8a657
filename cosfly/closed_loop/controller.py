"""The controller: turns a decision into a command, by a table with one row per action (controller.yaml).

It knows what a drone knows of itself, its pose, home position and height, but never the target's position. The camera
keeps its aim: the point ahead, at hip height, at which it looked when the episode began.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import Moment
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import look_at, wrap_deg
from cosfly.geometry.motion import in_axes_of
from cosfly.runtime.config import Config, build, read_yaml
from cosfly.runtime.errors import ConfigError

AIM_MOST_M = 100.0  # distance of the aim of a camera that looks at the horizon


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


class ControlTable(Config):
    """The file of the table."""

    schema_: Literal["cosfly.controller"] = Field(alias="schema", description="format of the file")
    schema_version: Literal["1.0"] = Field(description="version of the format")
    actions: dict[str, Control] = Field(min_length=1, description="action -> command")


def read_controls(path: Path, tokens: tuple[str, ...]) -> dict[str, Control]:
    """Read a table, which needs a row for each token."""
    found = build(ControlTable, read_yaml(path), path).actions
    if lacking := [token for token in tokens if token not in found]:
        what = "the table has no command for some decisions"
        raise ConfigError(what, where=path, got=", ".join(lacking), fix="add an entry for each under actions")
    return found


class Controller:
    """The controller of one episode."""

    def __init__(self, controls: dict[str, Control], drone: Drone, start: Moment) -> None:
        self.controls, self.drone = controls, drone
        self._home, self._height_m = start.position_m, start.height_m - TARGET_HEIGHT_M
        down = np.tan(np.radians(max(-start.rotation_deg[0], 0.1)))
        self.aim_m = float(min(max(self._height_m, 1.0) / down, AIM_MOST_M))
        self.pace_mps = max(0.0, float(in_axes_of(start.rotation_deg[1], start.velocity_mps)[0]))
        self._side = 1.0

    def command(self, action: str | None, now: Moment) -> np.ndarray:
        """Return the command of a decision, (5,) as ACTION; without a decision the drone hovers and keeps its pace."""
        row = self.controls[action] if action is not None else Control(source="hovers")
        self.pace_mps = 0.0 if row.stops else max(0.0, self.pace_mps + row.pace_step_mps)
        self.pace_mps = min(self.pace_mps, self.drone.speed_max_mps)
        ahead, yaw_rate = row.ahead_mps + self.pace_mps * row.with_pace, row.yaw_rate_degps
        left, yaw_deg = row.left_mps, now.rotation_deg[1]
        if row.turn == "orbit":
            yaw_rate = -float(np.degrees(left / self.aim_m))
        elif row.turn == "search":
            yaw_rate *= self._side
        elif row.turn == "home":
            way = self._home - now.position_m
            away_m = float(np.hypot(*way[:2]))
            ahead, left, _ = in_axes_of(yaw_deg, way * min(row.ahead_mps / max(away_m, 1e-9), 1.0))
            _, bearing = look_at(now.position_m, self._home)
            off_deg = float(wrap_deg(np.degrees(bearing) - yaw_deg)) if away_m > 1.0 else 0.0
            yaw_rate = float(np.clip(off_deg, -row.yaw_rate_degps, row.yaw_rate_degps))
        if row.turn == "rate" and yaw_rate:
            self._side = float(np.sign(yaw_rate))
        over_aim_m = self._height_m + now.position_m[2] - self._home[2]
        pitch_deg = -float(np.degrees(np.arctan2(over_aim_m, self.aim_m)))
        return self.drone.within_speed(np.clip([ahead, left, row.up_mps, yaw_rate, pitch_deg], *self.drone.bounds))
