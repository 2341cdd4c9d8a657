"""What a flight teaches a policy."""

import numpy as np
from numpy.testing import assert_allclose

from cosfly.formats.segments import Mission, Segment
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import rotation_matrices
from cosfly.geometry.motion import PlannedMotion


def curve(num: int, dt_s: float = 0.1) -> DroneTrace:
    """A flight on a curve, whose heading passes the south."""
    time_s = np.arange(num) * dt_s
    positions = np.stack([40 * np.cos(time_s / 4), 40 * np.sin(time_s / 4), 12 + time_s], axis=1)
    yaw_deg = (time_s * 35.0 + 120.0 + 180.0) % 360.0 - 180.0
    rotations = np.stack([-30 - time_s, yaw_deg, np.zeros(num)], axis=1)
    targets = np.stack([np.zeros(num), time_s, np.full(num, 0.9)], axis=1)
    ones = np.ones(num)
    segments = (Segment("follow", 0, 12), Segment("orbit", 12, 13), Segment("hold", 13, num))
    return DroneTrace(
        "p", "none", time_s, positions, rotations, targets, ones, 5 + np.cos(time_s * 7), segments=segments,
        mission=Mission("battery", 16, 21, (1.0, 2.0, 3.0)),
    )  # fmt: skip


def motion_of(time_s, poses, between=None) -> PlannedMotion:
    poses = np.asarray(poses, dtype=np.float64)
    return PlannedMotion(
        np.asarray(time_s), poses, np.empty((len(poses), 0, 6)) if between is None else between, poses[:, 4],
        poses[:, :3],
    )  # fmt: skip


def test_the_known_answer_of_the_public_release_as_an_action():
    """Points 0 to 1 of trajectory_1777083733: (-3.123, -2.072, -1.6) m/s and -3.13 degrees in 0.5 s, CARLA's axes."""
    x, y, z = np.array([-3.123, 2.072, -1.6]) * 0.5
    public = motion_of([0.0, 0.5], [[0, 0, 30, -40, 10, 0], [x, y, 30 + z, -40, 13.13, 0]])
    forward, left, up, turn, _ = public.action[0]
    assert_allclose([np.hypot(forward, left), up, turn], [np.hypot(3.123, 2.072), -1.6, 6.26])


def test_flying_the_actions_gives_the_plan():
    trace = curve(31)
    shown, between = trace.every(5), trace.between(5)
    motion = motion_of(shown.time_s, np.hstack([shown.positions_m, shown.rotations_deg]), between)
    yaw = np.radians(np.stack([np.zeros(7), motion.yaw_deg, np.zeros(7)], axis=1))
    for part in range(1, 6):
        flown = (motion.actions[:-1, :part, :3] * 0.1).sum(axis=1)
        reached = motion.poses[:-1, :3] + np.einsum("nij,nj->ni", rotation_matrices(yaw)[:-1], flown)
        assert_allclose(reached, trace.positions_m[part::5][:6], atol=1e-9)
        turned = shown.rotations_deg[:-1, 1] + (motion.actions[:-1, :part, 3] * 0.1).sum(axis=1)
        assert_allclose(np.cos(np.radians(turned - trace.rotations_deg[part::5][:6, 1])), 1.0)
        assert_allclose(motion.actions[:-1, part - 1, 4], trace.rotations_deg[part::5][:6, 0])
    assert_allclose(motion.action[:-1, :4], motion.actions[:-1, :, :4].mean(axis=1))
