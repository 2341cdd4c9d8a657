"""distill: student, encoding, training and inference on a tiny random Qwen3.5 model."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from specimens_distill import write_set

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from specimens_students import FAST, MAX_PIXELS, begun, inputs_of, load, log_of, run, samples_of, trees_of  # noqa: E402

from cosfly.formats.predictions import read_predictions  # noqa: E402
from distill.inference import stage as infer  # noqa: E402
from distill.student import model as student  # noqa: E402
from distill.student.checkpoint import load_checkpoint  # noqa: E402
from distill.student.encoding import IGNORED, encode_text, load_pictures, padded  # noqa: E402
from distill.training import stage as train  # noqa: E402
from distill.training.settings import Steps, TrainConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def trained(place, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    run(place, out, keep="last")  # which validation is the best depends on rounding
    return out


def test_processor_agrees_with_the_library_one(place):
    from transformers import Qwen3VLProcessor

    class WithoutVideos(Qwen3VLProcessor):
        @classmethod
        def get_attributes(cls):
            return ["image_processor", "tokenizer"]

        def check_argument_for_proper_class(self, name, argument):
            return None if argument is None else super().check_argument_for_proper_class(name, argument)

    own, sample = load(place), samples_of(place)[0]
    oracle = WithoutVideos(own.image_processor, own.tokenizer, None, chat_template=own.tokenizer.chat_template)
    frames = []
    for number, picture in enumerate(load_pictures(sample, trees_of(place))):
        frames += [{"type": "text", "text": f"t{number}:"}, {"type": "image", "image": picture}]
    messages = [
        {"role": "system", "content": [{"type": "text", "text": sample.prompt.system}]},
        {"role": "user", "content": [*frames, {"type": "text", "text": sample.prompt.user}]},
    ]
    wanted = oracle.apply_chat_template(
        messages, add_generation_prompt=True, tokenize=True, return_dict=True, return_tensors="pt"
    )
    found = inputs_of(own, [sample], trees_of(place))
    for name in ("input_ids", "pixel_values", "image_grid_thw"):
        assert torch.equal(found[name], wanted[name]), name


def test_mask_covers_exactly_the_answer(place):
    own = load(place)
    samples = samples_of(place)[:2]  # one in each language
    rows = [encode_text(own, sample) for sample in samples]
    ids, labels, positions = padded(own, rows)
    assert positions.shape == (3, *ids.shape)
    for i, sample in enumerate(samples):
        counted = labels[i] != IGNORED
        assert own.tokenizer.decode(ids[i][counted]) == sample.answer + student.END_OF_TURN
        assert np.array_equal(ids[i][counted], labels[i][counted])
        places = counted.nonzero()[0].tolist()
        assert places == list(range(places[0], places[-1] + 1))
        before = own.tokenizer.decode(ids[i][: places[0]])
        assert before.endswith("<|im_start|>assistant\n")
        assert sample.prompt.user in before
        assert len(rows[i]) == places[-1] + 1


def test_each_epoch_sees_each_sample_once():
    cfg = TrainConfig(samples_per_step=4, epochs=3)
    steps = Steps.make(cfg, num_samples=10, seed=4)
    assert (steps.num_steps, steps.steps_per_epoch) == (9, 3)
    for epoch in range(3):
        seen = [i for step in range(3) for i in steps.samples_of(3 * epoch + step)]
        assert sorted(seen) == list(range(10))
    assert steps.samples_of(0) != steps.samples_of(3)
    assert Steps.make(TrainConfig(max_steps=2), 100, 0).num_steps == 2


def test_loss_falls_and_the_log_tells_how_fast(trained):
    log = log_of(trained)
    assert [record["step"] for record in log] == list(range(1, 13))
    assert log[-1]["loss"] < 0.75 * log[0]["loss"]
    found = log_of(trained, "validation")
    assert [record["step"] for record in found] == [0, 3, 6, 9, 12]
    assert found[-1]["validation"]["loss"] < found[0]["validation"]["loss"]
    best, found = json.loads((trained / "manifest.json").read_text())["best_step"], (trained / "checkpoints").iterdir()
    assert sorted(path.name for path in found) == [f"step_{step:08d}" for step in sorted({best, 10, 12})]
    for line in (trained / "log.jsonl").read_text().splitlines():
        speed = json.loads(line).get("speed")
        assert speed is None or (
            speed["tokens_per_s"] > 0 and speed["memory_gb"] > 0 and 0 <= speed["waited_share"] <= 1
        )


def test_the_product_holds_no_pickle_and_no_local_path(place, trained):
    suffixes = {path.suffix for path in trained.rglob("*") if path.is_file()}
    assert suffixes <= {".json", ".jsonl", ".safetensors", ".sha256", ".md", ".lock", ""}, suffixes
    texts = {path.name: path.read_text() for path in (trained / "adapter").iterdir() if path.suffix != ".safetensors"}
    assert json.loads(texts["adapter_config.json"])["base_model_name_or_path"] == "student"
    assert not [name for name, text in texts.items() if str(place) in text]


def test_adapter_reloads_equal(place, trained):
    own = train.add_adapter(load(place), TrainConfig(**FAST), 0)
    assert load_checkpoint(trained / "checkpoints" / "step_00000012", own).step == 12
    again = student.load_student(place / "student", device="cpu", max_pixels=MAX_PIXELS, adapter=trained / "adapter")
    logits = []
    for model in (own, again, load(place)):
        inputs = inputs_of(model, samples_of(place)[:1], trees_of(place))
        with torch.inference_mode():
            logits.append(model.model.eval()(**inputs).logits)
    assert torch.equal(logits[0], logits[1])
    assert not torch.allclose(logits[0], logits[2], atol=0.1)  # and it does something


@pytest.mark.slow
def test_stopped_and_continued_is_the_same(place, tmp_path):
    out, whole, settings = tmp_path / "out", tmp_path / "whole", {"max_steps": 8}
    begun(place, out, **settings)
    assert sorted(path.name for path in (out / "checkpoints").iterdir()) == ["step_00000005", "step_00000006"]
    assert not (out / "manifest.json").exists()
    with open(out / "log.jsonl", "a") as file:
        file.write('{"step": 9, "lo')
    damaged = shutil.copytree(out / "checkpoints/step_00000006", out / "checkpoints/step_00000007")
    moments = damaged / "optimizer.safetensors"
    moments.write_bytes(moments.read_bytes()[:-7])
    run(place, out, **settings)
    run(place, whole, **settings)
    assert log_of(out) == log_of(whole)
    assert log_of(out, "validation") == log_of(whole, "validation")
    name = "adapter/adapter_model.safetensors"
    assert (out / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_a_student_that_overfits_answers_right(place, tmp_path):
    learnt = samples_of(place)[:2]
    write_set(tmp_path / "set", {"train": learnt, "val": learnt}, [place / "tree"])
    settings = {**FAST, "lora_rank": 16, "schedule": "cosine", "batch_size": 2, "samples_per_step": 2, "epochs": 80}
    cfg = TrainConfig(**settings, keep="last", patience=0)
    given = (tmp_path / "set", [place / "tree"], place / "student")
    adapter = train.run(cfg, *given, tmp_path / "trained")
    asked = infer.InferConfig(split="train", device="cpu")
    out = infer.run(asked, *given, tmp_path / "answers", adapter=adapter)
    predictions = read_predictions(out)
    assert [p.raw for p in predictions] == [sample.answer for sample in learnt]
    assert all(p.coc is not None and p.is_finished for p in predictions)
