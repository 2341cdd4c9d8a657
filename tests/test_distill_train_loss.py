"""distill: the loss against the library's own, samples in batches against samples alone, features of pictures against
none kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from specimens_students import FAST, features_of, inputs_of, load, losses_of, run, samples_of, trees_of  # noqa: E402

from cosfly.errors import ConfigError  # noqa: E402
from distill.student.encoding import EncodedSample, encode_text, padded  # noqa: E402
from distill.student.features import FramePicture, PictureData, PictureReader, VisionFeatures, pictures_of  # noqa: E402
from distill.student.model import Student  # noqa: E402
from distill.training import stage as train  # noqa: E402
from distill.training.loading import Maker, Order  # noqa: E402
from distill.training.loss import answer_loss, chunked_loss, output_head  # noqa: E402
from distill.training.settings import TARGET_MODULES, TrainConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")

# Adam divides by what gradients were before, so rounding grows from step to step, with a rate that makes a student
# learn in 12 steps sooner than with usual ones.
FOUR = {"max_steps": 4, "validation_samples": 0, "learning_rate": 1e-3}


def seen(place: Path, own: Student, count: int) -> tuple[list[EncodedSample], torch.Tensor]:
    """Some samples, and what the tower makes of their pictures."""
    samples = samples_of(place)[:count]
    return [encode_text(own, s) for s in samples], features_of(own, inputs_of(own, samples, trees_of(place)))


@pytest.mark.parametrize("chunk", [7, 1000])
def test_the_chunked_loss_is_the_plain_one_with_its_gradients(chunk):
    generator = torch.Generator().manual_seed(chunk)
    hidden = torch.randn(37, 16, generator=generator, requires_grad=True)
    head = torch.randn(101, 16, generator=generator, requires_grad=True)
    targets = torch.randint(0, 101, (37,), generator=generator)
    weights = torch.rand(37, generator=generator)
    total, nats = chunked_loss(hidden, head, targets, weights, chunk=chunk, dtype=torch.float32)
    (3.0 * total).backward()
    found = hidden.grad.clone(), head.grad.clone()
    hidden.grad = head.grad = None
    plain = torch.nn.functional.cross_entropy(hidden @ head.T, targets, reduction="none")
    (3.0 * (plain * weights).sum()).backward()
    assert torch.allclose(nats, plain, atol=1e-5)
    assert float(total.detach()) == pytest.approx(float((plain * weights).sum().detach()), rel=1e-6)
    assert torch.allclose(found[0], hidden.grad, atol=1e-5)
    assert torch.allclose(found[1], head.grad, atol=1e-5)


def test_a_frozen_head_gets_no_gradient_and_no_tokens_no_loss():
    hidden, head = torch.randn(3, 4, requires_grad=True), torch.randn(9, 4)
    total, _ = chunked_loss(hidden, head, torch.tensor([1, 2, 3]), torch.ones(3), chunk=2, dtype=torch.float32)
    total.backward()
    assert head.grad is None
    none = chunked_loss(
        hidden[:0], head, torch.zeros(0, dtype=torch.int64), torch.zeros(0), chunk=2, dtype=torch.float32
    )
    assert float(none[0].detach()) == 0.0


def test_loss_and_gradients_are_those_of_the_library(place):
    """The library's own forward pass with labels: the same mean over answer tokens, and the same gradient of every
    adapted weight."""
    own = train.add_adapter(load(place), TrainConfig(**FAST), 0)
    with torch.no_grad():  # a fresh adapter's second matrix is zero, which would hide the first one's gradient
        for name, parameter in own.model.named_parameters():
            if "lora_B" in name:
                parameter.normal_(0, 0.02, generator=torch.Generator().manual_seed(len(name)))
    (row,), features = seen(place, own, 1)
    learning = {name: p for name, p in own.model.named_parameters() if p.requires_grad}
    total, nats = answer_loss(own, [row], features, 16)
    (total / len(row.answer_ids)).backward()
    found = {name: p.grad.clone() for name, p in learning.items()}
    own.model.zero_grad()
    ids, labels, _ = padded(own, [row])
    inputs = inputs_of(own, samples_of(place)[:1], trees_of(place)) | {
        "input_ids": torch.from_numpy(ids), "attention_mask": torch.ones(ids.shape, dtype=torch.int64),
        "mm_token_type_ids": torch.from_numpy((ids == own.image_token_id).astype(np.int64)),
    }  # fmt: skip
    library = own.model(**inputs, labels=torch.from_numpy(labels)).loss
    library.backward()
    assert float(total.detach()) / len(row.answer_ids) == pytest.approx(float(library.detach()), rel=1e-5)
    assert float(nats[0]) == pytest.approx(float(total.detach()), rel=1e-6)
    for name, parameter in learning.items():
        assert torch.allclose(found[name], parameter.grad, atol=1e-5, rtol=1e-3), name


def test_a_sample_in_a_batch_has_its_loss_alone(place):
    """Neither padding nor neighbours reach it, in linear attention, convolution or full attention."""
    own = load(place)
    rows, features = seen(place, own, 4)
    parts = features.split([int((row.prompt_ids == own.image_token_id).sum()) for row in rows])
    # Lengths far apart, one beyond a piece of 64 tokens of the linear attention.
    rows[1] = replace(rows[1], answer_ids=np.tile(rows[1].answer_ids, 3))
    rows[2] = replace(rows[2], answer_ids=rows[2].answer_ids[:5], weight=0.5)
    with torch.no_grad():
        _, together = answer_loss(own, rows, features, 64)
        alone = [answer_loss(own, [row], part, 64) for row, part in zip(rows, parts, strict=True)]
    for row, found, (total, nats) in zip(rows, together.tolist(), alone, strict=True):
        assert found == pytest.approx(float(nats[0]), rel=1e-5)
        assert float(total) == pytest.approx(row.weight * float(nats[0]), rel=1e-6)


def test_a_sample_without_pictures_has_a_loss(place):
    own = load(place)
    row = encode_text(own, samples_of(place)[0])
    words = row.prompt_ids[row.prompt_ids != own.image_token_id]
    text = replace(row, prompt_ids=words, image_grids=np.zeros((0, 3), np.int64))
    with torch.no_grad():
        total, _ = answer_loss(own, [text], torch.zeros((0, 64)), 16)
    assert np.isfinite(float(total))


def test_an_adapted_head_is_refused(place):
    own = train.add_adapter(load(place), TrainConfig(**FAST, target_modules=f"{TARGET_MODULES}|.*lm_head"), 0)
    with pytest.raises(ConfigError, match="head cannot be adapted"):
        output_head(own)


def test_adapted_layers_keep_no_copy_of_what_they_are_given(place):
    own = train.add_adapter(load(place), TrainConfig(**FAST), 0)
    found = [m.cast_input_dtype_enabled for m in own.model.modules() if hasattr(m, "cast_input_dtype_enabled")]
    assert found
    assert not any(found)


def fed(features: VisionFeatures, reader: PictureReader, pictures: Sequence) -> list:
    """Take a step's pictures; gives those that had to be read."""
    plan = features.plan()
    wanted = features.wanted(plan, pictures)
    features.take([reader.read(picture) for picture in wanted])
    return wanted


def test_features_are_the_towers_and_made_once(place):
    own, sample = load(place), samples_of(place)[0]
    features, reader = VisionFeatures(own, memory_bytes=10**9), PictureReader(own, trees_of(place), own.dtype)
    pictures = pictures_of(sample)
    assert len(fed(features, reader, [*pictures, *pictures])) == 5
    found = features.of(pictures)
    assert torch.allclose(found, features_of(own, inputs_of(own, [sample], trees_of(place))), atol=1e-5)
    features.end_step()
    assert fed(features, reader, pictures) == []
    assert torch.equal(features.of(pictures), found)
    assert features.num_encoded == 5
    assert sum(map(features.bytes_of, pictures)) == found.numel() * found.element_size()


def test_what_memory_has_no_room_for_is_looked_at_again(place):
    own, pictures = load(place), pictures_of(samples_of(place)[0])
    features = VisionFeatures(own, memory_bytes=2 * VisionFeatures(own).bytes_of(pictures[0]))
    reader = PictureReader(own, trees_of(place), own.dtype)
    fed(features, reader, pictures)
    found = features.of(pictures)
    features.end_step()
    assert len(fed(features, reader, pictures)) == 3
    assert features.num_encoded == 8
    assert torch.equal(features.of(pictures), found)


def test_pictures_go_from_process_to_process_as_one_tensor():
    """However many they are: each tensor on its way holds a file open."""
    pictures = [FramePicture("run", str(number), "rgb", (64, 64), 100.0) for number in range(40)]
    loaded = [PictureData(picture, torch.rand(number % 5, 6)) for number, picture in enumerate(pictures)]
    reader = SimpleNamespace(processor=None, read={item.picture: item for item in loaded}.__getitem__)
    for chosen in (pictures, pictures[:1], []):
        made = Maker([], reader)(Order(0, [], chosen))
        assert not any(isinstance(value, torch.Tensor) for facts in made.pictures for value in facts)
        for item, wanted in zip(made.loaded(), loaded, strict=False):
            assert item.picture == wanted.picture
            assert torch.equal(item.patches, wanted.patches)
        assert len(made.loaded()) == len(chosen)


@pytest.mark.parametrize(
    "changes",
    [
        {"feature_memory_gb": 0, "batch_size": 3},
        {"feature_memory_gb": 2e-5, "logit_chunk": 9, "gradient_checkpointing": True},  # three pictures have room
        pytest.param({"data_workers": 2}, marks=pytest.mark.slow),
    ],
    ids=lambda changes: "_".join(changes),
)
def test_what_changes_how_and_not_what_gives_the_same_losses(place, plain, tmp_path, changes):
    run(place, tmp_path / "out", **{**FOUR, **changes})
    assert losses_of(tmp_path / "out") == pytest.approx(plain, rel=1e-5)


@pytest.fixture(scope="module")
def plain(place, tmp_path_factory) -> list[float]:
    out = tmp_path_factory.mktemp("plain") / "out"
    run(place, out, **FOUR)
    return losses_of(out)
