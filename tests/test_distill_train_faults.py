"""distill."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from processes import is_running, wait_until

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from specimens_distill import write_set  # noqa: E402
from specimens_students import FAST, TWELVE, begun, load, log_of, run, samples_of  # noqa: E402

from cosfly.runtime.errors import ConfigError, InputError  # noqa: E402
from distill.student.checkpoint import load_checkpoint, newest_checkpoint  # noqa: E402
from distill.training import fit  # noqa: E402
from distill.training import stage as train  # noqa: E402
from distill.training.settings import TrainConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
def test_a_picture_that_does_not_decode_costs_its_samples(place, tmp_path):
    """Its header is right, so only the step that needs it finds out; the others are learnt from, and once more the
    same."""
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


@pytest.mark.slow
def test_a_checkpoint_of_another_student_is_refused(place, tmp_path):
    begun(place, tmp_path / "out")
    newest = newest_checkpoint(tmp_path / "out" / "checkpoints")
    assert newest is not None
    other = train.add_adapter(load(place), TrainConfig(**{**FAST, "lora_rank": 8}), 0)
    with pytest.raises(InputError, match="checkpoint is of another student"):
        load_checkpoint(newest, other)


def test_a_loss_that_is_no_number_leaves_the_last_good_checkpoint(place, tmp_path, monkeypatch):
    real, calls = fit.answer_loss, []

    def broken(*args):
        total, nats = real(*args)
        calls.extend([1] * torch.is_grad_enabled())  # of steps, not of validations
        return (total * float("nan"), nats) if len(calls) > 13 else (total, nats)

    with monkeypatch.context() as patch:
        patch.setattr(fit, "answer_loss", broken)
        with pytest.raises(ConfigError, match="not finite"):
            run(place, tmp_path / "out")
    newest = newest_checkpoint(tmp_path / "out" / "checkpoints")
    assert newest is not None
    assert newest.name == "step_00000006"


WORKERS = """
import os, time
from distill.training.loading import in_order
for pid, _ in in_order(lambda order: (os.getpid(), bytes(10_000_000)), range(100), 2):
    print(pid, flush=True)
    time.sleep(0.5)
"""


@pytest.mark.slow
def test_workers_end_with_a_training_that_was_killed(tmp_path):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", WORKERS], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        workers = {int(process.stdout.readline()) for _ in range(2)}
        assert len(workers) == 2
        process.kill()
    wait_until(lambda: not any(map(is_running, workers)))


def test_samples_are_left_out_with_a_reason_and_counted(place, tmp_path):
    good = samples_of(place)
    long = good[0].model_copy(update={"sample_id": "long", "answer": "tree " * 5000})
    spoken = good[1].model_copy(update={"sample_id": "spoken", "answer": f"{good[1].answer}<|im_end|>"})
    shown = good[2].prompt.model_copy(update={"user": "an <|image_pad|> stands here"})
    pictured = good[2].model_copy(update={"sample_id": "pictured", "prompt": shown})
    sized = good[3].model_copy(update={"sample_id": "sized", "picture_px": (32, 32)})
    splits = {"train": [*good, long, spoken, pictured, sized], "val": samples_of(place, "val")}
    dataset = write_set(tmp_path / "set", splits, [place / "tree"])
    run(place, tmp_path / "out", dataset=dataset, max_steps=1)
    counts = json.loads((tmp_path / "out" / "manifest.json").read_text())["counts"]
    assert counts["dropped"] == {"special_token": 2, "too_long": 1, "unfit_picture": 1}
    assert (counts["kept"], counts["input"]) == (len(good), len(good) + 4)
    told = (tmp_path / "out" / "preflight.json").read_text()
    assert "long/en" in told or "long/zh" in told
    assert "at most 4096" in told
