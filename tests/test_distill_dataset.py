"""distill/prepare/stage.py: captions to leak-free splits."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from pydantic import ValidationError
from specimens_distill import make_caption, make_captions, prepared

from cosfly.errors import InputError, NothingKept, ResumeError, VerifyError
from cosfly.products.captions import parse_answer, write_captions
from cosfly.splits import SPLITS
from distill.prepare.leaks import check_no_leak
from distill.prepare.samples import PrepareConfig, make_sample
from distill.schema import Sample, open_split, split_path
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


def sample_of(trajectory="trajectory_1", variant="ORI", frame=4, town="Town01", language="en") -> Sample:
    caption = make_caption(town, trajectory, variant, frame)
    sample = make_sample(caption, language, PrepareConfig(), run="run", walk=f"{town}/{trajectory}")
    assert isinstance(sample, Sample)
    return sample


# --- leaks ------------------------------------------------------------------------------------------------------------


def test_leak_check_passes_clean_splits_and_counts():
    clean = {"train": [sample_of(), sample_of(language="zh"), sample_of(variant="aug_001")], "val": [sample_of("t2")]}
    assert check_no_leak(clean) == {"train": 3, "val": 1}


@pytest.mark.parametrize(
    ("other", "split_by", "word"),
    [
        (sample_of(variant="aug_001"), "walk", "walk"),  # the perturbed flight of the same trajectory
        (sample_of(frame=6), "walk", "walk"),
        (sample_of("t2").model_copy(update={"walk": "Town01/trajectory_1"}), "walk", "walk"),  # another timestamp
        (sample_of("t2", town="Town01_Opt"), "town", "town"),
    ],
)
def test_leak_check_fails(other, split_by, word):
    with pytest.raises(VerifyError, match=f"two splits share a {word}"):
        check_no_leak({"train": [sample_of()], "val": [other]}, split_by)


def test_leak_check_fails_on_a_trajectory_of_two_walks():
    other = sample_of(frame=6).model_copy(update={"walk": "elsewhere"})
    with pytest.raises(VerifyError, match="of two walks"):
        check_no_leak({"train": [sample_of()], "val": [other]})


def test_leak_check_fails_on_a_double():
    with pytest.raises(VerifyError, match=r"twice.*frame 4 of run/Town01/trajectory_1/ORI, language zh"):
        check_no_leak({"train": [sample_of(), sample_of(language="zh"), sample_of(frame=6), sample_of(language="zh")]})


# --- samples ----------------------------------------------------------------------------------------------------------


def test_sample_holds_what_the_student_needs():
    sample = sample_of(frame=6)
    assert sample.key == "trajectory_1_ORI_frame_00006/en"
    assert sample.images == [f"Town01/trajectory_1/ORI/frames_playback/frame_{i:05d}/rgb.png" for i in (2, 3, 4, 5, 6)]
    assert parse_answer(sample.answer).coc is not None
    assert parse_answer(sample.answer).recovered == ()
    assert json.loads(sample.answer)["flight_decision"] == sample.decision
    assert "行人" in sample_of(language="zh").answer  # not escaped: escapes would cost tokens


def test_modalities_are_interleaved_by_frame():
    caption = make_caption("Town01", "trajectory_1", "ORI", 4)
    sample = make_sample(caption, "en", PrepareConfig(modalities=("rgb", "depth")))
    assert isinstance(sample, Sample)
    assert [Path(image).name for image in sample.images[:4]] == ["rgb.png", "depth.npy", "rgb.png", "depth.npy"]


def test_a_depth_scale_that_the_teacher_saw_is_the_students(captions):
    caption = make_caption("Town01", "trajectory_1", "ORI", 4, depth_range_m=40.0)
    sample = make_sample(caption, "en", PrepareConfig(modalities=("depth",)))
    assert isinstance(sample, Sample)
    assert "black is 40 m and beyond" in sample.prompt.user
    assert sample.pictures.depth_range_m == 40.0


def test_captions_of_an_earlier_version_are_refused_with_the_way_out(tree, tmp_path):
    """Their prompts announce the teacher's pictures, whatever the student gets."""
    old = make_caption("Town01", "trajectory_1", "ORI", 4).model_dump(mode="json") | {"schema_version": "1.0"}
    (tmp_path / "captions.jsonl").write_text(json.dumps(old) + "\n")
    with pytest.raises(InputError, match=r"captions of another version.*got '1.0'; expected '2.0'.*run cosfly caption"):
        prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")


def test_a_prompt_without_a_place_for_the_pictures_is_refused(tree, tmp_path):
    caption = make_caption("Town01", "trajectory_1", "ORI", 4)
    prompts = {language: prompt.told("Each frame is given as: RGB.") for language, prompt in caption.prompt.items()}
    write_captions(tmp_path / "captions.jsonl", [caption.model_copy(update={"prompt": prompts})])
    with pytest.raises(InputError, match=r"trajectory_1_ORI_frame_00004: prompt\.en: .*no place.*cosfly caption anew"):
        prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")


def test_a_training_set_of_an_earlier_version_is_refused(tmp_path):
    (tmp_path / "train.jsonl").write_text('{"schema_version": "2.0"}\n')
    with pytest.raises(InputError, match=r"training set of another version.*train\.jsonl.*distill prepare"):
        open_split(tmp_path, "train")


def test_file_kinds_are_no_views():
    with pytest.raises(ValidationError, match="'rgb', 'depth' or 'segmentation'"):
        PrepareConfig.model_validate({"modalities": ("rgb", "instance")})


REPAIRED = {"strategy": "anchored", "asks": 2, "first_decision": "hover", "first_verdict": "HARD_CONFLICT"}


@pytest.mark.parametrize(
    ("changes", "settings", "expected"),
    [
        ({"status": "dropped", "drop_reason": "hard_conflict"}, {}, "dropped_hard_conflict"),
        ({"repair": REPAIRED}, {"repaired": "exclude"}, "repaired"),
        ({"repair": REPAIRED | {"rung": "anchored"}}, {"rungs": ("hint",)}, "repaired_by_anchored"),
        ({"zh": None}, {}, "no_zh"),
    ],
)
def test_reasons_for_leaving_out(changes, settings, expected):
    caption = make_caption("Town01", "trajectory_1", "ORI", 4, **changes)
    assert make_sample(caption, "zh", PrepareConfig(**settings)) == expected


def test_repaired_samples_are_weighed_and_named():
    caption = make_caption("Town01", "trajectory_1", "ORI", 4, repair=REPAIRED)
    sample = make_sample(caption, "en", PrepareConfig(repaired_weight=0.5))
    assert isinstance(sample, Sample)
    assert (sample.weight, sample.repair) == (0.5, "anchored")
    assert (sample_of().weight, sample_of().repair) == (1.0, None)


@pytest.mark.parametrize(
    ("states", "proved", "weight"),
    [
        (None, None, 0.5),
        (["unread", "unread"], 0.0, 0.5),
        (["proved", "unread"], 0.5, 0.75),
        (["proved"] * 4, 1.0, 1.0),
    ],
)
def test_what_is_proved_is_carried_weighed_and_filtered(states, proved, weight):
    checks = {"sentences": {"en": states}} if states else {}
    caption = make_caption("Town01", "trajectory_1", "ORI", 4, checks=checks)
    sample = make_sample(caption, "en", PrepareConfig(weigh_proved=True))
    assert (sample.proved, sample.weight) == (proved, weight)
    strict = make_sample(caption, "en", PrepareConfig(min_proved=0.5))
    assert strict == "too_little_proved" if (proved or 0.0) < 0.5 else strict.weight == 1.0
    assert make_sample(caption, "zh", PrepareConfig(min_proved=0.5)) == "too_little_proved"


def test_answers_that_the_geometry_contradicts_do_not_teach():
    checks = {"sentences": {"en": ["proved", "contradicted"], "zh": ["proved"]}}
    caption = make_caption("Town01", "trajectory_1", "ORI", 4, checks=checks)
    assert make_sample(caption, "en", PrepareConfig()) == "contradicted"
    assert isinstance(make_sample(caption, "zh", PrepareConfig()), Sample)
    assert isinstance(make_sample(caption, "en", PrepareConfig(contradicted="keep")), Sample)


def test_captions_of_unwanted_verdicts_and_noisy_labels_do_not_teach():
    soft = make_caption("Town01", "trajectory_1", "ORI", 4, verdict="SOFT_CONFLICT")
    assert make_sample(soft, "en", PrepareConfig(verdicts=("CONSISTENT",))) == "verdict_soft_conflict"
    assert isinstance(make_sample(soft, "en", PrepareConfig()), Sample)
    noisy = make_caption("Town01", "trajectory_1", "aug_001", 4, label_from="perturbed")
    assert noisy.label is not None
    assert make_sample(noisy, "en", PrepareConfig()).label is None


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """A caption with a prompt as `cosfly caption` makes it."""
    from caption.run.stage import run as caption_run
    from caption.schema import CaptionConfig
    from cosfly.products.captions import read_captions

    root = tmp_path_factory.mktemp("asked")
    path = caption_run(
        CaptionConfig(), make_playback_tree(root / "tree", 1, 12, with_augmented=False), root / "caption"
    )
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
    assert both.prompt.user.count("\n") == text.prompt.user.count("\n") == 7
    line = pictures.prompt.user
    assert "\n" not in line
    assert line == both.prompt.user.partition("\n")[0]
    # Of the measured values nothing is left: the numbers are those of frames, their distance in time, and pixels.
    assert re.findall(r"\d+(?:\.\d+)?", line) == ["5", "0.5", "64", "36"]
    assert pictures.images == both.images != []
    with pytest.raises(ValidationError, match="nothing to answer from"):
        PrepareConfig(modalities=(), text_state=False)


# --- run --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("split_by", ["walk", "town"])
def test_run_writes_leak_free_splits_and_counts_that_add_up(tree, captions, tmp_path, split_by):
    out = prepared(tree, captions, tmp_path / "set", split_by=split_by, too_few="fill")
    splits = {split: list(open_split(out, split)) for split in SPLITS}
    owners = {}  # a slow obvious oracle: group -> splits
    for split, samples in splits.items():
        for sample in samples:
            group = sample.walk if split_by == "walk" else sample.town.removesuffix("_Opt")
            owners.setdefault(group, set()).add(split)
            assert all((tree / image).is_file() for image in sample.images)
    assert all(len(found) == 1 for found in owners.values())
    manifest = json.loads((out / "manifest.json").read_text())
    assert (
        manifest["counts"]["kept"] == sum(map(len, splits.values())) == 5 * 2 * 4 * 2
    )  # flights, variants, windows, languages
    assert {split: facts["samples"] for split, facts in manifest["splits"].items()} == {
        split: len(samples) for split, samples in splits.items()
    }
    if split_by == "walk":
        assert splits["val"]
        assert splits["test"]


def test_run_twice_gives_the_same_bytes(tree, captions, tmp_path):
    first, second = (prepared(tree, captions, tmp_path / name) for name in "ab")
    for split in SPLITS:
        assert split_path(first, split).read_bytes() == split_path(second, split).read_bytes()
    assert prepared(tree, captions, first) == first
    with pytest.raises(ResumeError, match="languages"):
        prepared(tree, captions, first, languages=("en",))


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


def test_a_balanced_run_thins_train_alone_and_says_what_it_cost(tree, tmp_path, caplog):
    records = make_captions(tmp_path / "captions.jsonl", tree)
    mixed = [  # every window of straight tracking is judged by its English, whatever the Chinese says
        record.model_copy(update={"zh": record.zh.model_copy(update={"flight_decision": "hover"})})
        if record.frame_index == 5 and record.en.flight_decision == "track_straight"
        else record
        for record in records
    ]
    write_captions(tmp_path / "captions.jsonl", mixed)
    plain = prepared(tree, tmp_path / "captions.jsonl", tmp_path / "plain")
    write_captions(tmp_path / "captions.jsonl", mixed[::-1])
    caplog.set_level("INFO", logger="distill")
    out = prepared(tree, tmp_path / "captions.jsonl", tmp_path / "balanced", balance="decisions")

    keys = {(folder, split): {s.key for s in open_split(folder, split)} for folder in (plain, out) for split in SPLITS}
    assert all(keys[plain, split] == keys[out, split] for split in ("val", "test"))
    assert keys[out, "train"] < keys[plain, "train"]
    languages = Counter(sample.sample_id for sample in open_split(out, "train"))
    assert set(languages.values()) == {2}
    english = Counter(sample.decision for sample in open_split(out, "train") if sample.language == "en")
    assert english == {"track_straight": 8, "yaw_left_to_follow": 6, "slow_down": 6}  # of 12, 6, 6: an equal share is 8

    manifest = json.loads((out / "manifest.json").read_text())
    counts, cost = manifest["counts"], manifest["splits"]["train"]["balance"]
    assert counts["dropped"] == {"balance": 4 * 2}
    assert counts["kept"] + 8 == counts["input"] == json.loads((plain / "manifest.json").read_text())["counts"]["input"]
    assert (cost["windows"], cost["windows_left_out"], cost["samples_left_out"]) == (24, 4, 8)
    assert manifest["splits"]["train"]["samples"] == 40
    assert "balance left 4 of 24 training windows out (8 samples)" in caplog.text


def test_a_bound_that_nothing_reaches_gives_the_files_of_no_balance(tree, captions, tmp_path):
    plain = prepared(tree, captions, tmp_path / "plain")
    wide = prepared(tree, captions, tmp_path / "wide", balance="decisions", balance_ratio=100)
    for split in SPLITS:
        assert split_path(plain, split).read_bytes() == split_path(wide, split).read_bytes()
    facts = [json.loads((folder / "manifest.json").read_text()) for folder in (plain, wide)]
    assert facts[0]["counts"] == facts[1]["counts"]
    assert ["balance" in found["splits"]["train"] for found in facts] == [False, True]


@pytest.mark.parametrize("ratio", [0, -1, float("inf"), float("nan")], ids=str)
def test_a_bound_that_is_none_is_refused(ratio):
    with pytest.raises(ValidationError, match="balance_ratio"):
        PrepareConfig(balance="decisions", balance_ratio=ratio)


def test_run_refuses_a_tree_without_the_images(captions, tree, tmp_path):
    bare = make_playback_tree(tmp_path / "bare", num_flights=1, num_points=6, with_images=False)
    with pytest.raises(NothingKept, match=r"kept nothing.*missing_image 80.*--data"):
        prepared(bare, captions, tmp_path / "set")


def test_run_refuses_a_name_that_leads_out(tree, tmp_path):
    write_captions(tmp_path / "captions.jsonl", [make_caption("..", "trajectory_1", "ORI", 4)])
    with pytest.raises(InputError, match="not a folder name"):
        prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")


def test_settings_that_leave_nothing_are_refused():
    with pytest.raises(ValidationError, match="nothing is left to train on"):
        PrepareConfig(val_fraction=0.5, test_fraction=0.5)


def test_imports_without_torch():
    code = (
        "import sys; sys.modules['torch'] = sys.modules['transformers'] = sys.modules['peft'] = None\n"
        "import distill.prepare.stage, distill.training.stage, distill.inference.stage, distill.evaluation.stage"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
