"""Which frames are released: runs that are spread evenly, whole windows, never padded."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tables import each

from release.rules import select_frames

WINDOW = 5


@given(st.integers(0, 3000), st.integers(1, 800), st.integers(1, 12))
def test_so_many_frames_in_order(num_points, num_frames, window):
    chosen = select_frames(num_points, num_frames, window)
    assert len(chosen) == min(num_points, num_frames)
    assert (np.diff(chosen) >= 1).all()
    assert not len(chosen) or (chosen[0] >= 0 and chosen[-1] < num_points)
    if num_frames >= 2 * max(1, 6 * (window - 1)) and num_points:  # two runs or more
        assert (chosen[0], chosen[-1]) == (0, num_points - 1)


@given(st.integers(300, 3000), st.integers(1, 800), st.integers(1, 12))
def test_runs_and_the_gaps_between_them_differ_by_one_at_most(num_points, num_frames, window):
    chosen = select_frames(num_points, num_frames, window)
    gaps = np.diff(chosen)[np.diff(chosen) > 1]
    if len(gaps) and num_points - num_frames >= len(gaps) + 1 and gaps.min() > 2:  # no two runs have grown together
        lengths = [len(run) for run in np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)]
        assert max(lengths) - min(lengths) <= 1
        assert gaps.max() - gaps.min() <= 1


@given(st.integers(0, 3000), st.integers(1, 800))
def test_a_window_of_one_frame_gives_the_even_stride_of_the_paper(num_points, num_frames):
    chosen = select_frames(num_points, num_frames, 1)
    if 1 < num_frames < num_points:
        assert chosen.tolist() == [k * (num_points - 1) // (num_frames - 1) for k in range(num_frames)]


@each(("num_points", "num_frames", "window", "expected"), [
    (10, 4, 1, [0, 3, 6, 9]),
    (5, 3, 1, [0, 2, 4]),
    (7, 1, 1, [3]),
    (0, 3, 5, []),
    (3, 3, 5, [0, 1, 2]),
    (12, 8, 5, [2, 3, 4, 5, 6, 7, 8, 9]),  # one run, in the middle
    (20, 12, 2, [0, 1, 2, 3, 4, 5, 14, 15, 16, 17, 18, 19]),  # two runs of six
    (20, 13, 2, [0, 1, 2, 3, 4, 5, 13, 14, 15, 16, 17, 18, 19]),
])  # fmt: skip
def test_by_hand(num_points, num_frames, window, expected):
    assert select_frames(num_points, num_frames, window).tolist() == expected


@given(st.integers(1, 400), st.integers(400, 800))
def test_a_short_flight_is_kept_whole(num_points, num_frames):
    assert select_frames(num_points, num_frames, WINDOW).tolist() == list(range(num_points))
    assert select_frames(num_points, None, WINDOW).tolist() == list(range(num_points))
