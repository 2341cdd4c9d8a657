"""What a run costs whose folder lies at S3: paired with one in a local folder, and requests by kind and by frame.

python tests/benchmarks/bench_locations.py [PAIRS] [A.B=C ...]      (settings of the run beside those of quickstart)
"""

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from test_release_get_servers import served_by_s3  # noqa: E402


def main() -> None:
    pairs, *settings = sys.argv[1:] or ["2"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "empty").mkdir()
        (folder / "packages").mkdir()
        (folder / "packages/cosfly_configs").symlink_to(ROOT / "configs")
        with served_by_s3(folder / "empty", folder / "log", 0.0) as (python, env):
            env |= {"PYTHONPATH": f"{ROOT}:{folder / 'packages'}", "XDG_CACHE_HOME": str(Path.home() / ".cache")}
            for number in range(int(pairs)):
                for out in (str(folder / f"local{number}"), f"s3://flights/run{number}"):
                    words = [str(python), "-m", "cosfly", "--cache", str(folder / "cache"), "run", "quickstart"]
                    words += ["--out", out, *(word for one in settings for word in ("--set", one))]
                    (folder / "log.all").write_text("")
                    began_s = time.monotonic()
                    ended = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
                    took_s = time.monotonic() - began_s
                    asked = Counter(line.split()[0] for line in (folder / "log.all").read_text().splitlines())
                    kind = "S3" if out.startswith("s3:") else "local"
                    print(f"{kind} {took_s:.1f} s, load {os.getloadavg()[0]:.1f}, {dict(asked)}", flush=True)
                    print("  " + "\n  ".join(line for line in ended.stderr.splitlines() if "s3://" in line))
            frames = sum(1 for _ in (folder / "local0").rglob("rgb.*"))
            files = sum(path.is_file() for path in (folder / "local0").rglob("*"))
            print(f"{frames} frames, {files} files")


if __name__ == "__main__":
    main()
