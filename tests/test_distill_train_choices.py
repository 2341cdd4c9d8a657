"""distill: what a training can be: in full, of random weights, of texts alone; what it is told before, and when it
ends."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from specimens_distill import prepared

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from safetensors.torch import load_file  # noqa: E402
from specimens_students import FAST, MAX_PIXELS, inputs_of, load, log_of, losses_of, run, samples_of, trees_of  # noqa: E402

from cosfly.errors import InputError, ResumeError  # noqa: E402
from cosfly.products.actions import shipped_actions  # noqa: E402
from distill.schema import Sample  # noqa: E402
from distill.student.checkpoint import Progress  # noqa: E402
from distill.student.decoding import Completion  # noqa: E402
from distill.student.model import load_student  # noqa: E402
from distill.training import fit, preflight  # noqa: E402
from distill.training import stage as train  # noqa: E402
from distill.training.fit import Validation, judged  # noqa: E402
from distill.training.loading import choose_over_all  # noqa: E402
from distill.training.preflight import estimate, saved_bytes_per_token, used_gb  # noqa: E402
from distill.training.settings import TrainConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_model_trained_in_full_is_a_whole_folder(place, tmp_path):
    """transformers loads weights, tokenizer, picture processor, chat template and generation settings, and the tower is
    as it was."""
    from transformers import AutoModelForImageTextToText, AutoTokenizer, GenerationConfig

    folder = run(place, tmp_path / "out", method="full", max_steps=4, learning_rate=1e-3)
    assert folder.name == "model"
    model = AutoModelForImageTextToText.from_pretrained(folder, dtype=torch.float32)
    assert AutoTokenizer.from_pretrained(folder).chat_template == load(place).tokenizer.chat_template
    assert GenerationConfig.from_pretrained(folder) is not None
    own = load_student(folder, device="cpu", max_pixels=10**9)
    assert own.image_processor.size["longest_edge"] == MAX_PIXELS  # what it was taught with stays its own bound
    inputs = inputs_of(own, samples_of(place)[:1], trees_of(place))
    with torch.inference_mode():
        assert torch.equal(own.model.eval()(**inputs).logits, model.eval()(**inputs).logits)
    before, after = load(place).core.state_dict(), own.core.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert any("language_model" in name for name in changed)
    assert not any("visual" in name for name in changed)
    assert (folder / "cosfly_student.json").exists()


def test_the_tower_learns_when_it_is_told_to(place, tmp_path):
    folder = run(place, tmp_path / "out", method="full", train_vision=True, max_steps=2, learning_rate=1e-3)
    before, after = load(place).core.state_dict(), load_file(folder / "model.safetensors")
    assert any("visual" in name and not torch.equal(before[name], after[name]) for name in after)
    with pytest.raises(ValueError, match="train_vision needs method=full"):
        TrainConfig(train_vision=True)


@pytest.mark.slow
def test_bfloat16_computes_with_float32_weights_that_learn(place, tmp_path):
    settings = {"method": "full", "max_steps": 4, "learning_rate": 1e-3, "validation_answers": True}
    for dtype in ("float32", "bfloat16"):
        run(place, tmp_path / dtype, dtype=dtype, max_new_tokens=4, **settings)
    found, wanted = losses_of(tmp_path / "bfloat16"), losses_of(tmp_path / "float32")
    assert found == pytest.approx(wanted, rel=0.02)
    assert found != wanted
    newest = sorted((tmp_path / "bfloat16" / "checkpoints").iterdir())[-1]
    assert {tensor.dtype for tensor in load_file(newest / "weights.safetensors").values()} == {torch.float32}


@pytest.mark.slow
def test_a_tiny_student_has_a_tokenizer_of_the_data(place, tmp_path):
    """Its pieces are those of the samples: fewer tokens than those of a tokenizer trained on a few lines; and it is in
    the folder."""
    run(place, tmp_path / "out", "tiny", max_steps=2)
    own = load_student(tmp_path / "out" / "student", device="cpu", max_pixels=MAX_PIXELS)
    sample = samples_of(place)[0]
    assert len(own.tokenizer(sample.answer)["input_ids"]) < len(load(place).tokenizer(sample.answer)["input_ids"])
    facts = json.loads((tmp_path / "out" / "adapter" / "cosfly_adapter.json").read_text())
    assert list(facts["base_sha256"]) == ["model.safetensors"]
    (tmp_path / "out" / "manifest.json").unlink()
    with pytest.raises(ResumeError, match=r"random_student\.width"):
        run(place, tmp_path / "out", "tiny:small", max_steps=2)
    settings = {"width": 96, "layers": 8, "vision_layers": 1}
    run(place, tmp_path / "own", "random", max_steps=1, random_student=settings, method="full")
    config = load_student(tmp_path / "own" / "model", device="cpu", max_pixels=MAX_PIXELS).core.config
    text = config.text_config
    assert (text.hidden_size, text.num_hidden_layers, config.vision_config.depth) == (96, 8, 1)


def test_a_student_of_texts_alone_learns(place, tmp_path):
    dataset = prepared(place / "tree", place / "captions.jsonl", tmp_path / "set", modalities=())
    run(place, tmp_path / "out", dataset=dataset, max_steps=6, validation_answers=True, max_new_tokens=4)
    found = losses_of(tmp_path / "out")
    assert found[-1] < found[0]
    assert "the student sees texts only" in (tmp_path / "out" / "preflight.json").read_text()


def sample_like(base: Sample, flight: int, frame: int, decision: str) -> Sample:
    return base.model_copy(update={"sample_id": f"trajectory_{flight}_ORI_frame_{frame:05d}", "decision": decision})


def test_validation_is_drawn_over_all_decisions_and_flights(place):
    """One decision and one flight have most of the samples; still each of the others is asked about."""
    base = samples_of(place)[0]
    samples = [sample_like(base, flight % 3, flight, "track_straight") for flight in range(300)]
    samples += [sample_like(base, flight, 400, "hover") for flight in range(5)]
    samples += [sample_like(base, 9, frame, "ascend") for frame in range(500, 502)]
    chosen = choose_over_all(samples, 12, np.random.default_rng(0))
    assert chosen == sorted(set(chosen))
    assert Counter(samples[i].decision for i in chosen) == {"track_straight": 5, "hover": 5, "ascend": 2}
    assert len({samples[i].sample_id.split("_")[1] for i in chosen if samples[i].decision == "track_straight"}) == 3
    again, other = (choose_over_all(samples, 12, np.random.default_rng(seed)) for seed in (0, 1))
    assert again == chosen != other
    assert choose_over_all(samples, 1000, np.random.default_rng(0)) == list(range(len(samples)))
    assert choose_over_all([], 5, np.random.default_rng(0)) == []


@pytest.mark.parametrize("best_by", ["decision", "verdict"])
def test_the_best_is_who_decides_best_and_patience_ends(best_by):
    progress, cfg, found = Progress(), TrainConfig(best_by=best_by, patience=2), []
    for step, (share, loss) in enumerate([(0.2, 3.0), (0.5, 2.0), (0.5, 1.0), (0.4, 0.5), (0.5, 1.5)], 1):
        other = 0.1 * step  # what is not followed only grows
        accuracy, consistent = (share, other) if best_by == "decision" else (other, share)
        validation = Validation(samples=4, loss=loss, accuracy=accuracy, consistent=consistent)
        progress = judged(progress.model_copy(update={"step": step}), validation, cfg)
        found.append((progress.best_step, progress.stale, progress.has_ended))
    assert found == [(1, 0, False), (2, 0, False), (3, 0, False), (3, 1, False), (3, 2, True)]
    patient = TrainConfig(patience=0)
    assert not judged(Progress(step=9, best_score=(1.0, 0.0)), Validation(samples=1, loss=1.0), patient).has_ended
    with pytest.raises(ValueError, match="verdict needs validation_answers"):
        TrainConfig(best_by="verdict", validation_answers=False)


def test_an_answer_is_judged_by_the_teacher_and_by_the_future(place):
    sample = samples_of(place)[0].model_copy(update={"label": "hover", "contradicted": ("ascend",)})

    def counts(changes: dict, **future: object) -> list[float]:
        answer = json.dumps({**json.loads(sample.answer), **changes})
        return fit._judged_answer(
            sample.model_copy(update=future), Completion(answer, 9, True), shipped_actions()
        ).tolist()

    assert sample.decision != "hover"
    assert counts({}) == [1, 1, 1, 0]
    assert counts({"flight_decision": "hover"}) == [1, 0, 1, 1]
    assert counts({"flight_decision": "hover"}, contradicted=None) == [1, 0, 0, 0]
    assert counts({"flight_decision": "dance"}) == [0, 0, 1, 0]


@pytest.mark.slow
def test_training_ends_early_and_keeps_the_best_weights(place, tmp_path):
    """A rate that soon makes it worse: the product is the checkpoint of the best validation, also when it is run
    again."""
    settings = {"learning_rate": 5.0, "validate_every_steps": 1, "patience": 2, "keep_checkpoints": 1, "max_steps": 12}
    out = tmp_path / "out"
    run(place, out, **settings)
    manifest = json.loads((out / "manifest.json").read_text())
    best, steps = manifest["best_step"], manifest["steps"]
    assert steps == best + 2 < 12
    scores = {r["step"]: r["validation"]["loss"] for r in log_of(out, "validation") if r["step"]}
    assert min(scores, key=scores.__getitem__) == best
    kept = load_file(out / "checkpoints" / f"step_{best:08d}" / "weights.safetensors")
    product = load_file(out / "adapter" / "adapter_model.safetensors")
    for name, tensor in product.items():
        assert torch.equal(tensor, kept[name.replace(".weight", ".default.weight")]), name
    (out / "manifest.json").unlink()
    run(place, out, **settings)  # it has ended: nothing is done again
    assert json.loads((out / "manifest.json").read_text())["steps"] == steps
    (out / "manifest.json").unlink()
    weights = out / "checkpoints" / f"step_{best:08d}" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-7])
    with pytest.raises(InputError, match=r"best validation is damaged.*weights\.safetensors"):
        run(place, out, **settings)


def test_the_list_before_the_first_step(place, tmp_path):
    run(place, tmp_path / "out", max_steps=1)
    found = json.loads((tmp_path / "out" / "preflight.json").read_text())
    topics = [finding["topic"] for finding in found]
    assert topics == ["samples", "steps", "validation", "decisions", "chat template", "memory", "pictures", "kernels"]
    texts = {finding["topic"]: finding["text"] for finding in found}
    assert texts["samples"].startswith("12 of 12; ")
    assert "28, features 0.000 GB" in texts["pictures"]
    assert "batch_size 2" in texts["memory"]


def test_missing_fast_kernels_are_named_where_they_matter(place):
    own = load(place)
    assert [f.level for f in preflight._about_kernels(own)] == ["fact"]
    found = preflight._about_kernels(replace(own, device="cuda"))
    assert [f.level for f in found] == ["warning"] * 3
    assert "pip install flash-linear-attention" in found[0].text
    assert "tilelang" in found[1].text
    assert "causal-conv1d" in found[2].text


def test_what_is_kept_for_the_backward_pass_is_measured(place):
    """It grows with the batch, and recomputing keeps far less; freezing everything but the adapter keeps less than
    learning in full."""
    cfg = TrainConfig(**FAST)
    lora = train.add_adapter(load(place), cfg, 0)
    kept = saved_bytes_per_token(lora, cfg)
    lora.model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    assert 0 < saved_bytes_per_token(lora, cfg) < kept / 3
    full = train.free_weights(load(place), TrainConfig(**FAST, method="full"))
    one, four = (estimate(full, cfg.model_copy(update={"batch_size": size}), 300, 1e5) for size in (1, 4))
    assert four.activations == pytest.approx(4 * one.activations, rel=1e-6)  # each is measured anew
    assert one.optimizer == 2 * one.gradients > 0
    assert used_gb("cpu") * 1e9 <= one.needed < one.available  # the process itself is in it
