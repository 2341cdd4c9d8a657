"""The SLURM script: what `sbatch` and cosfly's own parser make of it. The container is in test_architecture.py."""

import os
import re
import shlex
import subprocess
from pathlib import Path

import typer
from tables import each

from cosfly.cli import app
from cosfly.runtime import limits

SCRIPT = Path(__file__).parents[1] / "docs/deploy/slurm.sh"
SBATCH = {  # options of sbatch (its manual page), and what may follow
    "job-name": r"[\w-]+", "nodes": r"\d+(-\d+)?", "ntasks-per-node": r"\d+", "cpus-per-task": r"\d+",
    "gpus-per-node": r"([a-z]\w*:)?\d+", "mem": r"\d+[KMGT]?", "time": r"(\d+-)?\d+(:\d\d){0,2}", 
    "output": r"[\w%./-]+", "open-mode": "append|truncate", "requeue": "",
}  # fmt: skip
TOOLS = {
    "srun": 'while [[ $1 == --* ]]; do shift; done; exec "$@"', "scontrol": "printf 'n1\\nn2\\n'",
    "ray": '[[ $1 != status ]] || printf " 1 node_a\\n 1 node_b\\n"', "sleep": ":",
}  # fmt: skip


def test_directives_are_options_of_sbatch_and_stand_before_any_command():
    head, _, commands = SCRIPT.read_text().partition("set -euo pipefail")
    found = dict(re.findall(r"^#SBATCH --([a-z-]+)=?(.*)$", head, re.MULTILINE))
    assert len(found) == head.count("\n#SBATCH") >= 8
    assert "#SBATCH" not in commands  # sbatch reads none after the first command
    assert {name: value for name, value in found.items() if not re.fullmatch(SBATCH[name], value)} == {}


def commands_of(tmp_path: Path, arguments: list[str], job: dict[str, str]) -> list[list[str]]:
    for name, text in TOOLS.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "COSFLY": "echo cosfly"} | job
    found = subprocess.run(["bash", SCRIPT, *arguments], env=environment, capture_output=True, text=True, check=True)
    return [shlex.split(line)[1:] for line in found.stdout.splitlines() if line.startswith("cosfly ")]


def parsed(words: list[str]) -> str:
    group = typer.main.get_command(app)
    command = group.commands[words[0]]  # type: ignore[attr-defined]
    command.make_context(words[0], words[1:])
    return words[0]


RUN = ["diverse", "shared/run"]


@each(("arguments", "job", "commands"), [
    (RUN, {"SLURM_JOB_NUM_NODES": "1", "SLURM_CPUS_PER_TASK": "16"}, ["run"]),
    (RUN, {"SLURM_JOB_NUM_NODES": "2", "SLURM_JOB_NODELIST": "n[1-2]", "SLURM_JOB_ID": "77"}, ["run"]),
    (
        [*RUN, "grid", "park"],
        {"SLURM_ARRAY_TASK_ID": "1", "SLURM_CPUS_PER_TASK": "16"},
        ["maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption"],
    ),
])  # fmt: skip
def test_every_command_of_the_script_is_one_that_cosfly_takes(tmp_path, arguments, job, commands):
    found = commands_of(tmp_path, arguments, job)
    assert [parsed(words) for words in found] == commands
    assert ("ray" in found[0]) == ("SLURM_JOB_NODELIST" in job)
    if len(found) > 1:
        assert all(words[1:5] == ["--config", "diverse", "--town", "park"] for words in found)
        assert all(words[words.index("--out") + 1] == f"shared/run/park/{words[0]}" for words in found)


@each(("files", "cpus", "memory"), [
    ({"cgroup": "0::/job/step\n", "job/cpu.max": "max 100000", "job/step/cpu.max": "150000 100000",
        "job/memory.max": "1073741824", "job/step/memory.max": "max"}, 2, 2**30),
    ({"cgroup": "4:cpu,cpuacct:/docker/1\n6:memory:/docker/1\n", "cpu/docker/1/cpu.cfs_quota_us": "-1",
        "cpu/cpu.cfs_quota_us": "100000",
        "cpu/cpu.cfs_period_us": "100000", "memory/memory.limit_in_bytes": "536870912"}, 1, 2**29),
    ({"cgroup": "0::/\n"}, 64, None),
])  # fmt: skip
def test_the_limits_of_a_job_are_those_of_its_control_groups(tmp_path, monkeypatch, files, cpus, memory):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(limits, "CGROUPS", tmp_path)
    monkeypatch.setattr(limits, "MEMBERSHIP", tmp_path / "cgroup")
    monkeypatch.setattr(limits.os, "sched_getaffinity", lambda pid: set(range(64)))
    assert limits.num_cpus() == cpus
    assert limits.memory_bytes() == memory or memory is None
