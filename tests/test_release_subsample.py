"""Stride selection: evenly spread, both ends, never padded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from release.subsample import select_frames


@given(st.integers(0, 3000), st.integers(1, 800))
def test_selection_is_even_and_has_both_ends(num_points, num_frames):
    chosen = select_frames(num_points, num_frames)
    assert len(chosen) == min(num_points, num_frames)
    gaps = np.diff(chosen)
    assert (gaps >= 1).all()
    if len(gaps):
        assert gaps.max() - gaps.min() <= 1
    if num_points:
        assert chosen[0] == 0
    if num_points and num_frames > 1:
        assert chosen[-1] == num_points - 1


@given(st.integers(1, 400), st.integers(400, 800))
def test_a_short_flight_is_kept_whole(num_points, num_frames):
    assert select_frames(num_points, num_frames).tolist() == list(range(num_points))


@given(st.integers(2, 500), st.integers(2, 500))
def test_selecting_twice_changes_nothing(num_points, num_frames):
    once = select_frames(num_points, num_frames)
    assert once[select_frames(len(once), num_frames)].tolist() == once.tolist()


@pytest.mark.parametrize(
    ("num_points", "num_frames", "expected"),
    [
        (10, 4, [0, 3, 6, 9]),
        (5, 3, [0, 2, 4]),
        (6, 4, [0, 1, 3, 5]),
        (7, 1, [0]),
        (0, 3, []),
        (3, 3, [0, 1, 2]),
    ],
)
def test_by_hand(num_points, num_frames, expected):
    assert select_frames(num_points, num_frames).tolist() == expected


def test_the_papers_lengths_give_400_frames():
    for num_points in (618, 700, 770):
        chosen = select_frames(num_points, 400)
        assert len(chosen) == 400
        assert set(np.diff(chosen)) == {1, 2}


@pytest.mark.parametrize(("num_points", "num_frames"), [(-1, 3), (5, 0)])
def test_bad_arguments(num_points, num_frames):
    with pytest.raises(ValueError, match="cannot choose"):
        select_frames(num_points, num_frames)
