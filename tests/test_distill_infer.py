"""Students asked through an engine, and those that answer in this process: what is sent, kept and goes wrong."""

import base64
import io
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import invoke, obeyed
from PIL import Image
from specimens_distill import ADAPTER_PIXELS, make_adapter, prepared
from specimens_students import features_of, make_place, samples_of
from teacher_server import TeacherServer, kept_answers

from cosfly.formats.predictions import Prediction, read_predictions
from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.errors import ConfigError, TeacherError
from distill.inference import merge
from distill.inference import stage as infer
from distill.inference.answers import generate
from distill.schema import resolve_trees
from distill.student.model import load_student

pytestmark = pytest.mark.usefixtures("one_thread")

NUM_TOKENS = 12


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    root = make_place(tmp_path_factory.mktemp("local"), modalities=("rgb", "depth"))
    make_adapter(root / "student", root / "trained" / "adapter")
    return root


@pytest.fixture(scope="module")
def clean(place) -> Path:
    return answer(place, place / "clean")


def settings(**changes: Any) -> infer.InferConfig:
    base = {"split": "train", "batch_size": 5, "max_new_tokens": NUM_TOKENS, "device": "cpu"}
    return infer.InferConfig.model_validate(base | changes)


def answer(place: Path, out: Path, **changes: Any) -> Path:
    given = (place / "set", [place / "tree"], place / "student", out)
    return infer.run(settings(**changes), *given, adapter=place / "trained" / "adapter")


ENDPOINT = {"max_tries": 1, "timeout_s": 60.0, "concurrency": 3}


def served(**changes: Any) -> infer.InferConfig:
    return infer.InferConfig.model_validate({"split": "train", "engine": "endpoint", "endpoint": ENDPOINT, **changes})


def infer_with(cfg: infer.InferConfig, place: Path, url: str, out: Path) -> Path:
    return infer.run(cfg, place / "set", [place / "tree"], url, out)


def test_a_server_is_asked_as_the_student_was_taught(place, tmp_path):
    samples = samples_of(place)
    with TeacherServer() as server:
        cfg = served(max_new_tokens=99, max_pixels=300, constrained=True)
        path = infer_with(cfg, place, server.url, tmp_path / "out")
    predictions = read_predictions(path)
    assert [p.key for p in predictions] == [sample.key for sample in samples]
    assert all(p.coc is not None and p.is_finished and p.num_tokens == 100 for p in predictions)
    bodies = {body["messages"][1]["content"][-1]["text"]: body for body in map(json.loads, server.bodies)}
    assert len(server.bodies) == len(samples)
    sample = samples[0]
    body = bodies[sample.prompt.user]
    assert (body["temperature"], body["top_p"], body["max_tokens"]) == (0.0, 1.0, 99)
    assert body["chat_template_kwargs"] == {"enable_thinking": False}
    assert body["messages"][0] == {"role": "system", "content": sample.prompt.system}
    assert len(body["response_format"]["json_schema"]["schema"]["properties"]["flight_decision"]["enum"]) == 17
    urls = [part["image_url"]["url"] for part in body["messages"][1]["content"] if part["type"] == "image_url"]
    sent = [Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))) for url in urls]
    assert len(sent) == len(sample.images)
    assert all(image.width * image.height <= 300 for image in sent)


def test_a_server_is_asked_without_pictures_and_trees(place, tmp_path):
    taught = prepared(place / "tree", place / "captions.jsonl", tmp_path / "set", modalities=())
    assert "no pictures" in (taught / "README.md").read_text()
    with TeacherServer() as server:
        path = infer.run(served(), taught, [], server.url, tmp_path / "out")
    assert all(prediction.coc is not None for prediction in read_predictions(path))
    assert not any("image_url" in body.decode() for body in server.bodies)


def test_one_sample_without_an_answer_costs_no_other(place, tmp_path):
    asked = "distill infer --engine endpoint --set distill.infer.split=train --set distill.infer.endpoint.max_tries=1"
    with TeacherServer(lambda number, body: "500" if number == 2 else None) as server:
        given = ["--dataset", place / "set", "--data", place / "tree", "--out", tmp_path / "out", "--model", server.url]
        result = invoke(asked, given)
        assert result.exit_code == 1
        assert "http_500" in str(result.exception)
        predictions, num_asked = read_predictions(tmp_path / "out" / "predictions.jsonl"), len(server.bodies)
        assert [p.reason for p in predictions if p.coc is None] == ["failed_http_500"]
        manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
        assert manifest["counts"]["failed"] == {"http_500": 1}
        assert manifest["counts"]["kept"] == manifest["parsed"] == len(predictions) - 1
        obeyed(asked, given)
        assert len(server.bodies) == num_asked + 1
    assert all(p.coc is not None for p in read_predictions(tmp_path / "out" / "predictions.jsonl"))


def test_nothing_answered_is_asked_twice(place, tmp_path, monkeypatch):
    monkeypatch.setattr("distill.inference.answers.STOP_AFTER_FAILURES", 2)
    out = tmp_path / "out"
    cfg = served()
    with TeacherServer(lambda number, body: "500" if number >= 5 else None) as server:
        with pytest.raises(TeacherError, match=r"[2-9] samples in a row got no answer.*http_500.*same command"):
            infer_with(cfg, place, server.url, out)
        num_kept = len(kept_answers(out))
        assert num_kept >= 5 - ENDPOINT["concurrency"]
        assert not (out / "predictions.jsonl").exists()
        server.fault, num_asked = (lambda number, body: None), len(server.bodies)
        path = infer_with(cfg, place, server.url, out)
        num_samples = len(read_predictions(path))
        assert len(server.bodies) == num_asked + num_samples - num_kept
        (out / "manifest.json").unlink()
        before = path.read_bytes()
        assert infer_with(cfg, place, server.url, out).read_bytes() == before
        assert len(server.bodies) == num_asked + num_samples - num_kept
    assert infer_with(cfg, place, server.url, out).read_bytes() == before  # a complete folder needs no server


def told(predictions: list[Prediction]) -> dict[str, str]:
    return {prediction.key: prediction.raw for prediction in predictions}


def test_each_sample_has_the_answer_that_it_has_alone(place, clean):
    student = load_student(place / "student", device="cpu", adapter=place / "trained" / "adapter")
    samples, trees = samples_of(place), resolve_trees(place / "set", [place / "tree"])
    alone = {}
    for sample in samples:
        features = features_of(student, [sample], trees)
        row = student.encode(sample, ADAPTER_PIXELS)
        alone[sample.key] = generate(student, [row], features, max_tokens=NUM_TOKENS)[0].text
    predictions = read_predictions(clean)
    assert [prediction.key for prediction in predictions] == [sample.key for sample in samples]
    assert told(predictions) == alone
    assert len(set(alone.values())) > 1
    assert {prediction.model for prediction in predictions} == {"student+trained"}
    # With a text that ends answers, they are the same up to that text.
    rows, features = [student.encode(sample, ADAPTER_PIXELS) for sample in samples[:4]], []
    for sample in samples[:4]:
        features += features_of(student, [sample], trees)
    texts = [one.text for one in generate(student, rows, features, max_tokens=NUM_TOKENS)]
    stop = next(char for char in texts[0][2:] if char.strip())
    cut = generate(student, rows, features, max_tokens=NUM_TOKENS, stop=stop)
    assert [one.text for one in cut] == [text.partition(stop)[0] for text in texts]
    assert cut[0].is_finished


def test_one_bad_picture_costs_its_samples_only(place, clean, tmp_path):
    tree = shutil.copytree(place / "tree", tmp_path / "tree")
    samples = samples_of(place)
    bad = samples[0].images[0]
    hit = {sample.key for sample in samples if bad in sample.images}
    whole = (tree / bad).read_bytes()
    (tree / bad).write_bytes(b"not a picture")
    words = ["distill infer --dataset", place / "set", "--data", tree, "--model", place / "student", "--adapter"]
    words += [place / "trained" / "adapter", "--out", tmp_path / "out"]
    for name, value in settings().model_dump(include={"split", "batch_size", "max_new_tokens", "device"}).items():
        words += [f"--set distill.infer.{name}={value}"]
    result = invoke(*words)
    assert result.exit_code == 1
    assert "some items failed" in str(result.exception)
    found, expected = read_predictions(tmp_path / "out" / "predictions.jsonl"), told(read_predictions(clean))
    assert {p.key for p in found if p.reason == "failed_input"} == hit
    assert 0 < len(hit) < len(samples) / 2
    others = {key: raw for key, raw in expected.items() if key not in hit}
    assert {p.key: p.raw for p in found if p.key not in hit} == others
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"]["failed"] == {"input": len(hit)}
    assert (tmp_path / "out" / "failures.jsonl").read_text().count("image cannot be decoded") == len(hit)
    (tree / bad).write_bytes(whole)  # mended: those alone are answered
    obeyed(*words)
    assert told(read_predictions(tmp_path / "out" / "predictions.jsonl")) == expected
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["speed"]["answers"] == len(hit)


def test_a_schema_is_enforced_by_servers_and_vllm_only(place, tmp_path):
    with pytest.raises(ConfigError, match=r"cannot enforce a schema.*--engine endpoint or --engine vllm"):
        answer(place, tmp_path / "out", constrained=True)


def test_a_merged_student_sees_pictures_as_it_was_taught(place, tmp_path):
    adapter = Path(shutil.copytree(place / "trained" / "adapter", tmp_path / "few" / "adapter"))
    path = adapter / CHAT_FORMAT_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {"max_pixels": 32 * 32}))
    merged = merge.run(place / "student", adapter, tmp_path / "merged")
    given = (settings(max_samples=3), place / "set", [place / "tree"])
    infer.run(*given, place / "student", tmp_path / "beside", adapter=adapter)
    infer.run(*given, merged, tmp_path / "alone")
    infer.run(*given, place / "student", tmp_path / "base")
    runs = [kept_answers(tmp_path / name) for name in ("beside", "alone", "base")]
    beside, alone, base = ([line["usage"]["prompt_tokens"] for line in run] for run in runs)
    assert alone == beside
    assert sum(base) > sum(beside)
