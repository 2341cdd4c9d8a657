"""Numbers of a release: which frames are released, what the card says of them."""

import itertools
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimens_rows import make_row
from tables import each

from cosfly.formats.frames import (
    INVALID_DEPTH_M,
    LEGIBLE_CONTRAST,
    LEGIBLE_HEIGHT_PX,
    LEGIBLE_SHARE,
    SKY_DEPTH_M,
)
from cosfly.geometry.axes import BODY_FROM_CAMERA
from release.card.render import render_card
from release.columns import CONTRACT
from release.counting import Sum, action_class, count_track, numbers_of
from release.reading import TrackRows
from release.record import read_record
from release.rules import select_frames

TRACKS = [
    TrackRows(f"one/Town01/trajectory_{k}/{variant}", [make_row(i, variant, f"trajectory_{k}") for i in range(12)])
    for k in (1, 2)
    for variant in ("ORI", "aug_001")
]


def test_a_track_is_as_long_as_it_is_without_its_perturbation():
    tracks = [count_track(rows, rows) for rows in TRACKS]
    numbers = numbers_of(tracks, 12)
    assert (numbers.flights, numbers.trajectories, numbers.frames) == (4, 2, 48)
    length = numbers.spreads["trajectory_length_m"].model_dump()
    assert length == {"count": 2, "mean": 33.0, "std": 0.0, "min": 33.0, "max": 33.0}
    alone = numbers_of(tracks[1::2], 12)  # the perturbed tracks, minus their offsets
    assert alone.spreads["trajectory_length_m"].model_dump() == length
    # What the noise would add: 11 steps of hypot(3, 2) m in place of 3 m.
    places = TRACKS[1].pose[:, :3].tolist()
    assert math.fsum(math.dist(a, b) for a, b in itertools.pairwise(places)) == pytest.approx(11 * math.hypot(3, 2))


@given(st.lists(st.floats(-1e6, 1e6), max_size=30), st.integers(0, 30))
def test_values_added_in_pieces_give_the_same_sum(values, cut):
    assert Sum.all([Sum.of(values[:cut]), Sum.of(values[cut:])]) == Sum.of(values)


@each(("forward", "left", "up", "turn", "expected"), [
    (1.0, 0.2, 0.0, 30.0, "forward"), (-1.0, 0.2, 0.0, 0.0, "backward"), (0.1, -0.4, 0.0, 0.0, "right"),
    (0.1, 0.2, 0.5, 0.0, "up"), (0.1, 0.1, 0.0, 6.0, "turn left"), (0.0, 0.0, 0.0, -6.0, "turn right"),
    (0.1, 0.1, 0.0, 2.0, "hover"),
])  # fmt: skip
def test_the_class_of_an_action(forward, left, up, turn, expected):
    action = {"forward_mps": forward, "left_mps": left, "up_mps": up, "yaw_rate_degps": turn}
    assert action_class(action) == expected


def test_every_snippet_of_the_card_runs(built, tmp_path, monkeypatch):
    record = read_record(built / "release.json")
    datasets = pytest.importorskip("datasets")
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    values: dict = {"FOLDER": str(built)}
    blocks = re.findall(r"```python\n(.*?)```", render_card(record), re.DOTALL)
    assert len(blocks) == 3
    for block in blocks:
        exec(block, values)
    assert set(values["splits"]) == set(record.splits.splits)
    assert values["poses"].num_rows == next(iter(record.splits.splits.values())).frames
    assert values["poses"].column_names == ["sample_id", "pose"]
    window = values["window"](0)
    assert len(window["facts"]["time_s"]) == record.settings.window_frames
    assert window["prompt"]
    assert window["caption"]
    assert len(values["places"]) == min(10, values["poses"].num_rows)


@given(st.integers(0, 3000), st.integers(1, 800), st.integers(1, 12))
def test_so_many_frames_in_order(num_points, num_frames, window):
    chosen = select_frames(num_points, num_frames, "windows", window)
    assert len(chosen) == min(num_points, num_frames)
    assert (np.diff(chosen) >= 1).all()
    assert not len(chosen) or (chosen[0] >= 0 and chosen[-1] < num_points)
    if num_frames >= 2 * max(1, 6 * (window - 1)) and num_points:  # two runs or more
        assert (chosen[0], chosen[-1]) == (0, num_points - 1)


@given(st.integers(300, 3000), st.integers(1, 800), st.integers(1, 12))
def test_runs_and_the_gaps_between_them_differ_by_one_at_most(num_points, num_frames, window):
    chosen = select_frames(num_points, num_frames, "windows", window)
    gaps = np.diff(chosen)[np.diff(chosen) > 1]
    if len(gaps) and num_points - num_frames >= len(gaps) + 1 and gaps.min() > 2:  # no two runs have grown together
        lengths = [len(run) for run in np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)]
        assert max(lengths) - min(lengths) <= 1
        assert gaps.max() - gaps.min() <= 1


@given(st.integers(0, 3000), st.integers(1, 800))
def test_the_stride_is_that_of_the_paper(num_points, num_frames):
    chosen = select_frames(num_points, num_frames, "stride", 5)
    if 1 < num_frames < num_points:
        assert chosen.tolist() == [k * (num_points - 1) // (num_frames - 1) for k in range(num_frames)]


@each(("num_points", "num_frames", "window", "expected"), [
    (10, 4, 1, [0, 3, 6, 9]),
    (5, 3, 1, [0, 2, 4]),
    (7, 1, 1, [3]),
    (0, 3, 5, []),
    (3, 3, 5, [0, 1, 2]),
    (3, 9, 5, [0, 1, 2]),
    (12, 8, 5, [2, 3, 4, 5, 6, 7, 8, 9]),  # one run, in the middle
    (20, 12, 2, [0, 1, 2, 3, 4, 5, 14, 15, 16, 17, 18, 19]),  # two runs of six
    (20, 13, 2, [0, 1, 2, 3, 4, 5, 13, 14, 15, 16, 17, 18, 19]),
])  # fmt: skip
def test_by_hand(num_points, num_frames, window, expected):
    selection = "stride" if window == 1 else "windows"
    assert select_frames(num_points, num_frames, selection, window).tolist() == expected


def test_the_coordinates_state_the_constants_of_the_code():
    assert CONTRACT["body_from_camera"] == BODY_FROM_CAMERA.astype(int).tolist()
    assert f"{SKY_DEPTH_M:g} sky, {INVALID_DEPTH_M:g} invalid" in CONTRACT["depth"]
    limits = (f"{LEGIBLE_HEIGHT_PX:g} px high", f"{LEGIBLE_SHARE:g} of it", f"contrast at least {LEGIBLE_CONTRAST:g}")
    assert all(limit in CONTRACT["legibility"] for limit in limits)
