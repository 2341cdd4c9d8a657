"""What it costs to copy a run to S3 and back, beside a copy on this disk; requests by kind. Without RUN: what it costs
to make a run there, beside the same on this disk, in pairs. A server of the tests.

python tests/benchmarks/bench_locations.py [RUN]
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from test_release_get_servers import served_by_s3  # noqa: E402

MEASURE = """
import shutil, sys, time
from collections import Counter
from pathlib import Path
from cosfly.work.locations import WorkingFolder

run, folder = map(Path, sys.argv[1:])

def measure(what, work):
    (folder / "log.all").write_text("")
    began_s = time.monotonic()
    work()
    asked = Counter(line.split()[0] for line in (folder / "log.all").read_text().splitlines())
    print(f"{what} {time.monotonic() - began_s:.2f} s {dict(asked)}", flush=True)

def all_of(written):
    with written.at_work():
        pass

for number in range(2):
    measure("copy on this disk", lambda: shutil.copytree(run, folder / f"plain{number}"))
    written = WorkingFolder(f"s3://flights/run{number}", folder / "cache", is_written=True)
    written.take()
    shutil.copytree(run, written.local, dirs_exist_ok=True)
    measure("sent", lambda: all_of(written))
    measure("sent again, nothing new", written.copy_out)
    read = WorkingFolder(f"s3://flights/run{number}", folder / "other", is_written=False)
    measure("fetched", read.fetch)
    measure("fetched again, nothing new", read.fetch)
"""


SMALL = ("render.width_px=320", "render.height_px=180")
PAIRS = 3


def make_runs(python: Path, env: Mapping[str, str], folder: Path) -> None:
    """Make a run on this disk and at S3, in turns."""
    (folder / "packages").mkdir()  # as an installation has them
    (folder / "packages/cosfly_configs").symlink_to(ROOT / "configs")
    kernels = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))  # compiled once on a machine
    env = {**env, "XDG_CACHE_HOME": kernels, "PYTHONPATH": f"{ROOT}:{folder / 'packages'}"}
    words = [str(python), "-m", "cosfly", "-q", "--cache", str(folder / "cache"), "run", "quickstart"]
    words += [word for one in SMALL for word in ("--set", one)]
    for number in range(PAIRS):
        for place in (str(folder / f"run{number}"), f"s3://flights/run{number}"):
            load, began_s = os.getloadavg()[0], time.monotonic()
            subprocess.run([*words, "--out", place], env=env, cwd=ROOT, check=True, capture_output=True)
            print(f"{place}: {time.monotonic() - began_s:.1f} s, load before {load:.1f}", flush=True)
    files = [path for path in (folder / "run0").rglob("*") if path.is_file()]
    frames = sum(path.stem == "rgb" for path in files)
    print(f"{frames} frames, {len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.0f} MB")


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "empty").mkdir()
        with served_by_s3(folder / "empty", folder / "log", 0.0) as (python, env):
            if len(sys.argv) == 1:
                return make_runs(python, env, folder)
            run = Path(sys.argv[1]).resolve()
            frames, files = (sum(path.is_file() for path in run.rglob(name)) for name in ("rgb.*", "*"))
            print(f"{frames} frames, {files} files, load {os.getloadavg()[0]:.1f}")
            subprocess.run([str(python), "-c", MEASURE, str(run), name], env=env, check=True)


if __name__ == "__main__":
    main()
