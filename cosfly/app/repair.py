"""`--repair`: what cannot be used in the journals of a folder is set aside, counted, and done again by the next run."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from cosfly.chat.answers import TOTALS, read_line
from cosfly.work.folder_lock import hold_folder
from cosfly.work.journal import ASIDE, Journal
from cosfly.work.stage_folder import read_item

log = logging.getLogger(__name__)

# Of a stage folder: its journals, and what reads a line of them.
JOURNALS: dict[str, Callable[[dict], object]] = {
    "items.jsonl": read_item,
    "answers/*.jsonl": read_line,
    "judgements/*.jsonl": read_line,
}


def repair(folder: Path) -> int:
    """Set aside what is broken in the journals of a stage folder, or of all stages of a run; gives the number of lines.

    A finished stage of which something is set aside is open again. Links are left alone.
    """
    if not folder.is_dir():
        return 0
    # Stages; those of towns.
    below = sorted(path for depth in ("*", "*/*") for path in folder.glob(depth) if path.is_dir())
    return sum(_repair_stage(stage, folder) for stage in (folder, *below))


def _repair_stage(stage: Path, out: Path) -> int:
    root = out.resolve()  # only the folder that was named may itself be a link
    found = [(path, read) for pattern, read in JOURNALS.items() for path in sorted(stage.glob(pattern))]
    found = [(path, read) for path, read in found if path.is_file() and path.resolve() == root / path.relative_to(out)]
    if not found:
        return 0
    lock = hold_folder(stage)
    try:
        return sum(_set_aside(path, read, stage / "manifest.json") for path, read in found)
    finally:
        lock.release()


def _set_aside(path: Path, read: Callable[[dict], object], manifest: Path) -> int:
    """Set aside what is broken. What follows from it is done before: after a kill in between nobody would see it."""
    journal = Journal(path)
    num_lines = sum(not _is_usable(record, read) for record in journal.read()) + journal.num_damaged
    if num_lines:
        manifest.unlink(missing_ok=True)
        # Totals have counted what is broken; the next run counts anew.
        journal.set_aside(lambda record: TOTALS not in record and _is_usable(record, read))
        log.warning("%s: %d lines set aside in %s", path, num_lines, path.name + ASIDE)
    return num_lines


def _is_usable(record: dict, read: Callable[[dict], object]) -> bool:
    try:
        read(record)
    except ValidationError:
        return False
    return True
