"""cosfly/space/reprojection.py: what two frames say of each other, and what is usual among those of a flight."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosfly.products.frames import grid_rows
from cosfly.products.kinds import KINDS
from cosfly.render.contract import LAYERS
from cosfly.space.reprojection import (
    COLUMNS,
    FLAT,
    LEAST_CONTRAST,
    LEAST_PAIRS,
    View,
    compare_views,
    correlate_colours,
    median_of,
    usual_correlations,
    way_px,
)


def test_frames_are_judged_by_those_of_their_own_zoom():
    """Two levels that agree differently well, one frame of the better one as bad as the other level's: it is unusual, those are not."""
    near, far = np.full(12, 0.80), np.full(12, 0.97)
    far[5] = 0.80
    focal_px = np.concatenate([np.full(12, 2400.0), np.full(12, 640.0)])
    correlations = np.concatenate([near, far])
    usual, drops = usual_correlations(correlations, focal_px, 0.1)
    assert_allclose(usual, [0.80] * 12 + [0.97] * 12)
    assert np.flatnonzero(correlations < usual - drops).tolist() == [17]


def test_unrest_of_a_level_widens_what_is_usual_there():
    correlations = np.array([0.9, 0.94, 0.98, 0.86, 0.82, np.nan])
    usual, drops = usual_correlations(correlations, np.full(6, 640.0), 0.1)
    assert_allclose(usual, 0.9)
    assert_allclose(drops, 8 * 0.04)


def test_too_few_frames_are_no_measure():
    correlations = np.full(LEAST_PAIRS, 0.9)
    correlations[0] = np.nan
    usual, drops = usual_correlations(correlations, np.full(LEAST_PAIRS, 640.0), 0.1)
    assert np.isnan(usual).all()
    assert np.isnan(drops).all()


def test_flat_is_what_renderers_lay_in_layers():
    assert np.flatnonzero(FLAT).tolist() == sorted(KINDS[name] for name in LAYERS)


@pytest.mark.parametrize(
    ("kinds", "is_same"),
    [(("Roads", "Roads"), True), (("Roads", "Sidewalks"), False), (("Buildings", "Buildings"), False)],
)
def test_of_two_roads_in_one_plane_either_may_show(kinds, is_same):
    """One camera, one depth, but another id stands there."""
    views = []
    for number, kind in enumerate(kinds):
        instance = np.zeros((90, 160, 3), np.uint8)
        instance[:] = (KINDS[kind], number, 0)
        views.append(View(np.full((90, 160), 20.0, np.float32), instance, None, np.eye(3), np.zeros(3)))
    found = compare_views(*views, np.array([80.0, 80.0, 80.0, 45.0]))
    assert found.agree > 1000
    assert found.same == (found.agree if is_same else 0)


CAMERA = np.array([80.0, 80.0, 80.0, 45.0])


def building_at(depth_m: float) -> View:
    """A picture full of one building's wall."""
    instance = np.zeros((90, 160, 3), np.uint8)
    instance[:] = (KINDS["Buildings"], 7, 0)
    return View(np.full((90, 160), depth_m, np.float32), instance, None, np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("before_m", "after_m", "is_found"), [(20.0, 23.0, True), (23.0, 20.0, False), (20.0, 20.0, False)]
)
def test_a_thing_that_is_farther_has_moved_and_one_that_is_nearer_may_hide_itself(before_m, after_m, is_found):
    """From behind a corner another wall of the same building stands before the one that was seen."""
    assert (compare_views(building_at(before_m), building_at(after_m), CAMERA).shifted > 0) == is_found


@pytest.mark.parametrize(
    ("kind", "num_renamed", "is_found"), [("Buildings", 40, True), ("Buildings", 2, False), ("Roads", 40, False)]
)
def test_a_thing_under_another_id_is_told_but_for_ground(kind, num_renamed, is_found):
    """A wall at one place, of which in the second picture so many columns have another id."""
    views = [building_at(20.0), building_at(20.0)]
    for view in views:
        view.instance[..., 0] = KINDS[kind]
    views[0].instance[:, :40, 1] = 8
    views[1].instance[:, :num_renamed, 1] = 9
    views[1].instance[:, num_renamed:40, 1] = 8
    assert (compare_views(*views, CAMERA).renamed > 0) == is_found


def test_way_between_two_pictures():
    """A wall at 20 m, 80 px focal length: 0.5 m to the side are 2 px, and a camera that looks at nothing tells none."""
    here = building_at(20.0)
    beside = View(here.depth, here.instance, None, np.eye(3), np.array([0.5, 0.0, 0.0]))
    assert_allclose(way_px(here, beside, CAMERA, CAMERA), 2.0)
    assert_allclose(way_px(here, here, CAMERA, CAMERA), 0.0, atol=1e-12)
    assert way_px(building_at(1000.0), beside, CAMERA, CAMERA) == 0.0


def test_points_come_out_in_a_picture_of_another_size():
    """A wall at 20 m, seen from 20 m to the side by a camera of half as many pixels: what lies beyond its edges is not seen."""
    wall = building_at(20.0)
    halved = View(wall.depth[::2, ::2].copy(), wall.instance[::2, ::2].copy(), None, np.eye(3), np.array([-20.0, 0.0, 0.0]))  # fmt: skip
    found = compare_views(wall, halved, CAMERA, CAMERA / 2.0)
    columns, rows = ((np.arange(num) + 0.5) * size // num for num, size in ((COLUMNS, 160), (len(grid_rows(90)), 90)))
    s, t = (columns + 0.5) / 2.0 + 40.0, (rows + 0.5) / 2.0
    assert found.seen == ((s > 1.5) & (s < 77.5)).sum() * ((t > 1.5) & (t < 42.5)).sum()
    assert (found.agree, found.through, found.same) == (found.seen, 0, found.seen)


@pytest.mark.parametrize("rain", [0.0, 60.0])
def test_colours_of_points_agree_as_numpy_says(rain):
    """A plane with a picture on it and a camera that moves 1 px to the side: by hand from the pictures' rows. Alone or with all else."""
    rng = np.random.default_rng(0)
    whole = rng.integers(0, 200, (90, 161, 3)).astype(np.uint8)
    noisy = whole + rng.uniform(0.0, rain, whole.shape).astype(np.uint8)
    rows, columns = grid_rows(90), ((np.arange(COLUMNS) + 0.5) * 160 / COLUMNS).astype(int)
    depth, nothing = np.full((90, 160), 20.0, np.float32), np.empty((0, 0, 3), np.uint8)
    one = View(depth, nothing, whole[rows, :160], np.eye(3), np.zeros(3))
    other = View(depth, nothing, noisy[rows, 1:], np.eye(3), np.array([0.25, 0.0, 0.0]))
    camera = np.array([80.0, 80.0, 80.0, 45.0])
    found = compare_views(one, other, camera)
    reached = columns[(columns >= 3) & (columns < 158)]
    inside = (rows > 1) & (rows < 87)  # all that is compared lies a pixel and a half inside
    here = whole[rows[inside]][:, reached].reshape(-1, 3).astype(float)
    there = noisy[rows[inside]][:, reached].reshape(-1, 3).astype(float)
    pairs = np.stack([here.mean(axis=1), there.mean(axis=1)])
    assert_allclose(found.correlation, np.corrcoef(pairs)[0, 1], rtol=1e-12)
    assert_allclose(found.shade, np.median(pairs[1] - pairs[0]), atol=1e-12)
    hues = (there - pairs[1][:, None]) - (here - pairs[0][:, None])
    assert_allclose(found.tint, np.median(np.abs(hues).max(axis=1)), atol=1e-12)
    assert correlate_colours(one, other, camera, camera, least_contrast=LEAST_CONTRAST) == found.correlation
    assert np.isnan(correlate_colours(one, other, camera, camera, least_contrast=200.0))


@pytest.mark.parametrize("num", [1, 2, 5, 8])
def test_median(num):
    values = np.random.default_rng(num).normal(size=num).astype(np.float32)
    assert median_of(values) == float(np.median(values))
