"""Captions of somebody else: files, and a student behind a server, asked as it was taught, to the byte."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import invoke, obeyed
from specimens_captions import VOCABULARY
from specimens_distill import prepared
from teacher_server import MODEL, TeacherServer
from test_cosfly_answers import CHINESE as ZH
from test_cosfly_answers import GOOD as EN

from caption.schema import CaptionConfig
from caption.stage.stage import run
from caption.teachers.foreign import read_foreign
from caption.teachers.students import student_settings
from cosfly.formats.captions import Caption, read_captions, write_captions
from cosfly.inspection import stage as inspection
from cosfly.inspection.settings import InspectConfig
from cosfly.llm.student_chat import CHAT_FORMAT_FILE, read_chat_format, write_chat_format
from cosfly.runtime.errors import ConfigError, InputError
from distill.inference import stage as infer
from distill.schema import open_split
from distill.training.stage import chat_format_of
from release.build import stage as package
from release.build.sources import Source
from release.record import read_record
from release.verify.verify import verify
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def rules(tree, tmp_path_factory) -> list[Caption]:
    return list(read_captions(run(CaptionConfig(), tree, tmp_path_factory.mktemp("rules") / "out")))


def line(caption: Caption, **changes) -> dict:
    decision = {"flight_decision": changes.pop("decision", caption.label or "hover")}
    value = {"sample_id": caption.sample_id, "en": EN | decision, "zh": ZH | decision, **changes}
    return {name: content for name, content in value.items() if content is not None}


def captions_of(lines: list[dict], tree: Path, folder: Path, **settings) -> list[Caption]:
    folder.mkdir(exist_ok=True)
    path = folder / "theirs.jsonl"
    path.write_text("".join(json.dumps(one, ensure_ascii=False) + "\n" for one in lines), encoding="utf-8")
    cfg = CaptionConfig.model_validate({"teacher": f"file:{path}", **settings})
    return list(read_captions(run(cfg, tree, folder / "out")))


def test_a_file_is_judged_as_answers_are(tree, rules, tmp_path):
    lines = [line(caption) for caption in rules[:-1]]
    found = captions_of(lines, tree, tmp_path / "a")
    assert [caption.status for caption in found[:-1]] == ["accepted"] * (len(rules) - 1)
    assert (found[-1].drop_reason, found[-1].en) == ("not_in_file", None)
    assert (found[0].teacher.kind, found[0].teacher.model) == ("file", "theirs.jsonl")
    assert found[0].verdict == "CONSISTENT"
    assert (found[0].checks.values or {}).keys() == {"en", "zh"}
    record = json.loads((tmp_path / "a/out/stage.json").read_text())
    assert record["inputs"].keys() == {"data", "captions"}
    report = json.loads((tmp_path / "a/out/caption_report.json").read_text())
    assert report["windows"]["dropped"] == {"not_in_file": 1}
    # No server, and nothing that --retry-failed could mend.
    assert (report["refusals"], found[-1].checks.refusal) == ({}, None)


def test_a_contradicted_value_is_recorded_and_drops_its_window_unless_the_settings_keep_it(tree, rules, tmp_path):
    said = EN | {"critical_components": "The person can be made out from 777 m up.", "flight_decision": rules[0].label}
    lines = [line(rules[0], en=said, zh=None), line(rules[1])]
    found = captions_of(lines, tree, tmp_path / "a", contradicted_values="keep")
    assert found[0].status == "accepted"
    assert [problem.partition(":")[0] for problem in found[0].checks.contradictions] == ["en number"]
    assert found[0].checks.values["en"].values_contradicted == 1
    dropped = captions_of(lines, tree, tmp_path / "b")
    assert [caption.drop_reason for caption in dropped[:2]] == ["contradicted_value", None]


@pytest.mark.parametrize(("changes", "reason", "detail"), [
    ({"decision": "do a barrel roll"}, "structure", "decision_not_in_closed_set"),
    ({"zh": ZH | {"flight_decision": "return_to_home"}}, "bilingual", "decision"),
    ({"zh": {"critical_components": "短", "reasoning_trace": "短", "flight_decision": "hover"}}, "bilingual", "structure_"),
    ({"en": EN | {"reasoning_trace": "So.", "flight_decision": "hover"}}, "structure", "reasoning_trace_too_short"),
])  # fmt: skip
def test_what_is_wrong_with_a_caption_drops_its_window(tree, rules, tmp_path, changes, reason, detail):
    found = captions_of([line(rules[0], **changes), *(line(caption) for caption in rules[1:])], tree, tmp_path / "a")
    assert found[0].status == "dropped"
    assert found[0].drop_reason == reason
    assert detail is None or getattr(found[0].checks, reason).startswith(detail)
    assert {caption.status for caption in found[1:]} == {"accepted"}


BAD = [
    ('{"sample_id": "a"}', "en"), ("[1]", ""), ("{broken", ""),
    ('{"sample_id": "a", "en": {"critical_components": 7}}', "en.critical_components"),
    (json.dumps({"sample_id": "a", "en": EN | {"flight_decision": "hover"}, "colour": "red"}), "colour"),
    (json.dumps({"sample_id": "first", "en": EN | {"flight_decision": "hover"}}), "sample_id"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "field"), BAD)
def test_a_bad_line_names_file_line_and_field(tmp_path, text, field):
    path = tmp_path / "theirs.jsonl"
    good = json.dumps({"sample_id": "first", "en": EN | {"flight_decision": "hover"}})
    path.write_text(f"{good}\n{text}\n")
    with pytest.raises(InputError, match=f"{re.escape(str(path))}:2.*{re.escape(field)}"):
        read_foreign(path)


def test_from_a_students_answers_to_a_release(tree, rules, tmp_path):
    write_captions(tmp_path / "captions.jsonl", rules)
    taught = prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set", val_fraction=0, test_fraction=0)
    answers = {sample.prompt.user: sample.answer for sample in open_split(taught, "train")}
    with TeacherServer() as server:
        server.text = lambda body: answers[body["messages"][1]["content"][-1]["text"]]
        cfg = infer.InferConfig(split="train", engine="endpoint")
        infer.run(cfg, taught, [tree], server.url, tmp_path / "infer")
    obeyed("caption --teacher", f"student:{tmp_path / 'infer'}", "--data", tree, "--out", tmp_path / "out")
    inspected = inspection.run(InspectConfig(), None, None, tree, tmp_path / "inspect")
    source = Source("students", tree, tmp_path / "out/captions.jsonl", inspected)
    folder = package.run(package.ReleaseConfig(licence="mit", pairs="any"), [source], tmp_path / "release")
    assert verify(folder).is_ok
    counts = read_record(folder / "release.json").numbers.counts
    assert counts["teacher_kind"] == {"student": len(rules)}
    assert counts["teacher_model"] == {MODEL: len(rules)}


SIDE_PX = 40  # smaller than the camera's, so that pictures are scaled
MAX_PIXELS = 600  # smaller than those, so that the server's pictures are once more


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("students")
    tree = make_playback_tree(root / "tree", 3, 14)
    captions = run(CaptionConfig.model_validate({"image": {"max_side_px": SIDE_PX}}), tree, root / "rules")
    prepared(tree, captions, root / "set", modalities=("rgb", "depth"), val_fraction=0, test_fraction=0)
    (root / "trained" / "adapter").mkdir(parents=True)
    write_chat_format(root / "trained" / "adapter", chat_format_of(open_split(root / "set", "train"), MAX_PIXELS))
    return root


def label_of(place: Path) -> Callable[[dict], str]:
    """What a student decides that learnt all: the label of the window whose prompt is asked, in either language."""
    captions = read_captions(place / "rules" / "captions.jsonl")
    # Of a prompt all but its first line, which names the pictures.
    labels = {p.user.partition("\n")[2]: c.label or "track_straight" for c in captions for p in c.prompt.values()}
    return lambda body: labels[body["messages"][1]["content"][-1]["text"].partition("\n")[2]]


def settings(url: str, folder: Path, **changes: Any) -> CaptionConfig:
    return CaptionConfig.model_validate({
        "teacher": url, "student": {"folder": folder}, "endpoint": {"max_tries": 1, "timeout_s": 60.0}, **changes,
    })  # fmt: skip


@pytest.mark.parametrize("constrained", [False, True])
def test_requests_are_those_of_infer_to_the_byte(place, tmp_path, constrained):
    decide = label_of(place)
    with TeacherServer(decision=decide) as server:
        cfg = {"split": "train", "engine": "endpoint", "max_pixels": MAX_PIXELS, "endpoint": {"timeout_s": 60.0}}
        asking = infer.InferConfig.model_validate(cfg | {"constrained": constrained})
        infer.run(asking, place / "set", [place / "tree"], server.url, tmp_path / "infer")
        asked, samples = set(server.bodies), open_split(place / "set", "train")
        assert len(asked) == len(samples) == len(server.bodies)
        assert {sample.language for sample in samples} == {"en", "zh"}
        server.bodies.clear()
        student = {"folder": place / "trained", "constrained": constrained}
        own = settings(server.url, place / "trained", student=student)
        captions = list(read_captions(run(own, place / "tree", tmp_path / "captions")))
        windows = {sample.sample_id for sample in samples}
        assert windows <= {caption.sample_id for caption in captions}
        assert asked <= set(server.bodies)  # and further windows, which the training set left out
        assert len(server.bodies) <= 2 * len(captions)
        sent = [json.loads(body)["messages"][1]["content"] for body in server.bodies]
        assert {sum(part["type"] == "image_url" for part in parts) for parts in sent} == {10}
        assert all(("response_format" in json.loads(body)) == constrained for body in server.bodies)


def test_unlabelled_flights_are_captioned_and_marked(place, tmp_path):
    with TeacherServer(decision=label_of(place)) as server:
        words = ["caption", "--teacher", server.url, "--as-student", place / "trained", "--data", place / "tree"]
        tried = invoke([*words, "--out", tmp_path / "out", "--try", "1"])
        assert "--- outcome ---\naccepted" in tried.output
        num_tried = len(server.bodies)
        obeyed([*words, "--out", tmp_path / "out"])
        assert num_tried == 2  # in two languages
        assert len(set(server.bodies)) == len(server.bodies)  # nothing is asked twice
        assert {json.loads(body)["temperature"] for body in server.bodies} == {0.0}
    captions = list(read_captions(tmp_path / "out" / "captions.jsonl"))
    accepted = [caption for caption in captions if caption.status == "accepted"]
    assert len(accepted) > len(captions) / 2
    for caption in accepted:
        assert (caption.teacher.kind, caption.teacher.model, caption.writing) == ("student", "test-teacher", "prose")
        assert caption.teacher.settings.temperature == 0.0
        assert caption.verdict in ("CONSISTENT", "SOFT_CONFLICT", "ABSTAIN")
        assert caption.checks.values is not None
        assert caption.zh is not None
        assert caption.picture_px == read_chat_format(place / "trained").looks[0].size_px
    told = (tmp_path / "out" / "stage.json").read_text()
    assert str(place) not in json.dumps(json.loads(told)["config"])


def taught_otherwise(place: Path, folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    value = json.loads((place / "trained" / "adapter" / CHAT_FORMAT_FILE).read_text())
    (folder / CHAT_FORMAT_FILE).write_text(json.dumps(value | changes))
    return folder


def test_another_version_of_the_prompt_is_refused(place, tmp_path):
    taught = json.loads((place / "trained" / "adapter" / CHAT_FORMAT_FILE).read_text())
    english = taught["prompts"]["en"]
    for number, changed in enumerate([
        {"system": english["system"] + " Be brief.", "user": english["user"]},
        {"system": english["system"], "user": english["user"].replace("Altitude:", "Height:")},
        {"system": english["system"], "user": english["user"].replace("5 frames", "7 frames")},
        {"system": english["system"], "user": english["user"].replace("2 pictures", "3 pictures")},
    ]):  # fmt: skip
        folder = taught_otherwise(place, tmp_path / f"{number}", prompts=taught["prompts"] | {"en": changed})
        with pytest.raises(ConfigError, match="another version of the prompt"):
            student_settings(settings("http://127.0.0.1:1/v1", folder), VOCABULARY)
    lines = ("Goal: follow the man in the black shorts.", "Other people in view: 4", "Mission: the time is over.")
    mission = {"system": english["system"], "user": "\n".join((english["user"], *lines))}
    folder = taught_otherwise(place, tmp_path / "mission", prompts={"en": mission})
    assert student_settings(settings("http://127.0.0.1:1/v1", folder), VOCABULARY).endpoint.temperature == 0.0
    folder = taught_otherwise(place, tmp_path / "zh", prompts={"zh": taught["prompts"]["zh"]})
    with pytest.raises(ConfigError, match="not trained with English"):
        student_settings(settings("http://127.0.0.1:1/v1", folder), VOCABULARY)
