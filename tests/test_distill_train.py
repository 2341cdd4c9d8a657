"""distill: student, encoding and training on a tiny random Qwen3.5 model; what training can be, and what goes wrong.

Many processes of one training, on a CPU over gloo, give what one gives.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from processes import is_running, wait_until
from simulator_serving import free_port
from specimens_distill import write_set
from specimens_students import (
    FAST,
    MAX_PIXELS,
    TWELVE,
    inputs_of,
    load,
    log_of,
    losses_of,
    run,
    safetensors,
    samples_of,
    torch,
    trees_of,
)

from cosfly.formats.predictions import read_predictions
from cosfly.llm.student_chat import read_chat_format
from cosfly.runtime.errors import ConfigError
from distill.inference import stage as infer
from distill.student import features
from distill.student import model as student
from distill.training import fit, loading
from distill.training import stage as train
from distill.training.checkpoints import newest_checkpoint
from distill.training.fit import count_steps, steps_from
from distill.training.loading import TrainingContext
from distill.training.settings import TrainConfig

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def trained(place, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    run(place, out, keep="last")  # which validation is the best depends on rounding
    return out


def test_each_epoch_sees_each_sample_once():
    cfg = TrainConfig(samples_per_step=4, epochs=3)
    steps = list(steps_from(cfg, num_samples=10, seed=4, first=0))
    assert (len(steps), 3) == count_steps(cfg, 10) == (9, 3)
    for epoch in range(3):
        assert sorted(i for step in steps[3 * epoch : 3 * epoch + 3] for i in step) == list(range(10))
    assert steps[0] != steps[3]
    assert list(steps_from(cfg, num_samples=10, seed=4, first=4)) == steps[4:]
    few = TrainConfig(max_steps=2)
    assert len(list(steps_from(few, 100, 0, 0))) == count_steps(few, 100)[0] == 2


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
        assert speed is None or (speed["tokens_per_s"] > 0 and speed["memory_gb"] > 0)


def test_the_product_holds_no_pickle_and_no_local_path(place, trained):
    suffixes = {path.suffix for path in trained.rglob("*") if path.is_file()}
    assert suffixes <= {".json", ".jsonl", ".safetensors", ".sha256", ".md", ".lock", ""}, suffixes
    texts = {path.name: path.read_text() for path in (trained / "adapter").iterdir() if path.suffix != ".safetensors"}
    assert json.loads(texts["adapter_config.json"])["base_model_name_or_path"] == "student"
    assert not [name for name, text in texts.items() if str(place) in text]


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_signal_ends_a_training_after_its_step_with_a_checkpoint(place, tmp_path, monkeypatch, caplog, number, error):
    """A second signal, in the step of the first, ends it at once."""
    steps, real = [], fit.train_step

    def interrupted(*args):
        steps.append(1)
        for _ in range({3: 1, 5: 2}.get(len(steps), 0)):
            signal.raise_signal(number)
        return real(*args)

    monkeypatch.setattr(fit, "train_step", interrupted)
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # as the command line has it
    caplog.set_level("INFO")
    try:
        for _ in range(2):
            with pytest.raises(error):
                run(place, tmp_path, max_steps=6, validate_every_steps=6)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step_00000003"]
    assert "begins with step 1 of 6" in caplog.text
    assert "resumes with step 4 of 6" in caplog.text
    assert not (tmp_path / "adapter").exists()


@pytest.mark.slow
def test_a_student_that_overfits_answers_right(place, tmp_path):
    learnt = samples_of(place)[:2]
    write_set(tmp_path / "set", {"train": learnt, "val": learnt}, [place / "tree"])
    settings = {**FAST, "lora_rank": 16, "batch_size": 2, "samples_per_step": 2, "epochs": 80}
    cfg = TrainConfig(**settings, keep="last", patience=0)
    given = (tmp_path / "set", [place / "tree"], place / "student")
    adapter = train.run(cfg, *given, tmp_path / "trained")
    asked = infer.InferConfig(split="train", device="cpu")
    out = infer.run(asked, *given, tmp_path / "answers", adapter=adapter)
    predictions = read_predictions(out)
    assert [p.raw for p in predictions] == [sample.answer for sample in learnt]
    assert all(p.coc is not None and p.is_finished for p in predictions)


@pytest.mark.slow
def test_a_model_trained_in_full_is_a_whole_folder(place, tmp_path):
    from transformers import AutoModelForImageTextToText, AutoTokenizer, GenerationConfig

    folder = run(place, tmp_path / "out", method="full", max_steps=4, learning_rate=1e-3)
    assert folder.name == "model"
    model = AutoModelForImageTextToText.from_pretrained(folder, dtype=torch.float32)
    assert AutoTokenizer.from_pretrained(folder).chat_template == load(place).tokenizer.chat_template
    assert GenerationConfig.from_pretrained(folder) is not None
    own = student.load_student(folder, device="cpu")
    assert read_chat_format(folder).max_pixels == MAX_PIXELS  # the limit that it was taught with
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
    real = TrainingContext.total  # of steps; validations are pairs, whose loss is the next one
    planned = lambda self, values: [next(losses), 1.0] if len(values) == 2 else real(self, values)  # noqa: E731
    monkeypatch.setattr(TrainingContext, "total", planned)
    settings = {"validate_every_steps": 1, "patience": 2}
    out = tmp_path / "out"
    run(place, out, **settings)
    manifest = json.loads((out / "manifest.json").read_text())
    assert (manifest["best_step"], manifest["steps"]) == (2, 4)
    assert [r["validation"]["loss"] for r in log_of(out, "validation")] == [4.0, 3.0, 1.0, 2.0, 1.5]
    best, last = (out / "checkpoints" / f"step_{step:08d}" / "weights.safetensors" for step in (2, 4))
    kept, newest = safetensors.load_file(best), safetensors.load_file(last)
    product = safetensors.load_file(out / "adapter" / "adapter_model.safetensors")
    product = {name.replace(".weight", ".default.weight"): tensor for name, tensor in product.items()}
    assert product.keys() == kept.keys()
    assert all(torch.equal(tensor, kept[name]) for name, tensor in product.items())
    assert not all(torch.equal(tensor, newest[name]) for name, tensor in product.items())
    (out / "manifest.json").unlink()
    run(place, out, **settings)  # it has ended: nothing is done again
    assert json.loads((out / "manifest.json").read_text())["steps"] == 4
    assert next(losses) == 0.5


@pytest.mark.slow
def test_bfloat16_computes_with_float32_weights_that_learn(place, tmp_path):
    settings = {"method": "full", "max_steps": 4, "learning_rate": 1e-3}
    settings |= {"decision_weight": 1.0}  # the mean of few tokens rounds more
    for dtype in ("float32", "bfloat16"):
        run(place, tmp_path / dtype, dtype=dtype, **settings)
    found, wanted = losses_of(tmp_path / "bfloat16"), losses_of(tmp_path / "float32")
    assert found == pytest.approx(wanted, rel=0.02)
    assert found != wanted
    newest = sorted((tmp_path / "bfloat16" / "checkpoints").iterdir())[-1]
    weights = safetensors.load_file(newest / "weights.safetensors")
    assert {tensor.dtype for tensor in weights.values()} == {torch.float32}


@pytest.mark.slow
def test_a_picture_that_does_not_decode_costs_its_samples(place, tmp_path):
    """The other samples are learnt from, and again the same."""
    tree = shutil.copytree(place / "tree", tmp_path / "tree")
    sample = samples_of(place)[0]
    path = tree / sample.images[0]
    path.write_bytes(path.read_bytes()[:60])
    users = [s.key for s in samples_of(place) if sample.images[0] in s.images]
    cfg = TrainConfig(**{**TWELVE, "epochs": 1, "samples_per_step": 3})
    for name in ("one", "two"):
        train.run(cfg, place / "set", [tree], place / "student", tmp_path / name)
    counts = json.loads((tmp_path / "one" / "manifest.json").read_text())["counts"]
    assert counts["dropped"] == {"unreadable_picture": len(users)}
    assert counts["kept"] + len(users) == counts["input"] == 12
    log = log_of(tmp_path / "one")
    assert sum(record["samples"] for record in log) == counts["kept"]
    assert log == log_of(tmp_path / "two")


def test_a_loss_that_is_no_number_leaves_the_last_good_checkpoint(place, tmp_path, monkeypatch):
    real, calls = fit.answer_loss, []

    def broken(*args):
        total = real(*args)
        calls.extend([1] * torch.is_grad_enabled())  # of steps, not of validations
        return total * float("nan") if len(calls) > 13 else total

    with monkeypatch.context() as patch:
        patch.setattr(fit, "answer_loss", broken)
        with pytest.raises(ConfigError, match="became infinite or NaN"):
            run(place, tmp_path / "out")
    newest = newest_checkpoint(tmp_path / "out" / "checkpoints")
    assert newest is not None
    assert newest.name == "step_00000006"


WORKERS = """
import os, signal, time
from distill.training.loading import in_order
for pid, _ in in_order(lambda order: (os.getpid(), bytes(10_000_000)), range(200), 2):
    os.kill(pid, signal.SIGTERM)  # to which a worker does not react: its parent ends it
    print(pid, flush=True)
    time.sleep(0.1)
"""


@pytest.mark.slow
def test_workers_end_with_a_training_that_was_killed(tmp_path):
    given: dict = {"stdout": subprocess.PIPE, "text": True, "env": {**os.environ, "OMP_NUM_THREADS": "1"}}
    with subprocess.Popen([sys.executable, "-c", WORKERS], **given) as process:
        assert process.stdout is not None
        workers = {int(process.stdout.readline()) for _ in range(12)}  # more than were computed before the first signal
        assert len(workers) == 2
        process.kill()
    wait_until(lambda: not any(map(is_running, workers)))


@pytest.mark.parametrize("settings", [{}, {"method": "full", "train_vision": True, "learning_rate": 1e-3}])
def test_features_that_do_not_fit_into_the_memory_are_computed_again(place, tmp_path, monkeypatch, caplog, settings):
    """With the same losses; the first pictures that are read together are kept."""
    run(place, tmp_path / "whole", max_steps=3, **settings)
    monkeypatch.setattr(features, "PICTURES_PER_BATCH", 8)
    monkeypatch.setattr(loading, "memory_bytes", lambda: 1)
    run(place, tmp_path / "little", max_steps=3, **settings)
    assert "do not fit into the memory: they are encoded at each use" in caplog.text
    assert log_of(tmp_path / "little") == log_of(tmp_path / "whole")


def test_samples_are_left_out_with_a_reason_and_counted(place, tmp_path, caplog):
    good = samples_of(place)
    long = good[0].model_copy(update={"sample_id": "long", "answer": "tree " * 5000})
    spoken = good[1].model_copy(update={"sample_id": "spoken", "answer": f"{good[1].answer}<|im_end|>"})
    shown = good[2].prompt.model_copy(update={"user": "an <|image_pad|> stands here"})
    pictured = good[2].model_copy(update={"sample_id": "pictured", "prompt": shown})
    sized = good[3].model_copy(update={"sample_id": "sized", "picture_px": (32, 32)})
    splits = {"train": [*good, long, spoken, pictured, sized], "val": samples_of(place, "val")}
    dataset = write_set(tmp_path / "set", splits, [place / "tree"])
    run(place, tmp_path / "out", dataset=dataset, max_steps=1, samples_per_step=len(good) + 4)
    counts = json.loads((tmp_path / "out" / "manifest.json").read_text())["counts"]
    assert counts["dropped"] == {"special_token": 2, "too_long": 1, "unreadable_picture": 1}
    assert (counts["kept"], counts["input"]) == (len(good), len(good) + 4)
    assert "skipped as too_long; the first: long/" in caplog.text
    run(place, tmp_path / "few", max_steps=2, samples_per_step=3)  # encodes no more than it needs
    counts = json.loads((tmp_path / "few" / "manifest.json").read_text())["counts"]
    assert (counts["kept"], counts["dropped"]) == (6, {"beyond_max_steps": len(good) - 6})


# A usual rate: with one that makes a student learn in 12 steps, rounding grows beyond 1e-5 within few of them.
SETTINGS = {**TWELVE, "learning_rate": 1e-3}


@pytest.fixture(scope="module")
def alone(place, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("alone") / "out"
    assert finish(start(place, out, 1)) == [0]
    return out


# The second process kills itself in its fifth step.
MORTAL = """
import os, signal
from cosfly.__main__ import main
from distill.training import fit
real, steps = fit.train_step, []
def step(*given):
    steps.append(1)
    if len(steps) == 5 and os.environ["RANK"] == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*given)
fit.train_step = step
main()
"""


def start(place: Path, out: Path, size: int, program: Sequence[str] = ("-m", "cosfly")) -> list[subprocess.Popen]:
    settings = [f"distill.train.{name}={json.dumps(value)}" for name, value in SETTINGS.items()]
    command = [sys.executable, *program, "distill", "train", "--student", str(place / "student"), "--out", str(out)]
    command += ["--dataset", str(place / "set"), "--data", str(place / "tree")]
    command += [word for text in settings for word in ("--set", text)]
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
    group = {**os.environ, **address, "WORLD_SIZE": str(size)}
    given: dict = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    ranks = [{"RANK": str(rank), "LOCAL_RANK": str(rank)} for rank in range(size)]
    return [subprocess.Popen(command, env={**group, **own}, **given) for own in ranks]


def finish(processes: list[subprocess.Popen]) -> list[int]:
    return [process.wait(timeout=180) for process in processes]


@pytest.mark.slow
def test_two_processes_give_what_one_gives(place, alone, tmp_path):
    assert finish(start(place, tmp_path / "out", 2)) == [0, 0]
    assert losses_of(tmp_path / "out") == pytest.approx(losses_of(alone), rel=1e-5)
    for mine, other in zip(log_of(tmp_path / "out", "validation"), log_of(alone, "validation"), strict=True):
        found, wanted = ({n: v for n, v in each["validation"].items() if v is not None} for each in (mine, other))
        assert found == pytest.approx(wanted, rel=1e-5)
    name = "adapter/adapter_model.safetensors"
    adapters = [safetensors.load_file(out / name) for out in (tmp_path / "out", alone)]
    for name, tensor in adapters[0].items():
        assert np.allclose(tensor, adapters[1][name], atol=1e-4), name
    manifests = [json.loads((out / "manifest.json").read_text()) for out in (tmp_path / "out", alone)]
    assert manifests[0]["counts"] == manifests[1]["counts"]


@pytest.mark.slow
def test_when_one_dies_all_end_and_one_process_goes_on(place, alone, tmp_path):
    out = tmp_path / "out"
    processes = start(place, out, 2, ("-c", MORTAL))
    assert finish(processes) == [1, -signal.SIGKILL]  # within the time limit: nobody waits for the dead
    assert processes[0].stderr is not None
    told = processes[0].stderr.read()
    assert "error: another process of this training has ended" in told
    assert not (out / "manifest.json").exists()
    assert finish(start(place, out, 1)) == [0]
    assert losses_of(out) == pytest.approx(losses_of(alone), rel=1e-5)
