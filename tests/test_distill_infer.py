"""Students asked through an engine: what is sent, what is kept, and what happens when nobody answers."""

import base64
import io
import json
from pathlib import Path

import pytest
from commands import invoke, obeyed
from PIL import Image
from specimens_distill import prepared
from teacher_server import TeacherServer, kept_answers

from cosfly.formats.predictions import read_predictions
from cosfly.runtime.errors import TeacherError
from distill.inference import stage as infer
from distill.schema import open_split

ENDPOINT = {"max_tries": 1, "timeout_s": 60.0, "concurrency": 3}


def settings(**changes) -> infer.InferConfig:
    endpoint = ENDPOINT | changes.pop("endpoint", {})
    return infer.InferConfig.model_validate({"split": "train", "engine": "endpoint", "endpoint": endpoint, **changes})


def infer_with(cfg: infer.InferConfig, place: Path, url: str, out: Path, **more) -> Path:
    return infer.run(cfg, place / "set", [place / "tree"], url, out, **more)


def test_a_server_is_asked_as_the_student_was_taught(place, tmp_path):
    samples = list(open_split(place / "set", "train"))
    with TeacherServer() as server:
        path = infer_with(
            settings(max_new_tokens=99, max_pixels=300, constrained=True), place, server.url, tmp_path / "out"
        )
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
    prepared(place / "tree", place / "captions.jsonl", tmp_path / "set", modalities=())
    with TeacherServer() as server:
        path = infer.run(settings(), tmp_path / "set", [], server.url, tmp_path / "out")
    assert all(prediction.coc is not None for prediction in read_predictions(path))
    assert not any("image_url" in body.decode() for body in server.bodies)


def test_one_sample_without_an_answer_costs_no_other(place, tmp_path):
    words = ["distill", "infer", "--dataset", place / "set", "--data", place / "tree", "--engine", "endpoint"]
    words += ["--out", tmp_path / "out", "--set", "distill.infer.split=train"]
    words += ["--set", "distill.infer.endpoint.max_tries=1"]
    with TeacherServer(lambda number, body: "500" if number == 2 else None) as server:
        words += ["--model", server.url]
        result = invoke(words)
        assert result.exit_code == 1
        assert "http_500" in str(result.exception)
        predictions, num_asked = read_predictions(tmp_path / "out" / "predictions.jsonl"), len(server.bodies)
        assert [p.reason for p in predictions if p.coc is None] == ["failed_http_500"]
        manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
        assert manifest["counts"]["failed"] == {"http_500": 1}
        assert manifest["counts"]["kept"] == manifest["parsed"] == len(predictions) - 1
        obeyed(words)
        assert len(server.bodies) == num_asked + 1
    assert all(p.coc is not None for p in read_predictions(tmp_path / "out" / "predictions.jsonl"))


def test_nothing_answered_is_asked_twice(place, tmp_path, monkeypatch):
    monkeypatch.setattr("distill.inference.answers.STOP_AFTER_FAILURES", 2)
    out = tmp_path / "out"
    cfg = settings()
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
