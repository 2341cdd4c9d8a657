import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosfly.pedestrians.walking import SLOWEST_SPEED_MPS, arrival_times, menger_curvature, resample, speed_profile

BEND_45 = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.5]])  # a straight step, then a diagonal one


def calm(curvatures, **settings_):
    return speed_profile(np.asarray(curvatures, dtype=float), np.random.default_rng(0), jitter=0.0, **settings_)


# --- curvature --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "curvature"),
    [
        ([(0, 0), (1, 0), (2, 0)], 0.0),
        (
            [(0, 0), (0.5, 0), (0.5, 0.5)],
            2 * np.sqrt(2),
        ),  # circle through three corners of a 0.5 m square: radius 0.3536
        (BEND_45, 4 / np.sqrt(10)),
        ([(0, 0), (1, 0), (1, 0)], 0.0),  # no distance, no curvature
        ([(0, 0), (1, 0), (0, 0)], 0.0),  # there and back
        ([(0, 0), (1e-3, 0), (1e-3, 1e-3)], 0.0),  # product of lengths 1.4e-9 m3, below the guard
    ],
)
def test_curvature_by_hand(points, curvature):
    assert menger_curvature(np.array(points, dtype=float)).tolist() == pytest.approx([0.0, curvature, 0.0])


@pytest.mark.parametrize("count", [1, 2])
def test_short_polylines_have_no_curvature(count):
    assert menger_curvature(np.ones((count, 2))).tolist() == [0.0] * count


@given(st.floats(0.5, 200), st.floats(0.01, 1.0), st.floats(-100, 100))
def test_points_on_a_circle_have_its_curvature(radius_m, step_rad, turn_rad):
    angles = turn_rad + step_rad * np.arange(6)
    circle = radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    if radius_m * step_rad > 0.05:
        np.testing.assert_allclose(menger_curvature(circle)[1:-1], 1 / radius_m, rtol=1e-5)


# --- speed ------------------------------------------------------------------------------------------------------------


def test_speeds_by_hand():
    np.testing.assert_allclose(calm([0.0, 0.2, 1.0]), [1.2, 0.6, 0.2])
    np.testing.assert_allclose(calm([0.0, 1.0], cruise_speed_mps=3.0), [1.6, 0.5])
    np.testing.assert_allclose(calm([0.0, 1.0], min_speed_mps=0.4), [1.2, 0.4])
    np.testing.assert_allclose(calm([5.0], curvature_gain_m=0.0), [1.2])


def test_nobody_stands_still_for_ever():
    assert calm([1e9]).tolist() == [SLOWEST_SPEED_MPS]


def test_the_guard_changes_nothing_at_the_sharpest_grid_corner_and_the_papers_settings():
    sharpest = 2 * np.sqrt(2)
    speeds = speed_profile(np.full(10_000, sharpest), np.random.default_rng(1))
    assert speeds.min() > SLOWEST_SPEED_MPS


def test_jitter_is_even_within_its_share():
    speeds = speed_profile(np.zeros(20_000), np.random.default_rng(2), jitter=0.15)
    assert 1.2 * 0.85 <= speeds.min() < 1.2 * 0.852
    assert 1.2 * 1.148 < speeds.max() <= 1.2 * 1.15
    assert speeds.mean() == pytest.approx(1.2, abs=0.005)


# --- time -------------------------------------------------------------------------------------------------------------


def test_times_by_hand():
    polyline = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    np.testing.assert_allclose(arrival_times(polyline, np.array([1.0, 0.5, 1.5])), [0.0, 4.0, 8.0])


def test_no_speed_is_a_value_error():
    with pytest.raises(ValueError, match="for ever"):
        arrival_times(np.array([[0.0, 0.0], [1.0, 0.0]]), np.zeros(2))


def test_even_speed_gives_even_steps_and_ends_at_the_goal():
    polyline = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.3]])
    speeds = np.full(3, 1.0)
    time_s, positions, sampled = resample(polyline, speeds, arrival_times(polyline, speeds), 0.5)
    np.testing.assert_allclose(time_s, [0, 0.5, 1.0, 1.5, 2.0, 2.5])
    np.testing.assert_allclose(positions, [[0, 0], [0.5, 0], [1, 0], [1, 0.5], [1, 1.0], [1, 1.3]], atol=1e-12)
    np.testing.assert_allclose(sampled, 1.0)


def test_a_walk_that_ends_on_a_step_has_no_second_last_point():
    polyline = np.array([[0.0, 0.0], [1.0, 0.0]])
    time_s, positions, _ = resample(polyline, np.ones(2), np.array([0.0, 1.0]), 0.5)
    np.testing.assert_allclose(time_s, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(positions[-1], [1.0, 0.0])


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(2, 12))
def test_samples_agree_with_a_walk_in_tiny_steps(seed, count):
    rng = np.random.default_rng(seed)
    polyline = np.cumsum(rng.uniform(0.2, 1.0, (count, 2)), axis=0)
    speeds = rng.uniform(0.1, 1.6, count)
    times = arrival_times(polyline, speeds)
    time_s, positions, sampled = resample(polyline, speeds, times, 0.5)
    # The slow way: speed is linear in time between waypoints, the way walked is its integral.
    fine_s = np.linspace(0.0, times[-1], 200_001)
    fine_mps = np.interp(fine_s, times, speeds)
    walked_m = np.concatenate([[0.0], np.cumsum(0.5 * (fine_mps[1:] + fine_mps[:-1]) * np.diff(fine_s))])
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))])
    now_s = np.minimum(time_s, times[-1])
    wanted_m = np.interp(now_s, fine_s, walked_m)
    expected = np.column_stack([np.interp(wanted_m, along_m, polyline[:, k]) for k in (0, 1)])
    np.testing.assert_allclose(positions, expected, atol=1e-3)
    np.testing.assert_allclose(sampled, np.interp(now_s, times, speeds), atol=1e-9)
    np.testing.assert_allclose(positions[[0, -1]], polyline[[0, -1]], atol=1e-9)
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() <= 1.6 * 0.5 + 1e-9
