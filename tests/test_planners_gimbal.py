"""The direction of the camera: the limit of yaw rate, and the gimbal."""

import numpy as np
import pytest
from specimens_planning import town_of, walk_along

from cosfly.formats.frames import Camera
from cosfly.geometry import kernels
from cosfly.geometry.axes import intrinsic_matrix, look_at, project, world_from_camera, wrap_deg
from cosfly.planners.contract import PlanConfig
from cosfly.planners.gimbal import GimbalConfig, follow_direction, limit_yaw_rate
from cosfly.planners.stage import plan_trajectory
from cosfly.runtime.seeding import draw_smooth

DT_S = 0.5
OPEN = kernels.obstacle_index(town_of())
STRAIGHT = walk_along("straight", [(0, 0), (90, 0)])
CAMERA = Camera(640, 360, intrinsic_matrix(640, 360, 60.0))
GIMBAL = GimbalConfig(bandwidth_hz=0.2, delay_s=0.2, error_deg=4.0)


def overhead(aside_m=0.5, height_m=21.0):
    """A target that passes under a drone at 2 m/s: drone and target, (n, 3)."""
    target = np.column_stack([np.arange(-20.0, 21.0), np.full(41, aside_m), np.zeros(41)])
    return np.tile([0.0, 0.0, height_m], (41, 1)), target


def pixels(drone, target, pitch, yaw):
    poses = np.degrees(np.column_stack([pitch, yaw, 0.0 * yaw]))
    views = [world_from_camera(place, pose) for place, pose in zip(drone, poses, strict=True)]
    return np.array([project(at[None], view, CAMERA.intrinsic)[0][0] for at, view in zip(target, views, strict=True)])


def rates_degps(yaw):
    return np.abs(wrap_deg(np.degrees(np.diff(yaw)))) / DT_S


def test_a_direction_within_the_limit_stays_as_it_is():
    pitch, yaw = look_at(*overhead(aside_m=40.0))
    limited = limit_yaw_rate(pitch, yaw, 60.0, DT_S)
    assert limited[0] is pitch
    assert limited[1] is yaw


@pytest.mark.parametrize("aside_m", [0.5, -0.5, 1.0])
def test_a_camera_that_passes_over_its_target_turns_slowly_and_keeps_it_in_the_picture(aside_m):
    drone, target = overhead(aside_m)
    pitch, yaw = look_at(drone, target)
    assert rates_degps(yaw).max() > 60.0
    limited = limit_yaw_rate(pitch, yaw, 60.0, DT_S)
    assert rates_degps(limited[1]).max() <= 60.0 + 1e-9
    uv = pixels(drone, target, *limited)
    assert ((uv > 0) & (uv < [CAMERA.width_px, CAMERA.height_px])).all()
    np.testing.assert_allclose(limited[1][[0, -1]], yaw[[0, -1]])


def test_the_gimbal_lags_behind_a_target_that_moves_through_the_picture():
    yaw = np.radians(10.0 * DT_S * np.arange(60))
    exact = GIMBAL.model_copy(update={"error_deg": 0.0})
    pitch, followed = follow_direction(0.0 * yaw, yaw, exact, 60.0, DT_S, np.random.default_rng(0))
    # A loop without feed-forward lags by rate x (2 x damping / natural frequency + delay).
    lag_s = 2.0 * GIMBAL.damping / (2.0 * np.pi * GIMBAL.bandwidth_hz) + GIMBAL.delay_s
    assert wrap_deg(np.degrees(yaw - followed))[-1] == pytest.approx(10.0 * lag_s, rel=0.05)
    assert np.abs(pitch).max() < 1e-9


def test_the_aiming_error_has_its_standard_deviation_and_is_smooth():
    still = np.zeros(20_000)
    pitch, yaw = follow_direction(still, still, GIMBAL, 60.0, DT_S, np.random.default_rng(0))
    assert np.degrees(yaw.std()) == pytest.approx(4.0, rel=0.1)
    assert np.degrees(pitch.std()) == pytest.approx(2.0, rel=0.1)
    assert rates_degps(yaw).max() < 5.0


def test_the_gimbal_turns_no_faster_than_the_limit():
    yaw = np.where(np.arange(40) < 20, 0.0, 2.5)
    _, followed = follow_direction(0.0 * yaw, yaw, GIMBAL, 30.0, DT_S, np.random.default_rng(0))
    assert 25.0 < rates_degps(followed).max() <= 30.0 + 1e-9


def test_a_plan_with_a_gimbal_flies_the_same_way_and_looks_elsewhere():
    exact, loose, again, other = (
        plan_trajectory(STRAIGHT, OPEN, PlanConfig(gimbal=gimbal), seed)
        for gimbal, seed in ((GimbalConfig(), 0), (GIMBAL, 0), (GIMBAL, 0), (GIMBAL, 1))
    )
    np.testing.assert_array_equal(exact.positions_m, loose.positions_m)
    np.testing.assert_array_equal(loose.rotations_deg, again.rotations_deg)
    assert np.abs(wrap_deg(loose.rotations_deg - exact.rotations_deg)[:, 1]).max() > 3.0
    assert np.abs(wrap_deg(loose.rotations_deg - other.rotations_deg)[:, 1]).max() > 3.0


def test_new_settings_are_recorded_only_where_they_are_set():
    assert not {"gimbal", "yaw_rate_max_degps"} & PlanConfig().recorded().keys()
    recorded = PlanConfig(gimbal=GIMBAL, yaw_rate_max_degps=90.0).recorded()
    assert recorded["yaw_rate_max_degps"] == 90.0
    assert recorded["gimbal"]["bandwidth_hz"] == 0.2


@pytest.mark.parametrize("correlation_s", [1.0, 6.0])
def test_smooth_draws_have_the_stated_covariance(correlation_s):
    drawn = draw_smooth(100_000, 2, DT_S, correlation_s, np.random.default_rng(0))
    np.testing.assert_allclose(drawn.std(axis=0), 1.0, rtol=0.03)
    steps = round(correlation_s / DT_S)
    found = (drawn[steps:] * drawn[:-steps]).mean(axis=0)
    np.testing.assert_allclose(found, np.exp(-0.5), atol=0.05)
    assert abs((drawn[:, 0] * drawn[:, 1]).mean()) < 0.05
