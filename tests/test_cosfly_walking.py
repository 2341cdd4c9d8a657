import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosfly.pedestrians.speed_model import PACES, TimedRoute, standing_time_s, take_pace


def test_even_speed_gives_even_steps_and_ends_at_the_goal():
    polyline = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.3]])
    speeds = np.full(3, 1.0)
    time_s, positions, sampled = TimedRoute(polyline, speeds, np.zeros(3)).resample(0.5)
    np.testing.assert_allclose(time_s, [0, 0.5, 1.0, 1.5, 2.0, 2.5])
    np.testing.assert_allclose(positions, [[0, 0], [0.5, 0], [1, 0], [1, 0.5], [1, 1.0], [1, 1.3]], atol=1e-12)
    np.testing.assert_allclose(sampled, 1.0)
    time_s, positions, _ = TimedRoute(polyline[:2], np.ones(2), np.zeros(2)).resample(0.5)
    np.testing.assert_allclose(time_s, [0.0, 0.5, 1.0])  # one that ends on a step has no second last point
    np.testing.assert_allclose(positions[-1], [1.0, 0.0])


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(2, 12))
def test_samples_agree_with_a_walk_in_tiny_steps(seed, count):
    rng = np.random.default_rng(seed)
    polyline = np.cumsum(rng.uniform(0.2, 1.0, (count, 2)), axis=0)
    speeds = rng.uniform(0.1, 1.6, count)
    route = TimedRoute(polyline, speeds, np.zeros(count))
    times = route.times_s
    time_s, positions, sampled = route.resample(0.5)
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


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(3, 10))
def test_stops_change_when_a_place_is_reached_and_not_which(seed, count):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 3.0, count)) - 0.2
    stops = rng.uniform(0.0, 5.0, count) * (rng.random(count) < 0.5)
    fine_s = np.arange(0.0, times[-1] + stops.sum() + 1.0, 0.01)
    stood = standing_time_s(fine_s, times, stops)
    walked = fine_s - stood
    assert (np.diff(stood) >= -1e-12).all()
    assert (np.diff(walked) >= -1e-12).all(), "nobody goes back in time"
    assert stood[-1] == pytest.approx(stops.sum())
    for at, stop in zip(times, stops, strict=True):
        assert (np.abs(walked - at) < 1e-9).sum() * 0.01 == pytest.approx(stop, abs=0.03)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 30), st.sampled_from(sorted(PACES)), st.floats(0.5, 20.0))
def test_every_way_arrives(seed, count, name, cell_m):
    route = np.column_stack([cell_m * np.arange(count + 1), np.zeros(count + 1)])
    way = take_pace(route, PACES[name], np.random.default_rng(seed))
    speeds = np.where(way.stops_s > 0, 0.0, 1.2)
    assert np.isfinite(TimedRoute(way.polyline_m, speeds, way.stops_s).times_s).all()
    np.testing.assert_array_equal(way.polyline_m[0], route[0])
