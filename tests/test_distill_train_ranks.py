"""distill: many processes of one training, on a CPU over gloo, give what one gives."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from later import safetensors
from simulator_serving import free_port
from specimens_students import TWELVE, log_of, losses_of

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
    adapters = [
        safetensors.load_file(out / "adapter" / "adapter_model.safetensors") for out in (tmp_path / "out", alone)
    ]
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
