"""cosfly/reprojection.py: what is usual among the frames of a flight."""

import numpy as np
from numpy.testing import assert_allclose

from cosfly.reprojection import LEAST_PAIRS, usual_correlations


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
