"""A student behind a server as a teacher: asked as it was taught, to the byte."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import invoke
from specimens_captions import VOCABULARY
from specimens_distill import prepared
from teacher_server import TeacherServer

from caption.schema import CaptionConfig
from caption.stage.stage import run
from caption.teachers.students import student_settings
from cosfly.formats.captions import read_captions
from cosfly.llm.student_chat import CHAT_FORMAT_FILE, read_chat_format, write_chat_format
from cosfly.runtime.errors import ConfigError
from distill.inference import stage as infer
from distill.schema import Sample, open_split
from distill.training.stage import taught_by
from specimens import make_playback_tree

SIDE_PX = 40  # smaller than the camera's, so that pictures are scaled
MAX_PIXELS = 600  # smaller than those, so that the server's pictures are once more


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("students")
    tree = make_playback_tree(root / "tree", 3, 14)
    captions = run(CaptionConfig.model_validate({"image": {"max_side_px": SIDE_PX}}), tree, root / "rules")
    prepared(tree, captions, root / "set", modalities=("rgb", "depth"))
    (root / "trained" / "adapter").mkdir(parents=True)
    write_chat_format(root / "trained" / "adapter", taught_by(open_split(root / "set", "train"), MAX_PIXELS))
    return root


def label_of(place: Path) -> Callable[[dict], str]:
    """What a student decides that learnt all: the label of the window whose prompt is asked, in either language."""
    labels: dict[str, str] = {}
    for caption in read_captions(place / "rules" / "captions.jsonl"):
        for prompt in caption.prompt.values():
            labels[key_of(prompt.user)] = caption.label or "track_straight"
    return lambda body: labels[key_of(body["messages"][1]["content"][-1]["text"])]


def key_of(user: str) -> str:
    """A prompt without its first line, which names the pictures."""
    return user.partition("\n")[2]


def settings(url: str, folder: Path, **changes: Any) -> CaptionConfig:
    return CaptionConfig.model_validate({
        "teacher": url, "student": {"folder": folder}, "endpoint": {"max_tries": 1, "timeout_s": 60.0}, **changes,
    })  # fmt: skip


def infer_all(place: Path, url: str, out: Path, **changes: Any) -> list[Sample]:
    samples: list[Sample] = []
    for split in ("train", "val", "test"):
        cfg = infer.InferConfig.model_validate({
            "split": split, "engine": "endpoint", "max_pixels": MAX_PIXELS, "endpoint": {"timeout_s": 60.0}, **changes,
        })  # fmt: skip
        infer.run(cfg, place / "set", [place / "tree"], url, out / split)
        samples += open_split(place / "set", split)
    return samples


@pytest.mark.parametrize("constrained", [False, True])
def test_requests_are_those_of_infer_to_the_byte(place, tmp_path, constrained):
    decide = label_of(place)
    with TeacherServer(decision=decide) as server:
        samples = infer_all(place, server.url, tmp_path / "infer", constrained=constrained)
        asked = set(server.bodies)
        assert len(asked) == len(samples) == len(server.bodies)
        assert {sample.language for sample in samples} == {"en", "zh"}
        server.bodies.clear()
        student = {"folder": place / "trained", "constrained": constrained}
        cfg = settings(server.url, place / "trained", student=student)
        captions = list(read_captions(run(cfg, place / "tree", tmp_path / "captions")))
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
        result = invoke([*words, "--out", tmp_path / "out"])
        assert result.exit_code == 0, result.output
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
