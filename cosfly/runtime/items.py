"""One item of a stage: what it is, doing it, and telling how far it is."""

from __future__ import annotations

import contextlib
import logging
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from cosfly.runtime.errors import CosflyError
from cosfly.runtime.stage_folder import Dropped, Failed, ItemRecord, Kept

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Item:
    """One unit of work. `item_id` is unique within the stage and stable between runs.

    num_steps: how many steps, as frames, the work tells of with `advance`; None where they are not known before.
    """

    item_id: str
    payload: Any = None
    num_steps: int | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of an item that did not fail: `result` is JSON-able, `drop_reason` is None for a kept item."""

    result: dict = field(default_factory=dict)
    drop_reason: str | None = None


Work = Callable[[Item], Outcome]

_place = 0
_on_steps: Callable[[int], None] | None = None
_num_steps = 0


def worker_place() -> int:
    """Return which of a stage's workers this process is, from 0; one that replaces another has its place."""
    return _place


def take_place(place: int) -> None:
    """Be the worker of a place."""
    global _place
    _place = place


def advance(num_steps: int = 1) -> None:
    """Tell that the item in hand is getting on: a sign of life, and a step of the progress bar."""
    global _num_steps
    _num_steps += num_steps
    if _on_steps is not None:
        _on_steps(_num_steps)


@contextlib.contextmanager
def counted_steps(on_steps: Callable[[int], None]) -> Iterator[None]:
    """Tell `on_steps` how many steps of an item are done, each time that its work calls `advance` in this process."""
    global _on_steps, _num_steps
    _on_steps, _num_steps = on_steps, 0
    try:
        yield
    finally:
        _on_steps = None


def attempt(work: Work, item: Item) -> ItemRecord:
    """Do one item and give its record. Only a fatal error gets out."""
    start_s = time.monotonic()
    try:
        outcome = work(item)
    except CosflyError as error:
        if error.fatal:
            raise
        return Failed(id=item.item_id, code=error.code, message=str(error))
    except Exception as error:  # the item boundary: a bug in one item must not lose the others
        log.error("%s: a bug in cosfly\n%s", item.item_id, traceback.format_exc())
        return Failed(id=item.item_id, code="bug", message=f"{type(error).__name__}: {error}")
    seconds = round(time.monotonic() - start_s, 3)
    if outcome.drop_reason is None:
        return Kept(id=item.item_id, result=outcome.result, seconds=seconds)
    return Dropped(id=item.item_id, result=outcome.result, reason=outcome.drop_reason, seconds=seconds)
