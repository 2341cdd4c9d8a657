"""Captions as conversations; exports of what has nothing to export, and onto a full disk."""

import json
import shutil
from pathlib import Path

import pytest
from processes import full_disk
from release_tampering import errors_in
from specimens_release import CFG, DROPPED, build, release_of

from cosfly.formats.captions import Caption, Coc, read_captions
from cosfly.runtime.config import build as build_config
from cosfly.runtime.errors import CosflyError, InputError, StorageError
from cosfly.runtime.png import png_size
from distill.prepare.stage import RunSource
from release.export.stage import EXPORTS, ExportConfig
from release.export.stage import run as export
from release.record import read_record
from specimens import make_playback_tree

NUM_POINTS = 9
ANSWER = {"critical_components": "=HYPERLINK(1) ahead", "reasoning_trace": 'A, B\nC "D"', "flight_decision": "hover"}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run folder: render/, captions.jsonl (one dropped in each flight), and release/dataset/ of it."""
    root = tmp_path_factory.mktemp("one") / "run"
    make_playback_tree(root / "render", 2, NUM_POINTS)
    (root / "tree").symlink_to("render")

    def changes(caption: Caption) -> dict:
        odd = Coc(**ANSWER | {"flight_decision": caption.en.flight_decision})
        return {4: {"en": odd}, NUM_POINTS - 2: DROPPED}.get(caption.frame_index, {})

    release_of(root, changes=changes, selection="all")
    return root


def accepted(run: Path) -> list:
    return [caption for caption in read_captions(run / "captions.jsonl") if caption.status == "accepted"]


def exported(source: Path, out: Path, format: str = "chat", **settings) -> Path:
    return export(build_config(ExportConfig, {"format": format, **settings}, "test"), source, out)


@pytest.mark.parametrize("format", ["chat", "sharegpt"])
def test_the_last_frame_alone_needs_no_consecutive_frames(run, tmp_path, format):
    stride = build(run, tmp_path / "r", CFG.model_copy(update={"num_frames": 5}))
    with pytest.raises(InputError, match=r"needs consecutive frames.*release\.selection=windows"):
        exported(stride, tmp_path / "windows", format)
    folder = exported(stride, tmp_path / "last", format, frames="last", languages=["en"])
    released = read_record(stride / "release.json").history.captions.released
    about = f"- {released} samples, one per window and language. Skipped: none."
    assert about in (folder / "README.md").read_text(encoding="utf-8")
    assert released > 0


def lines_of(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


@pytest.mark.parametrize("shown", ["all", "last"])
def test_messages_are_what_their_loaders_ask_for(run, tmp_path, shown):
    datasets = pytest.importorskip("datasets")
    product = exported(run, tmp_path / "out", frames=shown)
    train = product / "train.jsonl"
    samples = lines_of(train)
    found = datasets.load_dataset("json", data_files=str(train), split="train", cache_dir=str(tmp_path / "cache"))
    assert len(found) == len(samples) == 2 * len(accepted(run))
    for sample, loaded in zip(samples, found, strict=True):
        assert [turn["role"] for turn in loaded["messages"]] == ["user", "assistant"]
        blocks = sample["messages"][0]["content"]
        num_pictures = sum(block["type"] == "image" for block in blocks)
        assert num_pictures == len(sample["images"]) == (5 if shown == "all" else 1)
        assert set(json.loads(sample["messages"][1]["content"][0]["text"])) == set(ANSWER)
        for name in sample["images"]:
            _, *place, frame = Path(name).with_suffix("").parts
            picture = run.joinpath("render", *place[-3:], "frames_playback", frame, "rgb.png")
            assert (product / name).read_bytes() == picture.read_bytes()
    first, caption = samples[0]["messages"][0]["content"], accepted(run)[0]
    assert caption.prompt["en"].system in first[0]["text"]
    assert ("One picture is given" in first[-1]["text"]) == (shown == "last")
    assert json.loads(samples[0]["messages"][1]["content"][0]["text"])["reasoning_trace"] == ANSWER["reasoning_trace"]


def test_pictures_have_the_pixels_of_which_the_texts_speak(tmp_path):
    """A caption's numbers refer to the pictures that its teacher saw, which may be smaller than the frames."""
    make_playback_tree(tmp_path / "tree", 1, NUM_POINTS, width_px=96, height_px=54)
    dataset = release_of(tmp_path, picture_px=(32, 18))
    product = exported(dataset, tmp_path / "out")
    [sample, *_] = lines_of(product / "train.jsonl")
    assert "pictures of 32 x 18 px" in json.dumps(sample)
    assert {png_size((product / name).read_bytes()) for name in sample["images"]} == {(32, 18)}


def test_sharegpt_is_one_file_a_split_with_its_entry(two_splits, tmp_path):
    product = exported(two_splits, tmp_path / "out", "sharegpt", languages=["en"])
    about = json.loads((product / "dataset_info.json").read_text())
    assert set(about) == {"cosfly_train", "cosfly_validation"}
    ids = set()
    for entry in about.values():
        samples = json.loads((product / entry["file_name"]).read_text(encoding="utf-8"))
        for sample in samples:
            human, gpt = sample[entry["columns"]["messages"]]
            assert (human["from"], gpt["from"]) == ("human", "gpt")
            assert human["value"].startswith("t0: <image>\n")
            assert human["value"].count("<image>") == len(sample["images"])
            assert all((product / name).is_file() for name in sample["images"])
        ids |= {sample["id"] for sample in samples}
        assert len({sample["id"] for sample in samples}) == len(samples) > 0
    assert all(name.endswith("_en") for name in ids)


def test_a_training_set_is_not_made_of_a_release(run):
    with pytest.raises(InputError, match=r"release: the folder is not a run directory.*pass the run"):
        RunSource.of_run(run / "release")


@pytest.mark.parametrize("format", ["chat", "sharegpt"])
def test_a_release_without_captions_verifies_and_is_no_conversation(tmp_path, format):
    make_playback_tree(tmp_path / "tree", 1, 4, width_px=96, height_px=54)  # too short for a window
    dataset = release_of(tmp_path)
    assert errors_in(dataset, "rows") == {}
    with pytest.raises(CosflyError, match="no caption to export"):
        exported(dataset, tmp_path / "out", format)
    assert not (tmp_path / "out" / format).exists()


@pytest.mark.parametrize("format", EXPORTS)
def test_what_is_not_a_release_is_refused(two_splits, tmp_path, format):
    run = tmp_path / "run"
    shutil.copytree(two_splits.parents[1] / "tree", run / "render")
    with pytest.raises(InputError, match=r"the folder is not a release.*cosfly release build"):
        exported(run, tmp_path / "out", format)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("format", EXPORTS)
def test_a_full_disk_leaves_nothing_half_written(two_splits, tmp_path, format):
    out = tmp_path / "out"
    with full_disk(1_000), pytest.raises(StorageError, match="the file cannot be written"):
        exported(two_splits, out, format)
    assert not (out / format).exists()
    assert list(out.rglob("*.partial")) == []
    assert (exported(two_splits, out, format) / "README.md").is_file()
