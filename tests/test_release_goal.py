"""Goals in a release: in its columns, exports and pages; a false or ambiguous one, or another picture, is found."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_cosfly_render import (
    crowded_tree,  # noqa: F401
    needs_gl,
)

from cosfly.formats.frames import FILE_NAMES, PERSON_ID, frame_path
from cosfly.formats.people import People
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.goals import SIDES, SLOTS, words_of
from release.columns import SCALARS, Placement
from release.reading import Row, TrackRows
from release.verify.findings import Findings
from release.verify.scene import check_goal, decode

pytestmark = [needs_gl]


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
