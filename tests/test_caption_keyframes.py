"""Keyframes: no change of the label is missed, and what is saved adds up."""

from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from caption.run.stage import run
from caption.run.windows import choose_keyframes, cut_windows, missed_changes
from caption.schema import CaptionConfig
from caption.truth.actions import label_of, measure
from cosfly.products.captions import read_captions
from cosfly.products.flights import find_flights
from cosfly.products.playback import read_flight
from specimens import make_playback_tree

LABELS = st.lists(st.sampled_from(["track_straight", "hover", None]), max_size=60)


def test_a_hand_made_flight():
    labels = ["a", "a", "a", "b", "b", "b", "b", "b", "a", None, None]
    found = choose_keyframes(labels, 3)
    assert {i: keyframe.model_dump() for i, keyframe in found.items()} == {
        0: {"reason": "start", "skipped": 2, "missed": 0},
        3: {"reason": "change", "skipped": 2, "missed": 0},
        6: {"reason": "stride", "skipped": 1, "missed": 0},
        8: {"reason": "change", "skipped": 0, "missed": 0},
        9: {"reason": "change", "skipped": 1, "missed": 0},
    }
    assert choose_keyframes([], 3) == {}


@given(LABELS, st.integers(1, 12))
def test_no_change_is_missed_and_every_window_is_taken_or_counted(labels, stride):
    chosen = choose_keyframes(labels, stride)
    assert missed_changes(labels, set(chosen)) == []
    assert len(chosen) + sum(keyframe.skipped for keyframe in chosen.values()) == len(labels)
    assert all(keyframe.skipped < stride for keyframe in chosen.values())
    # Whoever gives each window the label of the keyframe before it gets the flight's labels back.
    spread = [labels[max(k for k in chosen if k <= i)] for i in range(len(labels))]
    assert spread == labels


def test_the_count_of_missed_changes_can_fail():
    assert missed_changes(["a", "b", "b", "a"], {0, 3}) == [1]
    assert choose_keyframes(["a"] * 8, 20)[0].skipped == 7


def test_a_run_reports_what_it_saved(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 2, 40, with_images=False)
    window = {"require_images": False, "keyframe_stride": 5}
    plain = run(CaptionConfig.model_validate({"window": window}), tree, tmp_path / "plain")
    few = run(CaptionConfig.model_validate({"window": window | {"keyframes": True}}), tree, tmp_path / "few")
    every = {caption.sample_id: caption for caption in read_captions(plain)}
    taken = list(read_captions(few))
    report = json.loads((tmp_path / "few" / "caption_report.json").read_text())["keyframes"]
    assert report["windows"] == len(every) == 4 * 31
    assert report["taken"] == len(taken) < len(every)
    assert report["changes_missed"] == 0
    assert report["calls_saved"] > 0
    # Read anew from the flights: every window whose label differs from the one before was captioned.
    ids = {caption.sample_id for caption in taken}
    cfg = CaptionConfig.model_validate({"window": window})
    for folder in find_flights(tree):
        samples = list(cut_windows(read_flight(folder), cfg.window))
        labels = [label_of(measure(sample.future), cfg.label) for sample in samples]
        for before, after, sample in zip(labels, labels[1:], samples[1:], strict=False):
            assert before == after or sample.observed.sample_id in ids
    # The window itself is the same one: only the mark is added.
    for caption in taken:
        assert caption.checks.keyframe.missed == 0
        caption.checks.keyframe = None
        assert caption == every[caption.sample_id]
    assert json.loads((tmp_path / "plain" / "caption_report.json").read_text())["keyframes"] is None
