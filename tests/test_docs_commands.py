"""Every command of the documentation parses: its options and arguments exist. Nothing is run."""

import ast
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from cosfly.app.settings import RunConfig
from cosfly.app.settings_guide import explain
from cosfly.cli import app, options_first
from cosfly.cli.options import resolve
from cosfly.errors import CosflyError
from cosfly.products.boxes import read_boxes
from cosfly.products.review import how_to_decide

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cosfly", "caption", "distill", "release")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TOWNS = [f"runs/learning/{name}" for name in ("grid", "old_town", "city_a", "city_b")]
VARIABLES = {
    "trees": " ".join(f"--data {town}/render" for town in TOWNS),
    "towns": " ".join(TOWNS),
    "name": "both",
    "size": "2B",
    "DATA": "data",
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
    words = options_first(shlex.split(text, comments=True))
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


# --- what messages tell to type ---------------------------------------------------------------------------------------


def told_texts() -> Iterator[tuple[str, str]]:
    """Every text of the sources that names a command or an override: where, and the text; what is filled in is FILLED."""
    for path in (path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                text = "".join(part.value if isinstance(part, ast.Constant) else "FILLED" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
                text = node.value
            else:
                continue
            if re.search(r"--set \S|cosfly [a-z]", text):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text


def test_an_override_in_a_message_can_be_pasted_into_a_shell():
    """It is one word of a shell, and names a setting with a value, not an ellipsis."""
    known, found = {setting.name for setting in explain(RunConfig())}, list[str]()
    for place, text in told_texts():
        for word in re.findall(r"--set ('[^']*'|[^\s,;:)`]+)", text):
            name, _, value = shlex.split(word)[0].partition("=")
            is_plain = word.startswith("'") or not set(word) & set("[]{}()<>*?$&|\"'`")
            if not is_plain or "..." in word or not (value and (name in known or "FILLED" in name)):
                found.append(f"{place}: {word}")
    assert [line for line in found if not line.endswith(("A.B=C", "a.b=c", ": FILLED"))] == []


def test_paths_in_messages_are_quoted(tmp_path):
    folder = tmp_path / "two words"
    folder.mkdir()
    for command in (how_to_decide(folder), error_of(lambda: read_boxes(folder / "a b.csv"))):
        assert any(word.endswith(("two words", "a b.csv")) for word in shlex.split(command))
    assert str(folder) in shlex.split(error_of(lambda: resolve(folder, None)))


def error_of(call: Callable[[], object]) -> str:
    with pytest.raises(CosflyError) as caught:
        call()
    return str(caught.value.fix)
