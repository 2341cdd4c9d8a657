import itertools

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from cosfly.formats.boxes import make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.formats.roi import Roi
from cosfly.geometry.axes import rotation_matrix
from cosfly.geometry.grid import OccupancyGrid, blocks_walking, occupancy, roi_mask, surface

BUILDINGS, WATER, ROADS = KINDS["Buildings"], KINDS["Water"], KINDS["Roads"]


def grid_of(text: str) -> OccupancyGrid:
    rows = [[mark == "#" for mark in row] for row in text.split()]
    return OccupancyGrid(0.0, 0.0, 1.0, np.array(rows[::-1]))


def free_grid(num_x: int, num_y: int, resolution_m: float = 1.0, x_min_m: float = 0.0, y_min_m: float = 0.0):
    return OccupancyGrid(x_min_m, y_min_m, resolution_m, np.zeros((num_y, num_x), dtype=bool))


def one_box(center, half_extents, rotation_deg=(0, 0, 0), kind=BUILDINGS):
    return make_box_map([center], [half_extents], [rotation_deg], [kind])


def test_only_boxes_at_a_persons_height_block(subtests):
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
        with subtests.test(bottom_m=bottom_m):
            box_map = one_box((0, 0, (bottom_m + top_m) / 2), (1, 1, (top_m - bottom_m) / 2), kind=kind)
            assert blocks_walking(box_map).tolist() == [blocks]
            assert occupancy(box_map).occupied.any() == blocks


@settings(max_examples=60)
@given(st.floats(-3, 15), st.floats(-3, 15), st.floats(0.05, 6), st.floats(0.05, 6), st.floats(-180, 180))
def test_turned_boxes_fill_the_cells_that_shapely_finds(x, y, half_x, half_y, yaw_deg):
    grid = occupancy(one_box((x, y, 1), (half_x, half_y, 1), (0, yaw_deg, 0)), like=free_grid(12, 12))
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [half_x, half_y]
    turn = rotation_matrix(0.0, np.radians(yaw_deg), 0.0)[:2, :2]
    footprint = shapely.Polygon(corners @ turn.T + [x, y])
    for row, column in itertools.product(range(12), range(12)):
        cell = shapely.box(column, row, column + 1, row + 1)
        # Within twice the tolerance of a mere touch both answers are right.
        if footprint.intersects(cell.buffer(-2e-6, join_style="mitre")):
            assert grid.occupied[row, column]
        elif not footprint.intersects(cell):
            assert not grid.occupied[row, column]


def test_surfaces_near_the_ground_count_and_a_flyover_does_not():
    box_map = make_box_map(
        [[1, 1, -0.1], [3, 1, 6.0], [5, 1, 1.0]], [[1, 1, 0.1]] * 3, np.zeros((3, 3)), [ROADS, ROADS, BUILDINGS]
    )
    np.testing.assert_array_equal(surface(box_map, like=free_grid(6, 2)), grid_of("##.... ##....").occupied)
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
