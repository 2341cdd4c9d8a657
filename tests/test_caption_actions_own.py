"""An eighteenth action, from a file alone: labels, captions, students, release, verification, tables. No line of code
names it."""

from __future__ import annotations

import json
import re
import shutil
import textwrap
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from specimens_captions import ACTION_TABLE
from specimens_release import run_here
from teacher_server import TeacherServer
from test_caption_actions import future
from test_pipeline_tiny import TINY

from caption.run.own_files import vocabulary_of
from caption.run.released import read_released
from caption.run.stage import run as caption_run
from caption.schema import CaptionConfig, LabelConfig
from caption.truth.actions import measure, table_of
from caption.truth.reach import never_labels
from cosfly.errors import ConfigError, InputError
from cosfly.products.actions import ACTIONS_FILE, OWN_ACTIONS, actions_beside, read_actions, shipped_actions
from cosfly.products.answer_text import answer_schema, normalize_action
from cosfly.products.captions import read_captions
from cosfly.products.splits import SPLITS
from cosfly.reading.documents import read_json
from distill.evaluation import compare
from distill.evaluation import stage as evaluate
from distill.evaluation.floors import write_floors
from distill.inference import stage as infer
from distill.prepare import stage as prepare
from distill.prepare.sources import RunSource as Prepared
from distill.prepare.stage import PrepareConfig
from distill.schema import open_split, read_training_set
from release.export import stage as export
from release.export.contract import ExportConfig
from release.package import stage as package
from release.package.config import ReleaseConfig
from release.package.sources import Source
from release.record import read_record
from release.verify.verify import verify

OWN = "cruise_along"
ENTRY = """
  cruise_along:
    group: tracking
    en: cruise along
    zh: 巡航伴飞
    reason: {en: A brisk and even pace keeps the flight smooth., zh: 轻快而均匀的节奏使飞行平顺。}
    shown: {size: [mean_speed_mps / 0.5]}
    implied: {size: [mean_speed_mps / 0.5], where: ["|altitude_m| < 2 * label.altitude_m", visible_now >= 1]}
    reads_like: track_straight
"""


def with_own(path: Path, entry: str = ENTRY, line: str = f"  - [{OWN}]\n") -> Path:
    """Write the file that ships with one more action, before manoeuvres and their parts."""
    text = ACTIONS_FILE.read_text(encoding="utf-8")
    text = text.replace("\n# The first line in which", entry + "\n# The first line in which").replace(
        "  - [circle_left", f"{line}  - [circle_left"
    )
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def mine(tmp_path_factory) -> Path:
    return with_own(tmp_path_factory.mktemp("actions") / "mine.yaml")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, mine) -> Path:
    """The whole way with it: a map to a release."""
    more = [f"caption.actions={mine}", "caption.repair.soft_conflict=repair", "release.num_frames=20"]
    return run_here([*TINY, *more], tmp_path_factory.mktemp("own") / "run")


# --- the file ---------------------------------------------------------------------------------------------------------


def test_the_file_that_ships_can_be_written_and_checked(tmp_path):
    path = tmp_path / "actions.yaml"
    for words in (["--export", str(path)], ["--check", str(path)]):
        result = invoke("caption actions", words)
        assert result.exit_code == 0, result.output
    assert path.read_bytes() == ACTIONS_FILE.read_bytes()
    assert isinstance(invoke("caption actions --export", path).exception, ConfigError)


WRONG = [
    ("mean_speed_mps / 0.5]}\n    implied", "meen_speed / 0.9]}\n    implied",
    r"'meen_speed' is not measured \(did you mean 'mean_speed_mps'\?\)"),
    ("2 * label.altitude_m", "label.altitude", r"no threshold 'label\.altitude' \(did you mean 'altitude_m'\?\)"),
    ("visible_now >= 1", "visible_now = 1", r"compares nothing"),
    ("{size: [mean_speed_mps / 0.5]}", "{size: [mean_speed_mps]}", r"has no threshold"),
    ("{size: [mean_speed_mps / 0.5]}", "{size: [mean_speed_mps / -1]}", r"must be a number over 0"),
    ("{size: [mean_speed_mps / 0.5]}", "{}", r"a rule needs a size"),
    ("cruise_along:", "Cruise Along:", r"is no token"),
    ("cruise_along:", "h_over:", r"one letters: hover"),
    ("en: cruise along", "en: hover", r"one English name: hover"),
    ("    zh: 巡航伴飞\n", "", r"actions\.cruise_along\.zh: Field required"),
    ("reads_like: track_straight", "reads_like: trak_straight", r"does not ship \(did you mean 'track_straight'\?\)"),
    ("  - [cruise_along]", "  - [cruise]", r"precedence names 'cruise', which is no action.*cruise_along is implied by "
    r"something"),
    ("  - [cruise_along]", "  - [cruise_along, hover]", r"precedence names hover twice"),
    ('schema_version: "1.0"', 'schema_version: "9.0"', r"schema_version"),
    ("schema: cosfly.actions\n", "", r"schema: Field required"),
    ("group: recovery\n    en: hover", "grup: recovery\n    en: hover", r"unknown setting \(did you mean 'group'\?\)"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "told"), WRONG)
def test_what_is_wrong_with_a_file_is_told(tmp_path, old, new, told):
    path = with_own(tmp_path / "mine.yaml")
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=told):
        read_actions(path)


def test_all_that_is_wrong_with_a_file_is_told_at_once(tmp_path):
    path = with_own(tmp_path / "mine.yaml")
    text = path.read_text(encoding="utf-8")
    mistakes = (  # two in one condition, one in the next, one in a list beside it, and one across the whole file
        ("|yaw_deg| < label.hard_turn_deg", "|yow_deg| < label.hard"),
        ("forward_m > -label.forward_m", "forward_m = 1"),
        ("[mean_speed_mps / 0.5]", "[mean_speed_mps, meen_speed / 1]"),
        ("  - [cruise_along]", "  - [cruise]"),
    )
    for old, new in mistakes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_actions(path)
    for words in (
        "'yow_deg' is not measured", "no threshold 'label.hard'", "compares nothing", "has no threshold",
        "'meen_speed'", "precedence names 'cruise'",
        "cruise_along is implied by something",
    ):  # fmt: skip
        assert words in str(caught.value), words


def test_a_set_that_lacks_what_the_rule_teacher_decides_is_refused(tmp_path):
    text = ACTIONS_FILE.read_text(encoding="utf-8")
    hover = text[text.index("  hover:\n") : text.index("  break_off:\n")]
    path = tmp_path / "fewer.yaml"
    path.write_text(text.replace(hover, "").replace("  - [hover]\n", ""), encoding="utf-8")
    with pytest.raises(ConfigError, match="rule teacher decides what this set of actions does not hold; got hover"):
        vocabulary_of(CaptionConfig(actions=path))
    actions = vocabulary_of(CaptionConfig(actions=path, teacher="http://localhost:1", writing="prose")).actions
    assert len(actions.tokens) == 16
    assert normalize_action("hover", actions) is None
    assert "hover" not in table_of(actions, LabelConfig()).shown


def test_rules_measure_as_they_say(mine):
    fast, slow = ({"forward": 4.0, "target_step": (0.8, 0.0)}, {"forward": 1.0, "target_step": (0.2, 0.0)})
    actions, shipped = read_actions(mine), shipped_actions()
    labels = table_of(actions, LabelConfig())
    assert ACTION_TABLE.label_of(measure(future(**fast))) == "track_straight"
    assert labels.label_of(measure(future(**fast))) == OWN
    assert labels.label_of(measure(future(**slow))) == "track_straight"
    assert labels.label_of(measure(future(**fast, up=2.1))) == "ascend"  # it climbs too much
    assert not labels.is_contradicted(OWN, measure(future(**slow)))
    assert labels.is_contradicted(OWN, measure(future()))
    assert normalize_action("Cruise-Along.", actions) == OWN
    assert normalize_action(OWN, shipped) is None
    assert answer_schema(actions)["properties"]["flight_decision"]["enum"][-1] == OWN
    assert actions.kin_of(OWN) == "track_straight"


def test_a_value_that_nobody_knows_fulfils_no_condition(tmp_path):
    entry = ENTRY.replace(
        "implied: {size: [mean_speed_mps / 0.5], where:",
        "implied: {size: [sweep_deg / 1.0, mean_speed_mps / 0.5], unless: [approach_m < 0], where:",
    )
    labels = table_of(read_actions(with_own(tmp_path / "mine.yaml", entry)), LabelConfig())
    blind = measure(future(forward=4.0, target=(np.nan, np.nan)))
    assert np.isnan(blind.sweep_deg)
    assert dict(labels.implied[3])[OWN](blind) == pytest.approx(4.0 / 2.5 / 0.5)


@pytest.mark.parametrize("seed", range(3))
def test_every_action_that_ships_can_be_the_label(seed):
    assert never_labels(shipped_actions(), LabelConfig(), np.random.default_rng(seed)) == []


def test_the_example_of_the_page_is_a_label_and_behind_what_it_shares_its_motion_with_it_is_none(tmp_path):
    page = (Path(__file__).parent.parent / "docs/captions.md").read_text(encoding="utf-8")
    example = textwrap.dedent(page[page.index("    actions:\n      ...\n") : page.index("| word | meaning |")])
    entry, _, lines = example.strip().removeprefix("actions:\n  ...\n").partition("precedence:\n  - ...\n")
    own, straight = lines.splitlines()
    text = ACTIONS_FILE.read_text(encoding="utf-8")
    text = text.replace("\n# The first line in which", f"\n{entry}\n# The first line in which")
    for name, order in (("pasted.yaml", (own, straight)), ("last.yaml", (straight, own))):
        (tmp_path / name).write_text(text.replace(straight, "\n".join(order)), encoding="utf-8")
    told = {name: invoke("caption actions --check", tmp_path / name) for name in ("pasted.yaml", "last.yaml")}
    assert [result.exit_code for result in told.values()] == [0, 0]
    assert told["pasted.yaml"].output.endswith("18 actions, nothing wrong\n")
    assert "warning" not in told["pasted.yaml"].output
    assert re.search(rf"warning: {OWN}: \d+ of 3,000 .* label of 0, since .*track_straight", told["last.yaml"].output)


def test_an_action_that_nothing_implies_is_named(tmp_path):
    path = with_own(
        tmp_path / "mine.yaml",
        ENTRY.replace("implied: {size: [mean_speed_mps / 0.5]", "implied: {size: [mean_speed_mps / 900]"),
    )
    (told,) = never_labels(read_actions(path), LabelConfig(), np.random.default_rng(0))
    assert told.startswith(f"{OWN}: none of 3,000 made-up motions implies it")


def test_a_run_tells_of_an_action_that_was_never_the_label(whole, mine, tmp_path, caplog):
    path = with_own(tmp_path / "fast.yaml", ENTRY.replace("mean_speed_mps / 0.5", "mean_speed_mps / 900"))
    caption_run(CaptionConfig(actions=path), whole / "render", tmp_path / "fast")
    assert f"{OWN}, an action of yours, was the label of no window" in caplog.text
    caplog.clear()
    caption_run(CaptionConfig(actions=mine), whole / "render", tmp_path / "slow")
    assert "an action of yours" not in caplog.text


@pytest.mark.slow
def test_two_stages_of_other_sets_run_in_one_process_one_after_the_other_and_at_once(whole, mine, tmp_path):
    entry = ENTRY.replace(OWN, "glide_along").replace("cruise along", "glide along").replace("巡航伴飞", "滑行伴飞")
    other = with_own(tmp_path / "other.yaml", entry, "  - [glide_along]\n")

    def captions_of(name: str, path: Path) -> bytes:
        return caption_run(CaptionConfig(actions=path, limit=8), whole / "render", tmp_path / name).read_bytes()

    alone = [captions_of("first", mine), captions_of("second", other)]
    with ThreadPoolExecutor() as threads:
        assert list(threads.map(captions_of, ("third", "fourth"), (mine, other))) == alone
    assert alone[0] != alone[1]


# --- the whole way ----------------------------------------------------------------------------------------------------


def test_it_is_labelled_decided_and_written_in_both_languages(whole, mine):
    captions = [one for one in read_captions(whole / "caption/captions.jsonl") if one.status == "accepted"]
    labels, decisions = Counter(one.label for one in captions), Counter(one.en.flight_decision for one in captions)
    assert labels[OWN] > 5
    assert decisions[OWN] > 5
    own = next(one for one in captions if one.en.flight_decision == OWN)
    assert "cruise along" in own.en.reasoning_trace
    assert "巡航伴飞" in own.zh.reasoning_trace
    assert OWN in own.prompt["en"].system
    assert actions_beside(whole / "caption/captions.jsonl") == read_actions(mine)
    assert json.loads((whole / "caption/caption_report.json").read_text())["labels"][OWN] == sum(
        one.label == OWN for one in read_captions(whole / "caption/captions.jsonl")
    )
    listed = {entry["path"] for entry in json.loads((whole / "caption/manifest.json").read_text())["outputs"]}
    assert OWN_ACTIONS in listed


def test_the_release_says_so_and_verify_goes_by_that(whole, tmp_path):
    dataset = whole / "release/dataset"
    record = read_record(dataset / "release.json")
    assert record.actions.tokens[-1] == OWN
    assert record.numbers.captions.frames_by["decision"][OWN] > 0
    report = verify(dataset, level="pixels", reader=read_released)
    assert report.is_ok, str(report)
    assert OWN in (dataset / "README.md").read_text(encoding="utf-8")


def test_without_its_set_the_release_is_no_release(whole, tmp_path):
    dataset = shutil.copytree(whole / "release/dataset", tmp_path / "dataset")
    value = read_json(dataset / "release.json")
    (dataset / "release.json").write_text(json.dumps(value | {"actions": None}))
    report = verify(dataset, level="rows", reader=read_released)
    codes = {kind.code for kind in report.kinds if kind.severity == "error"}
    assert {"closed_set", "label"} <= codes
    value["actions"]["actions"][OWN]["shown"] = {"size": ["os.system / 1"]}
    (dataset / "release.json").write_text(json.dumps(value))
    report = verify(dataset, level="rows", reader=read_released)
    assert "record" in {kind.code for kind in report.kinds}


@pytest.mark.parametrize("form", ["webdataset", "lerobot"])
def test_exports_take_it_along(whole, tmp_path, form):
    out = tmp_path / form
    export.run(ExportConfig(format=form), whole / "release/dataset", out)
    report = verify(out / form, level="rows", reader=read_released)
    assert report.is_ok, str(report)


def test_runs_of_two_sets_go_into_no_release_and_no_training_set(whole, tmp_path):
    plain = caption_run(CaptionConfig(), whole / "render", tmp_path / "plain")
    mixed = [Source.of_run(whole), Source("other", whole / "render", plain)]
    with pytest.raises(InputError, match=rf"different sets of actions.*{OWN}"):
        package.run(ReleaseConfig(licence="cc-by-4.0"), mixed, tmp_path / "release")
    both = [Prepared.of_run(whole), Prepared("other", whole / "render", plain)]
    with pytest.raises(InputError, match="different sets of actions"):
        prepare.run(PrepareConfig(too_few="fill"), both, tmp_path / "set")
    (tmp_path / "bare").mkdir()
    bare = tmp_path / "bare/captions.jsonl"
    bare.write_bytes((whole / "caption/captions.jsonl").read_bytes())
    with pytest.raises(InputError, match=rf"not an action of the closed set.*got {OWN}.*{re.escape(OWN_ACTIONS)}"):
        prepare.run(
            PrepareConfig(too_few="fill", unbound="accept"),
            [Prepared("run", whole / "render", bare)],
            tmp_path / "none",
        )


def test_students_are_asked_and_scored_with_it(whole, tmp_path):
    cfg = PrepareConfig(modalities=("rgb",), too_few="fill", val_fraction=0.0, test_fraction=0.5)
    prepare.run(cfg, [Prepared.of_run(whole)], tmp_path / "set")
    record = read_training_set(tmp_path / "set")
    assert record.actions.tokens[-1] == OWN
    found = {split: list(open_split(tmp_path / "set", split)) for split in SPLITS if record.samples[split]}
    split = next(split for split, samples in found.items() if any(sample.decision == OWN for sample in samples))
    with TeacherServer(decision=lambda body: OWN) as server:
        asking = infer.InferConfig.model_validate(
            {"split": split, "engine": "endpoint", "constrained": True, "max_samples": 6, "endpoint": {"max_tries": 1}}
        )
        predictions = infer.run(asking, tmp_path / "set", [whole / "render"], server.url, tmp_path / "infer")
        body = json.loads(server.bodies[0])
    assert OWN in json.dumps(body["response_format"])
    report = read_json(
        evaluate.run(evaluate.EvaluateConfig(resamples=100), predictions, tmp_path / "set", tmp_path / "one")
    )
    assert report["actions"]["actions"][OWN]
    confusion = report["all"]["who"]["student"]["confusion"]
    assert any(OWN in row for row in confusion.values())
    floors = write_floors(tmp_path / "set", split, tmp_path / "floors", 0)
    other = evaluate.run(evaluate.EvaluateConfig(resamples=100), floors[0], tmp_path / "set", tmp_path / "two")
    compare.run(compare.ReportConfig(resamples=100), [tmp_path / "one", other.parent], tmp_path / "side")
    assert OWN in (tmp_path / "side/comparison.html").read_text(encoding="utf-8")
