"""The documents are true: every command has help and stands in the README, and what they name exists.

Banned words stay out of code, messages and documents.
"""

import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from processes import ran
from pydantic import BaseModel

import cosfly
from cosfly.cli import app
from cosfly.pipeline.settings import RunConfig
from release.columns import FRAME

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
REFERENCE = (ROOT / "docs/commands.md").read_text(encoding="utf-8")


def commands(command: Any, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    found = []
    children = getattr(command, "commands", {})  # a group has them; Typer brings its own click
    if path and (not children or command.invoke_without_command):
        found.append((path, command))
    for name, child in children.items():
        found += commands(child, (*path, name))
    return found


COMMANDS = commands(typer.main.get_command(app))


def test_every_command_has_help_an_example_and_stands_in_the_reference():
    for path, command in COMMANDS:
        assert command.help, path
        assert (command.epilog or "").startswith(f"cosfly {' '.join(path)}"), f"{path} has no example"
        command.make_context("cosfly", shlex.split(command.epilog)[1 + len(path) :])  # it parses
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"{path}: {parameter.name} has no help"
        assert f"cosfly {' '.join(path)}" in REFERENCE


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 90


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_and_pictures_outside_the_site_exist(name):
    """Those of the site fail when it is built, `test_the_site_is_built_without_a_warning`."""
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", (ROOT / name).read_text(encoding="utf-8")):
        if "://" not in target:
            assert (ROOT / target).exists(), target
            assert not anchor or f"\n## {anchor.replace('-', ' ')}\n" in (ROOT / target).read_text().lower(), anchor


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FOLDERS = ("cosfly", "caption", "distill", "release", "configs", "tests")
CODE = "\n".join(p.read_text(encoding="utf-8") for f in FOLDERS[:4] for p in sorted((ROOT / f).rglob("*.py")))


def test_the_folders_of_the_extending_page_are_the_disk():
    told = re.findall(r"^\| `([\w/]+)/` \|", (ROOT / "docs/extending.md").read_text(encoding="utf-8"), re.MULTILINE)
    disk = {
        str(path.parent.relative_to(ROOT))
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert sorted(told) == sorted(disk - {"cosfly"})


def test_paths_exist():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        words = set(
            re.findall(
                rf"(?<![\w./-])(?:{'|'.join((*FOLDERS, 'docs'))})/[\w./-]*(?:\.(?:py|glsl|txt|md|yaml)\b|/(?![\w<*]))",
                text,
            )
        )
        of_a_run = {"release/dataset/", "caption/answers/"}  # and not of the repository
        shown = set(re.findall(r"^```python\n# (\S+)$", text, re.MULTILINE))  # files that the page tells to make
        assert sorted(word for word in words - of_a_run - shown if not (ROOT / word).exists()) == []


def test_the_files_page_has_every_column_of_a_release_with_its_fields():
    rows = [line for line in (ROOT / "docs/files.md").read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    for column in FRAME:
        fields = column.type if isinstance(column.type, tuple) else ()
        own = [set(re.findall(r"\w+", row)) for row in rows if re.search(rf"`{column.name}`", row)]
        assert any(words >= set(fields) for words in own), f"{column.name}: {fields}"


def test_every_file_of_the_files_page_is_written_by_code():
    words = re.findall(
        r"`([\w./-]+\.(?:json|jsonl|html|png|gif|npy|md|sha256|yaml|pt))`", (ROOT / "docs/files.md").read_text()
    )
    names = {word.rpartition("/")[2] for word in words}
    # Named by a loop; a user's own.
    elsewhere = {*(f"{split}.jsonl" for split in ("train", "val", "test")), "roi_polygon.json"}
    assert len(names) > 40
    assert sorted(name for name in names - elsewhere if f'{name}"' not in CODE and f"{name}'" not in CODE) == []


def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs")
    words = f"-m mkdocs build --strict -f {ROOT / 'mkdocs.yml'} -d {tmp_path / 'site'}"  # with -q no warning counts
    ran(sys.executable, *words.split(), cwd=tmp_path)
    site = {page.stem for page in (tmp_path / "site").rglob("*.html")}
    assert {page.stem for page in (ROOT / "docs").rglob("*.md")} <= site


def settings_of(model: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the names of all settings and groups, with their types."""
    for name, field in model.model_fields.items():
        yield f"{path}{name}", str(field.annotation)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from settings_of(field.annotation, f"{path}{name}.")


SETTINGS = dict(settings_of(RunConfig))
ASSIGNED = re.compile(r"`([a-z]\w*(?:\.\w+)+)(?:=[^`]*)?`|--set [\"']?([\w.]+)=")
IN_CODE = re.compile(r"`([a-z][\w.]*)(?:=[^`]*)?`")


def settings_in(text: str) -> Iterator[str]:
    """Yield the settings that a page names: `plan.planner`, and in tables those in a column "setting of `plan`"."""
    section, column = "", 0
    for line in text.splitlines():
        cells = line.split("|")
        heading = re.search(r"setting of `([\w.]+)`", line) if line.startswith("|") else None
        if heading:
            section, column = heading[1], next(i for i, cell in enumerate(cells) if heading[0] in cell)
        elif not line.startswith("|"):
            section = ""
        elif section:
            yield from (f"{section}.{name}" for name in IN_CODE.findall(cells[column]))
        for names in ASSIGNED.findall(line):
            name = names[0] or names[1]
            if name.partition(".")[0] in SETTINGS and not name.endswith((".json", ".jsonl", ".html", ".png", ".yaml")):
                yield name


def test_every_setting_of_the_documents_exists():
    found = [(page.name, name) for page in PAGES for name in settings_in(page.read_text(encoding="utf-8"))]
    assert len(found) > 100
    mappings = tuple(f"{name}." for name, kind in SETTINGS.items() if kind.startswith("dict"))
    unknown = [(page, name) for page, name in found if name not in SETTINGS and not name.startswith(mappings)]
    assert [one for one in unknown if one[0] != "extending.md"] == []  # whose examples add settings


HEADING = re.compile(r"^## (\d+\.\d+\.\d+) \((unreleased|\d{4}-\d\d-\d\d)\)$", re.MULTILINE)


def test_one_version_is_named_everywhere_and_every_tag_has_its_heading():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = HEADING.findall(changelog)
    assert len(found) == len(re.findall(r"^## ", changelog, re.MULTILINE))  # no heading of another form
    numbers = [tuple(map(int, number.split("."))) for number, _ in found]
    assert numbers == sorted(set(numbers), reverse=True)
    assert all(day != "unreleased" for _, day in found[1:])
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]
    assert found[0][0] == cosfly.__version__ == pyproject == citation
    tags = ran("git", "tag", "--list", "v*", cwd=ROOT).stdout.split()
    assert set(tags) <= {f"v{number}" for number, day in found if day != "unreleased"}


TOWNS = [f"runs/diverse/{name}" for name in ("grid", "old_town", "towers")]
VARIABLES = {"trees": " ".join(f"--data {town}/render" for town in TOWNS), "size": "2B"}  # of loops in a page
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


def typed_commands(page: Path) -> list[str]:
    """Every `cosfly ...` of a page's blocks, without the word itself, with variables filled in."""
    found = []
    for block in blocks(page.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            if match := COMMAND.match(line.strip()):
                text = re.sub(r"\$(\w+)", lambda name: VARIABLES[name[1]], match[1].replace('"$@" ', ""))
                found.append(re.sub(r";? *(?:}|done)$", "", text.partition("  #")[0].strip()))
    return found


COMMAND_LINE = typer.main.get_command(app)
# The commands of extending.md need its examples: tests/test_docs_run.py runs them.
ALL = [(page.name, text) for page in PAGES if page.name != "extending.md" for text in typed_commands(page)]


def parsed(text: str) -> tuple[Any, list[str]]:
    """The command that a line names, and its words after that."""
    words = shlex.split(text, comments=True)
    command: Any = COMMAND_LINE
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


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


USER_WORDS = "cosfly/worldgen/words.yaml"  # the words of prompts
BANNED = re.compile(
    r"\b(anew|beside|whither|mend(s|ed|ing)?|look-alikes?|sign of life|of before|gone on with|taken up|left out|"
    r"that which|is told|are told|was told|is borne out|are borne out|stands? in for|who answers|what is said)\b",
    re.IGNORECASE,
)


def test_banned_words_are_not_used():
    wrong = [
        f"{name}:{number}: {match[0]}"
        for name in ran("git", "ls-files", cwd=ROOT).stdout.splitlines()
        if name.endswith((".py", ".md", ".html", ".js", ".yaml", ".css", "Makefile"))
        if name != USER_WORDS and not name.startswith("tests/")
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        for match in BANNED.finditer(line)
    ]
    assert wrong == []
