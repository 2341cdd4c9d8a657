"""Trees of somebody else: some flights, one track, flights behind links, several trees; to captions and a release."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from specimens_foreign import write_foreign_tree
from typer.testing import CliRunner

from caption.run.released import read_released
from caption.run.stage import run as caption_run
from caption.schema import CaptionConfig
from cosfly.cli import app
from cosfly.errors import InputError
from cosfly.products.captions import read_captions
from cosfly.products.flights import find_flights, read_twin, track_of
from cosfly.products.inspection import read_inspection
from cosfly.products.places import FlightChoice, place_of
from cosfly.products.playback import read_flight
from cosfly.work.provenance import fingerprint
from distill.prepare import stage as prepare
from distill.prepare.sources import RunSource as Prepared
from distill.prepare.stage import PrepareConfig
from distill.schema import open_split
from release.package.sources import NOT_CHOSEN
from release.record import read_record
from release.verify.verify import verify

TOWNS, NAMES = ("Town01", "Town02_Opt"), ("trajectory_1777083733", "trajectory_1777090000")


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return write_foreign_tree(
        tmp_path_factory.mktemp("public") / "tree", towns=TOWNS, trajectories=NAMES, num_points=14
    )


def names(tree: Path, **choice) -> list[str]:
    return [folder.relative_to(tree).as_posix() for folder in find_flights(tree, FlightChoice(**choice))]


def call(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.exception or result.output
    return result.output


# --- which flights ----------------------------------------------------------------------------------------------------


def test_patterns_are_of_folders_and_those_above_them(tree):
    for choice, count in (
        ({}, 8),
        ({"match": ("Town01",)}, 4),
        ({"match": ("Town0[12]*/trajectory_177708*",)}, 4),
        ({"match": ("*/ORI",)}, 4),
        ({"match": ("Town01/trajectory_1777083733/ORI", "Town02_Opt/trajectory_1777090000/")}, 3),
        ({"tracks": ("clean",)}, 4),
        ({"match": ("Town02*",), "tracks": ("perturbed",)}, 2),
    ):
        found = names(tree, **choice)
        assert len(found) == count
        assert set(found) <= set(names(tree))
    words = r"no flight of the tree has such a name; got Town9; .*Town01/trajectory_1777083733/ORI"
    with pytest.raises(InputError, match=words):
        names(tree, match=("Town9",))
    with pytest.raises(InputError, match="no flight of the tree is of this track; got perturbed"):
        names(tree, match=("*/ORI",), tracks=("perturbed",))


def test_a_track_is_told_by_the_file_where_the_folder_is_called_otherwise(tmp_path):
    odd = write_foreign_tree(tmp_path / "tree", variants=("first", "second"), num_points=4)
    assert {folder.name: track_of(folder) for folder in find_flights(odd)} == {"first": "clean", "second": "perturbed"}
    (next(odd.rglob("second")) / "trajectory.json").write_text("{")
    assert names(odd, tracks=("clean",)) == ["Town01/trajectory_1777083733/first"]


# --- links ------------------------------------------------------------------------------------------------------------


def test_linked_flights_are_those_that_they_lead_to_under_the_names_of_the_tree(tree, tmp_path):
    mine = tmp_path / "mine"
    shutil.copytree(tree, tmp_path / "theirs")
    (mine / "Town07").mkdir(parents=True)
    (mine / "Town07/trajectory_5").symlink_to(tmp_path / "theirs/Town01" / NAMES[0])
    (mine / "Town02_Opt").symlink_to(tmp_path / "theirs/Town02_Opt")
    assert len(names(mine)) == 6
    flight = read_flight(mine / "Town07/trajectory_5/aug_001")
    assert (flight.town, flight.trajectory, flight.variant) == ("Town07", "trajectory_5", "aug_001")
    assert place_of(flight.folder).town == "Town07"
    twin = read_twin(flight)
    assert twin is not None
    assert twin.trajectory == "trajectory_5"
    before = fingerprint(mine)
    (tmp_path / "theirs/Town01" / NAMES[0] / "ORI/trajectory.json").write_text("{}")
    assert fingerprint(mine) != before  # what is behind a link is part of the tree


# --- all the way ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_some_flights_of_a_public_tree_behind_a_link_reach_a_release_with_their_windows(tree, tmp_path):
    tree = shutil.copytree(tree, tmp_path / "mine")
    shutil.move(tree / "Town01" / NAMES[0], tmp_path / "disk")
    (tree / "Town01" / NAMES[0]).symlink_to(tmp_path / "disk")
    chosen = ("--flights", "Town01", "--flights", f"Town02_Opt/{NAMES[1]}")
    call("inspect", "--data", tree, "--out", tmp_path / "inspect", *chosen, "--set", "workers=1")
    assert len(read_inspection(tmp_path / "inspect/inspect.json").flights) == 6
    call("caption", "--data", tree, "--out", tmp_path / "caption", *chosen, "--tracks", "clean", "--set", "workers=1")
    captions = list(read_captions(tmp_path / "caption/captions.jsonl"))
    assert {(one.town, one.trajectory, one.variant) for one in captions} == {
        ("Town01", NAMES[0], "ORI"), ("Town01", NAMES[1], "ORI"), ("Town02_Opt", NAMES[1], "ORI"),
    }  # fmt: skip
    record = json.loads((tmp_path / "caption/stage.json").read_text())
    assert record["config"]["flights"] == {"match": ["Town01", f"Town02_Opt/{NAMES[1]}"], "tracks": ["clean"]}
    call(
        "release", "build", "--data", tree, "--captions", tmp_path / "caption/captions.jsonl", "--inspect",
        tmp_path / "inspect/inspect.json", "--flights", "Town01", "--out", tmp_path / "release", "--set",
        "release.licence=cc-by-4.0", "--set", "workers=1",
    )  # fmt: skip
    record = read_record(tmp_path / "release/dataset/release.json")
    assert record.history.flights.left_out == {NOT_CHOSEN: 2}
    assert record.history.captions.flight_left_out == sum(one.town == "Town02_Opt" for one in captions)
    assert record.numbers.captions.frames_with == sum(one.town == "Town01" for one in captions)
    report = verify(tmp_path / "release", level="rows", reader=read_released)
    assert report.is_ok, str(report)


def test_a_training_set_takes_some_flights(tree, tmp_path):
    captions = caption_run(CaptionConfig(), tree, tmp_path / "caption")
    cfg = PrepareConfig(modalities=("rgb",), too_few="fill", flights=FlightChoice(match=("Town01",), tracks=("clean",)))
    prepare.run(cfg, [Prepared.of_files(tree, captions)], tmp_path / "set")
    splits = ("train", "val", "test")
    flights = {(s.town, s.variant) for split in splits for s in open_split(tmp_path / "set", split)}
    assert flights == {("Town01", "ORI")}
    counts = json.loads((tmp_path / "set/manifest.json").read_text())["counts"]
    assert counts["dropped"]["not_chosen"] == 2 * 6 * 5  # languages, flights, windows of each
    assert counts["kept"] + sum(counts["dropped"].values()) == counts["input"]


def test_two_trees_are_refused_with_words_where_one_is_taken(tree, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in (
        "caption --out out",
        "inspect --out out",
        "caption compare-strategies --out out",
    ):
        result = CliRunner().invoke(app, [*words.split(), "--data", str(tree), "--data", "another"])
        assert isinstance(result.exception, InputError)
        assert "this command takes one playback tree; got 2:" in str(result.exception)
        assert not any(tmp_path.iterdir())


# --- smaller ----------------------------------------------------------------------------------------------------------


def test_a_missing_field_is_called_missing(tree, tmp_path):
    flight = shutil.copytree(tree / "Town01" / NAMES[0], tmp_path / "t/Town01/trajectory_1") / "ORI"
    value = json.loads((flight / "trajectory.json").read_text())
    del value["points"][3]["drone_pose"]["z"]
    (flight / "trajectory.json").write_text(json.dumps(value))
    with pytest.raises(
        InputError, match=r"points\[3\]\.drone_pose\.z: the field is missing or null; expected a finite number"
    ) as told:
        read_flight(flight)
    assert "None" not in str(told.value)
