"""What it costs to copy a run to S3 and back, beside a copy on this disk; requests by kind. A server of the tests.

python tests/benchmarks/bench_locations.py RUN
"""

import os
import subprocess
import sys
import tempfile
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


def main() -> None:
    run = Path(sys.argv[1]).resolve()
    frames, files = (sum(path.is_file() for path in run.rglob(name)) for name in ("rgb.*", "*"))
    print(f"{frames} frames, {files} files, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "empty").mkdir()
        with served_by_s3(folder / "empty", folder / "log", 0.0) as (python, env):
            subprocess.run([str(python), "-c", MEASURE, str(run), name], env=env, check=True)


if __name__ == "__main__":
    main()
