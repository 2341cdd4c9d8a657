"""Windows for training code of one's own: the same from a tree and from its release, in tensors, with workers."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from specimens_release import CFG, build, make_caption, make_inspection

from cosfly.formats.captions import write_captions
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from distill.windows import FACTS, Windows
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


@pytest.mark.parametrize("language", ["en", "zh"])
def test_a_tree_and_its_release_give_the_same_windows(place, language):
    tree = Windows(place / "tree", place / "captions.jsonl", language=language)
    release = Windows(place / "release", language=language)
    assert len(tree) == len(release) == 6 * (NUM_POINTS - 6)
    assert tree.left_out == {"dropped_hard_conflict": 6}
    numbers = {(p.flight[1:], p.window): i for i, p in enumerate(release._places)}
    for i, found in enumerate(tree._places):
        ours, theirs = tree[i], release[numbers[found.flight[1:], found.window]]
        assert np.array_equal(ours["frames"], theirs["frames"])
        assert (ours["prompt"], ours["caption"]) == (theirs["prompt"], theirs["caption"])
        assert ours["facts"].keys() == theirs["facts"].keys() == FACTS.keys()
        for name, values in ours["facts"].items():
            assert np.allclose(values, theirs["facts"][name], rtol=0, atol=1e-9, equal_nan=True), name
            assert values.dtype == theirs["facts"][name].dtype


def test_splits_of_a_release_share_no_walk_and_make_up_the_whole(place):
    record = json.loads((place / "release/dataset/release.json").read_text())
    names = sorted({shard["split"] for shard in record["shards"]})
    parts = [Windows(place / "release/dataset", split=name) for name in names]
    assert sum(map(len, parts)) == len(Windows(place / "release/dataset"))
    trajectories = [{found.flight[2] for found in part._places} for part in parts]
    assert sum(map(len, trajectories)) == len(set().union(*trajectories))


@pytest.mark.parametrize("source", ["tree", "release"])
def test_pytorch_loads_them_with_two_workers(place, source):
    torch = pytest.importorskip("torch")
    from distill.windows import WindowDataset

    given = (place / "tree", place / "captions.jsonl") if source == "tree" else (place / "release",)
    windows = WindowDataset(*given, max_side_px=48)
    assert len(pickle.loads(pickle.dumps(windows))) == len(windows)
    loader = torch.utils.data.DataLoader(windows, batch_size=4, num_workers=2)
    seen = []
    for batch in loader:
        assert (batch["frames"].shape[1:], batch["frames"].dtype) == ((5, 3, 27, 48), torch.uint8)
        assert batch["facts"]["target"].shape[1:] == (5, 3)
        seen += batch["sample_id"]
    assert seen == [windows[i]["sample_id"] for i in range(len(windows))]
