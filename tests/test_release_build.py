"""Building and packaging a release: what is in the folder, that others' tools open it, what verify finds wrong."""

import json
import os
import re
import shutil
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from release_tampering import errors_in, forge
from specimens_foreign import write_foreign_tree
from specimens_release import (
    CFG,
    FREE,
    all_bytes,
    build,
    make_caption,
    make_inspection,
    rewrite_captions,
    rows_by_id,
    source_of,
)
from test_cosfly_inspection import list_files

from caption.schema import CaptionConfig
from caption.stage import stage as caption_stage
from cosfly.formats.boxes import MapHeader
from cosfly.formats.captions import write_captions
from cosfly.formats.frames import read_rgb
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback_file import read_track
from cosfly.formats.town import write_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.trajectory_metrics import derivative_rms, length_m
from cosfly.runtime.errors import ConfigError, InputError, NothingKept, VerifyError
from cosfly.runtime.json_io import read_json
from release.build.config import ReleaseConfig
from release.build.shards import points_part
from release.build.sources import Source
from release.build.stage import run
from release.card.render import render_card
from release.record import ReleaseRecord, read_record
from release.verify.verify import verify
from specimens import make_playback_tree

POINTS = 14


def make_material(
    root: Path,
    num_walks: int,
    towns: tuple[str, ...] = ("Town01",),
    num_points: int = POINTS,
    captioned: range = range(4, POINTS - 1),
    num_future: int = 1,
) -> Path:
    """Write tree/, captions.jsonl of some frames of each flight (labels look num_future frames ahead), inspect.json."""
    tree = make_playback_tree(root / "tree", num_walks, num_points, width_px=48, height_px=27, towns=towns)
    captions = [
        make_caption(flight, i, future=list(range(i + 1, i + 1 + num_future)))
        for flight in map(read_track, find_tracks(tree))
        for i in captioned
    ]
    write_captions(root / "captions.jsonl", captions)
    write_inspection(root / "inspect.json", make_inspection(tree, {}))
    return root


@pytest.fixture(scope="module")
def few(tmp_path_factory) -> Path:
    return make_material(tmp_path_factory.mktemp("few"), 2)


@pytest.fixture
def copy(few, tmp_path) -> Path:
    return shutil.copytree(few, tmp_path / "material")


def split_cfg(**changes) -> ReleaseConfig:
    changes = {"validation_fraction": 0.25, "test_fraction": 0.25, "num_frames": 8} | changes
    return ReleaseConfig(**{**FREE, "pairs": "both", "shard_mb": 1, "row_group_mb": 1, **changes})


def record_of(material: Path, out: Path, cfg: ReleaseConfig | None = None) -> ReleaseRecord:
    return read_record(run(cfg or split_cfg(), [source_of(material)], out) / "release.json")


def test_splits_share_no_walk_and_no_twins(tmp_path):
    make_material(tmp_path, 8, ("Town01", "Town02", "Town02_Opt", "Town03"))
    record = record_of(tmp_path, tmp_path / "r")
    num_walks = {name: len(split.walks) for name, split in record.splits.splits.items()}
    assert num_walks == {"train": 4, "validation": 2, "test": 2}
    walks = [walk for split in record.splits.splits.values() for walk in split.walks]
    assert len(walks) == len(set(walks)) == 8
    by_name = {flight.flight: flight for flight in record.flights}
    for flight in record.flights:
        twin = by_name[flight.pair or ""]
        assert (twin.pair, twin.split, twin.walk) == (flight.flight, flight.split, flight.walk)
    for row in rows_by_id(tmp_path / "r/dataset").values():
        entry = by_name["/".join(row[name] for name in ("run", "town", "trajectory", "variant"))]
        assert (row["split"], row["walk"], row["pair"]) == (entry.split, entry.walk, entry.pair)
    for shard in record.shards:
        assert f"data/{shard.split}-{record.content_digest[:12]}-" in shard.path


def test_a_track_that_two_runs_have_is_released_once(copy, tmp_path):
    list_files(copy / "tree")
    other = shutil.copytree(copy, tmp_path / "other")
    product = run(split_cfg(), [source_of(copy), source_of(other, "two")], tmp_path / "r")
    counts = json.loads((tmp_path / "r/manifest.json").read_text())["counts"]
    assert len(read_record(product / "release.json").flights) == counts["kept"] == counts["input"] / 2
    assert counts["dropped"] == {"copy of another track": counts["kept"]}


def test_neither_twin_goes_without_the_other_unless_asked(copy, tmp_path):
    names = [folder.relative_to(copy / "tree").as_posix() for folder in find_tracks(copy / "tree")]
    write_inspection(copy / "inspect.json", make_inspection(copy / "tree", {names[0]: ("rejected", "jerk")}))
    record = record_of(copy, tmp_path / "both")
    assert record.history.flights.left_out == {"its other track is not released": 1, "rejected: jerk": 1}
    assert len(record.flights) == 2
    alone = record_of(copy, tmp_path / "any", split_cfg(pairs="any"))
    assert (len(alone.flights), [flight.pair for flight in alone.flights].count(None)) == (3, 1)
    clean = record_of(copy, tmp_path / "clean", split_cfg(tracks=("clean",)))
    assert (len(clean.flights), {flight.pair for flight in clean.flights}) == (1, {None})
    card = (tmp_path / "clean/dataset/README.md").read_text(encoding="utf-8")
    assert "All tracks of this release are clean: the other track of each trajectory is not released" in card


def test_tracks_of_a_trajectory_that_no_row_calls_a_pair_are_found(built, tmp_path):
    assert read_record(built / "release.json").settings.pairs == "any"
    forged = forge(built, tmp_path / "forged", lambda rows: [row.update(pair=None) for row in rows])
    assert errors_in(forged, "rows")["pair"] == 2


def test_a_public_tree_without_an_inspection_is_released(tmp_path):
    tree = write_foreign_tree(tmp_path / "tree", num_points=13)
    captions = caption_stage.run(CaptionConfig(), tree, tmp_path / "caption")
    cfg = ReleaseConfig(licence="cc-by-4.0", selection="all")
    record = read_record(run(cfg, [Source("theirs", tree, captions)], tmp_path / "r") / "release.json")
    assert (record.history.flights.found, record.history.flights.inspected) == (2, 0)
    assert record.history.trajectories is None
    assert record.provenance.sources[0].inspect_sha256 is None
    assert record.history.captions.released > 0


def test_the_record_says_where_it_comes_from_and_nothing_of_this_machine(copy, tmp_path):
    def local(lines):
        for line in lines:
            line["teacher"].update(model="/home/somebody/models/teacher-7", kind="endpoint")
            line["usage"] = {"prompt_tokens": 100, "completion_tokens": 10}

    rewrite_captions(copy, local)
    run(split_cfg(), [source_of(copy)], tmp_path / "r")
    record = read_record(tmp_path / "r/dataset/release.json")
    origin = record.provenance
    assert [(one.kind, one.model) for one in origin.teachers] == [("endpoint", "teacher-7")]
    assert origin.tokens == {"completion_tokens": 10 * 4 * 9, "prompt_tokens": 100 * 4 * 9}
    assert {"cosfly", "pyarrow"} <= origin.versions.keys()
    for data in all_bytes(tmp_path / "r/dataset").values():
        assert b"/home/somebody" not in data
        assert str(tmp_path).encode() not in data
    assert {row["teacher_model"] for row in rows_by_id(tmp_path / "r/dataset").values()} == {"teacher-7", None}


def first_flight(root: Path) -> Path:
    return find_tracks(root / "tree")[0]


def cut(path: Path, num_bytes: int) -> None:
    path.write_bytes(path.read_bytes()[:-num_bytes])


def other_size(root: Path) -> None:
    """One trajectory of a tree of another size in the place of the first."""
    other = make_playback_tree(root / "other", 1, POINTS, width_px=64, height_px=36)
    target = first_flight(root).parent
    shutil.rmtree(target)
    shutil.copytree(next(other.glob("*/*")), target)


FIFTH = "frames_playback/frame_00005"


def painted(frame_file: str, *shape: int, dtype=np.uint8):
    return lambda root: cv2.imwrite(str(first_flight(root) / FIFTH / frame_file), np.zeros(shape, dtype))


def caption(**values):
    return lambda root: rewrite_captions(root, lambda lines: lines[0].update(values))


def of_no_frame(root: Path) -> None:
    names = {"frame_index": 99, "window": [99]}
    rewrite_captions(root, lambda lines: lines[0].update(names, sample_id=lines[0]["sample_id"][:-5] + "00099"))


def not_finite(root: Path) -> None:
    path = first_flight(root) / "trajectory.json"
    text = path.read_text()
    number = json.dumps(json.loads(text)["points"][3]["drone_pose"]["x"])
    path.write_text(text.replace(number, "1e999", 1))


DAMAGES = {
    "depth cut by 100 bytes": (lambda r: cut(first_flight(r) / FIFTH / "depth.npy", 100), "depth.npy"),
    "a picture cut short": (lambda r: cut(first_flight(r) / FIFTH / "rgb.png", 20), "rgb.png"),
    "a picture of 16 bits": (painted("rgb.png", 27, 48, 3, dtype=np.uint16), "16 bits, colour type 2"),
    "a mask of grey": (painted("instance.png", 27, 48), "1 channels, not RGB"),
    "a picture that is missing": (lambda r: (first_flight(r) / FIFTH / "instance.png").unlink(), "missing or empty"),
    "1e999 in a trajectory": (not_finite, "is not finite"),
    "pictures of two sizes": (other_size, "the tracks differ in the size of pictures"),
    "a caption of no frame": (of_no_frame, "the frame of the caption does not exist"),
    "a caption of no flight": (caption(trajectory="trajectory_1", sample_id="trajectory_1_ORI_frame_00004"),
        "has no track of this caption"),
    "an id of another frame": (lambda r: rewrite_captions(r, lambda c: c[0].update(sample_id=c[1]["sample_id"])),
        "does not match its frame"),
    "two captions of a frame": (lambda r: rewrite_captions(r, lambda c: c.append(c[0])), "two accepted captions"),
    "a caption in one language": (caption(zh=None), "no text in one of the two languages"),
    "captions of another version": (caption(schema_version="1.0"), "the captions is not supported"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_material_that_cannot_be_released_is_refused_by_name(copy, tmp_path, damage):
    break_it, word = DAMAGES[damage]
    break_it(copy)
    with pytest.raises((InputError, VerifyError), match=word):
        run(split_cfg(), [source_of(copy)], tmp_path / "r")
    assert not (tmp_path / "r/dataset").exists()
    assert not (tmp_path / "r/manifest.json").exists()


def test_each_shard_that_cannot_be_written_is_named_and_the_finished_ones_are_not_done_again(tmp_path, monkeypatch):
    copy = make_material(tmp_path / "material", 3)
    from release.build import stage as package

    monkeypatch.setattr("release.build.config.MB", 20_000)
    whole = run(split_cfg(), [source_of(copy)], tmp_path / "whole")
    pictures = {folder / FIFTH / "rgb.png": b"" for folder in find_tracks(copy / "tree")[:4:2]}  # of two trajectories
    for picture in pictures:
        pictures[picture] = picture.read_bytes()
        cut(picture, 20)
    with pytest.raises(InputError, match="nothing is released") as caught:
        run(split_cfg(), [source_of(copy)], tmp_path / "r")
    assert all(str(picture) in str(caught.value) for picture in pictures)
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "r/parts").iterdir()}
    assert before
    for picture, data in pictures.items():
        picture.write_bytes(data)
    kept: dict[str, int] = {}
    real = package.name_shards

    def look(finished, folder):
        kept.update({path.name: path.stat().st_mtime_ns for path, _ in finished for path in (path, points_part(path))})
        return real(finished, folder)

    monkeypatch.setattr(package, "name_shards", look)
    assert all_bytes(run(split_cfg(), [source_of(copy)], tmp_path / "r")) == all_bytes(whole)
    assert sum(kept.get(name) == time_ns for name, time_ns in before.items()) >= len(before) - 1


def test_windows_keep_the_pictures_of_captions(tmp_path):
    make_material(tmp_path, 1, num_points=100, captioned=range(4, 90))
    folder = run(split_cfg(num_frames=60, selection="windows"), [source_of(tmp_path)], tmp_path / "r")
    rows = list(rows_by_id(folder).values())
    for variant in ("ORI", "aug_001"):
        own = [row for row in rows if row["variant"] == variant]
        frames = {row["frame_index"] for row in own}
        assert len(frames) == 60
        assert sum(b - a > 1 for a, b in pairwise(sorted(frames))) == 1  # two runs of thirty
        released = [row for row in own if row["has_caption"]]
        assert sum(set(row["caption_window"]) <= frames for row in released) >= 0.8 * len(released) > 30
    card = (folder / "README.md").read_text(encoding="utf-8")
    assert "is one of the first 4 of a run" in card
    assert "are not all in the release" not in card
    everything = run(split_cfg(selection="all"), [source_of(tmp_path)], tmp_path / "all")
    assert read_record(everything / "release.json").history.captions.released == 2 * 86


def test_a_frame_between_captions_was_not_asked_for(tmp_path):
    make_material(tmp_path, 1, num_points=30, captioned=range(4, 25, 3), num_future=5)
    without = record_of(tmp_path, tmp_path / "r", split_cfg(num_frames=30)).history.captions.frames_without
    # Of 30 frames the first 4 and the last 5 have no whole window, 4, 7, ... 22 have a caption.
    assert without == {"no whole window, at an end of the track": 2 * 9, "not asked for": 2 * 14}


UNLICENSED = CFG.model_copy(update={"licence": None})


@pytest.fixture(scope="module")
def loaded(built, tmp_path_factory):
    os.environ["HF_HUB_OFFLINE"] = "1"
    datasets = pytest.importorskip("datasets")
    return datasets.load_dataset(str(built), split="train", cache_dir=str(tmp_path_factory.mktemp("cache")))


def test_load_dataset_gives_pictures_poses_and_both_languages(loaded, release_inputs):
    assert (len(loaded), set(loaded["town"])) == (4 * 8, {"Town01", "Town02"})
    for row in (loaded[0], loaded[9], loaded[31]):
        flight = read_track(release_inputs / "tree" / row["town"] / row["trajectory"] / row["variant"])
        assert (np.asarray(row["image"]) == read_rgb(flight.frame_folder(row["frame_index"]))).all()
        assert row["perturbation"] == flight.events(row["frame_index"])
        assert row["track"] == ("clean" if row["variant"] == "ORI" else "perturbed")
    row = loaded.filter(lambda row: row["has_caption"])[0]
    assert "行人" in row["caption_zh_reasoning_trace"]
    assert row["caption_en_critical_components"].endswith(f"about {10 + row['frame_index']} m ahead.")
    assert row["caption_window"] == list(range(row["frame_index"] - 4, row["frame_index"] + 1))
    assert row["decision"] == row["caption_en_flight_decision"] == row["caption_zh_flight_decision"]
    assert (row["teacher_kind"], row["writing"], row["caption_picture_px"]) == ("rules", "slots", [96, 54])
    bare = loaded.filter(lambda row: not row["has_caption"])[0]
    assert bare["caption_en_reasoning_trace"] is bare["caption_window"] is bare["target_mask_bbox"] is None


def test_numbers_against_a_slow_oracle(loaded, built, release_inputs):
    """The record's numbers, counted again from what `datasets` gives; motion from the tree.

    A trajectory counts once, with the motion of its plan, though of one only the perturbed track is released.
    """
    numbers = read_json(built / "release.json")["numbers"]
    rows = list(loaded.remove_columns(["image", "instance", "depth"]))
    with_caption = [row for row in rows if row["has_caption"]]
    assert numbers["frames"] == len(rows)
    assert numbers["flights"] == len({(r["town"], r["trajectory"], r["variant"]) for r in rows}) == 4
    assert numbers["trajectories"] == len({(r["town"], r["trajectory"]) for r in rows})
    assert numbers["counts"]["flags"]["has_caption"] == len(with_caption)
    assert numbers["counts"]["decision"] == Counter(row["decision"] for row in with_caption)
    heights = np.array([row["pose"]["z_m"] - row["target"]["z_m"] for row in rows])
    assert numbers["spreads"]["height_m"]["mean"] == pytest.approx(heights.mean(), abs=1e-4)
    assert numbers["spreads"]["height_m"]["std"] == pytest.approx(heights.std(), abs=1e-4)
    characters = np.mean([len(row["caption_zh_reasoning_trace"]) for row in with_caption])
    assert numbers["spreads"]["caption_zh_reasoning_trace"]["mean"] == pytest.approx(characters, abs=1e-4)
    assert numbers["counts"]["flags"]["is_perturbed"] == sum(row["is_perturbed"] for row in rows)
    assert sum(numbers["counts"]["action"].values()) == sum(row["action"] is not None for row in rows)
    plans = [read_track(one).positions_m for one in find_tracks(release_inputs / "tree") if one.name == "ORI"]
    motions = {"length_m": length_m, "accel_rms_mps2": partial(derivative_rms, order=2)}
    motions |= {"jerk_rms_mps3": partial(derivative_rms, order=3)}
    for name, of in motions.items():
        spread, expected = numbers["spreads"][f"trajectory_{name}"], [of(plan) for plan in plans]
        assert [spread["mean"], spread["max"]] == pytest.approx([np.mean(expected), max(expected)], rel=1e-3)
        assert spread["count"] == len(plans) == 3


def with_maps(release_inputs: Path, copy: Path, **licences: str) -> Path:
    shutil.copytree(release_inputs, copy)
    for town, licence in licences.items():
        write_town_map(copy / "tree" / town, MapHeader(name=f"A {town}", licence=licence, credits="Made by M."))
    return copy


def test_a_release_takes_the_licence_of_its_maps_unless_told_and_names_them(release_inputs, tmp_path):
    source = with_maps(release_inputs, tmp_path / "in", Town01="mit", Town02="mit")
    folder = build(source, tmp_path / "r", UNLICENSED)
    record = read_json(folder / "release.json")
    card = (folder / "README.md").read_text(encoding="utf-8")
    assert record["licence"] == "mit"
    assert record["maps"][0] == {"name": "A Town01", "licence": "mit", "credits": "Made by M.", "town": "Town01"}
    for words in ("license: mit\n", "Map of Town02: A Town02, licence mit. Made by M.", "Map: a specimen."):
        assert words in card
    assert verify(folder).is_ok
    source = with_maps(release_inputs, tmp_path / "one", Town01="mit")
    card = (build(source, tmp_path / "own") / "README.md").read_text(encoding="utf-8")
    for words in ("license: cc-by-4.0\n", "licence mit. Made by M.", "Map of Town02: Town02, licence unknown."):
        assert words in card


@pytest.mark.parametrize(
    ("licences", "got"),
    [({}, "Town01: unknown, Town02: unknown"), ({"Town01": "mit"}, "Town02: unknown"),
        ({"Town01": "mit", "Town02": "cc0-1.0"}, "Town01: mit, Town02: cc0-1.0")],
)  # fmt: skip
def test_a_release_without_a_licence_is_refused(release_inputs, tmp_path, licences, got):
    source = with_maps(release_inputs, tmp_path / "in", **licences)
    with pytest.raises(ConfigError, match=rf"{re.escape(got)}.*release\.licence"):
        build(source, tmp_path / "r", UNLICENSED)
    assert not (tmp_path / "r" / "dataset").exists()


def ids_of(folder: Path) -> list[str]:
    return pq.read_table(folder / "data", columns=["sample_id"]).column(0).to_pylist()


def joined(out: Path, *sources: Source) -> tuple[Path, ReleaseRecord]:
    folder = run(CFG, sources, out)
    assert verify(folder).is_ok
    assert len(ids_of(folder)) == len(set(ids_of(folder))) == 8 * (4 + 6)
    return folder, read_record(folder / "release.json")


def test_runs_of_other_towns_go_into_one_release_under_ids_of_their_own(release_inputs, built, tmp_path):
    other, renamed = shutil.copytree(release_inputs, tmp_path / "in"), {"Town01": "Town03", "Town02": "Town04"}
    for old, new in renamed.items():
        (other / "tree" / old).rename(other / "tree" / new)
    rewrite_captions(other, lambda lines: [one.update(town=renamed[one["town"]]) for one in lines])
    write_inspection(other / "inspect.json", make_inspection(other / "tree", {}))
    folder, record = joined(tmp_path / "r", source_of(release_inputs), source_of(other, "two"))
    ids, alone = ids_of(folder), ids_of(built)
    assert f"Town01_{alone[0]}" in ids, "both runs have this trajectory, so the town tells them apart"
    assert set(alone) == {i.partition("_")[2] for i in ids if i.startswith(("Town01", "Town02"))}
    before = read_record(built / "release.json")
    assert record.history.captions.read == 2 * before.history.captions.read
    assert record.history.trajectories.planned == 2 * before.history.trajectories.planned
    rows = pq.read_table(folder / "data", columns=["run", "town", "has_caption"]).to_pylist()
    towns = {*(("one", town) for town in renamed), *(("two", town) for town in renamed.values())}
    assert {(row["run"], row["town"]) for row in rows} == towns
    num_captions = sum(row["has_caption"] for row in rows)
    assert num_captions == record.history.captions.released > before.history.captions.released
    with pytest.raises(InputError, match=r"several runs have the same name.*different names"):
        run(CFG, [source_of(other), source_of(other)], tmp_path / "r2")
    # Of two trees in one folder each goes by its own name.
    (other / "tree").rename(other / "second")
    _, record = joined(tmp_path / "trees", source_of(release_inputs), replace(source_of(other), data=other / "second"))
    assert {one.flight.partition("/")[0] for one in record.flights} == {"one_tree", "one_second"}


def test_what_is_not_chosen_is_counted_as_that_whatever_the_inspection_found(release_inputs, tmp_path):
    chosen = CFG.model_copy(update={"flights": ("Town01/*/ORI",)})
    history = read_record(build(release_inputs, tmp_path / "r", chosen) / "release.json").history.flights
    found = [folder.relative_to(release_inputs / "tree") for folder in find_tracks(release_inputs / "tree")]
    num_chosen = sum(folder.match("Town01/*/ORI") for folder in found)
    assert 0 < num_chosen < history.found == len(found)
    assert history.left_out["not chosen"] == len(found) - num_chosen
    with pytest.raises(NothingKept, match=r"not chosen 6\).*change --flights"):
        build(release_inputs, tmp_path / "none", CFG.model_copy(update={"flights": ("Town09",)}))


@pytest.mark.slow
def test_one_changed_digit_of_the_card_fails_wherever_it_stands(built, tmp_path):
    dataset = shutil.copytree(built, tmp_path / "dataset")
    card = dataset / "README.md"
    text = card.read_text(encoding="utf-8")
    places = [match.start() for match in re.finditer(r"\d", text)]
    expected = render_card(read_record(dataset / "release.json"))
    assert text == expected
    for place in places[:: max(1, len(places) // 12)]:
        digit = str((int(text[place]) + 1) % 10)
        card.write_text(text[:place] + digit + text[place + 1 :], encoding="utf-8")
        report = verify(dataset, level="rows")
        line = text[:place].count("\n") + 1
        assert [i.where for i in report.issues if i.code == "card"] == [f"README.md:{line}"]


def test_the_account_names_every_flight_and_caption(built):
    history = read_json(built / "release.json")["history"]
    left_out = {"rejected: missing_file": 1, "review: stray_frame": 1}
    assert history["flights"] == {"found": 6, "inspected": 6, "released": 4, "left_out": left_out}
    captions = history["captions"]
    assert (captions["read"], captions["dropped"]) == (6 * 8, {"hard_conflict": 6})
    assert captions["flight_left_out"] == 2 * 7
    # Of 12 frames 0, 1, 3, 4, 6, 7, 9 and 11 are released; captions stand at 4 to 10, and that of 11 is dropped.
    assert (captions["released"], captions["frame_not_selected"]) == (4 * 4, 4 * 3)
    why = {"no whole window, at an end of the track": 4 * 3, "dropped: hard_conflict": 4}
    assert captions["frames_without"] == why
