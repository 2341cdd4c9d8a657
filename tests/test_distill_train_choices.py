"""distill: what a training can be: in full, of random weights, of texts alone; what it is told before, and when it
ends."""

from __future__ import annotations

import json

import pytest

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from safetensors.torch import load_file  # noqa: E402
from specimens_students import MAX_PIXELS, inputs_of, load, log_of, run, samples_of, trees_of  # noqa: E402

from cosfly.runtime.errors import InputError  # noqa: E402
from distill.student.model import load_student  # noqa: E402

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
