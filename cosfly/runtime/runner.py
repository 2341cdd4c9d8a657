"""Items to work: worker processes with resume, progress, a tally that adds up and a record per failure.

`run_items` is the whole interface. A stage hands it items (an id and a payload that pickles) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that does
one item. Load maps and open GL contexts in it. `watch` says where: in processes of this machine, or of a Ray cluster.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError, EnvironmentMissing
from cosfly.runtime.items import Item, Outcome, Work, advance, attempt, counted_steps
from cosfly.runtime.journal import Journal
from cosfly.runtime.ray_engine import ALL_ROOM, Cluster
from cosfly.runtime.stage_events import EventLog
from cosfly.runtime.stage_folder import Dropped, Failed, ItemRecord, Kept, StageFolder, Tally, read_item, write_failures
from cosfly.runtime.store import remove_partials
from cosfly.runtime.worker_pool import LocalTransport, StartTransport, Watch, WorkerPool

__all__ = ["Item", "ItemOutcomes", "Outcome", "Watch", "Work", "advance", "run_items"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ItemOutcomes:
    """What became of all items of a stage. The records stay on the disk: each look through them, in the order of the
    items, reads them again, one at a time."""

    tally: Tally
    _journal: Journal
    _line_bytes: np.ndarray  # (n,) int64, by item: where its record begins

    @property
    def records(self) -> Iterator[ItemRecord]:
        return map(read_item, self._journal.read_at(self._line_bytes))

    @property
    def kept(self) -> Iterator[Kept]:
        return (record for record in self.records if isinstance(record, Kept))


def run_items(
    stage: StageFolder,
    items: Sequence[Item],
    make_worker: Callable[..., Work],
    worker_args: tuple = (),
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    label: str | None = None,
) -> ItemOutcomes:
    """Do all items that the stage's journal does not hold yet.

    An item whose work raises is recorded as failed and counted; a fatal CosflyError (full disk, no GL) stops the stage,
    and what was finished stays. A worker that dies (out of memory, kill) or stalls costs only its item, which gets two
    more tries, the last one alone. An item that stalls again has failed; if one's worker dies again, the others are
    finished first and the stage then stops, unfinished. On a later run kept and dropped items are taken from the
    journal and failed ones are tried again.

    Args:
        make_worker: module-level function; `make_worker(*worker_args)` returns the work function, once in each process.
        workers: processes; 0 works in this process, where nothing can end an item that hangs.
        watch: where workers work, and when one counts as stalled.
    Returns:
        Records and tally, in the order of `items` whatever the order of work.
    """
    line_bytes = _finished_before(stage, items)
    indices = np.flatnonzero(line_bytes < 0)
    todo = [item for item, line_byte in zip(items, line_bytes, strict=True) if line_byte < 0]
    if num_finished := len(items) - len(todo):
        log.info("%s: %d of %d items were finished before", stage.stage, num_finished, len(items))
    progress = _Progress(items, todo)
    if workers and todo:
        outcomes = _in_processes(stage, todo, (make_worker, worker_args), workers, watch, progress)
    else:
        outcomes = _in_this_process(todo, (make_worker, worker_args), progress.move)
    # Closed at once, also while an error is on its way: no worker goes on behind it.
    with stage.journal as journal, progress.shown(label or stage.stage), contextlib.closing(outcomes):
        for todo_index, record in outcomes:
            line_bytes[indices[todo_index]] = journal.append(record.model_dump())
            _tell(stage.stage, record)
            progress.finish(todo[todo_index])
    finished = ItemOutcomes(tally := Tally(input=len(items)), stage.journal, line_bytes)
    write_failures(stage.path / "failures.jsonl", _counted(finished.records, tally))
    if "worker_died" in tally.failed:
        # That is the machine's doing, not the item's: it must not become a result. The stage stays open.
        raise EnvironmentMissing(
            "worker processes were killed, three times for the same item",
            where=stage.path,
            got=f"{tally.failed['worker_died']} of {len(items)} items without an outcome",
            fix="free some memory or use fewer --workers, then run the same command again: finished items are kept",
        )
    return finished


def _finished_before(stage: StageFolder, items: Sequence[Item]) -> np.ndarray:
    """Return of each item the byte from which the journal tells that it is finished, (n,) int64; -1 where it does
    not."""
    indices = {item.item_id: index for index, item in enumerate(items)}
    assert len(indices) == len(items), "item ids must be unique"
    line_bytes, journal = np.full(len(items), -1), stage.journal
    for record in journal.read_as(read_item):
        if record.id in indices and not isinstance(record, Failed):
            line_bytes[indices[record.id]] = journal.line_byte
    return line_bytes


def _tell(stage: str, record: ItemRecord) -> None:
    if isinstance(record, Failed):
        named = "" if record.id in record.message else f"{record.id}: "
        log.error("%s: %s%s", stage, named, record.message)
    else:
        reason = f" ({record.reason})" if isinstance(record, Dropped) else ""
        log.debug("%s: %s: %s%s, %.2f s", stage, record.id, record.status, reason, record.seconds)


def _counted(records: Iterable[ItemRecord], tally: Tally) -> Iterator[Failed]:
    """Count records in a tally, and yield those that failed."""
    for record in records:
        if isinstance(record, Kept):
            tally.kept += 1
        elif isinstance(record, Dropped):
            tally.dropped[record.reason] += 1
        else:
            tally.failed[record.code] += 1
            yield record


_Start = tuple[Callable[..., Work], tuple]  # make_worker, worker_args


def _in_this_process(
    items: Sequence[Item], start: _Start, on_steps: Callable[[Item, int], None]
) -> Generator[tuple[int, ItemRecord], None, None]:
    if not items:
        return
    make_worker, worker_args = start
    work = make_worker(*worker_args)
    for index, item in enumerate(items):
        with counted_steps(partial(on_steps, item)):
            record = attempt(work, item)
        yield index, record


def _in_processes(
    stage: StageFolder, items: Sequence[Item], start: _Start, workers: int, watch: Watch, progress: _Progress
) -> Generator[tuple[int, ItemRecord], None, None]:
    start_transport: StartTransport = LocalTransport
    if watch.ray is not None:
        cluster = Cluster(watch.ray, stage.path)
        start_transport, workers = cluster.start_transport, cluster.room if workers == ALL_ROOM else workers
    events = EventLog(stage.path)
    pool = WorkerPool(*start, min(workers, len(items)), watch, events, progress.move, start_transport)
    try:
        yield from pool.outcomes(items)
    except CosflyError:
        remove_partials(stage.path)  # on a full disk they hold the space that is needed
        raise
    finally:
        events.close()
    if pool.num_lost:
        remove_partials(stage.path)  # what the lost workers had in hand


class _Progress:
    """How far a stage is: in steps, as frames, where every item says how many it has, else in items."""

    def __init__(self, items: Sequence[Item], todo: Sequence[Item]) -> None:
        self._in_steps = all(item.num_steps for item in items)
        self._total = sum(map(self._size, items))
        self._done = self._total - sum(map(self._size, todo))
        self._in_hand: dict[str, int] = {}  # of `done`, by item
        self._advance: Callable[[int], None] = lambda count: None

    def _size(self, item: Item) -> int:
        return item.num_steps or 1 if self._in_steps else 1

    @contextlib.contextmanager
    def shown(self, label: str) -> Iterator[None]:
        with progress_bar(label, total=self._total, done=self._done) as self._advance:
            yield

    def move(self, item: Item, num_steps: int) -> None:
        """Note how many steps of an item are done; fewer than before where it is begun again."""
        if self._in_steps:
            self._set(item, min(num_steps, self._size(item)))

    def finish(self, item: Item) -> None:
        self._set(item, self._size(item))
        del self._in_hand[item.item_id]

    def _set(self, item: Item, count: int) -> None:
        gained = count - self._in_hand.get(item.item_id, 0)
        self._in_hand[item.item_id] = count
        self._advance(gained)
