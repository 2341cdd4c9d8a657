"""The project's one convention for space, and what two frames say of each other."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tables import each

from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import intrinsic_matrix, look_at, mirror_poses, project, rotation_matrix, world_from_camera
from cosfly.geometry.reprojection import View, compare_views

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


@each(
    ("kinds", "is_same"),
    [(("Roads", "Roads"), True), (("Roads", "Sidewalks"), False), (("Buildings", "Buildings"), False)],
)
def test_of_two_roads_in_one_plane_either_may_show(kinds, is_same):
    views = []
    for number, kind in enumerate(kinds):
        instance = np.zeros((90, 160, 3), np.uint8)
        instance[:] = (KINDS[kind], number, 0)
        views.append(View(np.full((90, 160), 20.0, np.float32), instance, np.eye(3), np.zeros(3)))
    found = compare_views(*views, np.array([80.0, 80.0, 80.0, 45.0]))
    assert found.agree > 1000
    assert found.same == (found.agree if is_same else 0)


CAMERA = np.array([80.0, 80.0, 80.0, 45.0])


def building_at(depth_m: float) -> View:
    instance = np.zeros((90, 160, 3), np.uint8)
    instance[:] = (KINDS["Buildings"], 7, 0)
    return View(np.full((90, 160), depth_m, np.float32), instance, np.eye(3), np.zeros(3))


@each(("before_m", "after_m", "is_found"), [(20.0, 23.0, True), (23.0, 20.0, False), (20.0, 20.0, False)])
def test_a_thing_that_is_farther_has_moved_and_one_that_is_nearer_may_hide_itself(before_m, after_m, is_found):
    """From behind a corner another wall of the same building stands before the one that was seen."""
    assert (compare_views(building_at(before_m), building_at(after_m), CAMERA).moved > 0) == is_found


@each(("kind", "num_renamed", "is_found"), [("Buildings", 40, True), ("Buildings", 2, False), ("Roads", 40, False)])
def test_a_thing_under_another_id_is_told_but_for_ground(kind, num_renamed, is_found):
    """A wall at one place, of which in the second picture so many columns have another id."""
    views = [building_at(20.0), building_at(20.0)]
    for view in views:
        view.instance[..., 0] = KINDS[kind]
    views[0].instance[:, :40, 1] = 8
    views[1].instance[:, :num_renamed, 1] = 9
    views[1].instance[:, num_renamed:40, 1] = 8
    assert (compare_views(*views, CAMERA).other_id > 0) == is_found


def test_what_another_thing_hides_is_not_gone_and_what_comes_nearer_by_itself_is():
    """From behind a corner a wall stands before what was seen; seen from the first place it lies outside or is hidden.
    A wall that comes nearer without a camera that moves is before what the first picture shows."""
    corner, street = building_at(6.0), building_at(20.0)
    corner = View(corner.depth, corner.instance, np.eye(3), np.array([30.0, 0.0, 0.0]))
    around = compare_views(View(street.depth, street.instance, np.eye(3), np.zeros(3)), corner, CAMERA)
    assert around.hidden == around.seen > 500
    assert around.missing_share == 0.0
    assert compare_views(street, building_at(6.0), CAMERA).missing_share == 1.0
    assert compare_views(building_at(6.0), street, CAMERA).missing_share == 1.0
