"""distill: student, encoding, training and inference on a tiny random Qwen3.5 model."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from specimens_distill import make_captions, prepared, write_set

from specimens import make_playback_tree

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from cosfly.errors import ConfigError, EnvironmentMissing, InputError  # noqa: E402
from cosfly.products.predictions import read_predictions  # noqa: E402
from distill.inference import stage as infer  # noqa: E402
from distill.schema import Sample, open_split, resolve_trees  # noqa: E402
from distill.student import model as student  # noqa: E402
from distill.student.encoding import IGNORED, count_tokens, encode, load_pictures, training_batch  # noqa: E402
from distill.training import stage as train  # noqa: E402

MAX_PIXELS = 64 * 64
FAST = {"max_pixels": MAX_PIXELS, "lora_rank": 4, "learning_rate": 1e-2, "schedule": "constant", "device": "cpu"}


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums then do not depend on the machine, and a tiny model is faster so."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with a playback tree, a training set and a tiny student."""
    root = tmp_path_factory.mktemp("distill")
    make_playback_tree(root / "tree", num_flights=3, num_points=7)
    make_captions(root / "captions.jsonl", root / "tree")
    prepared(root / "tree", root / "captions.jsonl", root / "set")
    student.make_tiny_student(root / "student")
    return root


@pytest.fixture(scope="module")
def trained(place) -> Path:
    """The output folder of a training of 12 steps without a break."""
    cfg = train.TrainConfig(**FAST, accumulate=2, batch_size=2, epochs=6, max_steps=12, save_every_steps=5)
    train.run(cfg, place / "set", [place / "tree"], place / "student", place / "trained")
    return place / "trained"


def load(place: Path) -> student.Student:
    return student.load_student(place / "student", device="cpu", max_pixels=MAX_PIXELS)


def samples_of(place: Path, split: str = "train") -> list[Sample]:
    return list(open_split(place / "set", split))


def trees_of(place: Path) -> dict[str, Path]:
    return resolve_trees(place / "set", [place / "tree"])


# --- student ----------------------------------------------------------------------------------------------------------


def test_tiny_student_is_tiny_and_the_same_each_time(place, tmp_path):
    again = student.make_tiny_student(tmp_path / "again")
    other = student.make_tiny_student(tmp_path / "other", seed=1)
    names = {path.name for path in again.iterdir()}
    assert {"config.json", "model.safetensors", "tokenizer.json", "preprocessor_config.json"} <= names
    for name in names:
        assert (again / name).read_bytes() == (place / "student" / name).read_bytes(), name
    assert (other / "model.safetensors").read_bytes() != (again / "model.safetensors").read_bytes()
    assert sum(p.numel() for p in load(place).model.parameters()) < 500_000
    with pytest.raises(InputError, match="not empty"):
        student.make_tiny_student(again)


def test_processor_agrees_with_the_library_one(place):
    """The library's own processor, taught to live without videos, gives the same tokens and patches."""
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
    found = encode(own, sample, trees_of(place))
    assert found.prompt_ids.tolist() == wanted["input_ids"][0].tolist()
    assert np.array_equal(found.pixel_values, wanted["pixel_values"].numpy())
    assert found.image_grids.tolist() == wanted["image_grid_thw"].tolist()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "config.json").unlink(), "student model"),
        (lambda folder: (folder / "config.json").write_text('{"model_type": "llama"}'), "model_type.*qwen3_5"),
        (lambda folder: (folder / "model.safetensors").unlink(), "no weights"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"junk" * 9), "does not load"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), "processor does not load"),
        (lambda folder: (folder / "chat_template.jinja").unlink(), "no chat template"),
    ],
)
def test_a_broken_model_folder_is_named(place, tmp_path, damage, words):
    shutil.copytree(place / "student", tmp_path / "broken")
    damage(tmp_path / "broken")
    with pytest.raises(InputError, match=words) as caught:
        student.load_student(tmp_path / "broken", device="cpu", max_pixels=MAX_PIXELS)
    assert "broken" in str(caught.value)


def test_a_missing_package_gives_the_install_line():
    with pytest.raises(EnvironmentMissing, match=r'no_such_package.*pip install "cosfly\[distill\]"'):
        student.require("json", "no_such_package")


# --- encoding ---------------------------------------------------------------------------------------------------------


def test_mask_covers_exactly_the_answer(place):
    own = load(place)
    rows = [encode(own, sample, trees_of(place)) for sample in samples_of(place)[:2]]  # one in each language
    inputs, labels, weights = training_batch(own, rows)
    assert weights.tolist() == [1.0, 1.0]
    for i, sample in enumerate(samples_of(place)[:2]):
        counted = labels[i] != IGNORED
        text = own.tokenizer.decode(inputs["input_ids"][i][counted])
        assert text == sample.answer + student.END_OF_TURN
        assert torch.equal(inputs["input_ids"][i][counted], labels[i][counted])
        positions = counted.nonzero()[:, 0].tolist()
        assert positions == list(range(positions[0], positions[-1] + 1))
        before = own.tokenizer.decode(inputs["input_ids"][i][: positions[0]])
        assert before.endswith("<|im_start|>assistant\n")
        assert sample.prompt.user in before
        assert inputs["attention_mask"][i].sum() == len(rows[i]) == positions[-1] + 1


def test_counted_tokens_are_the_real_ones(place):
    own = load(place)
    for sample in samples_of(place)[:3]:
        row = encode(own, sample, trees_of(place))
        assert count_tokens(own, sample) == (len(row.prompt_ids), len(row.answer_ids))


def test_every_modality_becomes_a_picture(place):
    views = ("rgb", "depth", "segmentation")
    out = prepared(place / "tree", place / "captions.jsonl", place / "set3", modalities=views)
    sample = open_split(out, "train")[0]
    own = load(place)
    row = encode(own, sample, trees_of(place))
    assert len(sample.images) == len(row.image_grids) == 15
    assert count_tokens(own, sample)[0] == len(row.prompt_ids)
    depth = load_pictures(sample, trees_of(place))[1]
    assert depth.shape == (36, 64, 3)
    assert depth.std() > 0


def test_a_picture_of_another_size_is_refused_before_training(place, tmp_path):
    shutil.copytree(place / "tree", tmp_path / "tree")
    name = samples_of(place)[0].images[0]
    Image.new("RGB", (64, 40)).save(tmp_path / "tree" / name)
    with pytest.raises(InputError, match=r"rgb\.png: .*another size.*got 64 x 40 px; expected 64 x 36 px"):
        train.run(train.TrainConfig(**FAST), place / "set", [tmp_path / "tree"], place / "student", tmp_path / "out")


def test_pictures_keep_all_pixels_unless_told(place, tmp_path):
    cfg = train.TrainConfig(**FAST | {"max_pixels": 0}, max_steps=1)
    train.run(cfg, place / "set", [place / "tree"], place / "student", tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "adapter" / "cosfly_adapter.json").read_text())
    assert facts["max_pixels"] == 64 * 36


def test_loss_is_the_mean_over_answer_tokens_whatever_the_padding(place):
    own = load(place)
    own.model.eval()
    rows = [encode(own, sample, trees_of(place)) for sample in samples_of(place)[:4]]
    with torch.inference_mode():
        together, weight = train.answer_loss(own, rows)
        alone = [train.answer_loss(own, [row]) for row in rows]
        inputs, labels, _ = training_batch(own, rows[:1])
        library = own.model(**inputs, labels=labels).loss  # its own mean over the labels
    assert weight == sum(len(row.answer_ids) for row in rows)
    assert float(together) == pytest.approx(sum(float(nats) for nats, _ in alone), rel=1e-5)
    assert float(alone[0][0]) / alone[0][1] == pytest.approx(float(library), rel=1e-5)


def test_weights_scale_a_sample(place):
    own = load(place)
    own.model.eval()
    sample = samples_of(place)[0]
    half = sample.model_copy(update={"weight": 0.5})
    with torch.inference_mode():
        full = train.answer_loss(own, [encode(own, sample, trees_of(place))])
        less = train.answer_loss(own, [encode(own, half, trees_of(place))])
    assert float(less[0]) == pytest.approx(0.5 * float(full[0]))
    assert less[1] == pytest.approx(0.5 * full[1])


# --- training ---------------------------------------------------------------------------------------------------------


def test_each_epoch_sees_each_sample_once():
    cfg = train.TrainConfig(batch_size=2, accumulate=2, epochs=3)
    steps = train.Steps.make(cfg, num_samples=10, seed=4)
    assert (steps.num_steps, steps.steps_per_epoch) == (9, 3)
    for epoch in range(3):
        seen = [i for step in range(3) for i in steps.samples_of(3 * epoch + step)]
        assert sorted(seen) == list(range(10))
    assert steps.samples_of(0) != steps.samples_of(3)
    assert train.Steps.make(train.TrainConfig(max_steps=2), 100, 0).num_steps == 2


def test_learning_rate_rises_and_falls():
    cfg = train.TrainConfig(learning_rate=1.0, warmup_fraction=0.2)
    rates = [train.learning_rate_at(cfg, step, 10) for step in range(10)]
    assert rates[:3] == pytest.approx([0.5, 1.0, 1.0])
    assert rates[6] == pytest.approx(0.5)
    assert all(a > b for a, b in itertools.pairwise(rates[2:]))


def test_too_long_a_sample_is_named_and_nothing_is_cut(place, tmp_path):
    cfg = train.TrainConfig(**FAST, max_tokens=64)
    with pytest.raises(InputError, match=r"trajectory_\d+_\w+_frame_\d+/\w\w .* longer than max_tokens.*<= 64"):
        train.run(cfg, place / "set", [place / "tree"], place / "student", tmp_path / "out")


def test_no_matching_layer_is_an_error(place):
    with pytest.raises(ConfigError, match="target_modules"):
        train.add_adapter(load(place), train.TrainConfig(target_modules="nothing"), 0)


def test_adapter_covers_all_language_layers_and_nothing_else(place):
    own = train.add_adapter(load(place), train.TrainConfig(), 0)
    names = [name for name, p in own.model.named_parameters() if p.requires_grad]
    assert all("lora_" in name and "language_model" in name for name in names)
    # 3 linear-attention layers of 5, one full-attention layer of 4, an MLP of 3 in each of 4 layers; two matrices each
    assert len(names) == 2 * (3 * 5 + 4 + 4 * 3)


def test_loss_falls(trained):
    log = [json.loads(line) for line in (trained / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in log] == list(range(1, 13))
    assert log[-1]["loss"] < 0.75 * log[0]["loss"]
    manifest = json.loads((trained / "manifest.json").read_text())
    assert manifest["validation_loss_after"] < manifest["validation_loss_before"]
    assert [path.name for path in sorted((trained / "checkpoints").iterdir())] == ["step_00000010", "step_00000012"]


def test_adapter_reloads_equal(place, trained):
    own = train.add_adapter(load(place), train.TrainConfig(**FAST), 0)
    optimizer = torch.optim.AdamW([p for p in own.model.parameters() if p.requires_grad])
    assert train.load_checkpoint(trained / "checkpoints" / "step_00000012", own, optimizer) == 12
    again = student.load_student(place / "student", device="cpu", max_pixels=MAX_PIXELS, adapter=trained / "adapter")
    row = encode(own, samples_of(place)[0], trees_of(place))
    logits = []
    for model in (own, again, load(place)):
        inputs, _, _ = training_batch(model, [row])
        with torch.inference_mode():
            logits.append(model.model.eval()(**inputs).logits)
    assert torch.equal(logits[0], logits[1])
    assert not torch.allclose(logits[0], logits[2], atol=0.1)  # and it does something


def test_stopped_and_continued_is_the_same(place, trained, tmp_path):
    """Stop after 7 of 12 steps, the last checkpoint being 5, then go on: the same log and the same adapter."""
    cfg = train.TrainConfig(**FAST, accumulate=2, batch_size=2, epochs=6, max_steps=12, save_every_steps=5)
    out, steps, real = tmp_path / "out", [], train.train_step

    def stop_after_seven(*args):
        if len(steps) == 7:
            raise KeyboardInterrupt
        steps.append(1)
        return real(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "train_step", stop_after_seven)
        with pytest.raises(KeyboardInterrupt):
            train.run(cfg, place / "set", [place / "tree"], place / "student", out)
    assert [path.name for path in (out / "checkpoints").iterdir()] == ["step_00000005"]
    assert not (out / "manifest.json").exists()
    train.run(cfg, place / "set", [place / "tree"], place / "student", out)
    assert_same_training(out, trained)


@pytest.mark.slow
def test_killed_and_continued_is_the_same(place, trained, tmp_path):
    """kill -9 in the middle, a log line cut short and the newest checkpoint damaged: the same log and adapter."""
    out, log = tmp_path / "out", tmp_path / "out" / "log.jsonl"
    settings = {**FAST, "accumulate": 2, "batch_size": 2, "epochs": 6, "max_steps": 12, "save_every_steps": 5}
    code = (
        "import json, sys, pathlib; from distill.training import stage as train\n"
        "settings, *paths = json.loads(sys.argv[1])\n"
        "dataset, tree, student, out = map(pathlib.Path, paths)\n"
        "train.run(train.TrainConfig(**settings), dataset, [tree], student, out)"
    )
    paths = [str(path) for path in (place / "set", place / "tree", place / "student", out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, "-c", code, json.dumps([settings, *paths])], env=environment)
    deadline_s = time.monotonic() + 120
    while (not log.exists() or log.read_bytes().count(b"\n") < 6) and process.poll() is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "the training ended before it could be killed"
    with open(log, "a") as file:
        file.write('{"step": 9, "lo')
    damaged = out / "checkpoints" / "step_00000099"
    shutil.copytree(out / "checkpoints" / "step_00000005", damaged)
    (damaged / "optimizer.pt").write_bytes((damaged / "optimizer.pt").read_bytes()[:-7])
    newest = train.newest_checkpoint(out / "checkpoints")
    assert newest is not None
    assert newest.name != damaged.name
    shutil.rmtree(damaged)
    train.run(train.TrainConfig(**settings), place / "set", [place / "tree"], place / "student", out)
    assert_same_training(out, trained)


def assert_same_training(out: Path, other: Path) -> None:
    for name in ("log.jsonl", "adapter/adapter_model.safetensors"):
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


def test_gradient_checkpointing_changes_nothing_but_memory(place, tmp_path):
    losses = []
    for is_on in (False, True):
        cfg = train.TrainConfig(
            **FAST, max_steps=2, accumulate=2, lora_dropout=0, validation_samples=0, gradient_checkpointing=is_on
        )
        train.run(cfg, place / "set", [place / "tree"], place / "student", tmp_path / str(is_on))
        log = (tmp_path / str(is_on) / "log.jsonl").read_text().splitlines()
        losses.append([json.loads(line)["loss"] for line in log])
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_a_learning_rate_that_explodes_stops_with_a_clear_error(place, tmp_path):
    cfg = train.TrainConfig(**{**FAST, "learning_rate": 1e30}, max_steps=5, accumulate=1)
    with pytest.raises(ConfigError, match=r"not finite.*lower learning_rate"):
        train.run(cfg, place / "set", [place / "tree"], place / "student", tmp_path / "out")


# --- inference --------------------------------------------------------------------------------------------------------


def test_inference_is_deterministic_and_resumes(place, trained, tmp_path):
    cfg = infer.InferConfig(split="val", batch_size=3, max_new_tokens=12, device="cpu")
    arguments = (cfg, place / "set", [place / "tree"], place / "student")
    first = infer.run(*arguments, tmp_path / "a", adapter=trained / "adapter")
    real, calls = infer.decode, []

    def stop_at_second(*args, **more):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(infer, "decode", stop_at_second)
        with pytest.raises(KeyboardInterrupt):
            infer.run(*arguments, tmp_path / "b", adapter=trained / "adapter")
        patch.setattr(infer, "decode", lambda *args, **more: (calls.append(1), real(*args, **more))[1])
        second = infer.run(*arguments, tmp_path / "b", adapter=trained / "adapter")
    samples = samples_of(place, "val")
    assert len(calls) == 1 + -(
        -len(samples) // 3
    )  # the finished batch was not asked again; the broken call counts once
    assert first.read_bytes() == second.read_bytes()
    predictions = read_predictions(first)
    assert [p.key for p in predictions] == [s.key for s in samples]
    assert all((p.coc is None) == (p.reason is not None) for p in predictions)
    assert all(p.num_tokens <= 12 for p in predictions)


@pytest.mark.slow
def test_a_student_that_overfits_answers_right(place, tmp_path):
    """The whole way: two samples learned by heart come back as the answers they were, parsed."""
    learnt = samples_of(place)[:2]
    write_set(tmp_path / "set", {"train": learnt, "val": learnt}, [place / "tree"])
    cfg = train.TrainConfig(
        **{**FAST, "lora_rank": 16, "schedule": "cosine"}, lora_dropout=0, batch_size=2, accumulate=1, epochs=80
    )
    adapter = train.run(cfg, tmp_path / "set", [place / "tree"], place / "student", tmp_path / "trained")
    out = infer.run(
        infer.InferConfig(split="train", device="cpu"),
        tmp_path / "set",
        [place / "tree"],
        place / "student",
        tmp_path / "answers",
        adapter=adapter,
    )
    predictions = read_predictions(out)
    assert [p.raw for p in predictions] == [sample.answer for sample in learnt]
    assert all(p.coc is not None and p.is_finished for p in predictions)


def test_an_adapter_of_another_student_is_refused(place, trained, tmp_path):
    other = student.make_tiny_student(tmp_path / "other", seed=5)
    with pytest.raises(InputError, match="trained on another model"):
        infer.run(
            infer.InferConfig(device="cpu"),
            place / "set",
            [place / "tree"],
            other,
            tmp_path / "out",
            adapter=trained / "adapter",
        )


def test_an_unreadable_image_fails_its_batch_and_is_counted(place, tmp_path):
    shutil.copytree(place / "tree", tmp_path / "tree")
    sample = samples_of(place, "val")[0]
    # Frame 0 belongs to the first window alone, in two languages.
    (tmp_path / "tree" / sample.images[0]).write_bytes(b"not a picture")
    cfg = infer.InferConfig(split="val", batch_size=1, max_samples=6, max_new_tokens=2, device="cpu")
    out = infer.run(cfg, place / "set", [tmp_path / "tree"], place / "student", tmp_path / "out")
    predictions = read_predictions(out)
    assert predictions[0].reason == "failed_input"
    assert predictions[0].raw == ""
    counts = json.loads((tmp_path / "out" / "manifest.json").read_text())["counts"]
    assert counts["input"] == len(predictions) == 6
    assert counts["failed"]["input"] == sum(p.reason == "failed_input" for p in predictions) == 2
    assert "not an image" in (tmp_path / "out" / "failures.jsonl").read_text()


def test_predictions_with_odd_line_separators_survive(place, tmp_path):
    sample = samples_of(place)[0]
    record = infer.make_prediction(sample, "train", "a\u2028b\x85c\x0b", 3, True)
    path = tmp_path / "predictions.jsonl"
    path.write_text(infer.dump_json(record.model_dump(mode="json")) + "\n", encoding="utf-8")
    assert read_predictions(path) == [record]
