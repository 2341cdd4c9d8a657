"""The card's numbers: counted row by row, merged, flat in memory; what the card says of them."""

from __future__ import annotations

import itertools
import math
import tracemalloc

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosfly.errors import InputError
from release.card.numbers import COLUMNS, Counted, Sum, count_shard, spread_of
from release.columns import CAPTION_FACTS, CAPTION_FIELDS, POINT, POSE, schema

WORDS = {
    "decision": "hover",
    "label": "ascend",
    "label_from": "flight",
    "verdict": "SOFT_CONFLICT",
    "teacher_kind": "rules",
}


def make_row(i: int, variant: str = "ORI", trajectory: str = "trajectory_1", **change) -> dict:
    """A frame of a drone that flies 3 m a frame to the east, 20 m above a person; the perturbed track 1 m beside, left and right in turn."""
    shift = 0.0 if variant == "ORI" else (-1.0) ** i
    place = {"x_m": 3.0 * i, "y_m": shift, "z_m": 20.0}
    row = dict.fromkeys(COLUMNS) | {
        "sample_id": f"{trajectory}_{variant}_frame_{i:05d}", "run": "one", "town": "Town01", "trajectory": trajectory, "variant": variant,
        "track": "clean" if variant == "ORI" else "perturbed", "style": "follow", "pace": "walk", "frame_index": i, "time_s": 0.5 * i,
        "width_px": 64, "height_px": 36, "fov_deg": 60.0, "pose": dict.fromkeys(POSE, 0.0) | place,
        "drone_offset": dict.fromkeys(POSE, 0.0) | {"y_m": shift}, "target": dict(zip(POINT, (3.0 * i, 0.0, 0.0), strict=True)),
        "visibility": 0.75, "is_perturbed": variant != "ORI", "target_in_view": True, "target_visible": True, "has_caption": i % 2 == 0,
    }  # fmt: skip
    if row["has_caption"]:
        row |= dict.fromkeys((*CAPTION_FACTS, *CAPTION_FIELDS), "word") | WORDS | {"proved_en": 0.5}
    return row | change


ROWS = [make_row(i, variant, f"trajectory_{k}") for k in (1, 2) for variant in ("ORI", "aug_001") for i in range(12)]


def numbers_of(rows: list[dict], num_frames: int | None = 12):
    counted = Counted()
    counted.add(rows)
    return counted.numbers([], num_frames)


# --- numbers ----------------------------------------------------------------------------------------------------------


def test_a_flight_is_as_long_as_it_is_without_its_perturbation():
    numbers = numbers_of(ROWS)
    assert numbers.flights == 4
    assert numbers.flight_length_m.model_dump() == {"count": 4, "mean": 33.0, "std": 0.0, "min": 33.0, "max": 33.0}
    # What the noise would add: 11 steps of hypot(3, 2) m in place of 3 m.
    places = [[row["pose"][axis] for axis in POINT] for row in ROWS if row["variant"] == "aug_001"][:12]
    assert math.fsum(math.dist(a, b) for a, b in itertools.pairwise(places)) == pytest.approx(11 * math.hypot(3, 2))


def test_a_flight_that_does_not_say_how_far_it_was_shifted_has_no_length():
    rows = [
        dict(row, drone_offset=None) if row["variant"] == "aug_001" and row["frame_index"] == 5 else row for row in ROWS
    ]
    numbers = numbers_of(rows)
    assert (numbers.flight_length_m.count, numbers.flight_length_m.mean) == (2, 33.0)
    assert numbers.flight_duration_s.count == 4


@given(cuts=st.lists(st.integers(0, len(ROWS)), max_size=6), groups=st.integers(1, 20))
def test_rows_counted_in_pieces_give_the_same_numbers(cuts, groups):
    ends = [0, *sorted(cuts), len(ROWS)]
    total = Counted()
    for begin, end in itertools.pairwise(ends):
        part = Counted()
        for first in range(begin, end, groups):
            part.add(ROWS[first : min(first + groups, end)])
        total.merge(part)
    assert total.numbers([], 12) == numbers_of(ROWS)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
def test_sums_against_numpy(values):
    spread = spread_of(values)
    assert spread.count == len(values)
    for found, expected in (
        (spread.mean, np.mean(values)),
        (spread.std, np.std(values)),
        (spread.min, min(values)),
        (spread.max, max(values)),
    ):
        assert found == pytest.approx(expected, abs=2e-4)
    assert spread_of(reversed(values)) == spread


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_a_number_that_is_none_is_an_error(value):
    with pytest.raises(InputError, match="not a number"):
        Sum().add(value)
    with pytest.raises(InputError):
        numbers_of([make_row(0, visibility=value)])


def test_nothing_gives_no_numbers():
    numbers = numbers_of([], None)
    assert numbers.frames == numbers.flights == numbers.coverage.frames == 0
    assert numbers.flight_length_m.mean is numbers.captions.mean_proved["proved_en"] is None


@pytest.mark.parametrize(
    ("column", "value"),
    [("fov_deg", None), ("town", None), ("pose", None), ("pose", {"x_m": None}), ("target", {"y_m": None})],
)
def test_a_value_that_must_be_there_is_asked_for(tmp_path, column, value):
    rows = [make_row(i) for i in range(4)]
    rows[2][column] = value if value is None else rows[2][column] | value
    pa_rows = pa.Table.from_pylist(rows, schema=pa.schema([schema(()).field(name) for name in COLUMNS]))
    (tmp_path / "data").mkdir()
    pq.write_table(pa_rows, tmp_path / "data/one.parquet")
    with pytest.raises(InputError, match="a value is missing") as error:
        count_shard(tmp_path / "data/one.parquet")
    assert column in str(error.value.where)


def test_memory_does_not_grow_with_the_number_of_frames():
    """A row group at a time of two flights that never end."""

    def peak(num_groups: int) -> int:
        tracemalloc.start()
        counted = Counted()
        for k in range(num_groups):
            counted.add([make_row(i) for i in range(40 * k, 40 * (k + 1))])
        counted.numbers([], None)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(2)  # what is imported and cached
    assert peak(60) < peak(6) + 100_000
