"""Numbers of a release: which frames are released, what the card says of them, and `croissant.json`."""

import io
import itertools
import math
import re
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimens_release import rows_by_id
from specimens_rows import make_row
from tables import each

from cosfly.runtime.png import colours_of
from release.card.croissant import CROISSANT
from release.card.numbers import RowCounts
from release.card.render import first_split, render_card
from release.columns import POINT
from release.record import read_record
from release.rules import select_frames
from release.verify.verify import verify

ROWS = [make_row(i, variant, f"trajectory_{k}") for k in (1, 2) for variant in ("ORI", "aug_001") for i in range(12)]


def numbers_of(rows: list[dict], num_frames: int = 12):
    counted = RowCounts()
    counted.add(rows)
    return counted.numbers([], num_frames)


def test_a_flight_is_as_long_as_it_is_without_its_perturbation():
    numbers = numbers_of(ROWS)
    assert numbers.flights == 4
    assert numbers.flight_length_m.model_dump() == {"count": 4, "mean": 33.0, "std": 0.0, "min": 33.0, "max": 33.0}
    # What the noise would add: 11 steps of hypot(3, 2) m in place of 3 m.
    places = [[row["pose"][axis] for axis in POINT] for row in ROWS if row["variant"] == "aug_001"][:12]
    assert math.fsum(math.dist(a, b) for a, b in itertools.pairwise(places)) == pytest.approx(11 * math.hypot(3, 2))


@given(cuts=st.lists(st.integers(0, len(ROWS)), max_size=6), groups=st.integers(1, 20))
def test_rows_counted_in_pieces_give_the_same_numbers(cuts, groups):
    ends = [0, *sorted(cuts), len(ROWS)]
    total = RowCounts()
    for begin, end in itertools.pairwise(ends):
        for first in range(begin, end, groups):
            total.add(ROWS[first : min(first + groups, end)])
    assert total.numbers([], 12) == numbers_of(ROWS)


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
    assert values["poses"].num_rows == record.splits.splits[first_split(record)].frames
    assert values["poses"].column_names == ["sample_id", "pose"]
    window = values["window"](0)
    assert len(window["facts"]["time_s"]) == record.settings.window_frames
    assert window["prompt"]
    assert window["caption"]
    assert len(values["places"]) == min(10, values["poses"].num_rows)


def test_a_changed_word_of_it_is_found(dataset, tmp_path):
    broken = shutil.copytree(dataset, tmp_path / "broken")
    text = (broken / CROISSANT).read_text()
    (broken / CROISSANT).write_text(text.replace("cc-by-4.0", "cc0-1.0"))
    assert not verify(broken).is_ok


@pytest.mark.slow
def test_mlcroissant_loads_every_row(dataset):
    mlcroissant = pytest.importorskip("mlcroissant", reason="extra dev")
    rows = rows_by_id(dataset)
    found = list(mlcroissant.Dataset(jsonld=str(dataset / CROISSANT)).records("frames"))
    assert {row["frames/sample_id"].decode() for row in found} == rows.keys()
    assert {row["frames/split"].decode() for row in found} == {"train", "validation"}
    for one in found[::9]:
        row = rows[one["frames/sample_id"].decode()]
        assert (np.asarray(one["frames/image"]) == colours_of(row["image"]["bytes"], "x")).all()
        assert np.load(io.BytesIO(one["frames/depth"])).tobytes() == np.load(io.BytesIO(row["depth"])).tobytes()
        assert (one["frames/pose/x_m"], one["frames/time_s"]) == (row["pose"]["x_m"], row["time_s"])
        text = one["frames/caption_zh_reasoning_trace"]
        assert (text and text.decode()) == row["caption_zh_reasoning_trace"]
        assert (one["frames/caption_window"] or None) == row["caption_window"]


WINDOW = 5


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
    (12, 8, 5, [2, 3, 4, 5, 6, 7, 8, 9]),  # one run, in the middle
    (20, 12, 2, [0, 1, 2, 3, 4, 5, 14, 15, 16, 17, 18, 19]),  # two runs of six
    (20, 13, 2, [0, 1, 2, 3, 4, 5, 13, 14, 15, 16, 17, 18, 19]),
])  # fmt: skip
def test_by_hand(num_points, num_frames, window, expected):
    selection = "stride" if window == 1 else "windows"
    assert select_frames(num_points, num_frames, selection, window).tolist() == expected


@given(st.integers(1, 400), st.integers(400, 800))
def test_a_short_flight_is_kept_whole(num_points, num_frames):
    assert select_frames(num_points, num_frames, "windows", WINDOW).tolist() == list(range(num_points))
    assert select_frames(num_points, 1, "all", WINDOW).tolist() == list(range(num_points))
