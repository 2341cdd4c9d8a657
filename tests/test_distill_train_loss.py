"""distill."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from later import torch
from specimens_students import (
    FAST,
    MAX_PIXELS,
    features_of,
    load,
    losses_of,
    nats_of,
    pixels_of,
    run,
    samples_of,
    trees_of,
)

from distill.student.chat import EncodedSample, padded
from distill.student.features import Tensors
from distill.student.model import Student
from distill.training import fit
from distill.training import stage as train
from distill.training.loss import answer_loss, chunked_loss
from distill.training.settings import TrainConfig

pytestmark = pytest.mark.usefixtures("one_thread")

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


def test_loss_and_gradients_are_those_of_the_library(place):
    own = train.add_adapter(load(place), TrainConfig(**FAST), 0)
    with torch.no_grad():  # a fresh adapter's second matrix is zero, which would hide the first one's gradient
        for name, parameter in own.model.named_parameters():
            if "lora_B" in name:
                parameter.normal_(0, 0.02, generator=torch.Generator().manual_seed(len(name)))
    (row,), features = seen(place, own, 1)
    learning = {name: p for name, p in own.model.named_parameters() if p.requires_grad}
    total = answer_loss(own, [row], features, 16)
    (total / len(row.answer_ids)).backward()
    found = {name: p.grad.clone() for name, p in learning.items()}
    own.model.zero_grad()
    inputs = {name: torch.from_numpy(array) for name, array in padded(own, [row]).items() if name != "weights"}
    inputs["attention_mask"] = torch.ones_like(inputs["input_ids"])
    library = own.model(**inputs, **pixels_of(own, samples_of(place)[:1], trees_of(place))).loss
    library.backward()
    assert float(total.detach()) / len(row.answer_ids) == pytest.approx(float(library.detach()), rel=1e-5)
    for name, parameter in learning.items():
        assert torch.allclose(found[name], parameter.grad, atol=1e-5, rtol=1e-3), name


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
