"""What a run puts in the place of files that ship: its prompts. Read before anything is asked, in use while a block runs, copied beside
the captions, so that whoever reads them later knows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from caption.schema import CaptionConfig
from caption.teachers.prompt_files import PROMPTS, SUFFIX, own_prompts
from cosfly import own
from cosfly.products.captions import OWN_PROMPTS
from cosfly.store import write_bytes


@contextmanager
def own_files(cfg: CaptionConfig) -> Iterator[None]:
    """Have the files that the settings name in use while a block runs.

    Raises:
        ConfigError: one of them cannot be used.
    """
    with own.put(prompts=own_prompts(cfg.prompts)):
        yield


def package_files(cfg: CaptionConfig) -> dict[str, Path]:
    """Name the files in use that decide what is written: one folder never holds captions of two of them."""
    return {"prompts": cfg.prompts or PROMPTS}


def keep_own_files(out: Path) -> list[Path]:
    """Copy what is in use and does not ship beside the captions."""
    texts: dict[str, str] = own.in_place("prompts") or {}
    paths = [out / OWN_PROMPTS / f"{name}{SUFFIX}" for name in texts]
    if paths:
        (out / OWN_PROMPTS).mkdir(exist_ok=True)
    for path, text in zip(paths, texts.values(), strict=True):
        write_bytes(path, text.encode())
    return paths
