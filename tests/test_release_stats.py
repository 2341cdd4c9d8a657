"""The statistics."""

import numpy as np
import pytest
from commands import invoke
from hypothesis import given
from hypothesis import strategies as st
from specimens_rows import make_row

from cosfly.geometry.trajectory_metrics import derivative_rms, length_m
from cosfly.runtime.json_io import read_json
from release.columns import POINT, POSE
from release.counting import count_track
from release.flight_rows import FlightRows
from release.stats.tables import Stats


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
    rows = FlightRows("one/Town01/trajectory_1/aug_001", rows_of(plan, list(range(num)), rng.normal(0, 2, (num, 3))))
    flight = count_track(rows, rows)
    assert flight.length_m == pytest.approx(length_m(plan), rel=1e-9)
    assert flight.accel_rms_mps2 == pytest.approx(derivative_rms(plan, 2), rel=1e-6)
    assert flight.jerk_rms_mps3 == pytest.approx(derivative_rms(plan, 3), rel=1e-6)


def test_a_release_is_counted_again(built, tmp_path):
    result = invoke("release stats", built.parent, "--out", tmp_path, "--pixels 5")
    assert result.exit_code == 0, result.output
    written = Stats.model_validate({k: v for k, v in read_json(tmp_path / "stats.json").items() if k != "coverage"})
    tables = {table.key: {row[0]: row[1:] for row in table.rows} for table in written.tables}
    numbers = read_json(built / "release.json")["numbers"]
    assert (len(tables), tables["release"]["frames"]) == (len(written.tables), [numbers["frames"]])
    assert tables["release"]["trajectories"] == [numbers["trajectories"]]
    assert tables["release"]["captions"] == [numbers["captions"]["frames_with"]]
    assert {name: row[0] for name, row in tables["decisions"].items() if row[0]} == numbers["captions"]["frames_by"][
        "decision"
    ]
    assert {name: row[0] for name, row in tables["verdicts"].items() if row[0]} == numbers["captions"]["frames_by"][
        "verdict"
    ]
    assert sum(row[1] for row in tables["fovs"].values()) == numbers["frames"]
    assert tables["quality_stats"]["dropped before rendering: smoothness"] == [2]
    assert tables["quality_stats"]["tracks released"] == [numbers["flights"]]
    lengths = [flight for flight in tables["text_lengths"].values() if flight[0] is not None]
    assert len(lengths) == 4
    assert "weather and time of day, 15 x 4" in {one.what for one in written.absent}
    assert "weather" not in tables
    assert {"depth", "semantics"} <= tables.keys()
    text = (tmp_path / "stats.md").read_text(encoding="utf-8")
    page = (tmp_path / "stats.html").read_text(encoding="utf-8")
    for table in written.tables:
        assert f'id="{table.key}"' in page
        assert table.title.split("|")[0][:20] in text.replace("\\", "")
    for outside in ("<script", 'src="http', "://"):
        assert outside not in page
    assert "<title>one</title>" in page  # the run's name
    places = [
        page.index(text)
        for text in (
            f"<b>{numbers['frames']:,}</b>frames",
            "are filled",
            "<img",
            'id="release"',
            "<h2>Rules",
        )
    ]
    assert places == sorted(places)  # how much, how good, a picture, tables, formulas
