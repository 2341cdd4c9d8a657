"""Axes, poses and projection: the project's conventions for space.

World: right-handed, metres, +x East, +y North, +z up. Files store degrees; kernels take radians (suffix `_rad`).
`yaw` is counter-clockwise from +x, `pitch` positive nose-up, `roll` positive right-side-down;
rotation = Rz(yaw) @ Ry(-pitch) @ Rx(roll) in a body frame with x forward, y left, z up.
Cameras are OpenCV cameras (x right, y down, z forward) and depth is z-depth.

CARLA and Unreal are left-handed (y to the right, yaw clockwise): `mirror_poses` converts in both directions.
"""

from typing import TypeVar

import numpy as np

Angle = TypeVar("Angle", float, np.ndarray)

DT_S = 0.5  # the paper's time step (2 Hz); `pedestrians.dt_s` sets another for all stages

# Maps OpenCV camera coordinates to body coordinates: forward = z, left = -x, up = -y.
BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
STANDS_MPS = 0.05  # below this speed there is no heading
CORNER_SIGNS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, 8).T


def rotation_matrix(pitch_rad: float, yaw_rad: float, roll_rad: float) -> np.ndarray:
    """Return world_from_body, (3, 3) float64."""
    return rotation_matrices(np.array([[pitch_rad, yaw_rad, roll_rad]]))[0]


def rotation_matrices(rotations_rad: np.ndarray) -> np.ndarray:
    """Return world_from_body, (n, 3, 3) float64, for rotations (n, 3) of pitch, yaw, roll."""
    pitch, yaw, roll = np.asarray(rotations_rad, dtype=np.float64).T
    cp, sp = np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    cr, sr = np.cos(roll), np.sin(roll)
    # Rz(yaw) @ Ry(-pitch) @ Rx(roll), written out.
    rows = (
        [cy * cp, -sy * cr - cy * sp * sr, sy * sr - cy * sp * cr],
        [sy * cp, cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr],
        [sp, cp * sr, cp * cr],
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def axis_aligned_half_extents(half_extents: np.ndarray, rotations_deg: np.ndarray) -> np.ndarray:
    """Return the half sizes of the axis-aligned boxes around rotated boxes, (n, 3) m.

    half_extents: (n, 3) m; rotations_deg: (n, 3) pitch, yaw, roll.
    """
    turns = np.abs(rotation_matrices(np.radians(rotations_deg)))
    turns[turns < 1e-12] = 0.0  # cos(90 deg) is 6e-17: do not let it widen a box
    return np.einsum("nij,nj->ni", turns, half_extents)


def look_at(eye: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (pitch_rad, yaw_rad) that point the body's x axis from eye to target; works on (..., 3) arrays."""
    x, y, z = np.moveaxis(np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64), -1, 0)
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)


def focal_px(width_px: int, fov_deg: float) -> float:
    """Return the focal length in pixels of a horizontal field of view (eq:focal)."""
    return width_px / (2.0 * np.tan(np.radians(fov_deg) / 2.0))


def intrinsic_matrix(width_px: int, height_px: int, fov_deg: float) -> np.ndarray:
    """Return K, (3, 3), square pixels, principal point in the middle (app:zoom)."""
    f = focal_px(width_px, fov_deg)
    return np.array([[f, 0.0, width_px / 2.0], [0.0, f, height_px / 2.0], [0.0, 0.0, 1.0]])


def world_from_camera(position_m: np.ndarray, rotation_deg: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform of a camera at a body pose.

    position_m: (3,); rotation_deg: (3,) pitch, yaw, roll.
    """
    transform = np.eye(4)
    transform[:3, :3] = rotation_matrix(*np.radians(rotation_deg)) @ BODY_FROM_CAMERA
    transform[:3, 3] = position_m
    return transform


def project(points_m: np.ndarray, camera_pose: np.ndarray, intrinsic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points.

    Args:
        points_m: (n, 3) world; camera_pose: (4, 4) world_from_camera; intrinsic: (3, 3).
    Returns:
        uv (n, 2) px and z (n,) m. Points with z <= 0 lie behind the camera: their uv is NaN.
    """
    in_camera = (np.asarray(points_m, dtype=np.float64) - camera_pose[:3, 3]) @ camera_pose[:3, :3]
    z = in_camera[:, 2]
    uv = np.full((len(in_camera), 2), np.nan)
    front = z > 0
    homogeneous = in_camera[front] @ intrinsic.T
    uv[front] = homogeneous[:, :2] / homogeneous[:, 2:]
    return uv, z


def box_corners(center: np.ndarray, half_extents: np.ndarray, yaw_rad: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the eight corners of boxes that are turned about z, (..., 8, 3).

    center, half_extents: (..., 3); yaw_rad: (...).
    """
    turns = np.zeros((*np.shape(yaw_rad), 3))
    turns[..., 1] = yaw_rad
    world_from_box = rotation_matrices(turns.reshape(-1, 3)).reshape(*np.shape(yaw_rad), 3, 3)
    corners = CORNER_SIGNS * np.asarray(half_extents)[..., None, :] @ world_from_box.swapaxes(-1, -2)
    return corners + np.asarray(center)[..., None, :]


def mask_box(mask: np.ndarray) -> np.ndarray:
    """Return the box around a mask (h, w) bool: (4,) xmin, ymin, xmax, ymax px at pixel borders; NaN if it is empty."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return np.full(4, np.nan)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], dtype=np.float64)


def box_iou(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection over union of two boxes, (4,) xmin, ymin, xmax, ymax; 0 when both are empty."""
    sides = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
    shared = float(np.prod(np.clip(sides, 0, None)))
    union = float(np.prod(first[2:] - first[:2]) + np.prod(second[2:] - second[:2])) - shared
    return shared / union if union > 0 else 0.0


def wrap_deg(angle_deg: Angle) -> Angle:
    """Return an angle, or angles of any shape, degrees, in [-180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def mirror_poses(poses: np.ndarray) -> np.ndarray:
    """Convert positions or rotations (..., 3), or both in a row (..., 6), between right-handed and CARLA axes."""
    return np.asarray(poses, dtype=np.float64) * np.tile([1.0, -1.0, 1.0], np.shape(poses)[-1] // 3)


# --- time -------------------------------------------------------------------------------------------------------------


def step_s(time_s: np.ndarray) -> float:
    """Return the time step of even time stamps, (n,) s; DT_S for a single one."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else DT_S


def headings_of(positions_m: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return the heading of a motion at each time, (n,) rad counter-clockwise from +x.

    Args:
        positions_m: (n, 2 or more), n >= 2; time_s: (n,), increasing.
    Returns:
        Headings of central differences. Below STANDS_MPS the last heading stays, at the start the first; else east.
    """
    velocity = np.gradient(positions_m[:, :2], time_s, axis=0)
    moves = np.linalg.norm(velocity, axis=1) > STANDS_MPS
    if not moves.any():
        return np.zeros(len(time_s))
    last = np.maximum.accumulate(np.where(moves, np.arange(len(time_s)), -1))
    last[last < 0] = np.argmax(moves)
    return np.arctan2(velocity[:, 1], velocity[:, 0])[last]
