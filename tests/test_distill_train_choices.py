"""distill: what a training can be: in full, of random weights, of texts alone."""

import json

import pytest

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from safetensors.torch import load_file  # noqa: E402
from specimens_students import MAX_PIXELS, inputs_of, load, log_of, losses_of, run, samples_of, trees_of  # noqa: E402

from cosfly.runtime.errors import InputError  # noqa: E402
from distill.student.checkpoint import Progress  # noqa: E402
from distill.student.model import load_student  # noqa: E402
from distill.training import fit  # noqa: E402
from distill.training.fit import Validation, judged  # noqa: E402
from distill.training.settings import TrainConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
def test_a_model_trained_in_full_is_a_whole_folder(place, tmp_path):
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


@pytest.mark.slow
def test_training_ends_early_and_keeps_the_best_weights(place, tmp_path, monkeypatch):
    losses = iter([4.0, 3.0, 1.0, 2.0, 1.5, 0.5])  # before the first step, then after each: the best is step 2
    monkeypatch.setattr(fit, "validate", lambda *_: Validation(samples=4, loss=next(losses)))
    settings = {"validate_every_steps": 1, "patience": 2, "keep_checkpoints": 1}
    out = tmp_path / "out"
    run(place, out, **settings)
    manifest = json.loads((out / "manifest.json").read_text())
    assert (manifest["best_step"], manifest["steps"]) == (2, 4)
    assert [r["validation"]["loss"] for r in log_of(out, "validation")] == [4.0, 3.0, 1.0, 2.0, 1.5]
    best, last = (out / "checkpoints" / f"step_{step:08d}" / "weights.safetensors" for step in (2, 4))
    kept, newest = load_file(best), load_file(last)
    product = load_file(out / "adapter" / "adapter_model.safetensors")
    product = {name.replace(".weight", ".default.weight"): tensor for name, tensor in product.items()}
    assert product.keys() == kept.keys()
    assert all(torch.equal(tensor, kept[name]) for name, tensor in product.items())
    assert not all(torch.equal(tensor, newest[name]) for name, tensor in product.items())
    (out / "manifest.json").unlink()
    run(place, out, **settings)  # it has ended: nothing is done again
    assert json.loads((out / "manifest.json").read_text())["steps"] == 4
    assert next(losses) == 0.5
    (out / "manifest.json").unlink()
    best.write_bytes(best.read_bytes()[:-7])
    with pytest.raises(InputError, match=r"best validation is damaged.*weights\.safetensors"):
        run(place, out, **settings)


@pytest.mark.slow
def test_bfloat16_computes_with_float32_weights_that_learn(place, tmp_path):
    settings = {"method": "full", "max_steps": 4, "learning_rate": 1e-3, "validation_answers": True}
    for dtype in ("float32", "bfloat16"):
        run(place, tmp_path / dtype, dtype=dtype, max_new_tokens=4, **settings)
    found, wanted = losses_of(tmp_path / "bfloat16"), losses_of(tmp_path / "float32")
    assert found == pytest.approx(wanted, rel=0.05)
    assert found != wanted
    newest = sorted((tmp_path / "bfloat16" / "checkpoints").iterdir())[-1]
    assert {tensor.dtype for tensor in load_file(newest / "weights.safetensors").values()} == {torch.float32}


def test_the_best_is_who_decides_best_and_patience_ends():
    progress, cfg, found = Progress(), TrainConfig(patience=2), []
    for step, (share, loss) in enumerate([(0.2, 3.0), (0.5, 2.0), (0.5, 1.0), (0.4, 0.5), (0.5, 1.5)], 1):
        validation = Validation(samples=4, loss=loss, accuracy=share, consistent=0.1 * step)  # the latter only grows
        progress = judged(progress.model_copy(update={"step": step}), validation, cfg)
        found.append((progress.best_step, progress.stale, progress.has_ended))
    assert found == [(1, 0, False), (2, 0, False), (3, 0, False), (3, 1, False), (3, 2, True)]
    patient = TrainConfig(patience=0)
    assert not judged(Progress(step=9, best_score=(1.0, 0.0)), Validation(samples=1, loss=1.0), patient).has_ended
