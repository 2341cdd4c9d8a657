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
from cosfly.runtime.json_io import read_json
from release.card.render import render_card
from release.columns import CONTRACT, SCALARS, Placement
from release.counting import action_class
from release.reading import Row, TrackRows
from release.record import read_record
from release.rules import select_frames
from release.verify.findings import Findings
from release.verify.scene import check_goal, decode


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


def test_by_hand():
    for num_points, num_frames, window, expected in [
        (7, 1, 1, [3]),
        (12, 4, 1, [0, 3, 7, 11]),
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
