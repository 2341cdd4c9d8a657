"""What a flight teaches a policy: at each frame the velocities to command, and the places ahead.

All of it is of the planned motion, as labels are: a perturbation that is drawn for each frame is no manoeuvre.
Seen from a perturbed frame, the waypoints lead back to the plan.
"""

from __future__ import annotations

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
    """Take off what a perturbation added: the shifts of drone and person, the turn of the view, and the aim that
    followed the shifts (cosfly/render/perturbation.py).

    Args:
        poses, offsets: (n, 6) x, y, z in m, pitch, yaw, roll in degrees. targets_m, target_offsets_m: (n, 3).
    Returns:
        poses (n, 6) and targets (n, 3); NaN where nobody recorded by how much a frame was perturbed.
    """
    planned, targets = poses - offsets, targets_m - target_offsets_m
    # A frame without a shift was not aimed again, whether or not its target is known. An unknown shift (NaN) counts as
    # one.
    is_shifted = (offsets[:, :3] != 0).any(axis=1) | (target_offsets_m != 0).any(axis=1)
    aims = [np.degrees(look_at(eye[:, :3], at)).T for eye, at in ((poses, targets_m), (planned, targets))]
    planned[:, 3:5] -= np.where(is_shifted[:, None], aims[0] - aims[1], 0.0)
    planned[:, 4] = wrap_deg(planned[:, 4])
    return planned, targets


@dataclass(frozen=True)
class PlannedMotion:
    """The planned motion of a flight, n frames of k poses each.

    time_s: (n,). poses: (n, 6) planned, at the frames; NaN where not known. between: (n, k - 1, 6) planned, after each
    frame and before the next, at even times; of the last frame they are NaN. yaw_deg: (n,) of the frames as they were
    drawn, whose axes actions and waypoints are in. positions_m: (n, 3), the same.
    """

    time_s: np.ndarray
    poses: np.ndarray
    between: np.ndarray
    yaw_deg: np.ndarray
    positions_m: np.ndarray

    @property
    def poses_a_frame(self) -> int:
        return self.between.shape[1] + 1

    @cached_property
    def actions(self) -> np.ndarray:
        """What flies each part of the step from a frame to the next, (n, k, 5) as ACTION: mean velocities in the axes
        of the frame, and the camera's pitch at the part's end. NaN after the last frame."""
        n, k = len(self.poses), self.poses_a_frame
        found = np.full((n, k, len(ACTION)), np.nan)
        chain = np.concatenate([self.poses[:-1, None], self.between[:-1], self.poses[1:, None]], axis=1)
        part_s = np.diff(self.time_s)[:, None] / k
        steps = np.diff(chain, axis=1) / part_s[..., None]
        found[:-1, :, :3] = in_axes_of(self.yaw_deg[:-1, None], steps[..., :3])
        found[:-1, :, 3] = wrap_deg(np.diff(chain[..., 4], axis=1)) / part_s
        found[:-1, :, 4] = chain[:, 1:, 3]
        return found

    @cached_property
    def action(self) -> np.ndarray:
        """What flies the whole step, (n, 5) as ACTION."""
        return np.concatenate([self.actions[..., :4].mean(axis=1), self.actions[:, -1, 4:]], axis=1)

    def waypoints(self, i: int) -> np.ndarray:
        """Return the planned places of the next NUM_WAYPOINTS frames, fewer at the end, (m, 4) as WAYPOINT."""
        return self.poses[i + 1 : i + 1 + NUM_WAYPOINTS, [0, 1, 2, 4]]

    def body_waypoints(self, i: int) -> np.ndarray:
        """Return the same as seen from the frame, (m, 4) as BODY_WAYPOINT."""
        ahead = self.waypoints(i)
        moved = in_axes_of(self.yaw_deg[i], ahead[:, :3] - self.positions_m[i])
        return np.column_stack([moved, wrap_deg(ahead[:, 3] - self.yaw_deg[i])])


def in_axes_of(yaw_deg: np.ndarray | float, vectors: np.ndarray) -> np.ndarray:
    """Turn world vectors, (..., 3), into forward, left and up of who looks that way."""
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([x * cos + y * sin, y * cos - x * sin, z], axis=-1)
