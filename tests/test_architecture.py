"""The shape of the house: imports that point one way, what stays lazy, names; the container, CI, the SLURM script."""

import ast
import os
import re
import shlex
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from processes import ran
from test_docs import parsed

from cosfly.runtime import limits

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cosfly", "caption", "distill", "release")
STAGES = ("maps", "simplify", "pedestrians", "planners", "render", "inspection")  # a folder each
# From the ground up: a room may import what stands before it, and itself; stages do not import each other, nor do
# siblings.
ROOMS = ("runtime", "axes", "formats", "geometry", "viz", "llm", "simulators", "stages", "siblings", "pipeline", "cli")
# Geometry that knows no file, so that formats may use it.
BELOW_FORMATS = {f"cosfly.geometry.{name}" for name in ("axes", "motion")}
ASSEMBLY = ("pipeline", "closed_loop", "envs", "studies", "worldgen")  # what may know all stages and siblings

SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}


@cache
def _tree(name: str) -> ast.Module:
    text = SOURCES[name].read_text(encoding="utf-8")
    try:
        return ast.parse(text)
    except SystemError:  # Python before 3.11.8 (its issue 106905), where a thread prints a traceback meanwhile
        return ast.parse(text)


@cache
def imports(name: str) -> set[str]:
    """Modules that a source file imports; names taken from a package of ours count as modules if they are."""
    found, nodes = set(), [*_tree(name).body]
    for node in nodes:  # which grows
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in SOURCES else node.module
                for alias in node.names
            }
    return found


def room(name: str) -> str:
    package, _, rest = name.partition(".")
    first = rest.partition(".")[0]
    if package != "cosfly":
        return "siblings"
    if first in ASSEMBLY:
        return "pipeline"
    if first in STAGES:
        return "stages"
    if first in ("", "__main__"):  # the front door: `import cosfly`, `python -m cosfly`
        return "cli"
    return "axes" if name in BELOW_FORMATS else first


def house(name: str) -> str:
    return ".".join(name.split(".")[: 2 if name.startswith("cosfly.") else 1])


def folder(name: str) -> str:
    return room(name) if room(name) == "axes" else SOURCES[name].parent.relative_to(ROOT).as_posix()


def ours(name: str) -> set[str]:
    return {n for n in imports(name) if n in SOURCES} - {"cosfly"}


def may_import(name: str, other: str) -> bool:
    here, there = room(name), room(other)
    if here == there and here in ("stages", "siblings"):
        return house(name) == house(other)
    return ROOMS.index(there) <= ROOMS.index(here)


def test_imports_point_one_way():
    """Rooms know what stands below them, no stage imports a stage, siblings meet through files."""
    assert [(name, other) for name in SOURCES for other in ours(name) if not may_import(name, other)] == []


def test_no_two_folders_import_each_other():
    doors = {"cosfly", "cosfly.__main__"}
    arrows = {(folder(a), folder(b)) for a in SOURCES if a not in doors for b in ours(a) if folder(a) != folder(b)}
    assert {tuple(sorted(pair)) for pair in arrows if pair[::-1] in arrows} == set()


def test_what_opengl_draws_with_stays_behind_its_renderer():
    own = "cosfly.render.gl"
    assert [n for n in SOURCES if not n.startswith(own) and any(m.startswith(own) for m in imports(n))] == []


@pytest.mark.parametrize("step", ["prepare", "training", "inference", "evaluation"])
def test_no_step_of_distill_imports_a_step(step):
    others = tuple(f"distill.{name}" for name in ("prepare", "training", "inference", "evaluation") if name != step)
    modules = [name for name in SOURCES if name.startswith(f"distill.{step}")]
    assert modules
    assert not {found for name in modules for found in imports(name) if found.startswith(others)}


# What stands in a source, and the only ones where it may.
ONLY_IN = {
    # Axes of the tree are converted where its files are read and written.
    r"^from .*\bmirror_poses\b": {
        *("cosfly.formats.frames", "cosfly.formats.playback_file", "cosfly.simulators.conventions"),
    },
    r"^(import|from) numba\b": {"cosfly.runtime.compiled"},  # compiled functions share one cache
    # Foreign text is escaped in one place.
    r"(?i)html import escape|html\.escape|rich\.markup|jinja2|markupsafe|<!doctype": {
        *("cosfly.runtime.escaping", "cosfly.viz.page"),
    },
    r"Console\(": {"cosfly.runtime.console"},
}


@pytest.mark.parametrize("pattern", ONLY_IN)
def test_what_is_done_in_one_place_is_done_in_no_other(pattern):
    found = {name for name, path in SOURCES.items() if re.search(pattern, path.read_text(encoding="utf-8"), re.M)}
    assert found == ONLY_IN[pattern]


# Names that read what stands on disk, or text that stood there. Only the gate calls them: it knows what a file may do.
READING = {
    *("open", "read_bytes", "read_text", "load", "loads", "safe_load", "full_load", "fromfile", "memmap", "imread"),
    *("imdecode", "decompress", "ParquetFile", "read_table", "read_metadata", "load_file", "genfromtxt", "loadtxt"),
}
GATE = (
    *(f"cosfly.runtime.{name}" for name in ("io", "json_io", "arrays", "tables", "model_json", "config")),
    "cosfly.formats.mesh_files",
)
ALLOWED_TO_READ = {
    ("cosfly.runtime.ray_engine", "loads"),  # what a worker says, as `multiprocessing` reads it from a pipe
    ("cosfly.runtime.events", "read_bytes"),  # /proc, whose files have no size
    ("cosfly.runtime.limits", "read_text"),  # the same, and control groups
    ("cosfly.runtime.png", "open"),  # a picture in memory, whose size was checked
    ("cosfly.llm.protocol", "loads"),  # the reply, of a bounded size
    ("distill.training.checkpoints", "load_file"),  # tensors of this training
    ("cosfly.simulators.guard", "loads"),  # lines of the process that started it
}


def reading_calls(name: str) -> set[tuple[str, str]]:
    """Calls that open or decode input, as (module, name of the function); opening to write is none."""
    tree, found = _tree(name), set()
    ours = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in PACKAGES:
            ours |= {alias.name for alias in node.names}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        plain = isinstance(call.func, ast.Name)
        function = call.func.id if plain else getattr(call.func, "attr", "")
        if function not in READING or (plain and function in ours):
            continue
        modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
        writes = function == "open" and any(isinstance(mode, str) and set(mode) & set("wax+") for mode in modes)
        own = not plain and ast.unparse(call.func.value) in ("StageFolder", "cls")  # a folder of ours
        if not writes and not own:
            found.add((name, function))
    return found


def test_only_the_gate_opens_files_to_read_them():
    assert {call for name in SOURCES if not name.startswith(GATE) for call in reading_calls(name)} == ALLOWED_TO_READ


def test_help_is_instant():
    """No stage, no kernel, no image library is loaded to print help; the bound on its computing time is generous, the
    one on modules not."""
    program = "import sys; sys.argv = ['cosfly', '--help']; from cosfly.cli import main\ntry: main()\n"
    program += "except SystemExit: pass\nimport time; print('LOADED', time.process_time(), *sorted(sys.modules))"
    cpu_s, *loaded = ran(sys.executable, "-c", program).stdout.split("LOADED")[1].split()
    assert float(cpu_s) < 5
    assert not set(loaded) & {"numpy", "numba", "cv2", "pydantic", "torch", "scipy", "pyarrow", "moderngl"}


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_what_the_container_and_ci_install_is_pinned_and_is_what_the_project_needs():
    def names(requirements: list[str]) -> set[str]:
        return {re.split(r"[\[<>=!~]", line)[0].lower().replace("_", "-") for line in requirements} - {"cosfly"}

    text = text_of("docs/deploy/requirements.txt")
    hashed = re.findall(r"^([a-z0-9-]+)==\S+((?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", text, re.MULTILINE)
    assert len(hashed) == len(re.findall("^[a-z0-9]", text, re.MULTILINE)), "a line without a hash"
    setup = tomllib.loads(text_of("pyproject.toml"))
    needed, extras = setup["project"]["dependencies"], setup["project"]["optional-dependencies"]
    in_container = names([*needed, *extras["pyrender"], *setup["build-system"]["requires"]])
    assert in_container <= {name for name, _ in hashed}
    constrained = names([line for line in text_of("tests/constraints.txt").splitlines() if not line.startswith("#")])
    in_ci = [line for extra in ("carla", "dev", "distill", "pyrender", "unrealcv") for line in extras[extra]]
    assert names([*needed, *in_ci]) <= constrained


def test_the_container_has_the_libraries_of_the_makefile_its_files_and_a_user():
    recipe, ignored = text_of("docs/deploy/Containerfile"), text_of(".dockerignore").splitlines()
    packages = re.search("^GL_PACKAGES := (.*)$", text_of("Makefile"), re.MULTILINE)
    assert packages is not None
    assert packages[1] in recipe
    copied = [word for line in re.findall("^COPY (.*) ", recipe, re.MULTILINE) for word in line.split()]
    assert {f"!{name}" for name in copied} == {line for line in ignored if line.startswith("!")}
    assert re.search("^USER (?!root)", recipe, re.MULTILINE)


SCRIPT = Path(__file__).parents[1] / "docs/deploy/slurm.sh"
TOOLS = {
    "srun": 'while [[ $1 == --* ]]; do shift; done; exec "$@"', "scontrol": "printf 'n1\\nn2\\n'",
    "ray": '[[ $1 != status ]] || printf " 1 node_a\\n 1 node_b\\n"', "sleep": ":",
}  # fmt: skip


def commands_of(tmp_path: Path, arguments: list[str], job: dict[str, str]) -> list[list[str]]:
    for name, text in TOOLS.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "COSFLY": "echo cosfly"} | job
    told = ran("bash", SCRIPT, *arguments, env=environment).stdout
    return [shlex.split(line)[1:] for line in told.splitlines() if line.startswith("cosfly ")]


RUN = ["diverse", "shared/run"]


@pytest.mark.parametrize(("arguments", "job", "commands"), [
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
    assert [words[0] for words in found] == commands
    for command, words in (parsed(shlex.join(words)) for words in found):
        command.make_context("cosfly", words)
    assert ("ray" in found[0]) == ("SLURM_JOB_NODELIST" in job)
    if len(found) > 1:
        assert all(words[1:5] == ["--config", "diverse", "--town", "park"] for words in found)
        assert all(words[words.index("--out") + 1] == f"shared/run/park/{words[0]}" for words in found)


@pytest.mark.parametrize(("files", "cpus", "memory"), [
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
