"""Students that answer in this process: batches, pictures, kills, full memory, constrained answers."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import invoke, obeyed
from specimens_distill import ADAPTER_PIXELS, make_adapter
from specimens_students import features_of, make_place
from teacher_server import kept_answers

from cosfly.formats.predictions import Prediction, read_predictions
from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.errors import ConfigError
from distill.inference import merge
from distill.inference import stage as infer
from distill.inference.answers import generate
from distill.schema import Sample, open_split, resolve_trees
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


def answer(place: Path, out: Path, tree: Path | None = None, **changes: Any) -> Path:
    given = (place / "set", [tree or place / "tree"], place / "student", out)
    return infer.run(settings(**changes), *given, adapter=place / "trained" / "adapter")


def samples_of(place: Path) -> list[Sample]:
    return list(open_split(place / "set", "train"))


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
    words = ["distill", "infer", "--dataset", place / "set", "--data", tree, "--model", place / "student"]
    words += ["--adapter", place / "trained" / "adapter", "--out", tmp_path / "out"]
    for name, value in settings().model_dump(include={"split", "batch_size", "max_new_tokens", "device"}).items():
        words += ["--set", f"distill.infer.{name}={value}"]
    result = invoke(words)
    assert result.exit_code == 1
    assert "more items failed" in str(result.exception)
    found, expected = read_predictions(tmp_path / "out" / "predictions.jsonl"), told(read_predictions(clean))
    assert {p.key for p in found if p.reason == "failed_input"} == hit
    assert 0 < len(hit) < len(samples) / 2
    others = {key: raw for key, raw in expected.items() if key not in hit}
    assert {p.key: p.raw for p in found if p.key not in hit} == others
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"]["failed"] == {"input": len(hit)}
    assert (tmp_path / "out" / "failures.jsonl").read_text().count("image cannot be decoded") == len(hit)
    (tree / bad).write_bytes(whole)  # mended: those alone are answered
    obeyed(words)
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
