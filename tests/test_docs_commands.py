"""Every command of the documentation parses: its options and arguments exist. Nothing is run."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from cosfly.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TOWNS = [f"runs/learning/{name}" for name in ("grid", "old_town", "city_a", "city_b")]
VARIABLES = {
    "trees": " ".join(f"--data {town}/render" for town in TOWNS),
    "towns": " ".join(TOWNS),
    "name": "both",
    "size": "2B",
    "DATA": "data",
    "flights": "--map work/town10/maps/boxes_3d.json --simplified work/town10/simplify/step2_simplified.json "
    "--traces work/town10/plan/drone_trace.json",
}  # of loops in a page
COMMAND = re.compile(r"^(?:\$ )?(?:.*; )?(?:[A-Z_]+=\S+ )*(?:.* -m )?cosfly (.*)$")


def blocks(text: str) -> Iterator[str]:
    """The code blocks of a page that are no program: fenced ones of a shell, and indented ones."""
    fence, lines = None, list[str]()
    for line in [*text.splitlines(), ""]:
        mark = re.fullmatch(r"\s*```(\w*)", line)
        if mark:
            if fence in ("", "bash", "sh", "console"):
                yield "\n".join(lines)
            fence, lines = (mark[1], []) if fence is None else (None, [])
        elif fence is not None or line.startswith("    "):
            lines.append(line)
        else:
            if lines:
                yield "\n".join(lines)
            lines = []


def commands(page: Path) -> list[str]:
    """Every `cosfly ...` of a page's blocks, without the word itself, with variables filled in."""
    found = []
    for block in blocks(page.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            if match := COMMAND.match(line.strip()):
                text = re.sub(r"\$(\w+)", lambda name: VARIABLES[name[1]], match[1].replace('"$@" ', ""))
                found.append(re.sub(r";? *(?:}|done)$", "", text.partition("  #")[0].strip()))
    return found


COMMAND_LINE = typer.main.get_command(app)
ALL = [(page.name, text) for page in PAGES for text in commands(page)]


def parsed(text: str) -> tuple[Any, list[str]]:
    """The command that a line names, and its words after that."""
    words = shlex.split(text, comments=True)
    command: Any = COMMAND_LINE
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


def test_the_commands_are_found():
    pages = {name for name, _ in ALL}
    assert {"commands.md", "distillation.md", "releases.md", "teachers.md", "files.md", "first-runs.md"} <= pages
    assert len(ALL) > 90
    assert any(text.startswith("distill train --dataset work/dataset") for _, text in ALL)


def test_every_command_parses(subtests):
    for page, text in ALL:
        with subtests.test(page=page, text=text):
            command, words = parsed(text)
            command.make_context("cosfly", list(words))


def test_no_option_in_running_text_is_unknown():
    unknown = []
    for page in PAGES:
        for text in re.findall(r"`cosfly ([^`]+)`", page.read_text(encoding="utf-8")):
            command, words = parsed(re.sub(r"[\[\]\\<>]", "", text).replace("...", "").partition(" > ")[0])
            known = {option for parameter in command.params for option in parameter.opts} | {"--help", "--version"}
            unknown += [f"{page.name}: cosfly {text}" for word in words if word.startswith("-") and word not in known]
    assert not unknown
