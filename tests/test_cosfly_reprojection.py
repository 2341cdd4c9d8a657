"""cosfly/reprojection.py: what two frames say of each other, and what is usual among those of a flight."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosfly.products.kinds import KINDS
from cosfly.render.contract import LAYERS
from cosfly.reprojection import FLAT, LEAST_PAIRS, View, compare_views, usual_correlations


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
