"""The shape of the house: which way imports point, what stays lazy, which names exist."""

import ast
import importlib
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cosfly", "caption", "distill", "release")
FOUNDATIONS = {
    f"cosfly.{name}"
    for name in (
        "errors",
        "issues",
        "geometry",
        "compiled",
        "schema",
        "stage_folder",
        "store",
        "config",
        "console",
        "coc",
        "playback",
        "runner",
        "inspection",
    )
} | {"cosfly"}
ASSEMBLY = {
    "cosfly.cli",
    "cosfly.cli_caption",
    "cosfly.cli_distill",
    "cosfly.cli_options",
    "cosfly.pipeline",
    "cosfly.doctor",
    "cosfly.__main__",
}
HEAVY = {
    "torch",
    "transformers",
    "peft",
    "accelerate",
    "bert_score",
    "datasets",
    "vllm",
    "pyrender",
    "trimesh",
    "carla",
    "ray",
}

SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}


def imports(name: str, *, top_level_only: bool = False) -> set[str]:
    """Modules that a source file imports; names taken from a package of ours count as modules if they are."""
    tree = ast.parse(SOURCES[name].read_text(encoding="utf-8"))
    skipped = set()
    for node in ast.walk(tree):
        lazy = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if (lazy and top_level_only) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            skipped |= {id(inner) for inner in ast.walk(node)}
    found = set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            found |= {
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in SOURCES else node.module
                for alias in node.names
            }
    return found


def ours(names: set[str]) -> set[str]:
    return {n for n in names if n.split(".")[0] in PACKAGES}


def test_the_sources_were_found():
    assert {"cosfly.cli", "cosfly.store", "caption", "distill", "release"} <= SOURCES.keys()


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_imports_point_one_way(name):
    found = ours(imports(name))
    if name in FOUNDATIONS:
        assert found <= FOUNDATIONS, f"a foundation imports a stage: {found - FOUNDATIONS}"
    elif name.startswith("cosfly") and name not in ASSEMBLY:
        assert all(n.startswith("cosfly") for n in found), f"a stage imports a sibling package: {found}"
        assert not found & ASSEMBLY
    elif name not in ASSEMBLY:
        package = name.split(".")[0]
        siblings = {n for n in found if n.split(".")[0] not in (package, "cosfly")}
        assert not siblings, f"sibling packages meet through files: {siblings}"
        stages = {n for n in found if n.startswith("cosfly")} - FOUNDATIONS
        assert not stages, f"{package} needs foundations only: {stages}"


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_heavy_packages_are_imported_where_they_are_used(name):
    top = {n.split(".")[0] for n in imports(name, top_level_only=True)}
    assert not top & HEAVY


def test_compiled_functions_share_one_cache():
    importers = {name for name, path in SOURCES.items() if re.search(r"^(import|from) numba\b", path.read_text(), re.M)}
    assert importers == {"cosfly.compiled"}


def test_the_rule_can_fail(monkeypatch, tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("import torch\nimport release.package\n")
    monkeypatch.setitem(SOURCES, "cosfly.store", bad)
    with pytest.raises(AssertionError, match="a foundation imports a stage"):
        test_imports_point_one_way("cosfly.store")
    with pytest.raises(AssertionError):
        test_heavy_packages_are_imported_where_they_are_used("cosfly.store")


@pytest.mark.parametrize("package", PACKAGES)
def test_generic_names_resolve_to_this_repository(package):
    assert Path(importlib.import_module(package).__file__).parent == ROOT / package


def test_no_drawers_for_everything():
    names = {path.stem for path in SOURCES.values()}
    assert not names & {"utils", "helpers", "common", "misc", "inspect", "types"}


def test_help_is_instant():
    """No stage, no kernel, no image library is loaded to print help; the bound on time is generous, the one on modules not."""
    program = "import sys; sys.argv = ['cosfly', '--help']; from cosfly.cli import main\ntry: main()\nexcept SystemExit: pass\nprint('LOADED', *sorted(sys.modules))"
    start_s = time.monotonic()
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert time.monotonic() - start_s < 5
    loaded = set(result.stdout.split("LOADED")[1].split())
    assert not loaded & {"numpy", "numba", "cv2", "pydantic", "torch", "scipy", "pyarrow"}
