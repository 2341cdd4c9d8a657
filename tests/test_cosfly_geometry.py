"""The project's one convention for space."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from cosfly.geometry.axes import intrinsic_matrix, look_at, mirror_poses, project, rotation_matrix, world_from_camera

angles = st.floats(-180, 180)


@given(angles, angles, angles)
def test_rotation_is_the_stated_product(pitch, yaw, roll):
    p, y, r = np.radians([pitch, yaw, roll])
    rz = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    ry = np.array([[np.cos(-p), 0, np.sin(-p)], [0, 1, 0], [-np.sin(-p), 0, np.cos(-p)]])
    rx = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    assert_allclose(rotation_matrix(p, y, r), rz @ ry @ rx, atol=1e-12)


@given(angles, st.floats(-89, 89))
def test_look_at_puts_the_target_in_the_middle(yaw, pitch):
    eye = np.array([3.0, -2.0, 25.0])
    target = eye + 17.0 * rotation_matrix(np.radians(pitch), np.radians(yaw), 0.0)[:, 0]
    pitch_rad, yaw_rad = look_at(eye, target)
    pose = world_from_camera(eye, np.degrees([pitch_rad, yaw_rad, 0.0]))
    uv, z = project(target[None], pose, intrinsic_matrix(1280, 720, 90))
    assert_allclose(uv[0], (640, 360), atol=1e-6)
    assert_allclose(z[0], 17.0)


def test_image_axes():
    pose = world_from_camera(np.zeros(3), np.zeros(3))  # looks east
    uv, z = project(np.array([[10.0, 1, 0], [10, 0, 1], [-10, 0, 0]]), pose, intrinsic_matrix(1280, 720, 90))
    assert uv[0, 0] < 640
    assert uv[1, 1] < 360
    assert np.isnan(uv[2]).all()
    assert z[2] == -10


def test_mirroring_is_its_own_inverse_and_keeps_the_picture():
    point, eye, rotation = np.array([12.0, 5.0, 1.0]), np.array([0.0, 1.0, 20.0]), np.array([-40.0, 25.0, 0.0])
    assert_allclose(mirror_poses(mirror_poses(point)), point)
    assert_allclose(mirror_poses(mirror_poses(rotation)), rotation)
    k = intrinsic_matrix(1280, 720, 90)
    uv, z = project(point[None], world_from_camera(eye, rotation), k)
    mirrored = world_from_camera(mirror_poses(eye), mirror_poses(rotation))
    uv_mirrored, z_mirrored = project(mirror_poses(point)[None], mirrored, k)
    assert_allclose(z, z_mirrored)
    assert_allclose(uv_mirrored, [[1280 - uv[0, 0], uv[0, 1]]])
