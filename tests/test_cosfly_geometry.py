"""Geometry: the convention for space, reprojection, grids, box kernels, the motion that a policy learns, splits by trajectory."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from cosfly.formats.boxes import make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback_file import read_track, write_track
from cosfly.formats.roi import Roi
from cosfly.formats.traces import DroneTrace
from cosfly.geometry import kernels
from cosfly.geometry.axes import (
    intrinsic_matrix,
    look_at,
    project,
    rotation_matrices,
    rotation_matrix,
    world_from_camera,
)
from cosfly.geometry.grid import OccupancyGrid, blocks_walking, occupancy, roi_mask, surface
from cosfly.geometry.motion import PlannedMotion
from cosfly.geometry.reprojection import View, compare_views
from cosfly.geometry.splits import SPLITS, Course, assign_splits, walks_of
from specimens import make_flight, map_of

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
    uv, z = project(2 * eye[None] - target, pose, intrinsic_matrix(1280, 720, 90))  # behind the camera
    assert np.isnan(uv).all()
    assert_allclose(z[0], -17.0)


CAMERA = np.array([80.0, 80.0, 80.0, 45.0])


def surface_at(depth_m: float, kind: str = "Buildings", number: int = 7) -> View:
    instance = np.zeros((90, 160, 3), np.uint8)
    instance[:] = (KINDS[kind], number, 0)
    return View(np.full((90, 160), depth_m, np.float32), instance, np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("kinds", "is_same"),
    [(("Roads", "Roads"), True), (("Roads", "Sidewalks"), False), (("Buildings", "Buildings"), False)],
)
def test_of_two_roads_in_one_plane_either_may_show(kinds, is_same):
    found = compare_views(*(surface_at(20.0, kind, number) for number, kind in enumerate(kinds)), CAMERA)
    assert found.agree > 1000
    assert found.same == (found.agree if is_same else 0)


def test_what_another_thing_hides_is_not_gone_and_what_comes_nearer_by_itself_is():
    """From behind a corner a wall stands before what was seen; seen from the first place it lies outside or is hidden.
    A wall that comes nearer without a camera that moves is before what the first picture shows."""
    corner, street = surface_at(6.0), surface_at(20.0)
    corner = View(corner.depth, corner.instance, np.eye(3), np.array([30.0, 0.0, 0.0]))
    around = compare_views(street, corner, CAMERA)
    assert around.seen > 500
    assert around.agree == 0
    assert around.missing_share == 0.0
    assert compare_views(street, surface_at(6.0), CAMERA).missing_share == 1.0
    assert compare_views(surface_at(6.0), street, CAMERA).missing_share == 1.0


BUILDINGS, WATER, ROADS = KINDS["Buildings"], KINDS["Water"], KINDS["Roads"]


def free_grid(num_x: int, num_y: int, resolution_m: float = 1.0, x_min_m: float = 0.0, y_min_m: float = 0.0):
    return OccupancyGrid(x_min_m, y_min_m, resolution_m, np.zeros((num_y, num_x), dtype=bool))


def one_box(center, half_extents, rotation_deg=(0, 0, 0), kind=BUILDINGS):
    return make_box_map([center], [half_extents], [rotation_deg], [kind])


def test_only_boxes_at_a_persons_height_block():
    for bottom_m, top_m, kind, blocks in [
        (0.0, 3.0, BUILDINGS, True),
        (-5.0, 0.0, BUILDINGS, False),  # ends at the ground
        (-5.0, 0.1, BUILDINGS, True),
        (2.0, 6.0, BUILDINGS, False),  # begins where the head ends
        (1.9, 6.0, BUILDINGS, True),
        (1.0, 1.0, BUILDINGS, True),  # a plate without thickness at chest height
        (0.0, 0.0, BUILDINGS, False),  # and on the ground
        (-0.2, 0.3, ROADS, False),
        (-4.0, -1.0, WATER, True),
        (0.0, 1.0, WATER, True),
    ]:
        box_map = one_box((0, 0, (bottom_m + top_m) / 2), (1, 1, (top_m - bottom_m) / 2), kind=kind)
        assert blocks_walking(box_map).tolist() == [blocks]
        assert occupancy(box_map).occupied.any() == blocks


@settings(max_examples=60)
@given(
    st.floats(-3, 15), st.floats(-3, 15), st.floats(0.05, 6), st.floats(0.05, 6), st.floats(-180, 180),
    st.sampled_from([0.0, 25.0]),
)  # fmt: skip
def test_turned_boxes_fill_the_cells_that_shapely_finds(x, y, half_x, half_y, yaw_deg, tilt_deg):
    turn_deg = tilt_deg, yaw_deg, -tilt_deg
    grid = occupancy(one_box((x, y, 1), (half_x, half_y, 1), turn_deg), like=free_grid(12, 12))
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * [half_x, half_y, 1]
    turned = corners @ rotation_matrix(*np.radians(turn_deg)).T + [x, y, 1]
    footprint = shapely.MultiPoint(turned[:, :2]).convex_hull  # what the box covers, seen from above
    for row, column in itertools.product(range(12), range(12)):
        cell = shapely.box(column, row, column + 1, row + 1)
        # Within twice the tolerance of a mere touch both answers are right.
        if footprint.intersects(cell.buffer(-2e-6, join_style="mitre")):
            assert grid.occupied[row, column]
        elif not footprint.intersects(cell):
            assert not grid.occupied[row, column]


def test_surfaces_near_the_ground_count_and_a_flyover_does_not():
    rows = ("Roads", (1, 1, -0.1)), ("Roads", (3, 1, 6.0)), ("Buildings", (5, 1, 1.0))
    box_map = map_of(*((*row, (1, 1, 0.1)) for row in rows))
    np.testing.assert_array_equal(surface(box_map, like=free_grid(6, 2)), [[True] * 2 + [False] * 4] * 2)
    assert surface(box_map, [WATER], like=free_grid(6, 2)) is None


def test_roi_with_holes_and_several_rings_equals_shapely():
    rng = np.random.default_rng(3)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 15))
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(5, 14, 15)[:, None] + [14, 13]
    hole = [(10.2, 10.1), (16.4, 11.3), (13.3, 17.2)]
    poking = [(25.3, 2.2), (40.1, 2.2), (40.1, 9.4)]  # a hole that leaves its ring cuts only what is inside
    square = [(20.1, 0.3), (29.4, 0.3), (29.4, 8.9), (20.1, 8.9)]
    # The last ring may overlap the first: together they count as one region.
    roi = Roi(points_world=star.tolist(), holes=[hole], polygons=[{"points_world": square, "holes": [poking]}])
    grid = free_grid(60, 56, 0.5, -0.3, -0.7)
    region = (shapely.Polygon(star) - shapely.Polygon(hole)) | (shapely.Polygon(square) - shapely.Polygon(poking))
    centers = grid.centers_of(np.stack(np.meshgrid(np.arange(60), np.arange(56)), axis=-1))
    expected = shapely.contains_xy(region, centers[..., 0], centers[..., 1])
    np.testing.assert_array_equal(roi_mask(grid, roi), expected)
    assert 0 < expected.sum() < expected.size


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


def random_boxes(rng, num_boxes, spread_m=60.0, tilt=True):
    angles = rng.uniform(-np.pi, np.pi, (num_boxes, 3)) * (1.0 if tilt else np.array([0, 1, 0]))
    centers = rng.uniform(-spread_m, spread_m, (num_boxes, 3)) * np.array([1, 1, 0.3])
    return kernels.index_boxes(centers, rng.uniform(0, 8, (num_boxes, 3)), rotation_matrices(angles))


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


@pytest.mark.parametrize("inflate_m", [0.0, 2.5])
def test_segments_agree_with_plane_clipping(inflate_m):
    rng = np.random.default_rng(5)
    index = random_boxes(rng, 60)
    starts, ends = rng.uniform(-80, 80, (2, 300, 3)) * np.array([1, 1, 0.3])
    ends[:40, 0] = starts[:40, 0]  # along y
    ends[40:80, :2] = starts[40:80, :2]  # upright
    ends[80:90] = starts[80:90]  # a point
    expected = [slow_hits(index, a, b, inflate_m).any() for a, b in zip(starts, ends, strict=True)]
    assert 0 < sum(expected) < 300
    np.testing.assert_array_equal(kernels.segments_hit(index, starts, ends, inflate_m), expected)


def test_the_way_between_points_agrees_with_many_points_on_it():
    for seed in range(20):
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
    expected = [
        np.mean([not slow_hits(index, target + offset, drone).any() for offset in kernels.RAY_OFFSETS_M])
        for drone, target in zip(drones, targets, strict=True)
    ]
    assert len(set(expected)) > 2
    np.testing.assert_allclose(kernels.visibility(index, drones, targets), expected)


def motion_of(time_s, poses) -> PlannedMotion:
    poses = np.asarray(poses, dtype=np.float64)
    return PlannedMotion(np.asarray(time_s), poses, poses[:, 4], poses[:, :3])


def test_the_known_answer_of_the_public_release_as_an_action():
    """Points 0 to 1 of trajectory_1777083733: (-3.123, -2.072, -1.6) m/s and -3.13 degrees in 0.5 s, CARLA's axes."""
    x, y, z = np.array([-3.123, 2.072, -1.6]) * 0.5
    public = motion_of([0.0, 0.5], [[0, 0, 30, -40, 10, 0], [x, y, 30 + z, -40, 13.13, 0]])
    forward, left, up, turn, _ = public.action[0]
    assert_allclose([np.hypot(forward, left), up, turn], [np.hypot(3.123, 2.072), -1.6, 6.26])


def test_flying_the_actions_gives_the_plan():
    """On a curve, with a heading that passes the south."""
    time_s, zeros = np.arange(31) * 0.1, np.zeros(31)
    positions = np.stack([40 * np.cos(time_s / 4), 40 * np.sin(time_s / 4), 12 + time_s], axis=1)
    rotations = np.stack([-30 - time_s, (time_s * 35.0 + 300.0) % 360.0 - 180.0, zeros], axis=1)
    shown = DroneTrace("p", "none", time_s, positions, rotations, 0 * positions, zeros, zeros).every(5)
    motion = motion_of(shown.time_s, np.hstack([shown.positions_m, shown.rotations_deg]))
    yaw = np.radians(np.stack([np.zeros(7), motion.yaw_deg, np.zeros(7)], axis=1))
    flown = motion.action[:-1, :3] * 0.5
    reached = motion.poses[:-1, :3] + np.einsum("nij,nj->ni", rotation_matrices(yaw)[:-1], flown)
    assert_allclose(reached, shown.positions_m[1:], atol=1e-9)
    turned = shown.rotations_deg[:-1, 1] + motion.action[:-1, 3] * 0.5
    assert_allclose(np.cos(np.radians(turned - shown.rotations_deg[1:, 1])), 1.0)
    assert_allclose(motion.action[:-1, 4], shown.rotations_deg[1:, 0])


def walk(num_points: int, *, begin: tuple[float, float] = (0.0, 0.0)):
    time_s = np.arange(num_points) * 0.5
    return time_s, np.column_stack([begin[0] + 1.4 * time_s, np.full(num_points, begin[1]), np.full(num_points, 0.9)])


def groups(*courses: Course) -> list[set[str]]:
    found: dict[str, set[str]] = {}
    for name, walk_id in walks_of(courses).items():
        found.setdefault(walk_id, set()).add(name)
    return sorted(found.values(), key=sorted)


def test_perturbed_twins_are_one_walk_once_they_are_read_again(tmp_path):
    clean, _ = make_flight(40, seed=3)
    noisy, _ = make_flight(40, seed=3, variant="aug_001")
    offsets_m = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 3))
    perturbation = replace(noisy.perturbation, target_m=offsets_m)
    shifted = replace(noisy, targets_m=noisy.targets_m + offsets_m, perturbation=perturbation)
    for flight in (clean, shifted):
        write_track(tmp_path / "Town01" / flight.trajectory / flight.variant, flight)
    read = [read_track(tmp_path / "Town01" / clean.trajectory / variant) for variant in ("ORI", "aug_001")]
    one, other = (Course(flight.variant, flight.town, flight.time_s, flight.walked_m) for flight in read)
    assert groups(one, other) == [{"ORI", "aug_001"}]
    assert groups(one, replace(other, target_m=read[1].targets_m)) == [{"ORI"}, {"aug_001"}]  # the shift was real


@pytest.mark.parametrize(("num_s", "near_s", "beside_m", "is_one"), [
    (20, 20, 0.49, True), (20, 20, 0.51, False), (20, 10, 0.4, True), (20, 9, 0.4, False), (8, 5, 0.4, True),
    (8, 4, 0.4, False), (3, 3, 0.4, True),
])  # fmt: skip
def test_near_for_half_of_the_time_and_five_seconds_or_all_the_time_is_one_walk(num_s, near_s, beside_m, is_one):
    time_s, places_m = walk(2 * num_s)
    beside = np.where(time_s < near_s, beside_m, 9.0)[:, None] * [0.0, 1.0, 0.0]
    one, other = (Course(name, "Town01", time_s, at_m) for name, at_m in (("a", places_m), ("b", places_m + beside)))
    assert (len(groups(one, other)) == 1) == is_one


def test_walks_go_from_neighbour_to_neighbour_and_have_the_first_name():
    y_m = {"c": 0.0, "a": 0.4, "b": 0.8, "d": 1.4}
    courses = [Course(name, "Town01", *walk(9 + k, begin=(0.0, at_m))) for k, (name, at_m) in enumerate(y_m.items())]
    assert walks_of(courses) == {"a": "a", "b": "a", "c": "a", "d": "d"}


@given(
    num_groups=st.integers(3, 60), val=st.sampled_from([0.0, 0.01, 0.1, 0.45]),
    test=st.sampled_from([0.0, 0.01, 0.2, 0.45]), seed=st.integers(0, 5),
)  # fmt: skip
def test_splits_cover_all_and_none_is_empty(num_groups, val, test, seed):
    shares = {"val": val, "test": test}
    names = [f"run/Town/walk_{i}" for i in range(num_groups)]
    split_of = assign_splits(names, shares, seed)
    assert set(split_of) == set(names)
    counts = Counter(split_of.values())
    assert set(counts) == {split for split in SPLITS if split == "train" or shares[split] > 0}
    assert abs(counts["val"] - val * num_groups) <= 1
    assert split_of == assign_splits(list(reversed(names)) * 2, shares, seed)  # order, repeats
    renamed = assign_splits([name.replace("run", "again") for name in names], shares, seed)
    assert {name.replace("again", "run"): split for name, split in renamed.items()} == split_of
    if num_groups > 30 and min(val, test) > 0.05:
        assert split_of != assign_splits(names, shares, seed + 1)


def test_with_few_groups_train_comes_first():
    shares = {"val": 0.1, "test": 0.1}
    assert sorted(assign_splits(["a", "b"], shares, 0).values()) == ["train", "val"]
    assert assign_splits(["a"], shares, 0) == assign_splits(["a"], {}, 0) == {"a": "train"}
    assert assign_splits([], shares, 0) == {}
