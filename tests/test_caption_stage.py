"""Stage `caption` with the rule teacher: products, report page, tally, workers, resume, bad input."""

import json
import re
import shutil
from collections import Counter

import pytest

from caption.schema import CaptionConfig
from caption.stage import stage
from caption.stage.stage import run
from caption.stage.windows import cut_windows
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import read_captions
from cosfly.formats.playback import read_track, write_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import NothingKept, ResumeError
from specimens import change_json, make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 3, 18)


@pytest.fixture(scope="module")
def done(tree, tmp_path_factory):
    return run(CaptionConfig(), tree, tmp_path_factory.mktemp("done") / "caption").parent


def test_every_window_is_one_line_sorted_and_labelled_from_geometry(tree, done):
    captions = list(read_captions(done / "captions.jsonl"))
    expected = {}
    for folder in find_tracks(tree):
        for sample in cut_windows(read_track(folder), CaptionConfig().window):
            expected[sample.observed.sample_id] = TABLE.label_of(measure(sample.future))
    assert [caption.sample_id for caption in captions] == sorted(expected)
    assert {caption.sample_id: caption.label for caption in captions} == expected
    assert len(captions) == 6 * 9
    for caption in captions:
        assert (caption.teacher.kind, caption.window[-1]) == ("rules", caption.frame_index)
        assert (caption.future[0], caption.status) == (caption.frame_index + 1, "accepted")
        assert caption.verdict != "HARD_CONFLICT"
        assert caption.en.flight_decision == caption.zh.flight_decision


def test_the_report_adds_up_and_repairs_stay_on_record(tree, tmp_path):
    cfg = CaptionConfig.model_validate({"repair": {"soft_conflict": "repair"}})
    done = run(cfg, tree, tmp_path / "out").parent
    captions = list(read_captions(done / "captions.jsonl"))
    report = json.loads((done / "caption_report.json").read_text())
    manifest = json.loads((done / "manifest.json").read_text())
    accepted = [caption for caption in captions if caption.status == "accepted"]
    dropped = Counter(caption.drop_reason for caption in captions if caption.status == "dropped")
    counts = {"input": 54, "kept": len(accepted), "dropped": dict(dropped), "failed": {}}
    assert report["windows"] == manifest["counts"] == counts
    assert set(dropped) <= {"no_reason"}
    assert report["labels"] == dict(Counter(caption.label or "none" for caption in captions).most_common())
    repaired = [caption for caption in captions if caption.repair]
    assert repaired, "the specimens must hold a conflict for this test to mean anything"
    first = report["verdicts_of_first_answers"]
    assert report["repair"]["rejected"] == first["SOFT_CONFLICT"] + first.get("HARD_CONFLICT", 0) == len(repaired)
    assert any(caption.repair.rung == "anchored" for caption in repaired)
    anchored = [caption for caption in repaired if caption.status == "accepted"]
    assert all(c.repair.strategy == "anchored" and c.en.flight_decision == c.label for c in anchored)
    first = sum(count for row in report["confusion_label_to_first_decision"].values() for count in row.values())
    assert first == sum(report["verdicts_of_first_answers"].values()) == 54
    filled = [sum(caption.checks.values[language].values_filled for caption in accepted) for language in ("en", "zh")]
    assert [report["values"][language]["values_filled"] for language in ("en", "zh")] == filled
    assert min(filled) > 54
    assert not (done / "parts").exists()


def test_who_cannot_be_made_out_changes_what_is_said_to_be_seen_and_no_label(tree, done, tmp_path):
    before = list(read_captions(done / "captions.jsonl"))
    told = {}
    for legible in (True, False):
        dim = shutil.copytree(tree, tmp_path / f"tree_{legible}")
        for folder in find_tracks(dim):
            flight = read_track(folder)
            for point in flight.raw["points"]:
                point["target"]["legible"] = legible and point["target"]["visible"]
            write_track(folder, flight)
        told[legible] = list(read_captions(run(CaptionConfig(), dim, tmp_path / f"out_{legible}")))
    assert [one.model_dump() for one in told[True]] == [one.model_dump() for one in before], "nothing is said anew"
    for one, other in zip(before, told[False], strict=True):
        assert one.label == other.label
        if one.en is None or one.en.flight_decision in ("ascend", "move_backward"):  # which make the person smaller
            continue
        assert (one.verdict, one.en.flight_decision) == (other.verdict, other.en.flight_decision)
        text, chinese = (getattr(other, language).critical_components for language in ("en", "zh"))
        if one.checks.values and "search" not in one.en.flight_decision:
            assert not re.search(r"visible|centred|middle|midline|border|edge|axis", text), text
            assert not re.search("可见|居中|中央|中线|边缘|轴线", chinese), chinese


def test_a_product_never_loses_captions(tmp_path):
    tree, out = make_playback_tree(tmp_path / "tree", 3, 18), tmp_path / "caption"
    run(CaptionConfig(), tree, out)
    before = (out / "captions.jsonl").read_bytes()
    shutil.rmtree(find_tracks(tree)[0])
    with pytest.raises(ResumeError, match=r"the input data .* has changed; choose another --out"):
        run(CaptionConfig(), tree, out)
    assert (out / "captions.jsonl").read_bytes() == before


def test_a_larger_limit_writes_parts_again_that_were_removed(tree, done, tmp_path):
    out = tmp_path / "out"
    run(CaptionConfig(limit=12), tree, out)
    shutil.rmtree(out / "parts")
    product = run(CaptionConfig(limit=20), tree, out)
    lines = (done / "captions.jsonl").read_bytes().splitlines()
    assert product.read_bytes().splitlines() == lines[:20]


def test_bad_flights_are_counted_and_the_others_captioned(tree, tmp_path):
    root = tmp_path / "tree"
    shutil.copytree(tree, root)
    folders = find_tracks(root)
    flights = [folder / "trajectory.json" for folder in folders]
    change_json(flights[0], lambda raw: raw.update(points=raw["points"][:9]))  # one short of a window and its future
    flights[1].write_text('{"schema":')
    change_json(flights[2], lambda raw: raw["points"][3]["drone_pose"].update(x=None))
    (folders[5] / "frames_playback" / "frame_00006" / "rgb.png").unlink()
    out = run(CaptionConfig(), root, tmp_path / "out").parent
    report = json.loads((out / "caption_report.json").read_text())
    # Two that cannot be read, and the perturbed flight beside the second, whose labels come from it.
    assert report["flights"] == {"input": 6, "kept": 2, "dropped": {"too_short": 1}, "failed": {"input": 3}}
    # Frame 6 is observed by the windows at 6..10, of those at 4..12.
    assert report["windows"] == {"input": 18, "kept": 13, "dropped": {"unusable_frame": 5}, "failed": {}}
    failures = (out / "failures.jsonl").read_text()
    assert "points[3].drone_pose.x: the field is missing or null" in failures
    assert "not valid JSON" in failures


def test_a_perturbed_flight_waits_for_a_clean_one_that_cannot_be_read(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 14)
    clean = next(tree.rglob("ORI")) / "trajectory.json"
    whole = clean.read_bytes()
    clean.write_bytes(whole[:100])
    with pytest.raises(NothingKept):
        run(CaptionConfig(), tree, tmp_path / "out")
    clean.write_bytes(whole)
    found = list(read_captions(run(CaptionConfig(), tree, tmp_path / "again")))
    assert Counter(caption.label_from for caption in found) == {"flight": 5, "twin": 5}


@pytest.mark.parametrize("name", ["glossary"])
def test_captions_of_another_prompt_are_refused_by_name(tree, tmp_path, monkeypatch, name):
    shutil.copytree(run(CaptionConfig(), tree, tmp_path / "first").parent, tmp_path / "out")
    changed = tmp_path / "changed"
    changed.write_text("otherwise")
    monkeypatch.setitem(stage.PACKAGE_FILES, name, changed)
    with pytest.raises(ResumeError, match=f"the {name} has changed"):
        run(CaptionConfig(), tree, tmp_path / "out")
