"""Items to work, on this machine: a process pool with resume, progress, a tally that adds up and a record per failure.

`run_items` is the whole interface. A stage hands it items (an id and a payload that pickles) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that does one
item. Load maps and open GL contexts in it. The same signature fits an actor pool on other machines.
"""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import multiprocessing
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from cosfly.console import progress_bar, set_levels
from cosfly.errors import CosflyError, EnvironmentMissing
from cosfly.stage_folder import Dropped, Failed, ItemRecord, Kept, StageFolder, Tally, write_failures

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Item:
    """One unit of work. `item_id` is unique within the stage and stable between runs."""

    item_id: str
    payload: Any = None


@dataclass(frozen=True)
class Outcome:
    """What became of an item that did not fail: `result` is JSON-able, `drop_reason` is None for a kept item."""

    result: dict = field(default_factory=dict)
    drop_reason: str | None = None


Work = Callable[[Item], Outcome]


@dataclass(frozen=True)
class Finished:
    """All outcomes of a stage, in the order of the items."""

    records: list[ItemRecord]
    tally: Tally

    @property
    def kept(self) -> list[Kept]:
        return [record for record in self.records if isinstance(record, Kept)]


def run_items(
    stage: StageFolder,
    items: Sequence[Item],
    make_worker: Callable[..., Work],
    worker_args: tuple = (),
    *,
    workers: int = 1,
    label: str | None = None,
) -> Finished:
    """Do all items that the stage's journal does not hold yet.

    An item whose work raises is recorded as failed and counted; a fatal CosflyError (full disk, no GL) stops the stage, and
    what was finished stays. A worker that dies (out of memory, kill) costs only its items, which get one more try each, alone; if one
    dies again, the other items are finished first and the stage then stops, unfinished.
    On a later run kept and dropped items are taken from the journal and failed ones are tried again.

    Args:
        make_worker: module-level function; `make_worker(*worker_args)` returns the work function, once in each process.
        workers: processes; 1 works in this process.
    Returns:
        Records and tally, in the order of `items` whatever the order of work.
    """
    ids = [item.item_id for item in items]
    assert len(set(ids)) == len(ids), "item ids must be unique"
    with stage.journal as journal:
        known = set(ids)
        records: dict[str, ItemRecord] = {}
        records |= {r.id: r for r in stage.items() if r.id in known and not isinstance(r, Failed)}
        todo = [item for item in items if item.item_id not in records]
        if records:
            log.info("%s: %d of %d items were finished before", stage.stage, len(records), len(items))
        with progress_bar(label or stage.stage, total=len(items), done=len(records)) as advance:
            for record in _outcomes(todo, make_worker, worker_args, workers):
                records[record.id] = record
                journal.append(record.model_dump())
                if isinstance(record, Failed):
                    named = "" if record.id in record.message else f"{record.id}: "
                    log.error("%s: %s%s", stage.stage, named, record.message)
                advance(1)
    ordered = [records[item_id] for item_id in ids]
    tally = _tally(stage, ordered)
    if "worker_died" in tally.failed:
        # That is the machine's doing, not the item's: it must not become a result. The stage stays open.
        raise EnvironmentMissing(
            "worker processes were killed, twice for the same item",
            where=stage.path,
            got=f"{tally.failed['worker_died']} of {len(ordered)} items without an outcome",
            fix="free some memory or use fewer --workers, then run the same command again: finished items are kept",
        )
    return Finished(ordered, tally)


def _tally(stage: StageFolder, records: list[ItemRecord]) -> Tally:
    failures = [record for record in records if isinstance(record, Failed)]
    write_failures(stage.path / "failures.jsonl", failures)
    dropped = Counter(record.reason for record in records if isinstance(record, Dropped))
    kept = len(records) - dropped.total() - len(failures)
    return Tally(input=len(records), kept=kept, dropped=dropped, failed=Counter(failure.code for failure in failures))


def _outcomes(items: list[Item], make_worker: Callable, worker_args: tuple, workers: int) -> Iterator[ItemRecord]:
    if workers <= 1 or len(items) <= 1:
        work = make_worker(*worker_args) if items else None
        for item in items:
            yield _attempt(work, item)
        return
    suspects: list[Item] = []  # in flight when a worker died: each gets one more try, alone
    yield from _pooled(items, make_worker, worker_args, workers, suspects)
    for item in suspects:
        again: list[Item] = []
        yield from _pooled([item], make_worker, worker_args, 1, again)
        if again:
            message = f"{item.item_id}: its worker process died twice; it may need more memory than there is"
            yield Failed(id=item.item_id, code="worker_died", message=message)


def _pooled(
    items: list[Item], make_worker: Callable, worker_args: tuple, workers: int, suspects: list[Item]
) -> Iterator[ItemRecord]:
    """Run items on a pool; those in flight when a worker died are put into `suspects`, the others run on a new pool."""
    context = multiprocessing.get_context("spawn")  # fork would copy GL and thread-pool state
    waiting = list(reversed(items))
    logs = context.Queue()
    listener = logging.handlers.QueueListener(logs, *logging.getLogger().handlers, respect_handler_level=True)
    listener.start()
    try:
        while waiting:
            pool = ProcessPoolExecutor(
                min(workers, len(waiting)),
                context,
                _start_worker,
                (make_worker, worker_args, logs, logging.getLogger().level),
            )
            running: dict[Future, Item] = {}
            try:
                while waiting or running:
                    while waiting and len(running) < 2 * workers:  # a short queue keeps every worker fed
                        with _no_interrupt():  # a worker that starts here inherits the mask
                            running[pool.submit(_attempt_in_worker, waiting[-1])] = waiting[-1]
                        waiting.pop()
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        record = future.result()  # raises a fatal CosflyError, or BrokenProcessPool
                        del running[future]
                        yield record
            except BrokenProcessPool:
                suspects.extend(running.values())
                log.warning("a worker process died; its items get one more try")
            except KeyboardInterrupt:
                for process in multiprocessing.active_children():
                    process.terminate()  # what they had in hand is done again by the next run
                raise
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    finally:
        listener.stop()


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Hold back Ctrl-C: it would hit a starting worker in the middle of an import, which prints a traceback."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_work: Work | None = None  # this worker process's function
_start_error: Exception | None = None


def _start_worker(make_worker: Callable, worker_args: tuple, logs: Any, level: int) -> None:
    global _work, _start_error
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends a worker at once; only the main process speaks of it
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    root = logging.getLogger()
    root.handlers = [logging.handlers.QueueHandler(logs)]
    set_levels(level)
    try:
        _work = make_worker(*worker_args)
    except Exception as error:
        _start_error = error  # raised by the first item: in an initializer it would pass for a worker that was killed


def _attempt_in_worker(item: Item) -> ItemRecord:
    if _start_error is not None:
        raise _start_error
    return _attempt(_work, item)


def _attempt(work: Work | None, item: Item) -> ItemRecord:
    """Do one item and give its record. Only a fatal error gets out."""
    assert work is not None
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
