"""The examples of docs/extending.md work in a copy of the sources, and so do the cells of the notebook."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from test_docs_run import small_run

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
NOTEBOOK = json.loads((ROOT / "docs/release.ipynb").read_text(encoding="utf-8"))
CELLS = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
NAME = re.compile(r"^# (\S+\.(?:py|md))$")
PRODUCTS = (
    "work/blocks/boxes_3d.json", "work/overhead/drone_trace.json", "work/compared/compare.json",
    "work/thermal/manifest.json", "work/echo/captions.jsonl", "work/inspect/report.html",
    "work/altitudes/dataset/release.json", "work/poses/poses/checksums.sha256",
)  # fmt: skip


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def edits() -> Iterator[tuple[str, str, str]]:
    """Yield, for each hunk of the diff blocks, the file, the old and the new text."""
    for block in blocks("diff"):
        name, hunk = "", list[str]()
        for line in [*block.splitlines(), "@@"]:
            found = NAME.match(line)
            if found or line == "@@":
                if hunk:
                    yield name, *("".join(f"{one[1:]}\n" for one in hunk if one[0] != mark) for mark in "+-")
                name, hunk = found[1] if found else name, []
            else:
                hunk.append(line)


def apply_examples(folder: Path) -> None:
    for block in blocks("python"):
        if name := NAME.match(block.partition("\n")[0]):
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


def test_the_edits_of_the_examples_fit_the_sources(clone):
    apply_examples(clone)
    assert len(list(edits())) >= 10
    for file, _, new in edits():
        assert new in (clone / file).read_text()


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
    for block in blocks("bash"):
        done = subprocess.run(
            ["bash", "-e", "-c", block], cwd=clone, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{block}\n{done.stderr[-3000:]}"
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
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(r"^10 steps, loss \d", done.stdout, re.MULTILINE)
