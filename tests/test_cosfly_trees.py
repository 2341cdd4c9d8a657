"""Playback trees: strict and tolerant reading, our readers on others' trees; the choice of tracks.

QUIRKS is the place for the next thing that a foreign tree does otherwise.
"""

import copy
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from specimens_foreign import NOBODY, write_foreign_tree

from caption.schema import CaptionConfig
from caption.stage import stage as caption_stage
from cosfly.formats.captions import Verdict, read_captions
from cosfly.formats.inspection import read_inspection
from cosfly.formats.places import TrackChoice
from cosfly.formats.playback_file import read_track, write_track
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.geometry.splits import SPLITS
from cosfly.inspection import stage as inspection
from cosfly.inspection.settings import InspectConfig
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.json_io import read_json, write_json
from cosfly.runtime.run_dir import read_failures
from distill.prepare import stage as prepare
from distill.prepare.stage import PrepareConfig
from distill.prepare.stage import RunSource as Prepared
from distill.schema import open_split
from release.build import stage as package
from release.build.config import ReleaseConfig
from release.build.sources import Source
from release.record import read_record
from release.verify.verify import verify
from specimens import change_json

TOWNS, NAMES = ("Town01", "Town02_Opt"), ("trajectory_1777083733", "trajectory_1777090000")


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    return write_foreign_tree(tmp_path_factory.mktemp("foreign"), towns=TOWNS, trajectories=NAMES)


TRAJECTORY = "Town01/trajectory_1777083733"
KEPT = CaptionConfig.model_validate({"repair": {"hard_conflict": "keep"}})  # every window has a caption


def each(change: Callable[[dict], object]) -> Callable[[dict], object]:
    def changed(value: dict) -> None:
        for point in value.get("points") or value["waypoints"]:
            change(point)

    return changed


def old_times(value: dict) -> None:
    value["waypoints"] = value.pop("points")
    each(lambda p: p.update(timing={"timestamp": p["timing"]["trace_timestamp"]}))(value)


def listed(point: dict) -> None:
    if point["nav_waypoint"]["t1_world"]:
        point["nav_waypoint"]["t1_world"] = list(point["nav_waypoint"]["t1_world"].values())


# Changes of a foreign `trajectory.json`; after those of TOLERATED the layout does not hold.
QUIRKS = {
    "as it is": lambda v: None, "no target anywhere": each(lambda p: p.update(target=None)),
    "a target that is disabled": each(lambda p: p.update(target={"enabled": False, "world_location": None})),
    "targets left out": each(lambda p: p.pop("target")),
    "no waypoint at the end": lambda v: v["points"][-1].update(nav_waypoint=None),
    "no waypoints": each(lambda p: p.pop("nav_waypoint")),
    "pitch and roll left out": each(lambda p: [p["drone_pose"].pop(name) for name in ("pitch", "roll")]),
    "waypoints as lists": each(listed), "waypoints and flat times": old_times,
    "trace_dir is another's": lambda v: v.update(trace_dir="aug_002"),
    "perturbation left out": each(lambda p: p.pop("perturbation")),
    "perturbation is null": each(lambda p: p.update(perturbation=None)),
    "perturbation is one flag": each(lambda p: p.update(perturbation=True)),
    "augmentation is null": lambda v: v.update(augmentation=None),
    "source is null": lambda v: v.update(source=None),
    "a clock of hours": each(lambda p: p["timing"].update(trace_timestamp=p["timing"]["trace_timestamp"] + 9e4)),
    "whole numbers": each(lambda p: p["drone_pose"].update(roll=0)),
    "boxes as lists": each(lambda p: p["target"] and p["target"].update(bbox_2d=[1, 2, 3, 4])),
    "a pixel as an object": each(lambda p: p["target"] and p["target"].update(image_uv={"u": 1.0, "v": 2.0})),
    "unknown keys": lambda v: v.update(weather={"sun": [1, None]}, points=[p | {"imu": 1} for p in v["points"]]),
}  # fmt: skip
TOLERATED = {
    "targets left out", "pitch and roll left out", "no waypoint at the end", "no waypoints", "waypoints and flat times", "trace_dir is another's",
}  # fmt: skip


def holds(found: object, wanted: object) -> bool:
    if isinstance(wanted, dict):
        return isinstance(found, dict) and all(holds(found.get(key), value) for key, value in wanted.items())
    if isinstance(wanted, list):
        return isinstance(found, list) and len(found) == len(wanted) and all(map(holds, found, wanted))
    return found == pytest.approx(wanted) if isinstance(wanted, float) else found == wanted


def test_false_is_no_place(foreign, tmp_path):
    """Public files write false for an offset that is zero; a target's place is unknown then, not the origin."""
    change = each(lambda p: p.update(target={"world_location": False, "depth": 3.0}))
    assert np.isnan(read_track(rewrite(foreign / TRAJECTORY / "ORI", tmp_path, change)).targets_m).all()


@pytest.mark.parametrize("variant", ["ORI", "aug_001"])
@pytest.mark.parametrize("name", QUIRKS)
def test_a_quirk_is_read_and_survives_writing(foreign, tmp_path, name, variant):
    folder = rewrite(foreign / TRAJECTORY / variant, tmp_path, QUIRKS[name])
    flight = read_track(folder)
    assert bool(flight.issues) == (name in TOLERATED)
    assert len(flight) == 16
    assert np.isfinite(flight.positions_m).all()
    before = copy.deepcopy(flight.raw)
    write_track(folder, flight)
    again = read_track(folder)
    assert not again.issues or "left out" in name  # nothing says where the targets were
    for column, value in vars(flight).items():
        if isinstance(value, np.ndarray):
            assert_allclose(getattr(again, column), value, err_msg=column)
    if name not in TOLERATED:
        after = json.loads((folder / "trajectory.json").read_text())
        assert holds(in_public_form(after), in_public_form(before))


def in_public_form(value: dict) -> dict:
    value.pop("trace_dir")
    value |= {key: value[key] or {} for key in ("augmentation", "source")}
    for point in value["points"]:
        point.pop("nav_waypoint")
        if not isinstance(point.get("perturbation"), dict):
            point.pop("perturbation", None)
        if isinstance((point["target"] or {}).get("image_uv"), dict):
            point["target"].pop("image_uv")
    return value


def test_nobody_is_no_target(foreign):
    flight = read_track(find_tracks(foreign)[0])
    assert np.isnan(flight.targets_m[NOBODY]).all()
    assert not flight.target.visible[NOBODY]
    assert (flight.target.visible.sum(), flight.time_s[0]) == (len(flight) - 1, 7.5)


def test_the_clean_twin_is_the_track_beside_it(foreign, tmp_path):
    tree = shutil.copytree(foreign, tmp_path / "tree", copy_function=os.link)
    clean, shaken = (read_track(tree / TRAJECTORY / variant) for variant in ("ORI", "aug_001"))
    twin = read_twin(shaken)
    assert twin is not None
    assert_array_equal(twin.positions_m, clean.positions_m)
    assert read_twin(clean) is None
    change_json(clean.folder / "trajectory.json", lambda v: v["points"].pop())
    with pytest.raises(VerifyError, match=r"not its clean twin; .*points from"):
        read_twin(shaken)


@pytest.fixture(scope="module")
def way(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("way")
    tree = write_foreign_tree(
        root / "tree", towns=("Town01", "Town10HD_Opt"), trajectories=("trajectory_1777083733",), num_points=13
    )
    inspected = inspection.run(InspectConfig(), None, None, tree, root / "inspect")
    captions = caption_stage.run(KEPT, tree, root / "caption")
    for split_by in ("walk", "town"):
        cfg = PrepareConfig(val_fraction=0, test_fraction=0.5, split_by=split_by, verdicts=get_args(Verdict))
        prepare.run(cfg, [Prepared(tree, captions)], root / f"by_{split_by}")
    theirs = ReleaseConfig(licence="cc-by-4.0", credits="Made by somebody else.")
    package.run(theirs, [Source("theirs", tree, captions, inspected)], root / "release")
    return root


def test_a_foreign_tree_passes_the_inspection_without_plans(way):
    found = read_inspection(way / "inspect/inspect.json")
    assert {flight.result for flight in found.flights} == {"accepted"}
    assert {issue.code for flight in found.flights for issue in flight.issues} == {"not_in_this_tree", "no_checksums"}
    assert found.funnel.trajectories.planned == found.funnel.trajectories.accepted == 2
    assert {flight.track for flight in found.flights if flight.variant == "aug_001"} == {"perturbed"}


def test_a_foreign_tree_gives_samples_and_a_release(way):
    num_kept = sum(caption.status == "accepted" for caption in read_captions(way / "caption/captions.jsonl"))
    assert num_kept >= 8
    for split_by in ("walk", "town"):
        splits = {split: {sample.town for sample in open_split(way / f"by_{split_by}", split)} for split in SPLITS}
        assert sorted(map(len, splits.values())) == [0, 1, 1], "one trajectory a town, of the same name"
        assert sum(len(list(open_split(way / f"by_{split_by}", split))) for split in SPLITS) == 2 * num_kept
    assert verify(way / "release").is_ok
    record = read_record(way / "release/dataset/release.json")
    assert record.numbers.counts["tracks_by_track"] == {"clean": 2, "perturbed": 2}
    assert (record.numbers.of("flags")["has_caption"], record.history.captions.released) == (num_kept, num_kept)


def test_of_a_foreign_tree_what_was_inspected_is_released_and_nothing_else(tmp_path):
    tree = write_foreign_tree(tmp_path / "tree", num_points=11, files=("rgb.png",))
    inspected = inspection.run(InspectConfig(), None, None, tree, tmp_path / "inspect")
    captions = caption_stage.run(KEPT, tree, tmp_path / "caption")
    alone = tmp_path / "alone"  # inspections travel without the records of their stage
    alone.mkdir()
    cfg, clean = ReleaseConfig(licence="mit", modalities=("rgb",)), find_tracks(tree)[0]

    def failed(out: str, source: Source) -> list[str]:
        found: list[str] = []
        try:
            package.run(cfg, [source], tmp_path / out)
        except VerifyError:
            failures = " ".join(failure.message for failure in read_failures(tmp_path / out / "failures.jsonl"))
            found = re.findall(r"trajectory_1777083733/(\S+: [^;]+);", failures)
        assert (tmp_path / out / "dataset").exists() == (not found)
        return found

    picture = clean / "frames_playback/frame_00003/rgb.png"
    before = picture.read_bytes()
    picture.write_bytes((clean / "frames_playback/frame_00004/rgb.png").read_bytes())
    source = Source("theirs", tree, captions, inspected)
    assert failed("a", source) == ["ORI: the track has changed since its inspection"]
    picture.write_bytes(before)
    assert failed("a", source) == []
    shutil.copy(picture, alone / "private.png")  # the same bytes, but who knows what stands there tomorrow
    picture.unlink()
    picture.symlink_to(alone / "private.png")
    with pytest.raises(
        InputError, match=r"ORI/frames_playback/frame_00003/rgb\.png: a symbolic link leads out of its folder"
    ):
        failed("d", source)
    picture.unlink()
    picture.write_bytes(before)
    value = read_json(inspected)
    one, two = value["flights"]
    one["sha256"], two["sha256"] = two["sha256"], one["sha256"]
    write_json(alone / "inspect.json", value)
    # Of a shard the first problem.
    changed = ["ORI: the track has changed since its inspection"]
    assert failed("b", replace(source, inspect=alone / "inspect.json")) == changed
    one["folder"], two["folder"] = two["folder"], one["folder"]
    write_json(alone / "inspect.json", value)
    with pytest.raises(InputError, match="the record of a track has the folder of another"):
        failed("c", replace(source, inspect=alone / "inspect.json"))


def rewrite(folder, target, change):
    new = target / "Town01" / folder.parent.name / folder.name
    new.mkdir(parents=True, exist_ok=True)
    change_json(Path(shutil.copy(folder / "trajectory.json", new)), change)
    return new


def test_deviations_from_the_layout_are_noted(tree, tmp_path):
    for change, words in (
        (lambda v: v.update(schema="x"), "schema.*'x'"),
        (lambda v: v.update(schema_version="6.9.0"), "schema_version"),
        (lambda v: v.update(trace_dir="other"), "trace_dir"),
        (lambda v: v["points"][3].update(index=7), r"points\[3\].index"),
        (lambda v: v["points"][2]["nav_waypoint"].update(t1_world=[0, 0, 0]), r"points\[2\].nav_waypoint"),
        (lambda v: v["points"][-1]["nav_waypoint"].update(t1_world=[0, 0, 0]), "null at the last point"),
        (lambda v: v["points"][-1]["timing"].update(trace_timestamp=9), "steps of"),
        (lambda v: v["points"][4].pop("target"), "target.*missing"),
    ):
        first = read_track(rewrite(find_tracks(tree)[0], tmp_path, change)).issues[0]
        assert re.search(words, str(first)), words


def names(foreign: Path, **choice) -> list[str]:
    return [folder.relative_to(foreign).as_posix() for folder in find_tracks(foreign, TrackChoice(**choice))]


def test_patterns_are_of_folders_and_those_above_them(foreign):
    for choice, count in (
        ({}, 8), ({"match": ("Town01",)}, 4), ({"match": ("Town0[12]*/trajectory_177708*",)}, 4),
        ({"match": ("*/ORI",)}, 4),
        ({"match": ("Town01/trajectory_1777083733/ORI", "Town02_Opt/trajectory_1777090000/")}, 3),
        ({"tracks": ("clean",)}, 4), ({"match": ("Town02*",), "tracks": ("perturbed",)}, 2),
    ):  # fmt: skip
        found = names(foreign, **choice)
        assert len(found) == count
        assert set(found) <= set(names(foreign))
    words = r"no track folder in this directory matches the patterns of --flights; got Town9; .*Town01/trajectory_1777083733/ORI"
    with pytest.raises(InputError, match=words):
        names(foreign, match=("Town9",))
    with pytest.raises(InputError, match="this directory has no perturbed track among those that match --flights"):
        names(foreign, match=("*/ORI",), tracks=("perturbed",))
