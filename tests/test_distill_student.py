"""A student: its chat template, merged weights, fused norms and the chunked loss, each against the libraries'."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from specimens_distill import make_adapter
from specimens_students import (
    FAST,
    MAX_PIXELS,
    features_of,
    load,
    losses_of,
    nats_of,
    qwen,
    run,
    safetensors,
    samples_of,
    torch,
    trees_of,
)

from cosfly.runtime.errors import InputError
from distill.inference import merge
from distill.student import qwen3_5
from distill.student.chat import EncodedSample
from distill.student.features import Tensors
from distill.student.model import Student, load_student
from distill.student.random_student import make_random_student
from distill.training import fit
from distill.training import stage as train
from distill.training.loss import answer_loss, chunked_loss
from distill.training.settings import TrainConfig

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
