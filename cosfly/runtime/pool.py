"""Run the items of a stage in watched worker processes, with resume, progress, a tally and a record per failure.

`run_items` is the whole interface. A stage passes items (an id and a payload that can be pickled) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that works
on one item. Load maps and open GL contexts in `make_worker`. A worker that dies, stalls or takes too long is replaced,
and its item is tried again.

Everything that can block on a worker (sending an item, receiving a message) happens in one thread per worker, so that
no worker can hold up the stage.
"""

from __future__ import annotations

import contextlib
import logging
import math
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError, EnvironmentMissing
from cosfly.runtime.events import LOSSES, EventLog, Loss
from cosfly.runtime.io import remove_partials
from cosfly.runtime.journal import Journal
from cosfly.runtime.ray_engine import ALL_ROOM, Cluster, RayConfig, RayTransport
from cosfly.runtime.run_dir import Failed, ItemRecord, Kept, StageFolder, Tally, read_item, write_failures
from cosfly.runtime.worker import Heartbeat, Item, LocalTransport, Message, Start, Work, attempt

log = logging.getLogger(__name__)

# The default limit of an item: at least ten minutes, and at least 20 times the median duration of the last items.
LEAST_LIMIT_S = 600.0
TYPICAL_ITEMS = 20.0
ITEMS_REMEMBERED = 1000  # durations from which the median is taken
PATIENCE_S = 5.0  # time in which a worker without further items may end by itself
RUN_AGAIN = "then run the same command again: finished items are kept"

Transport = LocalTransport | RayTransport


@dataclass(frozen=True)
class Watch:
    """The place of the workers, and the time limits after which one has stalled: the paper's (sec:dataset_watchdog)."""

    ray: RayConfig | None = None  # the Ray cluster; None runs the workers on this machine
    # The longest time in which an item may report no step; 0 disables the limit. None sets it to ten minutes or 20
    # times the median duration of an item, whichever is longer, and doubles it with each attempt.
    item_limit_s: float | None = None
    heartbeat_s: float = 2.0
    check_s: float = 5.0
    probe_s: float = 1.5
    failed_checks: int = 3  # consecutive checks with neither a heartbeat nor processor time until a worker is lost
    retries: int = 2  # of one item
    restarts: int = 20  # lost workers, in addition to one per finished item, until the stage stops


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
        what = "a worker process died in each of three attempts at the same item"
        got = f"{tally.failed['worker_died']} of {len(items)} items without a result"
        fix = f"free some memory or use fewer --workers, {RUN_AGAIN}"
        raise EnvironmentMissing(what, where=stage.path, got=got, fix=fix)
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


# --- the processes ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Attempt:
    item_index: int  # among the items of the pool
    item: Item
    number: int = 0


@dataclass(eq=False)
class _Worker:
    """One process, its current attempt, and what it has reported since the last check."""

    index: int
    transport: Transport
    inbox: queue.SimpleQueue[Item | None] = field(default_factory=queue.SimpleQueue)
    is_logged: bool = False  # its start is recorded in the event log
    attempt: _Attempt | None = None
    num_steps: int = 0
    has_begun: bool = False  # the current item; before that, a new worker loads maps and compiles
    begun_s: float = 0.0
    has_reported: bool = False  # since the last check
    cpu_s: float = 0.0  # at the last check
    failed_checks: int = 0
    quiet_s: float = 0.0  # since the last step of the item, counted in checks

    def assign(self, attempt: _Attempt) -> None:
        self.attempt = attempt
        self.num_steps = 0
        self.has_begun = False
        self.has_reported = True
        self.failed_checks = 0
        self.quiet_s = 0.0
        self.inbox.put(attempt.item)

    @property
    def event_fields(self) -> dict[str, object]:
        """The fields that identify the worker in the event log."""
        return {"worker": self.index, "node": self.transport.node, "pid": self.transport.pid}


@dataclass
class WorkerPool:
    """Runs items in up to `num_workers` processes.

    start_transport: Called with the heartbeat interval in s, the log level and the index of the worker.
    on_steps: Called with an item and the number of its finished steps; 0 when the item starts again.
    """

    start: Start
    num_workers: int
    watch: Watch
    events: EventLog
    on_steps: Callable[[Item, int], None]
    start_transport: Callable[[float, int, int], Transport]
    num_lost: int = 0
    _num_done: int = 0
    _seconds: deque[float] = field(default_factory=lambda: deque(maxlen=ITEMS_REMEMBERED))
    _todo: deque[_Attempt] = field(default_factory=deque)
    _workers: dict[int, _Worker] = field(default_factory=dict)  # by index
    _lost: set[int] = field(default_factory=set)  # indices of lost workers that are not replaced yet
    _messages: queue.SimpleQueue[tuple[_Worker, Message | None]] = field(default_factory=queue.SimpleQueue)

    def outcomes(self, items: Sequence[Item]) -> Iterator[tuple[int, ItemRecord]]:
        """Yield the index and the record of each item as it is done."""
        self.events.write("began", workers=self.num_workers)
        self._todo.extend(_Attempt(index, item) for index, item in enumerate(items))
        next_probe_s = time.monotonic()
        next_check_s = next_probe_s + self.watch.check_s
        patience_s = 0.0
        try:
            while self._todo or self._busy():
                self._hand_out()
                yield from self._handle_message(min(next_check_s, next_probe_s))
                now_s = time.monotonic()
                if now_s >= next_probe_s:
                    next_probe_s = now_s + self.watch.probe_s
                    self._probe()
                if now_s >= next_check_s:
                    next_check_s = now_s + self.watch.check_s
                    yield from self._check()
            patience_s = PATIENCE_S
        finally:
            if workers := list(self._workers.values()):
                with ThreadPoolExecutor(len(workers)) as threads:
                    list(threads.map(lambda worker: self._stop(worker, patience_s), workers))
        self.events.write("ended")

    # --- workers and attempts ---

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers.values() if worker.attempt is not None]

    def _hand_out(self) -> None:
        """Assign an item to every free worker, and start missing workers."""
        for index in range(self.num_workers):
            worker = self._workers.get(index)
            if worker is None and len(self._workers) - len(self._busy()) < len(self._todo):
                worker = self._start(index)  # more attempts can begin now than workers are free or starting
            if worker is None or worker.attempt is not None or worker.transport.pid is None:
                continue
            if not worker.is_logged:
                worker.is_logged = True
                self.events.write("restarted" if index in self._lost else "worker_started", **worker.event_fields)
                self._lost.discard(index)
            if self._todo:
                worker.assign(self._todo.popleft())

    def _start(self, index: int) -> _Worker:
        transport = self.start_transport(self.watch.heartbeat_s, logging.getLogger().level, index)
        worker = self._workers[index] = _Worker(index, transport)
        threading.Thread(target=_relay, args=(worker, self.start, self._messages), daemon=True).start()
        return worker

    def _stop(self, worker: _Worker, patience_s: float) -> None:
        """End a worker; it may end by itself within `patience_s`."""
        del self._workers[worker.index]
        worker.inbox.put(None)
        worker.transport.kill(patience_s)

    # --- messages ---

    def _handle_message(self, until_s: float) -> Iterator[tuple[int, ItemRecord]]:
        """Wait for one message, at most until a time of the monotonic clock, and handle it."""
        try:
            worker, message = self._messages.get(timeout=max(0.0, until_s - time.monotonic()))
        except queue.Empty:
            return
        if self._workers.get(worker.index) is not worker:  # it was stopped meanwhile
            return
        if message is None:
            yield from self._lose(worker, "worker_died")
        elif isinstance(message, Exception):
            _add_node(message, worker.transport.node)
            raise message
        elif isinstance(message, logging.LogRecord):
            logging.getLogger(message.name).handle(message)
        elif isinstance(message, Heartbeat):
            self._record_heartbeat(worker, message)
        elif worker.attempt is not None:
            yield self._finish_attempt(worker, worker.attempt, message)

    def _record_heartbeat(self, worker: _Worker, heartbeat: Heartbeat) -> None:
        """Record that the current item has begun or has finished further steps."""
        attempt = worker.attempt
        if attempt is None or heartbeat.item_id != attempt.item.item_id:
            return
        if not worker.has_begun:
            worker.has_begun = True
            worker.begun_s = time.monotonic()
            worker.quiet_s = 0.0
        elif heartbeat.num_steps != worker.num_steps:
            worker.num_steps = heartbeat.num_steps
            worker.quiet_s = 0.0
            self.on_steps(attempt.item, heartbeat.num_steps)

    def _finish_attempt(self, worker: _Worker, attempt: _Attempt, record: ItemRecord) -> tuple[int, ItemRecord]:
        """Free a worker whose item is done; return the index and the record of the item."""
        seconds = time.monotonic() - worker.begun_s
        self._seconds.append(seconds)
        self._num_done += 1
        worker.attempt = None
        self.events.write(
            "item_done",
            worker=worker.index,
            item=record.id,
            status=record.status,
            seconds=round(seconds, 3),
            steps=worker.num_steps,
        )
        return attempt.item_index, record

    # --- lost workers ---

    def _probe(self) -> None:
        """Write the memory and processor time of the workers to the event log."""
        vitals_by_index = {}
        for worker in self._workers.values():
            if worker.transport.pid and (vitals := worker.transport.look()):
                vitals_by_index[worker.index] = vitals
        self.events.probe(vitals_by_index)

    def _check(self) -> Iterator[tuple[int, ItemRecord]]:
        """Find workers that neither report nor compute, and items that make no progress.

        Time is counted in checks: while this process itself is stopped, no worker can report.
        """
        for worker in self._busy():
            vitals = worker.transport.look()
            cpu_s = worker.cpu_s if vitals is None else vitals.cpu_s
            is_alive = worker.has_reported or cpu_s != worker.cpu_s
            worker.failed_checks = 0 if is_alive else worker.failed_checks + 1
            worker.has_reported = False
            worker.cpu_s = cpu_s
            worker.quiet_s += self.watch.check_s
            if vitals is None:
                yield from self._lose(worker, "worker_died")
            elif worker.failed_checks >= self.watch.failed_checks:
                yield from self._lose(worker, "heartbeat_lost")
            elif worker.quiet_s > self._limit_s(worker):
                yield from self._lose(worker, "timed_out")

    def _limit_s(self, worker: _Worker) -> float:
        """Return how long a worker may report no step of its item.

        `item_limit_s` is the limit once the item has begun. Before that, the worker may still load maps and compile, so
        the limit is at least the default one.
        """
        limit_s = self.watch.item_limit_s
        if limit_s == 0 or worker.attempt is None:
            return math.inf
        if limit_s is not None and worker.has_begun:
            return limit_s
        typical_s = statistics.median(self._seconds) if self._seconds else 0.0
        return max(LEAST_LIMIT_S, TYPICAL_ITEMS * typical_s, limit_s or 0.0) * 2**worker.attempt.number

    def _lose(self, worker: _Worker, loss: Loss) -> Iterator[tuple[int, ItemRecord]]:
        """End a worker that died or stalled; try its item again, or yield the item as failed."""
        self._stop(worker, 0.0)
        self._lost.add(worker.index)
        self.num_lost += 1
        attempt = worker.attempt
        fields = worker.event_fields
        if attempt is not None:
            fields["item"] = attempt.item.item_id
            fields["seconds"] = round(time.monotonic() - worker.begun_s, 3) if worker.has_begun else 0.0
            fields["steps"] = worker.num_steps
            self.on_steps(attempt.item, 0)
        self.events.write(loss, **fields)
        if self.num_lost > self.watch.restarts + self._num_done:
            what = "too many worker processes died or stalled"
            got = f"{self.num_lost} workers lost, {self._num_done} items done; in the last loss, {LOSSES[loss]}"
            fix = f"see events.jsonl; free some memory, use fewer --workers or raise item_limit_s, {RUN_AGAIN}"
            raise EnvironmentMissing(what, where=None if attempt is None else attempt.item.item_id, got=got, fix=fix)
        if attempt is not None:
            yield from self._retry_or_fail(attempt, loss)

    def _retry_or_fail(self, attempt: _Attempt, loss: Loss) -> Iterator[tuple[int, ItemRecord]]:
        """Queue the item of a lost worker again, or yield it as failed after the last attempt."""
        item_id = attempt.item.item_id
        num_tries = attempt.number + 1
        if num_tries > self.watch.retries:
            self.events.write("given_up", item=item_id)
            code = "worker_died" if loss == "worker_died" else "timed_out"
            message = f"{item_id}: {num_tries} attempts failed; in the last one, {LOSSES[loss]}"
            yield attempt.item_index, Failed(id=item_id, code=code, message=message)
            return
        log.warning("%s: %s; cosfly tries the item again", item_id, LOSSES[loss])
        self._todo.append(replace(attempt, number=num_tries))
        self.events.write("retried", item=item_id, attempt=num_tries)


def _add_node(error: Exception, node: str | None) -> None:
    """Add the name of the worker's node to an error of ours."""
    if node is not None and isinstance(error, CosflyError):
        error.where = f"node {node}" if error.where is None else f"node {node}: {error.where}"


def _relay(worker: _Worker, start: Start, messages: queue.SimpleQueue) -> None:
    """Send items to a worker and put its messages into `messages` until it ends; None reports that it is gone."""
    transport = worker.transport
    try:
        transport.send(start)
        messages.put((worker, Heartbeat(None, 0)))  # wakes the pool, which may assign an item now
        while (item := worker.inbox.get()) is not None:
            transport.send(item)
            while True:
                message = transport.receive()
                worker.has_reported = True
                messages.put((worker, message))
                if isinstance(message, Exception | ItemRecord):
                    break
        transport.send(None)
    except (EOFError, OSError):
        messages.put((worker, None))
    except Exception as error:  # an item that does not pickle, a message that does not unpickle
        messages.put((worker, error))
