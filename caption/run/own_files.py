"""What a run speaks with: its prompts and actions, those that ship or somebody's own. Read before anything is asked;
what does not ship is copied beside the captions, so that whoever reads them later knows."""

from __future__ import annotations

from pathlib import Path

from caption.schema import CaptionConfig
from caption.teachers.prompt_files import PROMPTS, SUFFIX, own_prompts, shipped_prompts
from caption.teachers.rules import DECIDES
from caption.truth.vocabulary import Vocabulary
from cosfly.errors import ConfigError
from cosfly.products.actions import ACTIONS_FILE, ActionSet, read_actions, shipped_actions, write_own_actions
from cosfly.products.captions import OWN_PROMPTS
from cosfly.work.store import write_bytes


def vocabulary_of(cfg: CaptionConfig) -> Vocabulary:
    """Read the files that the settings name."""
    prompts = shipped_prompts() if cfg.prompts is None else own_prompts(cfg.prompts)
    return Vocabulary(shipped_actions() if cfg.actions is None else _own_actions(cfg, cfg.actions), prompts)


def _own_actions(cfg: CaptionConfig, path: Path) -> ActionSet:
    actions = read_actions(path)
    lacking = [token for token in DECIDES if token not in actions.tokens]
    if cfg.teacher_kind == "rules" and lacking:
        raise ConfigError(
            "the rule teacher decides what this set of actions does not hold", where=path, got=", ".join(lacking),
            fix="keep these, or have another teacher asked (--teacher)",
        )  # fmt: skip
    return actions


def package_files(cfg: CaptionConfig) -> dict[str, Path]:
    """Name the files in use that decide what is written: one folder never holds captions of two of them."""
    return {"prompts": cfg.prompts or PROMPTS, "action table": cfg.actions or ACTIONS_FILE}


def keep_own_files(out: Path, vocabulary: Vocabulary) -> list[Path]:
    """Copy what is in use and does not ship beside the captions; gives what was written."""
    texts = {} if vocabulary.prompts == shipped_prompts() else vocabulary.prompts
    paths = [out / OWN_PROMPTS / f"{name}{SUFFIX}" for name in texts]
    if paths:
        (out / OWN_PROMPTS).mkdir(exist_ok=True)
    for path, text in zip(paths, texts.values(), strict=True):
        write_bytes(path, text.encode())
    return [*paths, *write_own_actions(out, vocabulary.actions)]
