"""kill -9 at every point of commands that write; all of them: `python tests/crash_sweep.py`."""

import subprocess
import sys
from pathlib import Path

import pytest
from crash_sweep import COMMANDS
from crashes import called_complete, sweep
from toy_workers import stage_in
from typer.main import get_command

from cosfly.cli import app
from cosfly.runtime.io import atomic_folder, write_bytes
from cosfly.runtime.json_io import write_json
from cosfly.runtime.run_dir import Tally

SWEEP = Path(__file__).with_name("crash_sweep.py")
# Of the commands that need a finished run, those that are swept here.
OF_A_RUN = (*("pedestrians", "inspect review", "caption, limited"), "release build")


def careless(out: Path) -> None:
    """Takes what stands there for finished."""
    if not (out / "product.json").exists():
        (out / "product.json").write_text('{"all": "of it"}')


def careful(out: Path) -> None:
    write_json(out / "product.json", {"all": "of it"})
    with atomic_folder(out / "frames") as folder:
        for number in range(2):
            (folder / f"{number}.txt").write_text("a frame")


def impatient(out: Path) -> None:
    """Refuses its own half."""
    if any(out.iterdir()):
        raise FileExistsError(out)
    careful(out)


def untidy(out: Path) -> None:
    """Leaves what another process with its name could not know."""
    write_bytes(out / f"{len(list(out.iterdir()))}.json", b"{}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("work", "words"),
    [(careless, "product.json: 8 bytes, not 16"), (impatient, "exit 1"), (untidy, "too much: 1.json"), (careful, None)],
)
def test_what_a_kill_spoils_is_found(work, words, tmp_path):
    swept = sweep([lambda: work(tmp_path / "out")], tmp_path)
    assert swept.num_killed == swept.num_steps
    assert any(words in line for line in swept.wrong) if words else not swept.wrong, swept.wrong
    assert swept.num_steps >= 2


def test_a_product_without_its_records_that_another_stage_would_take_is_found(tmp_path):
    stage = stage_in(tmp_path / "whole")
    write_json(stage.path / "product.json", {"all": "of it"})
    stage.finish([stage.path / "product.json"], Tally(input=1, kept=1))
    write_json(tmp_path / "killed/s/product.json", {"all": "of"})
    assert called_complete(tmp_path / "killed", [tmp_path / "whole"]) == ["s/product.json is taken by the next stage"]


@pytest.mark.parametrize("asked", [
    pytest.param(("caption prompts",), id="at every step"),
    pytest.param(("maps",), id="of a stage", marks=pytest.mark.slow),
    pytest.param(("--few", "run"), id="of a run", marks=pytest.mark.timeout(1800)),
    pytest.param(("--few", "--twice", *OF_A_RUN), id="twice", marks=pytest.mark.timeout(1800)),
])  # fmt: skip
@pytest.mark.slow
def test_killed_commands_go_on(asked):
    done = subprocess.run([sys.executable, SWEEP, *asked], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" 0 wrong") == sum(name in COMMANDS for name in asked)


def test_every_command_that_writes_is_in_the_sweep():
    told = {
        "list", "show", "doctor", "config check", "config show", "release verify", "caption doctor",
        "caption judge-check", "roi edit",
    }  # fmt: skip
    root, names = get_command(app), set[str]()
    for name, found in root.commands.items():
        names |= {f"{name} {inner}" for inner in getattr(found, "commands", ())} or {name}
    swept = [text for commands in COMMANDS.values() for text in commands if isinstance(text, str)]
    lacking = {name for name in names if not any(line.startswith(f"{name} ") for line in swept)}
    assert lacking == told | {"bench"}
