"""distill/prepare/dual_track.py: windows over both tracks of a flight."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tables import each

from cosfly.formats.playback import read_track
from cosfly.geometry.splits import SPLITS
from cosfly.runtime.run_dir import read_failures, read_manifest
from cosfly.runtime.tables import rows_of
from distill.prepare import dual_track
from distill.prepare.dual_track import DualTrackConfig, TrackSample, windows_of
from distill.schema import split_path
from specimens import make_playback_tree

NUM_POINTS = 24


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("run") / "render"
    return make_playback_tree(root, num_flights=4, num_points=NUM_POINTS, towns=("Town01", "Town03"), with_images=False)


@pytest.fixture(scope="module")
def dataset(tree, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("windows") / "set"
    return dual_track.run(DualTrackConfig(val_fraction=0.25, test_fraction=0.25), [tree], out)


def samples(dataset: Path) -> dict[str, list[TrackSample]]:
    return {split: [TrackSample(**row) for row in rows_of(split_path(dataset, split))] for split in SPLITS}


def run(tree: Path, out: Path, **settings: object) -> Path:
    return dual_track.run(DualTrackConfig.model_validate(settings), [tree], out)


@each(("num_frames", "expected"), [(9, []), (10, [0]), (12, [0]), (13, [0, 3]), (170, 54), (200, 64)])
def test_the_papers_windows(num_frames, expected):
    """Windows of 10 frames, one every 3: (N - 10) / 3 + 1, which the paper calls 50 to 60 of 170 to 200 frames."""
    found = list(windows_of(num_frames, DualTrackConfig()))
    assert (len(found) if isinstance(expected, int) else found) == expected


def test_a_window_holds_both_tracks_frame_by_frame(tree, dataset):
    found = [sample for split in samples(dataset).values() for sample in split]
    assert len(found) == 4 * ((NUM_POINTS - 10) // 3 + 1)
    for sample in found:
        folder = tree / sample.town / sample.trajectory
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
        np.testing.assert_allclose(
            np.subtract(sample.observed_position_m, sample.clean_position_m),
            noisy.perturbation.drone_m[seen],
            atol=1e-9,
        )


def test_a_bad_flight_stops_no_other(tmp_path, tree):
    own_tree = Path(shutil.copytree(tree, tmp_path / "run" / "render"))
    flights = sorted(own_tree.glob("*/*/aug_001"))
    (flights[0] / "trajectory.json").write_text("{")
    shutil.rmtree(flights[1].parent / "ORI")
    raw = json.loads((flights[2] / "trajectory.json").read_text())
    raw["points"] = raw["points"][:20]
    raw["points"][-1]["nav_waypoint"]["t1_world"] = None
    (flights[2] / "trajectory.json").write_text(json.dumps(raw))
    out = run(own_tree, tmp_path / "set")
    counts = read_manifest(out).counts
    assert (counts.input, counts.kept) == (4, 1)
    assert counts.dropped == {"no_clean_flight": 1, "clean_flight_of_other_frames": 1}
    assert counts.failed.total() == 1
    assert flights[0].parent.name in read_failures(out / "failures.jsonl")[0].id


def test_no_walk_is_in_two_splits(dataset):
    walks = [{sample.walk for sample in found} for found in samples(dataset).values()]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 4
    splits = json.loads((dataset / "manifest.json").read_text())["splits"]
    assert {split: facts["samples"] for split, facts in splits.items()} == {
        split: len(found) for split, found in samples(dataset).items()
    }
