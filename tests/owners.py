"""Environments of libraries that cannot share the tests' own: made once, kept in `.venv-owners/`, one for each list of
pins.

They see the packages of this environment (torch among them, which is large) behind their own.
"""

import fcntl
import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

KEPT_IN = Path(__file__).resolve().parents[1] / ".venv-owners"
UNREACHABLE = (
    *("NewConnectionError", "ConnectTimeoutError", "ReadTimeoutError", "name resolution"),
    *("Network is unreachable", "Max retries exceeded"),
)
_LIGHT = (
    "draccus==0.10.0 mergedeep==1.3.4 typing-inspect==0.9.0 mypy_extensions==1.1.0 pyyaml-include==1.4.1 toml==0.10.2 "
    "pyserial==3.5 deepdiff==8.6.1 orderly-set==5.5.0"
)
_OF_LEROBOT = (
    "torchvision==0.28.0 jsonlines==4.0.0 attrs==25.3.0 einops==0.8.1 termcolor==3.1.0 huggingface_hub==0.35.3"
)
# LeRobot's own pins ask for another torch; what reads data sets works with ours, so the packages are named one by one.
LEROBOT = ("lerobot==0.4.4", "datasets==4.4.1", "av==15.1.0", *_LIGHT.split(), *_OF_LEROBOT.split())


def python_with(pins: tuple[str, ...]) -> Path:
    """Give the interpreter of an environment with these packages; skips the test only where no registry can be
    reached."""
    name = hashlib.sha256("\n".join([sys.version, *pins]).encode()).hexdigest()[:16]
    KEPT_IN.mkdir(exist_ok=True)
    with open(KEPT_IN / f"{name}.lock", "w") as lock:  # the tests of another worker may need it now, too
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _made(KEPT_IN / name, pins)


def _made(folder: Path, pins: tuple[str, ...]) -> Path:
    python = folder / "bin" / "python"
    if (folder / ".complete").exists():
        return python
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    shared = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "shared.pth").write_text("".join(f"{path}\n" for path in shared))
    command = [str(python), "-m", "pip", "install", "--quiet", "--no-deps", *pins]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and any(sign in done.stderr for sign in UNREACHABLE):
        shutil.rmtree(folder)
        pytest.skip(f"no package registry can be reached: {done.stderr[-300:]}")
    assert not done.returncode, done.stderr[-3000:]
    (folder / ".complete").touch()
    return python
