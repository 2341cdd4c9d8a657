"""Training sets: of captions, of both tracks of a flight, and windows of a release in tensors."""

import json
import pickle
import re
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from specimens_distill import make_caption, make_captions, prepared
from specimens_release import DROPPED, release_of

from cosfly.formats.captions import read_captions, write_captions
from cosfly.formats.frames import frame_name
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.geometry.splits import SPLITS
from cosfly.inspection.blind_baseline import past_of
from cosfly.runtime.errors import ConfigError, InputError, ResumeError
from cosfly.runtime.run_dir import read_failures, read_manifest
from cosfly.runtime.tables import rows_of
from cosfly.viz.frame_views import Pictures, read_view
from distill.prepare import dual_track, stage
from distill.prepare.dual_track import DualTrackConfig, TrackSample, windows_of
from distill.prepare.stage import PrepareConfig, RunSource, make_sample
from distill.schema import Sample, open_split, resolve_trees, split_path
from distill.windows import FACTS, FLAGS, WindowDataset
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("tree")
    return make_playback_tree(root, num_flights=5, num_points=8, towns=("Town01", "Town03", "Town03_Opt"))


@pytest.fixture(scope="module")
def captions(tree, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("captions") / "captions.jsonl"
    make_captions(path, tree)
    return path


def test_which_captions_teach_and_how_much():
    checks = {"values": {"en": {"values_filled": 1, "values_contradicted": 1}, "zh": {"values_filled": 1}}}

    def made(changes: dict, language: str = "en", variant: str = "ORI", **settings) -> Sample | str:
        caption = make_caption("Town01", "trajectory_1", variant, 4, **changes)
        return make_sample(caption, language, PrepareConfig(**settings))

    assert made({"verdict": "SOFT_CONFLICT"}, verdicts=("CONSISTENT",)) == "verdict_soft_conflict"
    assert isinstance(made({"verdict": "SOFT_CONFLICT"}), Sample)
    assert made({"checks": checks}) == "contradicted"
    assert isinstance(made({"checks": checks}, "zh"), Sample)
    assert made({"label": "hover"}).label == "hover"
    assert made({"label": "hover", "label_from": "perturbed"}, variant="aug_001").label is None  # it is noisy
    dark = made({"depth_range_m": 40.0}, modalities=("depth",))
    assert "black is 40 m and beyond" in dark.prompt.user
    assert dark.pictures.depth_range_m == 40.0


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    from caption.schema import CaptionConfig
    from caption.stage.stage import run as caption_run

    root = tmp_path_factory.mktemp("asked")
    tree = make_playback_tree(root / "tree", 1, 12, with_augmented=False)
    path = caption_run(CaptionConfig(), tree, root / "caption")
    return next(caption for caption in read_captions(path) if caption.status == "accepted")


@pytest.mark.parametrize("language", ["en", "zh"])
def test_a_student_may_get_text_alone_or_pictures_alone(asked, language):
    both, text, pictures = (
        make_sample(asked, language, PrepareConfig(modalities=views, text_state=state))
        for views, state in ((("rgb",), True), ((), True), (("rgb",), False))
    )
    told = {"en": "No pictures are given.", "zh": "未提供图像。"}[language]
    assert told in text.prompt.user
    assert text.images == []
    assert both.prompt.user.count("\n") == text.prompt.user.count("\n") > 8
    line = pictures.prompt.user
    assert "\n" not in line
    assert line == both.prompt.user.partition("\n")[0]
    # Of the measured values nothing is left: the numbers are those of frames, their distance in time, and pixels.
    assert re.findall(r"\d+(?:\.\d+)?", line) == ["5", "0.5", "64", "36"]
    assert pictures.images == both.images != []
    with pytest.raises(ValidationError, match="modalities must not be empty"):
        PrepareConfig(modalities=(), text_state=False)


def test_a_town_and_its_layered_map_are_in_one_split_and_counts_add_up(tree, captions, tmp_path):
    out = prepared(tree, captions, tmp_path / "set", split_by="town")
    splits = {split: list(open_split(out, split)) for split in SPLITS}
    towns = [{sample.town.removesuffix("_Opt") for sample in found} for found in splits.values()]
    assert sum(map(len, towns)) == len(set.union(*towns)) == 2
    manifest, sizes = json.loads((out / "manifest.json").read_text()), {name: len(own) for name, own in splits.items()}
    # Flights, variants, windows, languages.
    assert manifest["counts"]["kept"] == sum(sizes.values()) == 5 * 2 * 4 * 2
    assert {split: facts["samples"] for split, facts in manifest["splits"].items()} == sizes


def test_a_sample_has_the_past_of_its_own_frames(tree, captions, tmp_path):
    samples = [sample for split in SPLITS for sample in open_split(prepared(tree, captions, tmp_path / "set"), split)]
    assert {sample.variant for sample in samples} == {"ORI", "aug_001"}
    for sample in samples:
        past = past_of(read_track(tree / sample.town / sample.trajectory / sample.variant), sample.window, False)
        np.testing.assert_allclose(sample.past, past, atol=1e-4)


def test_run_counts_what_it_leaves_out(tree, tmp_path):
    records = make_captions(tmp_path / "all.jsonl", tree)
    records[0] = records[0].model_copy(update={"status": "dropped", "drop_reason": "hard_conflict"})
    records[1] = records[1].model_copy(update={"window": [90, 91, 92, 93, 94]})
    records[2] = records[2].model_copy(update={"zh": None})
    write_captions(tmp_path / "captions.jsonl", records)
    out = prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")
    counts = json.loads((out / "manifest.json").read_text())["counts"]
    assert counts["dropped"] == {"dropped_hard_conflict": 2, "missing_image": 2, "no_zh": 1}
    assert counts["input"] == counts["kept"] + 5


def test_the_walk_of_a_flight_decides_its_split_and_not_its_name(tmp_path):
    runs = []
    for number, (town, shift) in enumerate((("Town03", 0), ("Town03_Opt", 7), ("Town03", 9))):
        run = tmp_path / f"run_{number}"
        tree = make_playback_tree(run / "render", 4, 8, towns=(town,))
        for folder in sorted(tree.glob(f"{town}/trajectory_*")):  # another second of the same walk
            folder.rename(folder.with_name(f"trajectory_{int(folder.name[11:]) + shift}"))
        make_captions(run / "captions.jsonl", tree)
        runs.append(RunSource(tree, run / "captions.jsonl"))
    cfg = PrepareConfig(val_fraction=0.25, test_fraction=0.25)
    out = stage.run(cfg, runs, tmp_path / "set")
    samples = {split: list(open_split(out, split)) for split in SPLITS}
    walks = {split: {sample.walk for sample in found} for split, found in samples.items()}
    assert sorted(map(len, walks.values())) == [1, 1, 2]
    assert len(set.union(*walks.values())) == 4
    everyone = [sample for found in samples.values() for sample in found]
    assert len({sample.key for sample in everyone}) == len(everyone) == 3 * 4 * 2 * 4 * 2
    flights = {(s.walk, s.run, s.trajectory, s.variant) for s in everyone}
    assert set(Counter(walk for walk, *_ in flights).values()) == {6}  # of three runs, clean and perturbed
    facts = json.loads((out / "manifest.json").read_text())["splits"]
    assert sum(found["tracks"] for found in facts.values()) == 24
    trees = resolve_trees(out, [source.data for source in reversed(runs)])
    assert trees == {source.run: source.data for source in runs}
    for sample in everyone[::17]:
        assert all((trees[sample.run] / image).is_file() for image in sample.images)


def test_a_window_that_is_captioned_twice_is_refused(tree, tmp_path):
    records = make_captions(tmp_path / "all.jsonl", tree)
    write_captions(tmp_path / "captions.jsonl", [*records, records[3]])
    with pytest.raises(InputError, match=f"{records[3].sample_id}: the captions have two lines for this window"):
        prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")


def test_a_limit_keeps_so_many_windows_whole_and_more_with_a_larger_limit(tree, captions, tmp_path):
    def kept(limit: int) -> dict[str, set[str]]:
        out = prepared(tree, captions, tmp_path / str(limit), limit=limit)
        languages: dict[str, set[str]] = {}
        for sample in (sample for split in SPLITS for sample in open_split(out, split)):
            languages.setdefault(sample.sample_id, set()).add(sample.language)
        counts = json.loads((out / "manifest.json").read_text())["counts"]
        assert counts["dropped"].get("limit", 0) == 2 * (40 - len(languages))
        return languages

    few, more, everything = kept(7), kept(16), kept(0)
    assert (len(few), len(more), len(everything)) == (7, 16, 40)
    assert few.keys() < more.keys() < everything.keys()
    assert all(languages == {"en", "zh"} for languages in few.values())


def test_run_twice_gives_the_same_bytes(tree, captions, tmp_path):
    first, second = (prepared(tree, captions, tmp_path / name) for name in "ab")
    for split in SPLITS:
        assert split_path(first, split).read_bytes() == split_path(second, split).read_bytes()
    with pytest.raises(ResumeError, match="languages"):
        prepared(tree, captions, first, languages=("en",))


def test_the_library_of_data_sets_opens_it(tree, captions, tmp_path):
    datasets = pytest.importorskip("datasets", reason="needs the extra distill")
    out = prepared(tree, captions, tmp_path / "set")
    found = datasets.load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    assert set(found) == {"train", "validation", "test"}
    for split, name in (("train", "train"), ("val", "validation")):
        samples = open_split(out, split)
        assert len(found[name]) == len(samples)
        row, sample = found[name][3], samples[3]
        found_values = row["prompt"], row["answer"], row["window"]
        assert found_values == (sample.prompt.model_dump(), sample.answer, list(sample.window))


NUM_FRAMES = 24


@pytest.fixture(scope="module")
def four_walks(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("run") / "render"
    return make_playback_tree(root, num_flights=4, num_points=NUM_FRAMES, towns=("Town01", "Town03"), with_images=False)


@pytest.fixture(scope="module")
def windows_of_tracks(four_walks, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("windows") / "set"
    return dual_track.run(DualTrackConfig(val_fraction=0.25, test_fraction=0.25), [four_walks], out)


def test_the_papers_windows():
    """Windows of 10 frames, one every 3: (N - 10) / 3 + 1, which the paper calls 50 to 60 of 170 to 200 frames."""
    for num_frames, expected in [(9, []), (10, [0]), (12, [0]), (13, [0, 3]), (170, 54), (200, 64)]:
        found = list(windows_of(num_frames, DualTrackConfig()))
        assert (len(found) if isinstance(expected, int) else found) == expected


def test_a_window_holds_both_tracks_frame_by_frame_and_no_walk_is_in_two_splits(four_walks, windows_of_tracks):
    paths = {split: split_path(windows_of_tracks, split) for split in SPLITS}
    splits = {split: [TrackSample(**row) for row in rows_of(path)] for split, path in paths.items()}
    walks = [{sample.walk for sample in found} for found in splits.values()]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 4
    told = json.loads((windows_of_tracks / "manifest.json").read_text())["splits"]
    assert {name: facts["samples"] for name, facts in told.items()} == {name: len(own) for name, own in splits.items()}
    found = [sample for own in splits.values() for sample in own]
    assert len(found) == 4 * ((NUM_FRAMES - 10) // 3 + 1)
    for sample in found:
        folder = four_walks / sample.town / sample.trajectory
        noisy, clean = read_track(folder / sample.variant), read_track(folder / "ORI")
        assert sample.variant == "aug_001"
        first = sample.window[0]
        assert sample.window == tuple(range(first, first + 5))
        assert sample.future == tuple(range(first + 5, first + 10))
        assert sample.sample_id == f"{sample.trajectory}_aug_001_frame_{first + 4:05d}"
        seen, after = list(sample.window), list(sample.future)
        np.testing.assert_array_equal(sample.time_s, clean.time_s[seen + after])
        np.testing.assert_array_equal(sample.observed_position_m, noisy.positions_m[seen])
        np.testing.assert_array_equal(sample.observed_rotation_deg, noisy.rotations_deg[seen])
        np.testing.assert_array_equal(sample.clean_position_m, clean.positions_m[seen])
        np.testing.assert_array_equal(sample.future_position_m, clean.positions_m[after])
        np.testing.assert_array_equal(sample.future_target_m, clean.targets_m[after])
        # What was added is what the flight's record says was added.
        added_m = np.subtract(sample.observed_position_m, sample.clean_position_m)
        np.testing.assert_allclose(added_m, noisy.perturbation.drone_m[seen], atol=1e-9)


def test_a_bad_flight_stops_no_other(tmp_path, four_walks):
    own_tree = Path(shutil.copytree(four_walks, tmp_path / "run" / "render"))
    flights = sorted(own_tree.glob("*/*/aug_001"))
    (flights[0] / "trajectory.json").write_text("{")
    shutil.rmtree(flights[1].parent / "ORI")
    raw = json.loads((flights[2] / "trajectory.json").read_text())
    raw["points"] = raw["points"][:20]
    raw["points"][-1]["nav_waypoint"]["t1_world"] = None
    (flights[2] / "trajectory.json").write_text(json.dumps(raw))
    out = dual_track.run(DualTrackConfig(), [own_tree], tmp_path / "set")
    counts = read_manifest(out).counts
    assert (counts.input, counts.kept) == (4, 1)
    assert counts.dropped == {"no_clean_flight": 1, "clean_flight_of_other_frames": 1}
    assert counts.failed.total() == 1
    assert flights[0].parent.name in read_failures(out / "failures.jsonl")[0].id


NUM_POINTS = 9


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """tree/, captions.jsonl and release/dataset/ of three walks; the last caption of each flight was dropped."""
    root = tmp_path_factory.mktemp("windows")
    make_playback_tree(root / "tree", 3, NUM_POINTS, width_px=96, height_px=54)
    release_of(root, changes=lambda one: DROPPED if one.frame_index == NUM_POINTS - 2 else {}, selection="all")
    return root


def facts_in_tree(track: Track, at: list[int]) -> dict[str, np.ndarray]:
    """The slow obvious version: what a release says of some frames of a track."""
    target = track.target
    cameras = [track.camera_at(index).intrinsic for index in at]
    found = {
        "time_s": track.time_s[at], "pose": np.hstack([track.positions_m[at], track.rotations_deg[at]]),
        "intrinsics": np.array([(c[0, 0], c[1, 1], c[0, 2], c[1, 2]) for c in cameras]), "target": track.targets_m[at],
        "visibility": target.visibility[at], "target_mask_bbox": np.full((len(at), 4), np.nan),
    }  # fmt: skip
    return found | {f"target_{n}": getattr(target, n)[at] for n in ("uv", "bbox", "depth_m", "in_view", "visible")}


@pytest.mark.parametrize("language", ["en", "zh"])
def test_windows_are_those_of_the_tree(place, language):
    captions = [caption for caption in read_captions(place / "captions.jsonl") if caption.status == "accepted"]
    windows = WindowDataset(place / "release", language=language)
    found = {(p.flight[1:], p.window): windows[i] for i, p in enumerate(windows._places)}
    assert len(found) == len(captions) == 6 * (NUM_POINTS - 6)
    for caption in captions:
        folder = place / "tree" / caption.town / caption.trajectory / caption.variant
        window = found[folder.parts[-3:], tuple(caption.window)]
        pictures = np.stack([read_view(folder / frame_name(index), "rgb") for index in caption.window])
        assert np.array_equal(window["frames"], pictures.transpose(0, 3, 1, 2))
        sentence = Pictures(("rgb",), caption.picture_px).sentence(language)
        assert window["prompt"] == caption.prompt[language].filled(sentence).model_dump()
        texts = (caption.en if language == "en" else caption.zh).model_dump()
        assert window["caption"] == texts | {"label": caption.label or "", "verdict": caption.verdict or ""}
        facts = facts_in_tree(read_track(folder), list(caption.window))
        assert window["facts"].keys() == facts.keys() == FACTS.keys()
        for name, values in window["facts"].items():
            assert np.allclose(values, facts[name], rtol=0, atol=1e-9, equal_nan=True), name
            assert values.dtype == (bool if name in FLAGS else np.float64)


def test_splits_of_a_release_make_up_the_whole(place):
    record = json.loads((place / "release/dataset/release.json").read_text())
    names = sorted({shard["split"] for shard in record["shards"]})
    parts = [WindowDataset(place / "release/dataset", split=name) for name in names]
    assert sum(map(len, parts)) == len(WindowDataset(place / "release/dataset"))
    assert len(WindowDataset(place)) == sum(map(len, parts))  # a run directory has its release below it


def test_pytorch_loads_them_with_two_workers(place):
    torch = pytest.importorskip("torch")
    windows = WindowDataset(place / "release")
    assert len(pickle.loads(pickle.dumps(windows))) == len(windows)
    loader = torch.utils.data.DataLoader(windows, batch_size=4, num_workers=2)
    seen = []
    for batch in loader:
        assert (batch["frames"].shape[1:], batch["frames"].dtype) == ((5, 3, 54, 96), torch.uint8)
        assert batch["facts"]["target"].shape[1:] == (5, 3)
        assert batch["facts"]["target_visible"].dtype == torch.bool
        seen += batch["sample_id"]
    assert seen == [windows[i]["sample_id"] for i in range(len(windows))]


def test_frames_are_scaled_to_the_size_that_pixels_in_the_texts_refer_to(place, tmp_path):
    (tmp_path / "tree").symlink_to(place / "tree")
    release_of(tmp_path, picture_px=(48, 27), selection="all")
    assert WindowDataset(tmp_path / "release")[0]["frames"].shape == (5, 3, 27, 48)


def test_what_is_no_release_of_consecutive_frames_is_refused(place, built):
    with pytest.raises(InputError, match="contains no release"):
        WindowDataset(place / "tree")
    with pytest.raises(ConfigError, match="no split of this name"):
        WindowDataset(place / "release", split="tests")
    with pytest.raises(InputError, match=r"release\.selection=windows"):
        WindowDataset(built)
