"""Run the items of a stage in watched worker processes, with resume, progress, a tally and a record per failure.

`run_items` is the whole interface. A stage passes items (an id and a payload that can be pickled) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that works
on one item. Load maps and open GL contexts in `make_worker`. A worker that dies, stalls or takes too long is replaced,
and its item is tried again (`worker_pool`).
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError, EnvironmentMissing
from cosfly.runtime.events import EventLog
from cosfly.runtime.io import remove_partials
from cosfly.runtime.journal import Journal
from cosfly.runtime.ray_engine import ALL_ROOM, Cluster
from cosfly.runtime.run_dir import Failed, ItemRecord, Kept, StageFolder, Tally, read_item, write_failures
from cosfly.runtime.worker import Item, LocalTransport, Start, Work, attempt
from cosfly.runtime.worker_pool import RUN_AGAIN, Transport, Watch, WorkerPool

__all__ = ["ItemOutcomes", "Watch", "run_items"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ItemOutcomes:
    """The outcomes of all items of a stage. The records stay on the disk; each iteration reads them again."""

    tally: Tally
    _journal: Journal
    _line_bytes: np.ndarray  # (n,) int64, by item: the first byte of its record in the journal

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
    has_product: Callable[[Item], bool] = lambda item: True,
) -> ItemOutcomes:
    """Run all items that the stage's journal does not hold yet.

    An item whose work raises is recorded as failed. A fatal CosflyError (full disk, no GL) stops the stage; finished
    items stay. If a worker dies (out of memory, kill) or stalls, its item is tried twice more. An item that stalls in
    each try has failed. If its worker dies in each try, the stage finishes the others and stops incomplete. A later run
    takes kept and dropped items from the journal and tries failed ones again.

    Args:
        make_worker: Module-level function; `make_worker(*worker_args)` returns the work function, once per process.
        workers: Number of processes; 0 works in this process, where an item that hangs is not ended.
        has_product: Whether what a kept item wrote is still there; otherwise the item is run again.

    Returns:
        Records and tally, in the order of `items`, independent of the order of work.
    """
    line_bytes = _journaled_lines(stage, items, has_product)
    indices = np.flatnonzero(line_bytes < 0)
    todo = [items[index] for index in indices.tolist()]
    if num_finished := len(items) - len(todo):
        log.info("%s: %d of %d items are already finished", stage.stage, num_finished, len(items))
    progress = _Progress(items, todo)
    start = partial(make_worker, *worker_args)
    if workers and todo:
        outcomes = _in_processes(stage, todo, start, workers, watch, progress)
    else:
        outcomes = _in_this_process(todo, start, progress.move)
    # `closing` also ends the workers when an error is raised: none outlives the call.
    with stage.journal as journal, progress.shown(label or stage.stage), contextlib.closing(outcomes):
        for todo_index, record in outcomes:
            line_bytes[indices[todo_index]] = journal.append(record.model_dump())
            if isinstance(record, Failed):
                prefix = "" if record.id in record.message else f"{record.id}: "
                log.error("%s: %s%s", stage.stage, prefix, record.message)
            progress.finish(todo[todo_index])
    tally = Tally(input=len(items))
    finished = ItemOutcomes(tally, stage.journal, line_bytes)
    write_failures(stage.path / "failures.jsonl", filter(None, map(tally.count, finished.records)))
    if "worker_died" in tally.failed:
        # The cause is the machine, not the item, so it must not become a result: the stage stays incomplete.
        raise EnvironmentMissing(
            "a worker process died in each of three attempts at the same item",
            where=stage.path,
            got=f"{tally.failed['worker_died']} of {len(items)} items without a result",
            fix=f"free some memory or use fewer --workers, {RUN_AGAIN}",
        )
    return finished


def _journaled_lines(stage: StageFolder, items: Sequence[Item], has_product: Callable[[Item], bool]) -> np.ndarray:
    """Return the first byte of each item's record in the journal, (n,) int64; -1 for an item that is not finished."""
    indices = {item.item_id: index for index, item in enumerate(items)}
    assert len(indices) == len(items), "item ids must be unique"
    line_bytes = np.full(len(items), -1)
    journal = stage.journal
    for record in journal.read_as(read_item):
        index = indices.get(record.id)
        if index is None or isinstance(record, Failed):
            continue
        if not isinstance(record, Kept) or has_product(items[index]):
            line_bytes[index] = journal.line_byte
    return line_bytes


def _in_this_process(
    items: Sequence[Item], start: Start, on_steps: Callable[[Item, int], None]
) -> Generator[tuple[int, ItemRecord], None, None]:
    if not items:
        return
    work = start()
    for index, item in enumerate(items):
        yield index, attempt(work, item, partial(on_steps, item))


def _in_processes(
    stage: StageFolder, items: Sequence[Item], start: Start, workers: int, watch: Watch, progress: _Progress
) -> Generator[tuple[int, ItemRecord], None, None]:
    start_transport: Callable[[float, int, int], Transport] = LocalTransport
    if watch.ray is not None:
        cluster = Cluster(watch.ray, stage.path)
        start_transport = cluster.start_transport
        if workers == ALL_ROOM:
            workers = cluster.room
    with contextlib.closing(EventLog(stage.path)) as events:
        pool = WorkerPool(start, min(workers, len(items)), watch, events, progress.move, start_transport)
        try:
            yield from pool.outcomes(items)
        except CosflyError:
            remove_partials(stage.path)  # on a full disk they hold the space that is needed
            raise
    if pool.num_lost:
        remove_partials(stage.path)  # those of the lost workers


class _Progress:
    """The progress bar of a stage. It counts steps, such as frames, if every item has a number of steps, else items."""

    def __init__(self, items: Sequence[Item], todo: Sequence[Item]) -> None:
        self._in_steps = all(item.num_steps for item in items)
        self._total = sum(map(self._size, items))
        self._done = self._total - sum(map(self._size, todo))
        self._current: dict[str, int] = {}  # steps done of each current item, by item id
        self._advance: Callable[[int], None] = lambda count: None

    def _size(self, item: Item) -> int:
        return item.num_steps or 1 if self._in_steps else 1

    @contextlib.contextmanager
    def shown(self, label: str) -> Iterator[None]:
        with progress_bar(label, total=self._total, done=self._done) as self._advance:
            yield

    def move(self, item: Item, num_steps: int) -> None:
        """Set the number of steps done of an item; it decreases when the item starts again."""
        if self._in_steps:
            count = min(num_steps, self._size(item))
            self._advance(count - self._current.get(item.item_id, 0))
            self._current[item.item_id] = count

    def finish(self, item: Item) -> None:
        self._advance(self._size(item) - self._current.pop(item.item_id, 0))
