"""distill: students of ten families, of random weights: they train, resume, merge and answer through one interface."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from later import torch
from specimens_families import FAMILIES, TEXT_ONLY, WITH_PICTURES, make_family
from specimens_students import begun, features_of, log_of, losses_of, pixels_of, run, samples_of, trees_of
from tables import each

from cosfly.formats.predictions import read_predictions
from cosfly.runtime.errors import EnvironmentMissing, InputError
from distill.inference import merge
from distill.inference import stage as infer
from distill.student.chat import AnswerWeights, padded
from distill.student.model import load_student
from distill.training.loss import answer_loss

pytestmark = pytest.mark.usefixtures("one_thread")

SIZES_PX = ((64, 36), (320, 180), (224, 126), (160, 90))


@pytest.fixture(params=FAMILIES)
def family(request, built_once) -> Path:
    name = request.param
    if name == "smolvlm" and importlib.util.find_spec("num2words") is None:
        pytest.skip("the processor of SmolVLM needs num2words")
    return built_once(f"family_{name}", lambda root: make_family(name, root / name)) / name


def test_the_loss_is_that_of_the_library(place, family):
    """Features that are kept, batches without a mask and the chunked loss give what the family's own forward gives."""
    own, trees = load_student(family, device="cpu"), trees_of(place)
    samples = samples_of(place)[:2]
    assert own.has_pictures == (family.name in WITH_PICTURES)
    if not own.has_pictures:
        samples = [sample.without_pictures() for sample in samples]
        assert all("No pictures are given." in s.prompt.user or "未提供图像。" in s.prompt.user for s in samples)
    rows = [own.encode(sample, 64 * 64) for sample in samples]
    own.model.train()
    with torch.no_grad():
        total, nats = answer_loss(own, rows, features_of(own, samples, trees), 16)
    for sample, row, found in zip(samples, rows, nats, strict=True):
        inputs = {name: torch.from_numpy(array) for name, array in padded(own, [row]).items() if name != "weights"}
        inputs["attention_mask"] = torch.ones_like(inputs["input_ids"])
        with torch.no_grad():
            wanted = own.model(**inputs, **pixels_of(own, [sample], trees)).loss
        assert float(found) / len(row.answer_ids) == pytest.approx(float(wanted), rel=1e-4)
    assert float(total) == pytest.approx(float(nats.sum()), rel=1e-5)


def test_prompt_answer_and_end_are_what_the_template_writes(place, family):
    own = load_student(family, device="cpu")
    for sample in samples_of(place)[:2]:
        seen = sample if own.has_pictures else sample.without_pictures()
        assert own.prompt_text(seen) + own.lead + seen.answer + own.end_of_answer == own.chat_text(seen)
        row = own.encode(seen)
        assert own.tokenizer.decode(row.answer_ids) == own.lead + seen.answer + own.tokenizer.decode([own.end_token_id])
        assert row.answer_ids[-1] == own.end_token_id != own.pad_token_id


@each("name", WITH_PICTURES)
def test_a_picture_takes_the_tokens_that_the_family_s_processor_says(name, built_once):
    """Training, inference and a server ask the family's processor with the same picture; its features are as many."""
    folder = built_once(f"family_{name}", lambda root: make_family(name, root / name)) / name
    own = load_student(folder, device="cpu")
    for size_px in SIZES_PX:
        picture = np.random.default_rng(0).integers(0, 255, (*size_px[::-1], 3), dtype=np.uint8)
        inputs = {n: torch.from_numpy(a) for n, a in own.picture_inputs(picture, is_alone=True).items()}
        with torch.no_grad():
            pooled = own.core.base_model.get_image_features(**inputs).pooler_output
        parts = pooled if isinstance(pooled, list | tuple) else [pooled]
        assert sum(part.numel() for part in parts) // own.width == own.picture_tokens(size_px), size_px


@pytest.mark.slow
def test_a_family_trains_resumes_merges_and_answers(place, family, tmp_path):
    settings: dict[str, Any] = {"max_steps": 4, "save_every_steps": 2, "validation_samples": 2, "learning_rate": 1e-3}
    begun(place, tmp_path / "out", 3, student=family, **settings)
    adapter = run(place, tmp_path / "out", family, **settings)
    run(place, tmp_path / "whole", family, **settings)
    assert log_of(tmp_path / "out") == log_of(tmp_path / "whole")
    assert losses_of(tmp_path / "out")[-1] < losses_of(tmp_path / "out")[0]
    merged = merge.run(family, adapter, tmp_path / "merged")
    cfg = infer.InferConfig(split="train", max_samples=3, max_new_tokens=6, device="cpu", batch_size=3)
    given = (cfg, place / "set", [place / "tree"])
    beside = read_predictions(infer.run(*given, family, tmp_path / "beside", adapter=adapter))
    alone = read_predictions(infer.run(*given, merged, tmp_path / "alone"))
    assert [one.raw for one in alone] == [one.raw for one in beside]
    assert len(alone) == 3
    taught = json.loads((merged / "cosfly_student.json").read_text())
    assert bool(taught["looks"][0]["views"]) == (family.name not in TEXT_ONLY)


def test_the_decision_can_weigh_more_and_come_first(place, built_once):
    folder = built_once("family_llama", lambda root: make_family("llama", root / "llama")) / "llama"
    own, sample = load_student(folder, device="cpu"), samples_of(place)[0].without_pictures()
    row = own.encode(sample, weights=AnswerWeights(decision=20.0, reason=0.5))
    for weight, field in ((20.0, "flight_decision"), (0.5, "reasoning_trace")):
        text = own.tokenizer.decode(row.answer_ids[row.weights == weight])
        assert json.loads(sample.answer)[field] in text
        assert len(text) < len(json.loads(sample.answer)[field]) + 4
    assert row.weights[-1] == 1.0
    assert np.array_equal(own.encode(sample).weights, np.ones(len(row.answer_ids), np.float32))


def _changed(folder: Path, name: str, change: Any) -> None:
    value = json.loads((folder / name).read_text())
    change(value)
    (folder / name).write_text(json.dumps(value))


def _without_template(folder: Path) -> None:
    (folder / "chat_template.jinja").unlink(missing_ok=True)
    _changed(folder, "tokenizer_config.json", lambda value: value.pop("chat_template", None))


def _without_end(folder: Path) -> None:
    (folder / "chat_template.jinja").write_text("{% for m in messages %}{{ m.content }}{% endfor %}")
    _changed(folder, "tokenizer_config.json", lambda value: value.pop("eos_token"))


def _remote_code(folder: Path) -> None:
    own = {"auto_map": {"AutoConfig": "code.Config"}, "model_type": "their_own"}
    _changed(folder, "config.json", lambda value: value.update(own))


def _unknown_family(folder: Path) -> None:
    _changed(folder, "config.json", lambda value: value.update(model_type="qwen99"))


def _no_language_model(folder: Path) -> None:
    _changed(folder, "config.json", lambda value: value.update(model_type="vit"))


def _several_files(folder: Path) -> None:
    (folder / "config.json").unlink()
    for name in ("a.gguf", "b.gguf"):
        (folder / name).touch()


@each("change, words", [
    (_without_template, r"no chat template.*set distill\.train\.chat_template"),
    (_without_end, r"no end token.*eos_token"),
    (_remote_code, r"needs code from its own repository, which is not run.*their_own.*allow_code=true"),
    (_unknown_family, r"does not know the model type.*qwen99.*update transformers"),
    (_no_language_model, r"neither a language model nor a vision-language model.*vit"),
    (_several_files, r"several GGUF files.*a\.gguf, b\.gguf"),
])  # fmt: skip
def test_a_student_that_cannot_be_used_is_refused_in_one_line(place, tmp_path, change, words):
    folder = make_family("llama", tmp_path / "student")
    change(folder)
    with pytest.raises(InputError, match=words) as told:
        run(place, tmp_path / "out", folder)
    assert "\n" not in str(told.value)


def test_a_gguf_file_that_cannot_be_read_is_refused(place, tmp_path):
    (tmp_path / "broken.gguf").write_bytes(b"GGUF" + bytes(60))
    has_reader = importlib.util.find_spec("gguf") is not None
    words = r"cannot be loaded.*quantization" if has_reader else "gguf"
    with pytest.raises(InputError if has_reader else EnvironmentMissing, match=words):
        run(place, tmp_path / "out", tmp_path / "broken.gguf")
