"""Windows for training code of one's own: those of the tree that a release was built from, in tensors, with workers."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from specimens_release import CFG, build, make_caption, make_inspection

from cosfly.formats.captions import read_captions, write_captions
from cosfly.formats.frames import frame_name
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.viz.frame_views import Pictures, read_view
from distill.windows import FACTS, FLAGS, WindowDataset
from specimens import make_playback_tree

NUM_POINTS = 9


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """tree/, captions.jsonl and release/dataset/ of three walks; the last caption of each flight was dropped."""
    root = tmp_path_factory.mktemp("windows")
    make_playback_tree(root / "tree", 3, NUM_POINTS, width_px=96, height_px=54)
    dropped = {"status": "dropped", "drop_reason": "hard_conflict"}
    captions = [
        make_caption(flight, i, **(dropped if i == NUM_POINTS - 2 else {}))
        for flight in map(read_track, find_tracks(root / "tree"))
        for i in range(4, NUM_POINTS - 1)
    ]
    write_captions(root / "captions.jsonl", captions)
    write_inspection(root / "inspect.json", make_inspection(root / "tree", {}))
    build(root, root / "release", CFG.model_copy(update={"selection": "all"}))
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
        assert window["prompt"] == caption.prompt[language].told(sentence).model_dump()
        texts = (caption.en if language == "en" else caption.zh).model_dump()
        assert window["caption"] == texts | {"label": caption.label or "", "verdict": caption.verdict or ""}
        facts = facts_in_tree(read_track(folder), list(caption.window))
        assert window["facts"].keys() == facts.keys() == FACTS.keys()
        for name, values in window["facts"].items():
            assert np.allclose(values, facts[name], rtol=0, atol=1e-9, equal_nan=True), name
            assert values.dtype == (bool if name in FLAGS else np.float64)


def test_splits_of_a_release_share_no_walk_and_make_up_the_whole(place):
    record = json.loads((place / "release/dataset/release.json").read_text())
    names = sorted({shard["split"] for shard in record["shards"]})
    parts = [WindowDataset(place / "release/dataset", split=name) for name in names]
    assert sum(map(len, parts)) == len(WindowDataset(place / "release/dataset"))
    assert len(WindowDataset(place)) == sum(map(len, parts))  # a run directory has its release below it
    trajectories = [{found.flight[2] for found in part._places} for part in parts]
    assert sum(map(len, trajectories)) == len(set().union(*trajectories))


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
    small = [caption.model_copy(update={"picture_px": (48, 27)}) for caption in read_captions(place / "captions.jsonl")]
    (tmp_path / "tree").symlink_to(place / "tree")
    write_captions(tmp_path / "captions.jsonl", small)
    write_inspection(tmp_path / "inspect.json", make_inspection(place / "tree", {}))
    build(tmp_path, tmp_path / "release", CFG.model_copy(update={"selection": "all"}))
    assert WindowDataset(tmp_path / "release")[0]["frames"].shape == (5, 3, 27, 48)


def test_what_is_no_release_of_consecutive_frames_is_refused(place, built):
    with pytest.raises(InputError, match="contains no release"):
        WindowDataset(place / "tree")
    with pytest.raises(ConfigError, match="no split of this name"):
        WindowDataset(place / "release", split="tests")
    with pytest.raises(InputError, match=r"release\.selection=windows"):
        WindowDataset(built)
