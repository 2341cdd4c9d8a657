"""Conventions of CARLA and Unreal, and their conversion: axes, pictures of depth and of tags.

Their axes are left-handed (`cosfly.geometry.axes`); a pose is x, y, z, pitch, yaw, roll in m and degrees. Pictures of
CARLA are BGRA bytes: depth in 24 bits up to 1000 m, tags as the semantic number in red and an actor's number in green
(low byte) and blue (high byte).
"""

from collections.abc import Sequence

import numpy as np

from cosfly.geometry.axes import BODY_FROM_CAMERA, mirror_poses

SIMULATED_STEP_S = 0.05  # time step of synchronous mode (sec:step5)
DEPTH_RANGE_M = 1000.0
DEPTH_STEPS = 2**24 - 1
ACTOR_BITS = 0xFFFF  # the bits of an actor's number that pictures hold
CM_PER_M = 100.0
FAR_UNITS = 65504.0  # the largest half-precision number: UnrealCV's depth of the sky, in units of the server


def unreal_pose(position_m: np.ndarray, rotation_deg: np.ndarray) -> list[float]:
    """Convert a pose, (3,) m and (3,) pitch, yaw, roll in degrees, to x, y, z, pitch, yaw, roll of Unreal."""
    return (mirror_poses(np.array([*position_m, *rotation_deg])) + 0.0).tolist()  # + 0.0: no negative zeros


def world_pose(pose: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Convert a pose of Unreal, in m and degrees, back to position, (3,) m, and rotation, (3,) degrees."""
    mirrored = mirror_poses(np.array(pose)) + 0.0  # no negative zeros
    return mirrored[:3], mirrored[3:]


def camera_rotation_deg(camera_pose: np.ndarray) -> np.ndarray:
    """Return pitch, yaw, roll, (3,) degrees, of a world_from_camera of OpenCV axes, (4, 4)."""
    turn = camera_pose[:3, :3] @ BODY_FROM_CAMERA.T
    pitch = np.arctan2(turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    if np.hypot(turn[0, 0], turn[1, 0]) < 1e-9:  # straight up or down: roll is 0 by convention
        return np.degrees([pitch, np.arctan2(-turn[0, 1], turn[1, 1]), 0.0])
    return np.degrees([pitch, np.arctan2(turn[1, 0], turn[0, 0]), np.arctan2(turn[2, 1], turn[2, 2])])


def depth_of(picture: np.ndarray) -> np.ndarray:
    """Decode z-depth, (h, w) float32 m, from BGRA."""
    blue, green, red = (picture[..., k].astype(np.uint32) for k in range(3))
    return ((red | green << 8 | blue << 16) * (DEPTH_RANGE_M / DEPTH_STEPS)).astype(np.float32)


def tags_of(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode semantic numbers, (h, w) uint8, and the 16 bits of actors' numbers, (h, w) uint16, from BGRA."""
    return picture[..., 2].copy(), picture[..., 1] | picture[..., 0].astype(np.uint16) << 8
