"""Actions and waypoints of a track, for policies: at each frame the velocities to command and the positions ahead.

Both come from the planned motion, as labels do: a perturbation that is drawn for each frame is no manoeuvre. From a
perturbed frame, the waypoints lead back to the plan.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosfly.geometry.axes import look_at, wrap_deg

# Level axes of the drone: forward is where the camera looks, without pitch. Yaw is counter-clockwise from above.
ACTION = ("forward_mps", "left_mps", "up_mps", "yaw_rate_degps", "gimbal_pitch_deg")
WAYPOINT = ("x_m", "y_m", "z_m", "yaw_deg")  # world
BODY_WAYPOINT = ("forward_m", "left_m", "up_m", "yaw_deg")
NUM_WAYPOINTS = 10


def without_perturbation(
    poses: np.ndarray, targets_m: np.ndarray, offsets: np.ndarray, target_offsets_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Subtract a perturbation: the shifts of drone and target, the turn of the view, and the new aim after the shifts.

    Args:
        poses, offsets: (n, 6) x, y, z in m, pitch, yaw, roll in degrees.
        targets_m, target_offsets_m: (n, 3).
    Returns:
        poses (n, 6) and targets (n, 3); NaN where the perturbation of a frame is not recorded.
    """
    planned = poses - offsets
    targets = targets_m - target_offsets_m
    # A frame without a shift was not aimed again, whether or not its target is known. An unknown shift (NaN) counts
    # as a shift.
    is_shifted = (offsets[:, :3] != 0).any(axis=1) | (target_offsets_m != 0).any(axis=1)
    aim = np.degrees(look_at(poses[:, :3], targets_m)).T
    planned_aim = np.degrees(look_at(planned[:, :3], targets)).T
    planned[:, 3:5] -= np.where(is_shifted[:, None], aim - planned_aim, 0.0)
    planned[:, 4] = wrap_deg(planned[:, 4])
    return planned, targets


@dataclass(frozen=True)
class PlannedMotion:
    """The planned motion of a track of n frames."""

    time_s: np.ndarray  # (n,)
    poses: np.ndarray  # (n, 6) planned; NaN where unknown
    # Of the frames as rendered, with perturbations; actions and waypoints are relative to them.
    yaw_deg: np.ndarray  # (n,)
    positions_m: np.ndarray  # (n, 3)

    @cached_property
    def action(self) -> np.ndarray:
        """Return the action for the step from each frame to the next, (n, 5) as ACTION.

        It is the mean velocities in the axes of the frame, and the camera's pitch at the end; NaN after the last frame.
        """
        action = np.full((len(self.poses), len(ACTION)), np.nan)
        step_s = np.diff(self.time_s)
        steps = np.diff(self.poses, axis=0) / step_s[:, None]
        action[:-1, :3] = in_axes_of(self.yaw_deg[:-1], steps[:, :3])
        action[:-1, 3] = wrap_deg(np.diff(self.poses[:, 4])) / step_s
        action[:-1, 4] = self.poses[1:, 3]
        return action

    def waypoints(self, i: int) -> np.ndarray:
        """Return the planned positions at the next NUM_WAYPOINTS frames, fewer at the end, (m, 4) as WAYPOINT."""
        return self.poses[i + 1 : i + 1 + NUM_WAYPOINTS, [0, 1, 2, 4]]

    def body_waypoints(self, i: int) -> np.ndarray:
        """Return the waypoints relative to the frame, (m, 4) as BODY_WAYPOINT."""
        waypoints = self.waypoints(i)
        offsets_m = in_axes_of(self.yaw_deg[i], waypoints[:, :3] - self.positions_m[i])
        return np.column_stack([offsets_m, wrap_deg(waypoints[:, 3] - self.yaw_deg[i])])


def in_axes_of(yaw_deg: np.ndarray | float, vectors: np.ndarray) -> np.ndarray:
    """Return world vectors, (..., 3), as forward, left and up components of a body with this yaw."""
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([x * cos + y * sin, y * cos - x * sin, z], axis=-1)
