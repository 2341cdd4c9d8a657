"""The README is true: every command has help and stands in it, and what it names exists."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from cosfly.cli import app

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def commands(command: Any, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """All commands that can be run, with their words."""
    found = []
    children = getattr(command, "commands", {})  # a group has them; Typer brings its own click
    if path and (not children or command.invoke_without_command):
        found.append((path, command))
    for name, child in children.items():
        found += commands(child, (*path, name))
    return found


COMMANDS = commands(typer.main.get_command(app))


def test_there_are_commands():
    words = {path for path, _ in COMMANDS}
    assert {("run",), ("caption",), ("release", "verify"), ("config", "check"), ("distill", "train")} <= words


@pytest.mark.parametrize(
    ("path", "command"), COMMANDS, ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_every_command_has_help_and_stands_in_the_readme(path, command):
    assert command.help
    for parameter in command.params:
        assert getattr(parameter, "help", None), f"{parameter.name} has no help"
    assert f"cosfly {' '.join(path)}" in README


def readme_commands() -> list[list[str]]:
    """Every `cosfly ...` line of the README's code blocks."""
    blocks = re.findall(r"```(?:bash|sh|console)\n(.*?)```", README, re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.strip().startswith("cosfly ")]


@pytest.mark.parametrize("words", readme_commands(), ids=" ".join)
def test_every_example_parses(words):
    """Options and arguments of the examples exist (nothing is run)."""
    command: Any = typer.main.get_command(app)
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    command.make_context("cosfly", list(words))


def test_links_and_pictures_exist():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_ci_runs_a_command_of_the_readme():
    (command,) = [line for line in (ROOT / ".ci/run").read_text().splitlines() if line.startswith("make")]
    assert f"`{command}`" in README
