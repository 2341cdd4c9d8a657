"""Box kernels against slow, obvious numpy versions, hand-checkable tables and invariances."""

import numpy as np
import pytest

from cosfly.geometry import kernels
from cosfly.geometry.axes import rotation_matrices, rotation_matrix


def parts(index):
    return index.rows[:, :3], index.rows[:, 3:6], index.rows[:, 6:15].reshape(-1, 3, 3)


def slow_distances(index, points):
    """(n, k) signed distances, all pairs, straight from the definition."""
    centers, half_extents, rotations = parts(index)
    local = np.einsum("kij,nki->nkj", rotations, points[:, None] - centers[None])
    q = np.abs(local) - half_extents[None]
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def slow_hits(index, start, end, inflate_m=0.0):
    hits = np.zeros(len(index.rows), dtype=bool)
    for box, (center, half_extent, rotation) in enumerate(zip(*parts(index), strict=True)):
        a = rotation.T @ (start - center)
        d = rotation.T @ (end - center) - a
        half = half_extent + inflate_m
        low, high = 0.0, 1.0
        for axis in range(3):
            for sign in (1, -1):  # sign * (a + t d) <= half
                slope, room = sign * d[axis], half[axis] - sign * a[axis]
                if abs(slope) < 1e-12:
                    high = high if room >= 0 else -1.0
                elif slope > 0:
                    high = min(high, room / slope)
                else:
                    low = max(low, room / slope)
        hits[box] = low <= high
    return hits


def slow_visibility(index, drone, target):
    return np.mean([not slow_hits(index, target + offset, drone).any() for offset in kernels.RAY_OFFSETS_M])


def random_boxes(rng, num_boxes, spread_m=60.0, tilt=True):
    angles = rng.uniform(-np.pi, np.pi, (num_boxes, 3)) * (1.0 if tilt else np.array([0, 1, 0]))
    centers = rng.uniform(-spread_m, spread_m, (num_boxes, 3)) * np.array([1, 1, 0.3])
    return kernels.index_boxes(centers, rng.uniform(0, 8, (num_boxes, 3)), rotation_matrices(angles))


def one_box(center=(0, 0, 0), half=(1, 2, 3), yaw_deg=0.0):
    return kernels.index_boxes([center], [half], rotation_matrix(0, np.radians(yaw_deg), 0)[None])


def test_nearest_agrees_with_all_pairs(subtests):
    for cell_m in [1.0, 8.0, 500.0]:
        for seed in range(4):
            with subtests.test(cell_m=cell_m, seed=seed):
                rng = np.random.default_rng(seed)
                index = random_boxes(rng, 80)
                index = kernels.index_boxes(*parts(index), cell_m=cell_m)
                points = rng.uniform(-150, 150, (200, 3))  # inside the grid, at its border and far outside
                expected = slow_distances(index, points)
                distances, boxes = kernels.signed_distances(index, points)
                np.testing.assert_allclose(distances, expected.min(axis=1), atol=1e-9)
                np.testing.assert_allclose(expected[np.arange(200), boxes], distances, atol=1e-9)
                limited, in_reach = kernels.signed_distances(index, points, 10.0)
                np.testing.assert_allclose(limited, np.minimum(expected.min(axis=1), 10.0), atol=1e-9)
                assert ((in_reach == -1) == (expected.min(axis=1) >= 10.0)).all()


def test_segments_agree_with_plane_clipping(subtests):
    for inflate_m in [0.0, 2.5]:
        with subtests.test(inflate_m=inflate_m):
            rng = np.random.default_rng(5)
            index = random_boxes(rng, 60)
            starts, ends = rng.uniform(-80, 80, (2, 300, 3)) * np.array([1, 1, 0.3])
            ends[:40, 0] = starts[:40, 0]  # along y
            ends[40:80, :2] = starts[40:80, :2]  # upright
            ends[80:90] = starts[80:90]  # a point
            expected = [slow_hits(index, a, b, inflate_m).any() for a, b in zip(starts, ends, strict=True)]
            assert 0 < sum(expected) < 300
            np.testing.assert_array_equal(kernels.segments_hit(index, starts, ends, inflate_m), expected)


def test_the_way_between_points_agrees_with_many_points_on_it(subtests):
    for seed in range(20):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            index = random_boxes(rng, 12, spread_m=20.0)
            points = np.cumsum(rng.normal(0, 3, (30, 3)), axis=0)
            gaps, shares, boxes = kernels.swept_distances(index, points, 100.0)
            ends = points[:-1], points[1:]
            between = np.linspace(0, 1, 1001)[:, None, None]
            fine = (ends[0] * (1 - between) + ends[1] * between).reshape(-1, 3)
            dense = slow_distances(index, fine).min(axis=1).reshape(1001, -1)
            outside = np.maximum(dense.min(axis=0), 0.0)
            np.testing.assert_allclose(np.maximum(gaps[:-1], 0.0), outside, atol=1e-3)
            assert (np.maximum(gaps[:-1], 0.0) <= outside + 1e-9).all()
            at = ends[0] + shares[:-1, None] * (ends[1] - ends[0])
            found = slow_distances(index, at)[np.arange(len(at)), boxes[:-1]]
            np.testing.assert_allclose(np.maximum(found, 0.0), np.maximum(gaps[:-1], 0.0), atol=1e-9)
            assert gaps[-1] == pytest.approx(slow_distances(index, points[-1:]).min())


def test_visibility_agrees_with_slow_rays():
    rng = np.random.default_rng(8)
    index = random_boxes(rng, 120, tilt=False)
    targets = rng.uniform(-60, 60, (150, 3)) * np.array([1, 1, 0]) + np.array([0, 0, 0.9])
    drones = targets + rng.uniform(-1, 1, (150, 3)) * np.array([20, 20, 5]) + np.array([0, 0, 20])
    expected = [slow_visibility(index, p, x) for p, x in zip(drones, targets, strict=True)]
    assert len(set(expected)) > 2
    np.testing.assert_allclose(kernels.visibility(index, drones, targets), expected)


def test_a_wall_hides_what_it_should():
    wall = one_box(center=(10, 0, 0.5), half=(0.1, 5, 0.5))  # 1 m high, so from low down it hides the legs only
    drone, target = [(20.0, 0.0, 1.0)], [(0.0, 0.0, 0.9)]
    assert kernels.visibility(wall, drone, target)[0] == pytest.approx(0.2)  # only the head's ray passes over
    assert kernels.visibility(wall, [(20.0, 0.0, 20.0)], target)[0] == 1.0
    assert kernels.visibility(wall, [(20.0, 9.0, 0.0)], target)[0] == pytest.approx(0.0)
    assert kernels.visibility(wall, [(20.0, 11.0, 0.0)], target)[0] == 1.0  # past its end
    index = one_box(half=(2, 2, 2))  # somebody inside a box is hidden from everywhere
    assert kernels.visibility(index, [(20.0, 0.0, 20.0), (-9.0, 3.0, 50.0)], [(0.0, 0.0, 0.9)] * 2).tolist() == [0, 0]
