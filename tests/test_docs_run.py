"""Every command of the documentation runs, page after page in one folder, as somebody would who reads along.

The examples of docs/extending.md work in a copy of the sources, and so do the cells of the notebook.
"""

import glob
import gzip
import json
import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from processes import ran
from simulator_serving import serving
from specimens_foreign import write_foreign_tree
from teacher_server import TeacherServer, completion
from test_caption_servers import patient
from test_cosfly_derived_ground import sloped_city
from test_cosfly_map_kinds import node, write_world
from test_distill_evaluate import make_encoder
from test_docs import ALL, PAGES, ROOT, blocks
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.captions import read_captions
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.runtime.config import shipped
from distill.student.random_student import make_random_student

# Pages in the order in which what one makes is there for the next; the last one draws the tree of all others again.
FIRST, LAST = ("install.md", "commands.md"), ("rendering.md",)
QUICKSTART = "run quickstart --out runs/quickstart"  # what `make quickstart` does, beside installing
# What no machine of the tests can do, or another test does: words of the command, and why.
NOT_HERE = {
    "vllm serve ": "a server of real weights, on an accelerator; the teacher's server of the tests stands in for it",
    "torchrun --nproc-per-node 8": "eight accelerators; here one process, in tests/test_distill_train.py two",
    "make quickstart": "it installs first; what it runs then is QUICKSTART",
    "make test": "that is this",
    "pip install -e": "the tests stand in that environment",
    "pip install --no-deps": "the same",
    "python tests/benchmarks/": "minutes each; what they measure stands beside them in the documents",
    "--env cosfly/": "1,600 frames each; tests/test_cosfly_envs.py flies a list and policies",
    "--out work/round1": "two short flights are too few walks to split; tests/test_distill_dataset.py has more",
    "roi edit ": "it serves until it is stopped; tests/test_cosfly_viz.py draws on its page",
    "SmolLM2-135M-Instruct.Q4_1.gguf": "a file of 98 MB; tests/test_distill_student.py trains it where it is",
    "--predictions work/infer-cpu": "the answers of that file",
    "http://localhost:11434": "needs Ollama and a model; the commands run with a test server at another port",
    "--teacher vllm:": "vLLM needs an accelerator; tests/test_engines_contract.py holds its engine to the documents",
    "--engine vllm": "the same",
    "--out work/students-captions": "a student of random weights writes no caption that is kept",
}


def _set(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


# Command -> options that make it small; the longer one counts.
SMALL = {
    "maps": _set("maps.synthetic.size_m=150", "maps.synthetic.num_blocks=1"),
    "pedestrians": _set("pedestrians.min_distance_m=15", "pedestrians.max_distance_m=25"),
    "render": _set("render.width_px=160", "render.height_px=90"),
    "inspect --map": _set("inspect.legible_min=0"),
    "inspect --data": _set("inspect.legible_min=0"),
    "fly": _set("render.width_px=160", "render.height_px=90", "fly.most_decisions=5"),
    "study weather": _set("render.width_px=160", "render.height_px=90"),
    "study zoom": _set("render.width_px=160", "render.height_px=90"),
    "run work/village/loop.yaml": _set(
        *("pedestrians.num_paths=1", "pedestrians.min_distance_m=15", "pedestrians.max_distance_m=25"),
        *("render.width_px=160", "render.height_px=90", "render.fovs_deg=[60]", "inspect.legible_min=0"),
    ),
    "run quickstart --out runs/five": _set("pedestrians.num_paths=3"),
    "reproduce": ["--pedestrians", "1", "--workers", "1"],
    "distill train": _set(
        *("distill.train.max_steps=2", "distill.train.max_pixels=4096", "distill.train.samples_per_step=2"),
        *("distill.train.batch_size=1", "distill.train.validation_samples=2", "distill.train.data_workers=0"),
    ),
    "distill infer": _set(
        *("distill.infer.max_samples=2", "distill.infer.max_new_tokens=8", "distill.infer.max_pixels=4096")
    ),
}


@dataclass(frozen=True)
class Place:
    """The folder in which everything runs, and the servers that stand in for a reader's."""

    root: Path
    teacher: str
    ports: dict[str, int]  # of simulators, by those in the documents

    def make(self, text: str) -> None:
        for name, maker in BROUGHT.items():
            path = self.root / name.removeprefix("file:")
            if name in text and not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                maker(self.root, path)

    def words(self, text: str) -> list[str]:
        text = text.replace("http://localhost:8000", self.teacher).replace(" /shared/", f" {self.root}/shared/")
        for told, port_here in self.ports.items():
            text = re.sub(rf"(port[ =]){told}\b", rf"\g<1>{port_here}", text)
        words = [part for word in shlex.split(text, comments=True) for part in (sorted(glob.glob(word)) or [word])]
        small = max((name for name in SMALL if text.startswith(f"{name} ")), key=len, default=None)
        return [*words, *SMALL.get(small or "", [])]

    def clear(self, text: str) -> None:
        words = shlex.split(text, comments=True)
        if "--out" not in words:
            return
        out = self.root / words[words.index("--out") + 1]
        if out.is_file():
            out.unlink()
        elif any((out / name).exists() for name in MADE):
            shutil.rmtree(out)


# What tells that a folder is one command's, so that it may go before the next command makes it.
MADE = (
    *("stage.json", "export.json", "release.json", "report.json"),
    *("system_en.txt", "cosfly_student.json", "config.json"),
)


def copy_of(path: str) -> Callable[[Path, Path], object]:
    return lambda root, target: (shutil.copytree if (root / path).is_dir() else shutil.copy)(root / path, target)


def _shown(page: str, begin: str) -> Callable[[Path, Path], object]:
    """Return a maker of the file that a page shows in the block with this beginning."""
    text = next(path for path in PAGES if path.name == page).read_text(encoding="utf-8")
    shown = re.search(rf"^```\w+\n({re.escape(begin)}.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert shown is not None
    return lambda root, target: target.write_text(shown[1])


def _tagged(root: Path, target: Path) -> None:
    """Write four houses along three streets, with the tags of OpenStreetMap and of Overture."""
    west, south, per_m = 11.573, 48.136, 1.0e-5  # degrees

    def places(*corners_m: tuple[float, float]) -> list[list[float]]:
        return [[west + x * per_m, south + y * per_m] for x, y in corners_m]

    features = []
    for x, y in ((20, 20), (80, 20), (20, 80), (80, 80)):
        ring = places((x, y), (x + 25, y), (x + 25, y + 20), (x, y + 20), (x, y))
        properties = {"building": "yes", "class": "residential", "height": 9}
        features.append((properties, {"type": "Polygon", "coordinates": [ring]}))
    for begin, end in (((0, 0), (120, 0)), ((0, 60), (120, 60)), ((60, 0), (60, 120))):
        line = {"type": "LineString", "coordinates": places(begin, end)}
        features.append(({"highway": "residential", "class": "secondary"}, line))
    listed = [{"type": "Feature", "properties": tags, "geometry": shape} for tags, shape in features]
    target.write_text(json.dumps({"type": "FeatureCollection", "features": listed}))


def _world(root: Path, target: Path) -> None:
    roads = [node("BP_Road1_C", x, y) for x in range(-6000, 6001, 2000) for y in (-3000, 3000)]
    houses = [node("BP_Building_01_C", x, 0) for x in range(-5000, 5001, 2500)]
    sizes = {"BP_Building_01_C": (1500, 1000, 3000), "BP_Road1_C": (2000, 1500, 20)}
    write_world(target.parent, *roads, *houses, sizes=sizes)
    (target.parent / "world.json").rename(target)


def _others_captions(root: Path, target: Path) -> None:
    lines = [
        {"sample_id": c.sample_id, "en": c.en.model_dump(), "zh": c.zh.model_dump()}
        for c in read_captions(root / "runs/quickstart/caption/captions.jsonl")
        if c.en and c.zh
    ]
    target.write_text("".join(json.dumps(line) + "\n" for line in lines))


# What a reader brings: path, as a command names it -> what makes it. The longer path before the shorter.
BROUGHT: dict[str, Callable[[Path, Path], object]] = {
    "CosFly-Track": lambda root, target: write_foreign_tree(target, trajectories=("trajectory_1", "trajectory_2")),
    "town.csv": _shown("install.md", "type,x_m"), "town.geojson": _shown("maps.md", '{"type": "FeatureCollection"'),
    "mine.yaml": _shown("commands.md", "name: mine"),
    "osm.geojson": _tagged, "buildings.geojson": _tagged, "file:captions.jsonl": _others_captions,
    "progen_world.json": _world,
    "delft.json.gz": lambda root, target: target.write_bytes(gzip.compress(json.dumps(sloped_city()).encode())),
    "work/flown0": copy_of("work/rules"),
    "work/flown1": copy_of("work/planner"), "work/copy": copy_of("work/release"),
    "work/plan.yaml": copy_of("work/village/plan.yaml"),
    "work/unlabelled/render": copy_of("runs/quickstart/render"),
    "Qwen/Qwen3.5-2B": lambda root, target: make_random_student(target),
    "models/Qwen3.5-2B": lambda root, target: make_random_student(target),
    "work/roi_polygon.json": _shown("maps.md", '{"points_world"'),
    "models/roberta-large": lambda root, target: make_encoder(target),
    "models/bert-base-chinese": lambda root, target: make_encoder(target),
    "work/students-captions/captions.jsonl": copy_of("runs/five/caption/captions.jsonl"),
    "work/infer-4B": copy_of("work/infer-2B"), "work/infer-100k-4B": copy_of("work/infer-100k-2B"),
}  # fmt: skip


def small_run(name: str) -> dict[str, Any]:
    value = yaml.safe_load(shipped(f"{name}.yaml").read_text(encoding="utf-8"))
    value.setdefault("pedestrians", {}).update(num_paths=2, min_distance_m=15, max_distance_m=25)
    value.setdefault("render", {}).update(width_px=160, height_px=90)
    value.setdefault("inspect", {}).update(legible_min=0)
    if "towns" in value:
        value["render"].update(frame_stride=2)
    value.setdefault("maps", {}).setdefault("synthetic", {}).update(size_m=150, num_blocks=1)
    value["towns"] = dict(list(value.get("towns", {}).items())[:3])  # a split each
    return value


def answer(body: dict) -> tuple[int, dict] | None:
    text = json.dumps(body)
    if "REJECT_REGEN" in text:
        verdict = json.dumps({"verdict": "FIX_LABEL", "reason": "the text argues for the label"})
        return 200, completion(body, verdict)
    is_doctors = "Nothing has to change." in text  # the largest prompt, whose tokens must be counted
    return None if "flight_decision" in text and not is_doctors else patient()(body)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    root = tmp_path / "project"
    root.mkdir()
    monkeypatch.chdir(root)
    monkeypatch.setenv("COLUMNS", "200")
    for name in "quickstart showcase simworld delft diverse".split():  # before one that ships  # noqa: SIM905
        (root / name).write_text(yaml.safe_dump(small_run(name)))
    town = invent(SyntheticConfig(name="Town10HD_Opt", size_m=150.0, num_blocks=1), 0)
    with (
        TeacherServer(respond=answer) as teacher,
        serving(town, tmp_path / "carla") as carla,
        serving(town, tmp_path / "unrealcv", protocol="unrealcv") as unrealcv,
    ):
        yield Place(root, teacher.url, {"2000": carla, "9000": unrealcv})


def test_what_cannot_run_here_is_in_the_documents():
    lines = [" ".join(block.split()) for page in PAGES for block in blocks(page.read_text(encoding="utf-8"))]
    texts = [*lines, *(text for _, text in ALL)]
    assert [word for word in (*NOT_HERE, *BROUGHT) if not any(word in text for text in texts)] == [], "in no document"
    assert [word for word in SMALL if not any(text.startswith(word) for _, text in ALL)] == [], "in no document"


@pytest.mark.slow
@pytest.mark.timeout(3600)  # 4 minutes on a machine that has nothing else to do
def test_every_command_runs(place, in_this_process, monkeypatch):
    usage = shutil.disk_usage(Path.cwd())  # `doctor` fails on a disk that is nearly full, as this machine's may be
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage._replace(free=100 * 2**30))
    failed, pages = [], [*FIRST, *sorted({page for page, _ in ALL} - {*FIRST, *LAST}), *LAST]
    in_order = [(page, text) for wanted in pages for page, text in ALL if page == wanted]
    for page, text in [("commands.md", QUICKSTART), *in_order]:
        if any(word in text for word in NOT_HERE):
            continue
        place.make(text)
        place.clear(text)
        start = time.monotonic()
        result = CliRunner().invoke(app, place.words(text))
        print(f"{time.monotonic() - start:6.1f} s, {result.exit_code}: {page}: cosfly {text}", flush=True)
        if result.exit_code:
            failed.append(f"{page}: cosfly {text}\n{result.output[-1500:]}\n{result.exception!r}")
    assert not failed, "\n\n".join(failed)


EXTENDING = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
NOTEBOOK = json.loads((ROOT / "docs/release.ipynb").read_text(encoding="utf-8"))
CELLS = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
NAMED = re.compile(r"^# (\S+\.(?:py|md))$")
PRODUCTS = (
    "work/blocks/boxes_3d.json", "work/overhead/drone_trace.json", "work/compared/compare.json",
    "work/thermal/manifest.json", "work/echo/captions.jsonl", "work/inspect/report.html",
    "work/altitudes/dataset/release.json", "work/poses/poses/checksums.sha256",
)  # fmt: skip


def examples(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", EXTENDING, re.DOTALL | re.MULTILINE)


def edits() -> Iterator[tuple[str, str, str]]:
    """Yield, for each hunk of the diff blocks, the file, the old and the new text."""
    for block in examples("diff"):
        name, hunk = "", list[str]()
        for line in [*block.splitlines(), "@@"]:
            found = NAMED.match(line)
            if found or line == "@@":
                if hunk:
                    yield name, *("".join(f"{one[1:]}\n" for one in hunk if one[0] != mark) for mark in "+-")
                name, hunk = found[1] if found else name, []
            else:
                hunk.append(line)


def apply_examples(folder: Path) -> None:
    for block in examples("python"):
        if name := NAMED.match(block.partition("\n")[0]):
            assert not (folder / name[1]).exists()
            (folder / name[1]).write_text(block)
    for file, old, new in edits():
        text = (folder / file).read_text()
        assert text.count(old) == 1, f"{file} has no single place for:\n{old}"
        (folder / file).write_text(text.replace(old, new))


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    for name in ("cosfly", "caption", "distill", "release", "configs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def write_quickstart(folder: Path) -> None:
    """Write a configuration of the name `quickstart`, which `cosfly run` prefers to the shipped one."""
    small = small_run("quickstart")
    small["pedestrians"].update(num_paths=1)
    small["render"].update(width_px=480, height_px=270)  # smaller tracks are illegible, and rejected
    (folder / "quickstart").write_text(yaml.safe_dump(small))


@pytest.mark.slow
@pytest.mark.timeout(1800)  # 4 minutes on a machine that has nothing else to do: kernels are compiled again
def test_the_examples_work(clone):
    apply_examples(clone)
    write_quickstart(clone)
    (clone / "bin").mkdir()
    for name, words in (("cosfly", "-m cosfly"), ("python", "")):
        (clone / "bin" / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
        (clone / "bin" / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{clone}/bin:{os.environ['PATH']}", "PYTHONPATH": str(clone)}
    for block in examples("bash"):
        ran("bash", "-e", "-c", block, cwd=clone, env=environment)
    assert [name for name in PRODUCTS if not (clone / name).is_file()] == []


def test_every_cell_of_the_notebook_was_run_without_an_error():
    assert [cell["execution_count"] for cell in CELLS] == list(range(1, len(CELLS) + 1))
    outputs = [output for cell in CELLS for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_cells_of_the_notebook_run(tmp_path):
    write_quickstart(tmp_path)
    program = "\n\n".join(["import matplotlib", 'matplotlib.use("Agg")', *("".join(cell["source"]) for cell in CELLS)])
    for words in (["-m", "cosfly", "run", "quickstart", "--out", "runs/quickstart"], ["-c", program]):
        done = ran(sys.executable, *words, cwd=tmp_path)
    assert re.search(r"^10 steps, loss \d", done.stdout, re.MULTILINE)
