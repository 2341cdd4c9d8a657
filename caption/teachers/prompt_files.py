"""The prompt files: those that ship, or a folder of the user's own (`caption.prompts`) with the same names and slots.

Each file begins with a line `# version: ...`; the rest is the prompt, with `$slots` that are filled in and `$$` for a
dollar sign.
"""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from string import Template

from caption.schema import CaptionConfig, TextState
from cosfly.formats.captions import OWN_PROMPTS
from cosfly.runtime.errors import ConfigError, InputError, nearest
from cosfly.runtime.io import read_text, storage_errors, write_bytes

log = logging.getLogger(__name__)

PROMPTS = Path(__file__).with_name("prompts")
SUFFIX, VERSION = ".txt", "# version: "


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The prompts of a run. It is hashed by identity, so that caches of its prompts are fast."""

    prompts: Mapping[str, str]  # name of a prompt file -> its text, with its version line
    text_state: TextState = "relative"  # which flight data the questions contain

    @cached_property
    def templates(self) -> dict[str, Template]:
        """The prompts without their version lines; `user_en` and `user_zh` are those of the text state."""
        templates = {name: Template(text.partition("\n")[2].rstrip("\n")) for name, text in self.prompts.items()}
        if self.text_state == "paper":
            templates |= {f"user_{language}": templates[f"user_paper_{language}"] for language in ("en", "zh")}
        return templates


@cache
def shipped_prompts() -> dict[str, str]:
    """Return the files that ship, name without suffix -> text with its version line."""
    return {path.stem: read_text(path) for path in sorted(PROMPTS.glob(f"*{SUFFIX}"))}


def own_prompts(folder: Path) -> dict[str, str]:
    """Read a folder of prompts that replaces those that ship."""
    export = "run cosfly caption prompts --export DIR to write the built-in prompts"
    if not folder.is_dir():
        raise ConfigError("the folder of prompts does not exist", where=folder, fix=export)
    prompts, problems = dict[str, str](), list[str]()
    for name in sorted({*shipped_prompts(), *(path.stem for path in folder.glob(f"*{SUFFIX}"))}):
        path = folder / f"{name}{SUFFIX}"
        try:
            prompts[name] = read_text(path, what="prompt", tree=folder)
            problems += _problems(path, prompts[name])
        except InputError as error:
            missing = f"{path}: the prompt is missing; copy it from the exported prompts"
            problems.append(str(error) if path.exists() else missing)
    for problem in problems:
        log.error("%s", problem)
    if problems:
        got = problems[0] + (f", and {len(problems) - 1} more" if problems[1:] else "")
        raise ConfigError(
            "these prompts cannot be used", where=folder, got=got,
            expected="the files and slots of the built-in prompts", fix=f"{len(problems)} to fix; {export}",
        )  # fmt: skip
    return prompts


def _problems(path: Path, text: str) -> Iterator[str]:
    """Yield a message for each problem of a user's prompt file."""
    shipped = shipped_prompts().get(path.stem)
    if shipped is None:
        yield f"{path}: no prompt has this name{nearest(path.stem, shipped_prompts())}"
        return
    version, _, body = text.partition("\n")
    if not version.startswith(VERSION):
        yield f"{path}:1: the first line must be {VERSION!r} followed by a version of your own"
    if not body.strip():
        yield f"{path}:2: the prompt is empty"
    wrong = set(slots_of(shipped)).symmetric_difference(slots_of(text))
    if not Template(text).is_valid():
        yield f"{path}: a $ begins no slot; write $$ for a dollar sign"
    elif wrong:
        yield f"{path}: these slots are missing or unknown: {', '.join(sorted(wrong))}"


def slots_of(text: str) -> list[str]:
    """Return the names of the slots of a prompt, each once."""
    return Template(text).get_identifiers()


def export_prompts(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write prompts into a folder; return their paths. Existing files, as of an interrupted export, must have the same
    text."""
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    paths = {folder / f"{name}{SUFFIX}": text for name, text in texts.items()}
    different = [path.name for path, text in paths.items() if path.exists() and read_text(path) != text]
    if different:
        what, fix = "the folder already contains prompts with a different text", "choose another folder"
        raise ConfigError(what, where=folder, got=", ".join(different), fix=fix)
    for path, text in paths.items():
        write_bytes(path, text.encode())
    return list(paths)


def vocabulary_of(cfg: CaptionConfig) -> Vocabulary:
    """Read the prompts that the settings name."""
    prompts = shipped_prompts() if cfg.prompts is None else own_prompts(cfg.prompts)
    return Vocabulary(prompts, cfg.text_state)


def keep_own_prompts(out: Path, vocabulary: Vocabulary) -> list[Path]:
    """Write prompts that do not ship next to the captions, so that readers know them; return their paths."""
    if vocabulary.prompts == shipped_prompts():
        return []
    return export_prompts(out / OWN_PROMPTS, vocabulary.prompts)
