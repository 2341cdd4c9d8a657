"""The card's numbers: counted row by row, merged, flat in memory; what the card says of them; and `croissant.json`."""

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

from cosfly.runtime.arrays import parse_picture
from release.card.croissant import CROISSANT
from release.card.numbers import RowCounts
from release.card.render import first_split, render_card
from release.columns import POINT
from release.record import read_record
from release.verify.verify import verify

ROWS = [make_row(i, variant, f"trajectory_{k}") for k in (1, 2) for variant in ("ORI", "aug_001") for i in range(12)]


def numbers_of(rows: list[dict], num_frames: int | None = 12):
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
    assert len(window["frames"]) == len(window["facts"]["time_s"]) == record.settings.window_frames
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
        assert (np.asarray(one["frames/image"]) == parse_picture(row["image"]["bytes"], "x")[..., ::-1]).all()
        assert np.load(io.BytesIO(one["frames/depth"])).tobytes() == np.load(io.BytesIO(row["depth"])).tobytes()
        assert (one["frames/pose/x_m"], one["frames/time_s"]) == (row["pose"]["x_m"], row["time_s"])
        text = one["frames/caption_zh_reasoning_trace"]
        assert (text and text.decode()) == row["caption_zh_reasoning_trace"]
        assert (one["frames/caption_window"] or None) == row["caption_window"]
