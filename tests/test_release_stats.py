"""The statistics."""

import numpy as np
import pytest
from commands import invoke
from hypothesis import given
from hypothesis import strategies as st
from specimens_rows import make_row

from cosfly.geometry.trajectory_metrics import derivative_rms, length_m
from cosfly.runtime.json_io import read_json
from release.card.tables import tables_of
from release.columns import POINT, POSE
from release.counting import count_track
from release.reading import TrackRows
from release.record import read_record


def rows_of(positions: np.ndarray, frames: list[int], offsets: np.ndarray | None = None) -> list[dict]:
    """Rows at some frames of a flight, perturbed by known offsets."""
    offsets = np.zeros_like(positions) if offsets is None else offsets

    def at(place: np.ndarray) -> dict[str, float]:
        return dict.fromkeys(POSE, 0.0) | dict(zip(POINT, place.tolist(), strict=True))

    nothing = dict.fromkeys(POINT, 0.0)
    return [
        make_row(i, "aug_001", pose=at(positions[i] + offsets[i]), drone_offset=at(offsets[i]), target_offset=nothing)
        for i in frames
    ]


@given(seed=st.integers(0, 99), num=st.integers(4, 30))
def test_motion_is_that_of_the_plan_whatever_the_perturbation(seed, num):
    rng = np.random.default_rng(seed)
    plan = np.cumsum(rng.normal(0, 1, (num, 3)), axis=0)
    rows = TrackRows("one/Town01/trajectory_1/aug_001", rows_of(plan, list(range(num)), rng.normal(0, 2, (num, 3))))
    flight = count_track(rows, rows)
    assert flight.motion["length_m"] == pytest.approx(length_m(plan), rel=1e-9)
    assert flight.motion["accel_rms_mps2"] == pytest.approx(derivative_rms(plan, 2), rel=1e-6)
    assert flight.motion["jerk_rms_mps3"] == pytest.approx(derivative_rms(plan, 3), rel=1e-6)


def test_the_statistics_are_those_of_the_rows(built, tmp_path):
    result = invoke("release stats", built.parent, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    written = read_json(tmp_path / "stats.json")["tables"]
    tables = {table["key"]: {row[0]: row[1:] for row in table["rows"]} for table in written}
    numbers = read_json(built / "release.json")["numbers"]
    assert tables["release"]["frames"] == [numbers["frames"]]
    assert tables["release"]["trajectories"] == [numbers["trajectories"]]
    assert tables["release"]["frames with a caption"] == [numbers["counts"]["flags"]["has_caption"]]
    for key, name in (("decisions", "decision"), ("verdicts", "verdict"), ("actions", "action")):
        assert {name: row[0] for name, row in tables[key].items() if row[0]} == numbers["counts"][name]
    assert sum(row[1] for row in tables["fovs"].values()) == numbers["frames"]
    assert tables["quality_stats"]["dropped before rendering: smoothness"] == [2]
    assert tables["quality_stats"]["tracks released"] == [numbers["flights"]]
    assert len([spread for spread in tables["text_lengths"].values() if spread[0] is not None]) == 4
    assert "weather" not in tables
    card = (built / "README.md").read_text(encoding="utf-8")
    page = (tmp_path / "stats.html").read_text(encoding="utf-8")
    for table in written:
        assert f'id="{table["key"]}"' in page
        assert table["title"][:20] in card
    for outside in ("<script", 'src="http', "://"):
        assert outside not in page
    assert "<title>one</title>" in page  # the run's name


def test_odd_numbers_of_a_record_make_tables_of_whole_rows(built):
    record = read_record(built / "release.json")
    odd = {key: {"x": 3} for key in ("sky", "confusion", "events", "fov", "step_s", "decision")}
    for counts in ({}, record.numbers.counts | odd):
        numbers = record.numbers.model_copy(update={"counts": counts, "spreads": {}})
        for table in tables_of(record.model_copy(update={"numbers": numbers})):
            assert {len(row) for row in table.rows} == {len(table.head)}, table.key
