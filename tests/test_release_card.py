"""Numbers and goals of a release: which frames are released, what card and `release stats` say, false goals."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import obeyed
from hypothesis import given
from hypothesis import strategies as st
from test_cosfly_render import crowded_tree  # noqa: F401

from cosfly.formats.frames import (
    FILE_NAMES,
    INVALID_DEPTH_M,
    LEGIBLE_CONTRAST,
    LEGIBLE_HEIGHT_PX,
    LEGIBLE_SHARE,
    PERSON_ID,
    SKY_DEPTH_M,
    frame_path,
)
from cosfly.formats.people import People
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import BODY_FROM_CAMERA
from cosfly.geometry.goals import SIDES, SLOTS, words_of
from cosfly.geometry.trajectory_metrics import derivative_rms, length_m
from cosfly.runtime.json_io import read_json
from release.card.render import render_card
from release.card.tables import tables_of
from release.columns import CAPTION_FIELDS, CONTRACT, COUNTED, POINT, POSE, SCALAR_NAMES, SCALARS, Placement
from release.counting import Sum, action_class, count_track, numbers_of
from release.reading import Row, TrackRows
from release.record import read_record
from release.rules import select_frames
from release.verify.findings import Findings
from release.verify.scene import check_goal, decode

WORDS = {
    "decision": "hover", "label": "ascend", "label_from": "flight", "verdict": "SOFT_CONFLICT", "teacher_kind": "rules",
}  # fmt: skip


def make_row(i: int, variant: str = "ORI", trajectory: str = "trajectory_1", **change) -> dict:
    """A frame of a drone that flies 3 m a frame to the east, 20 m above a person; the perturbed track 1 m beside."""
    shift = 0.0 if variant == "ORI" else (-1.0) ** i
    place = {"x_m": 3.0 * i, "y_m": shift, "z_m": 20.0}
    row = dict.fromkeys(SCALAR_NAMES) | {
        "sample_id": f"{trajectory}_{variant}_frame_{i:05d}", "run": "one", "town": "Town01",
        "trajectory": trajectory, "variant": variant,
        "track": "clean" if variant == "ORI" else "perturbed", "style": "follow", "pace": "walk",
        "frame_index": i, "time_s": 0.5 * i,
        "width_px": 64, "height_px": 36, "fov_deg": 60.0, "pose": dict.fromkeys(POSE, 0.0) | place,
        "drone_offset": dict.fromkeys(POSE, 0.0) | {"y_m": shift},
        "target": dict(zip(POINT, (3.0 * i, 0.0, 0.0), strict=True)),
        "visibility": 0.75, "is_perturbed": variant != "ORI", "target_in_view": True,
        "target_visible": True, "has_caption": i % 2 == 0,
    }  # fmt: skip
    if row["has_caption"]:
        row |= dict.fromkeys((*COUNTED, *CAPTION_FIELDS), "word") | WORDS | {"values_filled_en": 2}
    return row | change


TRACKS = [
    TrackRows(f"one/Town01/trajectory_{k}/{variant}", [make_row(i, variant, f"trajectory_{k}") for i in range(12)])
    for k in (1, 2)
    for variant in ("ORI", "aug_001")
]


def test_a_trajectory_counts_once_and_is_as_long_as_it_is_without_perturbation():
    tracks = [count_track(rows, rows) for rows in TRACKS]
    numbers = numbers_of(tracks, 12)
    assert (numbers.flights, numbers.trajectories, numbers.frames) == (4, 2, 48)
    length = numbers.spreads["trajectory_length_m"].model_dump()
    assert length == {"count": 2, "mean": 33.0, "std": 0.0, "min": 33.0, "max": 33.0}


@given(st.lists(st.floats(-1e6, 1e6), max_size=30), st.integers(0, 30))
def test_values_added_in_pieces_give_the_same_sum(values, cut):
    assert Sum.all([Sum.of(values[:cut]), Sum.of(values[cut:])]) == Sum.of(values)


def test_the_class_of_an_action():
    for forward, left, up, turn, expected in [
        (1.0, 0.2, 0.0, 30.0, "forward"), (-1.0, 0.2, 0.0, 0.0, "backward"), (0.1, -0.4, 0.0, 0.0, "right"),
        (0.1, 0.2, 0.5, 0.0, "up"), (0.1, 0.1, 0.0, 6.0, "turn left"), (0.0, 0.0, 0.0, -6.0, "turn right"),
        (0.1, 0.1, 0.0, 2.0, "hover"),
    ]:  # fmt: skip
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


def test_by_hand():
    for num_points, num_frames, window, expected in [
        (7, 1, 1, [3]),
        (0, 3, 5, []),
        (3, 3, 5, [0, 1, 2]),
        (3, 9, 5, [0, 1, 2]),
        (12, 8, 5, [2, 3, 4, 5, 6, 7, 8, 9]),  # one run, in the middle
        (20, 12, 2, [0, 1, 2, 3, 4, 5, 14, 15, 16, 17, 18, 19]),  # two runs of six
        (20, 13, 2, [0, 1, 2, 3, 4, 5, 13, 14, 15, 16, 17, 18, 19]),
    ]:  # fmt: skip
        selection = "stride" if window == 1 else "windows"
        assert select_frames(num_points, num_frames, selection, window).tolist() == expected


def test_the_coordinates_state_the_constants_of_the_code():
    assert CONTRACT["body_from_camera"] == BODY_FROM_CAMERA.astype(int).tolist()
    assert f"{SKY_DEPTH_M:g} sky, {INVALID_DEPTH_M:g} invalid" in CONTRACT["depth"]
    limits = (f"{LEGIBLE_HEIGHT_PX:g} px high", f"{LEGIBLE_SHARE:g} of it", f"contrast at least {LEGIBLE_CONTRAST:g}")
    assert all(limit in CONTRACT["legibility"] for limit in limits)


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
    obeyed("release stats", built.parent, "--out", tmp_path)
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


@pytest.fixture(scope="module")
def flights(crowded_tree) -> list[tuple[TrackRows, Path]]:  # noqa: F811
    found = []
    for folder in find_tracks(crowded_tree):
        flight, placement = read_track(folder), Placement(walk="w", split="train")
        rows = [{one.name: one.cell(flight, i, None, placement) for one in SCALARS} for i in range(len(flight))]
        found.append((TrackRows("a/b/c/d", rows), folder))
    return found


def told(rows: list[Row], folder: Path) -> list[str]:
    flight, findings = TrackRows("a/b/c/d", rows), Findings()
    for i in range(len(rows)):
        files = {file: frame_path(folder / f"frames_playback/frame_{i:05d}", name) for file, name in FILE_NAMES.items()}
        pictures = {file: path.read_bytes() for file, path in files.items()}
        decoded = decode(flight, i, pictures, findings)
        assert decoded is not None
        check_goal(flight, i, decoded, pictures["rgb"], findings)
    return [f"{kind.where}: {kind.got}" for kind in findings.issues]


def changed(flight: TrackRows, says: list[str] | None = None, people: People | None = None, **values) -> list[Row]:
    says, people = says or list(flight.goal.says), people or flight.people
    words = {f"goal_{language}": text for language, text in words_of(says, people.target).items()}
    new = {**words, "goal_says": says, "people": json.dumps(asdict(people))} | values
    return [{**row, **new} for row in flight.rows]


def test_honest_goals_are_true(flights):
    assert all(not told(list(flight.rows), folder) for flight, folder in flights)
    assert all(row["goal_en"] and row["goal_zh"] for flight, _ in flights for row in flight.rows)
    pictures = [row["target_picture"] for flight, _ in flights for row in flight.rows if row["target_picture"]]
    assert len(pictures) == len(flights)
    assert all(cv2.imdecode(np.frombuffer(one["bytes"], np.uint8), 1) is not None for one in pictures)


def test_a_goal_that_is_true_of_others_is_found(flights):
    """Each goal with one thing less: as few are said as will do, so it means somebody else too."""
    num_ambiguous = 0
    for flight, folder in flights:
        garments = [one for one in flight.goal.says if one in SLOTS]
        for left_out in garments if len(garments) > 1 else []:
            lies = told(changed(flight, [one for one in flight.goal.says if one != left_out]), folder)
            num_ambiguous += any("goal_says: true of" in lie for lie in lies)
    assert num_ambiguous >= 2


def test_lies_about_goals_are_found(flights):
    # A goal without positions: nothing but looks tells the people apart.
    flight, folder = next(pair for pair in flights if not {*pair[0].goal.says} & {*SIDES})
    other = next(row for one, _ in flights if one is not flight for row in one.rows if row["target_picture"])
    target, others = flight.people.target, flight.people.others
    alike = next(one for one in others.values() if len(target.differences(one)) == 1)
    lies = {
        "goal_en": [{**row, "goal_en": "the person in the red hat"} for row in flight.rows],
        "goal_zh is another": [{**row, "goal_zh": flight.rows[0]["goal_zh"] + "人"} for row in flight.rows],
        "of nobody": changed(flight, people=replace(flight.people, others={**others, PERSON_ID: alike})),
        "who looks so too": changed(flight, people=replace(flight.people, others=dict.fromkeys(others, target))),
        "who is not on record": changed(flight, people=replace(flight.people, others={})),
        "no people": changed(flight, people=None) and [{**row, "people": None} for row in flight.rows],
        "another picture": [
            {**row, "target_picture": row["target_picture"] and other["target_picture"]} for row in flight.rows
        ],
        "no picture": [{**row, "target_picture": row["target_picture"] and {"bytes": b"x"}} for row in flight.rows],
    }
    assert {name: bool(told(rows, folder)) for name, rows in lies.items()} == dict.fromkeys(lies, True)
