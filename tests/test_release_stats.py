"""The statistics: figures against those of whole flights, tables against rows counted by hand, pages that show no
foreign text as markup."""

from __future__ import annotations

import gc
import math
import tracemalloc

import numpy as np
import pytest
from commands import invoke
from hypothesis import given
from hypothesis import strategies as st
from specimens_release import build, make_inputs
from specimens_rows import make_row

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.formats.inspection import read_inspection, write_inspection
from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import box_iou
from cosfly.geometry.trajectory_metrics import accel_rms, jerk_rms, length_m
from cosfly.runtime.json_io import read_json
from release.columns import POINT, POSE
from release.record import read_record
from release.stats.counting import Counts
from release.stats.pixels import BIN_M, Pixels
from release.stats.stats import run
from release.stats.tables import Stats


def counted(rows: list[dict]) -> Counts:
    counts = Counts()
    for row in rows:
        counts.add(row)
    return counts


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
    (flight,) = counted(rows_of(plan, list(range(num)), rng.normal(0, 2, (num, 3)))).flights.values()
    assert flight.path_m == pytest.approx(length_m(plan), rel=1e-9)
    assert flight.accel_rms_mps2 == pytest.approx(accel_rms(plan), rel=1e-6)
    assert flight.jerk_rms_mps3 == pytest.approx(jerk_rms(plan), rel=1e-6)


def test_differences_are_taken_over_frames_in_a_row_alone():
    """Two runs of a straight flight with a jump between: no acceleration, but the way across counts."""
    plan = np.array([[i * 1.0, 0.0, 0.0] for i in range(20)])
    plan[10:, 1] += 50.0
    (flight,) = counted(rows_of(plan, [0, 1, 2, 3, 4, 15, 16, 17, 18])).flights.values()
    assert flight.accel_rms_mps2 == pytest.approx(0.0, abs=1e-9)
    assert flight.jerk_rms_mps3 == pytest.approx(0.0, abs=1e-9)
    assert flight.path_m == pytest.approx(4 + math.hypot(11, 50) + 3)
    (strided,) = counted(rows_of(plan, list(range(0, 20, 2)))).flights.values()
    assert strided.accel_rms_mps2 is strided.jerk_rms_mps3 is None  # nothing to say, rather than something wrong


@pytest.mark.parametrize(
    ("a", "b", "share"),
    [
        ((0, 0, 2, 2), (0, 0, 2, 2), 1.0),
        ((0, 0, 2, 2), (1, 0, 3, 2), 1 / 3),
        ((0, 0, 1, 1), (2, 2, 3, 3), 0.0),
        ((0, 0, 0, 0), (0, 0, 0, 0), 0.0),
        ((2, 2, 0, 0), (0, 0, 2, 2), 0.0),
    ],
)
def test_overlap(a, b, share):
    assert box_iou(np.array(a), np.array(b)) == pytest.approx(share)
    assert box_iou(np.array(b), np.array(a)) == pytest.approx(share)


def test_captions_are_counted_by_what_they_say():
    rows = [
        make_row(0),
        make_row(1),
        make_row(2, label=None, repair_strategy="cascade", caption_en_reasoning_trace="x" * 60),
    ]
    counts = counted(rows)
    assert counts.decisions == {"hover": 2}
    assert counts.labels == {"ascend": 1, "none": 1}
    assert counts.confusion == {("ascend", "hover"): 1, ("none", "hover"): 1}
    assert counts.repairs["cascade"] == 1
    assert counts.lengths["en", "reasoning_trace"].spread().max == 60.0


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_depth_percentiles_against_numpy():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 90, (50, 80)).astype(np.float32)
    depth[:5], depth[5] = SKY_DEPTH_M, INVALID_DEPTH_M
    pixels = Pixels()
    pixels.add_depth(depth)
    assert (pixels.sky, pixels.invalid) == (5 * 80, 80)
    for share, found in pixels.percentiles_m():
        assert found == pytest.approx(np.quantile(depth[6:], share), abs=2 * BIN_M)
    assert Pixels().percentiles_m() == []


def test_kinds_are_shares_of_pixels_and_of_frames():
    pixels = Pixels(frames=2)
    for row in ((1, 1, 1, 3), (1, 1, 1, 1)):
        pixels.add_kinds(np.array([row], dtype=np.uint8))
    assert pixels.by_kind() == [("Roads", 0.875, 1.0), ("Buildings", 0.125, 0.5)]
    assert KINDS["Roads"] == 1


# --- pages ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_is_kept_a_frame():
    """Counts of ten times the frames hold as much memory."""

    def held(num: int) -> int:
        gc.collect()
        tracemalloc.start()
        counts = Counts()
        for i in range(num):
            counts.add(make_row(i))
        gc.collect()
        size = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return size

    held(200)
    assert held(4000) < held(400) + 10_000


# --- a whole release --------------------------------------------------------------------------------------------------


def test_a_release_is_counted_again(built, tmp_path):
    result = invoke("release stats", built.parent, "--out", tmp_path, "--pixels 5")
    assert result.exit_code == 0, result.output
    written = Stats.model_validate({k: v for k, v in read_json(tmp_path / "stats.json").items() if k != "coverage"})
    tables = {table.key: {row[0]: row[1:] for row in table.rows} for table in written.tables}
    numbers = read_json(built / "release.json")["numbers"]
    assert len(tables) == len(written.tables)
    assert tables["release"]["frames"] == [numbers["frames"]]
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
    assert tables["quality_stats"]["flights released"] == [numbers["flights"]]
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
        for text in (f"<b>{numbers['frames']:,}</b>frames", "are proved", "<img", 'id="release"', "<h2>Rules")
    ]
    assert places == sorted(places)  # how much, how good, a picture, tables, formulas


def test_five_ray_visibility_is_what_the_inspection_measured(tmp_path):
    inputs = make_inputs(tmp_path / "inputs")
    inspected = read_inspection(inputs / "inspect.json")
    values = {}
    for k, flight in enumerate(inspected.flights):
        values[flight.folder] = flight.metrics["five_ray_mean"] = 0.3 + 0.1 * k
    write_inspection(inputs / "inspect.json", inspected)
    built = build(inputs, tmp_path / "release")
    record = read_record(built / "release.json")
    for flight in record.flights:
        assert flight.five_ray_mean == values[flight.flight.partition("/")[2]]
    written = read_json(run(built, tmp_path / "stats", pixels=0).with_name("stats.json"))
    rows = {row[0]: row[1:] for table in written["tables"] if table["key"] == "dist_stats" for row in table["rows"]}
    clean = [flight.five_ray_mean for flight in record.flights if flight.flight.endswith("ORI")]
    assert rows["five-ray visibility, as inspected"][0] == pytest.approx(np.mean(clean), abs=1e-4)
    assert rows["five-ray visibility, as inspected"][-1] == len(clean)
    assert "five-ray visibility of the planner" not in {one["what"] for one in written["absent"]}
