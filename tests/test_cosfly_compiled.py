"""The cache of compiled functions: never stale, never in the way."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import cosfly


def make_package(root: Path) -> Path:
    package = root / "src" / "cosfly"
    package.mkdir(parents=True)
    shutil.copy(Path(cosfly.__file__).parent / "__init__.py", package)
    shutil.copytree(Path(cosfly.__file__).parent / "runtime", package / "runtime")
    return package


@pytest.mark.slow
def test_a_caller_sees_a_change_of_what_it_calls(tmp_path):
    package = make_package(tmp_path)
    (package / "upper.py").write_text(
        "from cosfly.runtime.compiled import njit\nfrom cosfly.lower import f\n\n\n"
        "@njit(cache=True)\ndef g(x):\n    return f(x)\n"
    )
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    env |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    env["PYTHONDONTWRITEBYTECODE"] = "1"  # Python knows a file by its size and second: both may be those of before
    printed = []
    for factor in (2, 3, 2):
        (package / "lower.py").write_text(
            f"from cosfly.runtime.compiled import njit\n\n\n@njit(cache=True)\ndef f(x):\n    return {factor} * x\n"
        )
        code = "from cosfly.upper import g; print(g(7), sum(g.stats.cache_hits.values()))"
        done = subprocess.run(
            [sys.executable, "-c", code], env=env, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        printed.append(done.stdout.split())
    assert printed == [["14", "0"], ["21", "0"], ["14", "1"]]  # what was compiled for the first sources is still there
    assert len(list((tmp_path / "cache" / "cosfly").iterdir())) == 2


@pytest.mark.slow
def test_compiling_is_told_once_and_loading_is_not(tmp_path):
    (tmp_path / "two.py").write_text(
        "import logging\nlogging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "from cosfly.runtime.compiled import njit\n\n\n@njit(cache=True)\ndef f(x):\n    return x + 1\n\n\n"
        "@njit(cache=True)\ndef g(x):\n    return x - 1\n\n\nf(1), g(1), f(1.5)\n"
    )
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    said = [
        subprocess.run(
            [sys.executable, str(tmp_path / "two.py")], env=env, capture_output=True, text=True, check=True
        ).stderr
        for _ in range(2)
    ]
    assert (said[0].count("compiling kernels of __main__, once"), said[1]) == (1, "")
