"""What a run puts in the place of files that ship: its prompts and actions. Read before anything is asked, in use while
a block runs, copied beside the captions, so that whoever reads them later knows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from caption.schema import CaptionConfig
from caption.teachers.prompt_files import PROMPTS, SUFFIX, own_prompts
from caption.teachers.rules import DECIDES
from cosfly.errors import ConfigError
from cosfly.products.actions import ACTIONS_FILE, ActionSet, read_actions, write_own_actions
from cosfly.products.captions import OWN_PROMPTS
from cosfly.work import in_place
from cosfly.work.store import write_bytes


@contextmanager
def own_files(cfg: CaptionConfig) -> Iterator[None]:
    """Have the files that the settings name in use while a block runs.

    Raises:
        ConfigError: one of them cannot be used.
    """
    with in_place.put(prompts=own_prompts(cfg.prompts), actions=_own_actions(cfg)):
        yield


def _own_actions(cfg: CaptionConfig) -> ActionSet | None:
    if cfg.actions is None:
        return None
    actions = read_actions(cfg.actions)
    lacking = [token for token in DECIDES if token not in actions.tokens]
    if cfg.teacher_kind == "rules" and lacking:
        raise ConfigError(
            "the rule teacher decides what this set of actions does not hold", where=cfg.actions,
            got=", ".join(lacking),
            fix="keep these, or have another teacher asked (--teacher)",
        )  # fmt: skip
    return actions


def package_files(cfg: CaptionConfig) -> dict[str, Path]:
    """Name the files in use that decide what is written: one folder never holds captions of two of them."""
    return {"prompts": cfg.prompts or PROMPTS, "action table": cfg.actions or ACTIONS_FILE}


def keep_own_files(out: Path) -> list[Path]:
    """Copy what is in use and does not ship beside the captions; gives what was written."""
    texts: dict[str, str] = in_place.given("prompts") or {}
    paths = [out / OWN_PROMPTS / f"{name}{SUFFIX}" for name in texts]
    if paths:
        (out / OWN_PROMPTS).mkdir(exist_ok=True)
    for path, text in zip(paths, texts.values(), strict=True):
        write_bytes(path, text.encode())
    return [*paths, *write_own_actions(out)]
