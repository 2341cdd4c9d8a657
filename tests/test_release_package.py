"""Packaging: what is in the folder, that other people's tools open it, and that verify finds what is wrong with it."""

import io
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimens_release import CFG, build, make_inspection, rewrite_captions, source_of

from cosfly.formats.boxes import MapHeader
from cosfly.formats.frames import read_depth, read_instance, read_rgb
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback import read_track
from cosfly.formats.town import write_town_map
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import read_json
from release.card.render import render_card
from release.package.plan import plan_shards
from release.package.sources import Source
from release.package.stage import run
from release.record import ReleaseRecord, read_record
from release.verify.verify import verify

UNLICENSED = CFG.model_copy(update={"licence": None})


@pytest.fixture(scope="module")
def loaded(built, tmp_path_factory):
    os.environ["HF_HUB_OFFLINE"] = "1"
    datasets = pytest.importorskip("datasets")
    cache = tmp_path_factory.mktemp("cache")
    return datasets.load_dataset(str(built), split="train", cache_dir=str(cache))


def test_load_dataset_gives_pictures_poses_and_both_languages(loaded, release_inputs):
    assert (len(loaded), set(loaded["town"])) == (4 * 8, {"Town01", "Town02"})
    for row in (loaded[0], loaded[9], loaded[31]):
        folder = release_inputs / "tree" / row["town"] / row["trajectory"] / row["variant"]
        flight, i = read_track(folder), row["frame_index"]
        frame = flight.frame_folder(i)
        assert (np.asarray(row["image"]) == read_rgb(frame)).all()
        coded = np.asarray(row["instance"]).astype(np.uint16)
        kinds, ids = read_instance(frame)
        assert (coded[..., 0] == kinds).all()
        assert ((coded[..., 1] | coded[..., 2] << 8) == ids).all()
        depth = np.load(io.BytesIO(row["depth"]))
        assert depth.dtype == np.float32
        assert depth.tobytes() == read_depth(frame).tobytes()
        assert [row["pose"][k] for k in ("x_m", "y_m", "z_m")] == flight.positions_m[i].tolist()
        assert [row["pose"][k] for k in ("pitch_deg", "yaw_deg", "roll_deg")] == flight.rotations_deg[i].tolist()
        assert [row["target"][k] for k in ("x_m", "y_m", "z_m")] == flight.targets_m[i].tolist()
        assert row["time_s"] == flight.time_s[i]
        assert row["is_perturbed"] == flight.perturbation.is_perturbed[i]
        assert row["perturbation"] == flight.events(i)
        assert row["track"] == ("clean" if row["variant"] == "ORI" else "perturbed")
    captioned = loaded.filter(lambda row: row["has_caption"])
    row = captioned[0]
    assert "行人" in row["caption_zh_reasoning_trace"]
    assert row["caption_en_critical_components"] == f"A person walks {row['frame_index']} m ahead"
    assert row["caption_window"] == list(range(row["frame_index"] - 4, row["frame_index"] + 1))
    assert row["decision"] == row["caption_en_flight_decision"] == row["caption_zh_flight_decision"]
    assert row["teacher_kind"] == "rules"
    for row in captioned:
        assert (row["writing"], row["caption_picture_px"]) == ("slots", [96, 54])
        assert row["sentence_states_zh"] is None
    bare = loaded.filter(lambda row: not row["has_caption"])
    assert bare[0]["caption_en_reasoning_trace"] is None
    assert bare[0]["caption_window"] is bare[0]["caption_picture_px"] is bare[0]["target_mask_bbox"] is None


def test_numbers_against_a_slow_oracle(loaded, built):
    """The record's numbers, counted again from what `datasets` gives."""
    numbers = read_json(built / "release.json")["numbers"]
    rows = list(loaded.remove_columns(["image", "instance", "depth"]))
    with_caption = [row for row in rows if row["has_caption"]]
    assert numbers["frames"] == len(rows)
    assert numbers["flights"] == len({(r["town"], r["trajectory"], r["variant"]) for r in rows}) == 4
    assert numbers["trajectories"] == len({(r["town"], r["trajectory"]) for r in rows})
    assert numbers["captions"]["frames_with"] == len(with_caption)
    assert numbers["captions"]["frames_without"] == len(rows) - len(with_caption)
    for decision, count in numbers["captions"]["frames_by"]["decision"].items():
        assert count == sum(row["decision"] == decision for row in with_caption)
    assert sum(numbers["captions"]["frames_by"]["decision"].values()) == len(with_caption)
    heights = np.array([row["pose"]["z_m"] - row["target"]["z_m"] for row in rows])
    assert numbers["height_over_target_m"]["mean"] == pytest.approx(heights.mean(), abs=1e-4)
    assert numbers["height_over_target_m"]["std"] == pytest.approx(heights.std(), abs=1e-4)
    characters = np.mean([len(row["caption_zh_reasoning_trace"]) for row in with_caption])
    assert numbers["captions"]["mean_characters"]["caption_zh_reasoning_trace"] == pytest.approx(characters, abs=0.06)
    assert numbers["frames_perturbed"] == sum(row["is_perturbed"] for row in rows)
    assert numbers["files"]["bytes"] == sum(p.stat().st_size for p in (built / "data").iterdir())


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
    with pytest.raises(ConfigError, match=r"release\.licence") as caught:
        build(source, tmp_path / "r", UNLICENSED)
    assert got in str(caught.value)
    assert not (tmp_path / "r" / "dataset").exists()


OTHER_TOWNS = {"Town01": "Town03", "Town02": "Town04"}


def other_run(release_inputs: Path, target: Path, rename: dict[str, str] = OTHER_TOWNS) -> Path:
    shutil.copytree(release_inputs, target)
    for old, new in rename.items():
        (target / "tree" / old).rename(target / "tree" / new)
    rewrite_captions(target, lambda lines: [one.update(town=rename.get(one["town"], one["town"])) for one in lines])
    write_inspection(target / "inspect.json", make_inspection(target / "tree", {}))
    return target


def ids_of(folder: Path) -> list[str]:
    return pq.read_table(folder / "data", columns=["sample_id"]).column(0).to_pylist()


def joined(out: Path, *sources: Source) -> tuple[Path, ReleaseRecord]:
    folder = run(CFG, sources, out)
    assert verify(folder).is_ok
    assert len(ids_of(folder)) == len(set(ids_of(folder))) == 8 * (4 + 6)
    return folder, read_record(folder / "release.json")


def test_runs_of_other_towns_go_into_one_release_under_ids_of_their_own(release_inputs, built, tmp_path):
    other = other_run(release_inputs, tmp_path / "in")
    folder, record = joined(tmp_path / "r", source_of(release_inputs), source_of(other, "two"))
    ids, alone = ids_of(folder), ids_of(built)
    assert f"Town01_{alone[0]}" in ids, "both runs have this trajectory, so the town tells them apart"
    assert set(alone) == {i.partition("_")[2] for i in ids if i.startswith(("Town01", "Town02"))}
    before = read_record(built / "release.json")
    assert record.history.captions.read == 2 * before.history.captions.read
    assert record.history.trajectories.planned == 2 * before.history.trajectories.planned
    rows = pq.read_table(folder / "data", columns=["run", "town", "has_caption"]).to_pylist()
    towns = {"one": set(OTHER_TOWNS), "two": set(OTHER_TOWNS.values())}
    assert {(row["run"], row["town"]) for row in rows} == {(name, town) for name in towns for town in towns[name]}
    num_captions = sum(row["has_caption"] for row in rows)
    assert num_captions == record.history.captions.released > before.history.captions.released
    with pytest.raises(InputError, match=r"two runs have one name.*different names"):
        run(CFG, [source_of(release_inputs), source_of(other)], tmp_path / "r2")
    # Of two trees in one folder each goes by its own name.
    (other / "tree").rename(other / "second")
    _, record = joined(tmp_path / "trees", source_of(release_inputs), replace(source_of(other), data=other / "second"))
    assert {one.flight.partition("/")[0] for one in record.flights} == {"one_tree", "one_second"}


@given(st.lists(st.integers(1, 50), max_size=30), st.integers(1, 120))
def test_shards_lose_nothing_and_keep_the_order(sizes, target):
    groups = plan_shards(sizes, target)
    assert [index for group in groups for index in group] == list(range(len(sizes)))
    for group in groups[:-1]:
        assert sum(sizes[i] for i in group) >= target
        assert sum(sizes[i] for i in group[:-1]) < target


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
    assert history["flights"] == {
        "found": 6, "inspected": 6, "released": 4, "left_out": {"rejected: missing_file": 1, "review: stray_frame": 1},
    }  # fmt: skip
    captions = history["captions"]
    assert (captions["read"], captions["dropped"]) == (6 * 8, {"hard_conflict": 6})
    assert captions["flight_left_out"] == 2 * 7
    # Of 12 frames 2 to 9 are released; captions stand at 4 to 10, and each needs the four frames before its own.
    assert (captions["released"], captions["window_not_whole"]) == (4 * 4, 4 * 2)
    assert captions["frame_not_selected"] == 4
