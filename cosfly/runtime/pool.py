"""Items to work: a pool of watched processes with resume, progress, a tally that adds up and a record per failure.

`run_items` is the whole interface. A stage gives it items (an id and a payload that pickles) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that does
one item. Load maps and open GL contexts in it. A worker that dies, stalls or takes too long is replaced, and its item
is tried again.

Everything that can block on a worker (sending it an item, reading from it) happens in a thread of its own, so no worker
can hold up the stage. Its process is of this machine, at the other end of a pipe (`LocalTransport`), or on a node of a
cluster (`ray_engine.RayTransport`).
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import math
import multiprocessing
import os
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import resource_tracker

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError, EnvironmentMissing
from cosfly.runtime.events import LOSSES, EventLog, Loss, Vitals
from cosfly.runtime.io import remove_partials
from cosfly.runtime.journal import Journal
from cosfly.runtime.ray_engine import ALL_ROOM, Cluster, RayConfig, RayTransport
from cosfly.runtime.run_dir import Failed, ItemRecord, Kept, StageFolder, Tally, read_item, write_failures
from cosfly.runtime.worker import Item, Message, Sign, Start, Work, attempt, signals_held_back, work_through

log = logging.getLogger(__name__)

LEAST_LIMIT_S, TYPICAL_ITEMS = 600.0, 20.0  # of the default limit: at least so long, and so many times what items take
ITEMS_REMEMBERED = 1000  # to know what items take
PATIENCE_S = 5.0  # for a worker that has no more to do to end by itself


@dataclass(frozen=True)
class Watch:
    """The place of the workers, and when one counts as stalled; with the times of the paper (sec:dataset_watchdog).

    ray: The cluster; None: this machine.
    item_limit_s: The time for which an item may report no step; 0: unlimited; None: ten minutes or 20 times what items
    take, whichever is more. It doubles with each attempt, as it does for the start of a worker.
    """

    ray: RayConfig | None = None
    item_limit_s: float | None = None
    heartbeat_s: float = 2.0
    check_s: float = 5.0
    probe_s: float = 1.5
    failed_checks: int = 3  # in a row: neither a heartbeat nor any processor time
    retries: int = 2  # of an item
    restarts: int = 20  # of workers, beyond one for each item that was done: after that the machine is not fit


# --- the interface ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ItemOutcomes:
    """The outcomes of all items of a stage. The records stay on the disk and are read again by each iteration."""

    tally: Tally
    _journal: Journal
    _line_bytes: np.ndarray  # (n,) int64, by item: the first byte of its record

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
    """Run all items that the stage's journal does not hold yet.

    An item whose work raises is recorded as failed and counted; a fatal CosflyError (full disk, no GL) stops the stage,
    and finished items stay. A worker that dies (out of memory, kill) or stalls costs only its item, which gets two
    more tries, the last one alone. An item that stalls again has failed; if one's worker dies again, the others are
    finished first and the stage then stops, unfinished. On a later run kept and dropped items are taken from the
    journal and failed ones are tried again.

    Args:
        make_worker: Module-level function; `make_worker(*worker_args)` returns the work function, once per process.
        workers: Processes; 0 works in this process, where nothing can end an item that hangs.

    Returns:
        Records and tally, in the order of `items` whatever the order of work.
    """
    line_bytes = _finished_before(stage, items)
    indices = np.flatnonzero(line_bytes < 0)
    todo = [items[index] for index in indices.tolist()]
    if num_finished := len(items) - len(todo):
        log.info("%s: %d of %d items were finished before", stage.stage, num_finished, len(items))
    progress, start = _Progress(items, todo), partial(make_worker, *worker_args)
    if workers and todo:
        outcomes = _in_processes(stage, todo, start, workers, watch, progress)
    else:
        outcomes = _in_this_process(todo, start, progress.move)
    # Closed at once, also while an error is on its way: no worker outlives the call.
    with stage.journal as journal, progress.shown(label or stage.stage), contextlib.closing(outcomes):
        for todo_index, record in outcomes:
            line_bytes[indices[todo_index]] = journal.append(record.model_dump())
            if isinstance(record, Failed):
                named = "" if record.id in record.message else f"{record.id}: "
                log.error("%s: %s%s", stage.stage, named, record.message)
            progress.finish(todo[todo_index])
    finished = ItemOutcomes(tally := Tally(input=len(items)), stage.journal, line_bytes)
    write_failures(stage.path / "failures.jsonl", filter(None, map(tally.count, finished.records)))
    if "worker_died" in tally.failed:
        # The cause is the machine, not the item: it must not become a result. The stage stays open.
        raise EnvironmentMissing(
            "worker processes were killed, three times for the same item",
            where=stage.path,
            got=f"{tally.failed['worker_died']} of {len(items)} items without an outcome",
            fix="free some memory or use fewer --workers, then run the same command again: finished items are kept",
        )
    return finished


def _finished_before(stage: StageFolder, items: Sequence[Item]) -> np.ndarray:
    """Return the byte of each item's record in the journal, (n,) int64; -1 where it is not finished."""
    indices = {item.item_id: index for index, item in enumerate(items)}
    assert len(indices) == len(items), "item ids must be unique"
    line_bytes, journal = np.full(len(items), -1), stage.journal
    for record in journal.read_as(read_item):
        if record.id in indices and not isinstance(record, Failed):
            line_bytes[indices[record.id]] = journal.line_byte
    return line_bytes


def _in_this_process(
    items: Sequence[Item], start: Start, on_steps: Callable[[Item, int], None]
) -> Generator[tuple[int, ItemRecord], None, None]:
    work = start() if items else None
    for index, item in enumerate(items):
        assert work is not None
        yield index, attempt(work, item, partial(on_steps, item))


def _in_processes(
    stage: StageFolder, items: Sequence[Item], start: Start, workers: int, watch: Watch, progress: _Progress
) -> Generator[tuple[int, ItemRecord], None, None]:
    start_transport: Callable[[float, int, int], Transport] = LocalTransport
    if watch.ray is not None:
        cluster = Cluster(watch.ray, stage.path)
        start_transport, workers = cluster.start_transport, cluster.room if workers == ALL_ROOM else workers
    with contextlib.closing(EventLog(stage.path)) as events:
        pool = WorkerPool(start, min(workers, len(items)), watch, events, progress.move, start_transport)
        try:
            yield from pool.outcomes(items)
        except CosflyError:
            remove_partials(stage.path)  # on a full disk they hold the space that is needed
            raise
    if pool.num_lost:
        remove_partials(stage.path)  # of the lost workers


class _Progress:
    """The progress of a stage: in steps, as frames, where every item has a number of them, else in items."""

    def __init__(self, items: Sequence[Item], todo: Sequence[Item]) -> None:
        self._in_steps = all(item.num_steps for item in items)
        self._total = sum(map(self._size, items))
        self._done = self._total - sum(map(self._size, todo))
        self._current: dict[str, int] = {}  # of `done`, by item
        self._advance: Callable[[int], None] = lambda count: None

    def _size(self, item: Item) -> int:
        return item.num_steps or 1 if self._in_steps else 1

    @contextlib.contextmanager
    def shown(self, label: str) -> Iterator[None]:
        with progress_bar(label, total=self._total, done=self._done) as self._advance:
            yield

    def move(self, item: Item, num_steps: int) -> None:
        """Set the number of steps done of an item; fewer than before where it is started again."""
        if self._in_steps:
            count = min(num_steps, self._size(item))
            self._advance(count - self._current.get(item.item_id, 0))
            self._current[item.item_id] = count

    def finish(self, item: Item) -> None:
        self._advance(self._size(item) - self._current.pop(item.item_id, 0))


# --- the processes ----------------------------------------------------------------------------------------------------


class LocalTransport:
    """A process of this machine, which it starts and which runs `work_through`.

    pid: None until it has started. node: The name of its machine in a cluster.
    """

    node: str | None = None

    def __init__(self, heartbeat_s: float, log_level: int, place: int) -> None:
        context = multiprocessing.get_context("spawn")  # fork would copy GL and thread-pool state
        self.connection, there = context.Pipe()
        args = (there, os.getpid(), heartbeat_s, log_level, place)  # few: this process waits until they are read
        self._process = context.Process(target=work_through, args=args, daemon=True)
        resource_tracker.ensure_running()  # else the first worker starts it, and with it ends the holding back
        with signals_held_back():
            self._process.start()
            # A Ctrl-C is raised at the end of this block, a second one may interrupt the code that ends the worker, and
            # the worker ignores the SIGTERM that Python sends at its exit.
            atexit.register(self._process.kill)
        there.close()
        self.pid: int | None = self._process.pid

    def send(self, what: Start | Item | None) -> None:
        """Send it its Start, then items one by one, at last None; may block."""
        self.connection.send(what)

    def receive(self) -> Message:
        """Return its next message; EOFError or OSError when it is gone."""
        return self.connection.recv()

    def look(self) -> Vitals | None:
        """Return its vitals without blocking; None: it is gone."""
        return Vitals.of(self._process.pid or 0) if self._process.is_alive() else None

    def kill(self, patience_s: float) -> None:
        """End it, at once or after the time in which it may end by itself; it is gone or out of reach then."""
        if patience_s:
            self._process.join(patience_s)
        self._process.kill()
        self._process.join()
        atexit.unregister(self._process.kill)


Transport = LocalTransport | RayTransport


# --- the pool ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Attempt:
    item_index: int  # among all items
    item: Item
    number: int = 0


@dataclass(eq=False)
class _Worker:
    """One process, its current item, and the signs of life since the last check."""

    place: int
    transport: Transport
    inbox: queue.SimpleQueue[Item | None] = field(default_factory=queue.SimpleQueue)
    is_known: bool = False  # to the log of events
    attempt: _Attempt | None = None
    num_steps: int = 0
    has_begun: bool = False  # the item; before that, a new worker reads maps and compiles
    begun_s: float = 0.0
    has_reported: bool = False  # since the last check
    cpu_s: float = 0.0  # at the last check
    failed_checks: int = 0
    quiet_s: float = 0.0  # since the item got on

    def assign(self, attempt: _Attempt) -> None:
        self.attempt, self.num_steps, self.has_begun = attempt, 0, False
        self.has_reported, self.failed_checks, self.quiet_s = True, 0, 0.0
        self.inbox.put(attempt.item)

    @property
    def about(self) -> dict[str, object]:
        return {"worker": self.place, "node": self.transport.node, "pid": self.transport.pid}


@dataclass
class WorkerPool:
    """Does items in `num_workers` processes; on_steps(item, n) is called with the steps done of a current item."""

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
    _alone: deque[_Attempt] = field(default_factory=deque)  # last attempts
    _workers: dict[int, _Worker] = field(default_factory=dict)
    _lost: set[int] = field(default_factory=set)  # places that wait for a new worker
    _messages: queue.SimpleQueue[tuple[_Worker, Message | None]] = field(default_factory=queue.SimpleQueue)

    def outcomes(self, items: Sequence[Item]) -> Iterator[tuple[int, ItemRecord]]:
        """Yield the index and the record of each item as it is done."""
        self.events.write("began", workers=self.num_workers)
        self._todo.extend(_Attempt(index, item) for index, item in enumerate(items))
        next_check_s, next_probe_s = time.monotonic() + self.watch.check_s, time.monotonic()
        patience_s = 0.0
        try:
            while self._todo or self._alone or self._busy():
                self._hand_out()
                yield from self._handle_message(min(next_check_s, next_probe_s))
                if (now_s := time.monotonic()) >= next_probe_s:
                    next_probe_s = now_s + self.watch.probe_s
                    seen = {w.place: w.transport.look() for w in self._workers.values() if w.transport.pid}
                    self.events.probe({place: vitals for place, vitals in seen.items() if vitals})
                if now_s >= next_check_s:
                    next_check_s = now_s + self.watch.check_s
                    yield from self._check()
            patience_s = PATIENCE_S
        finally:
            if workers := list(self._workers.values()):
                with ThreadPoolExecutor(len(workers)) as at_once:
                    list(at_once.map(lambda worker: self._stop(worker, patience_s), workers))
        self.events.write("ended")

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers.values() if worker.attempt is not None]

    def _hand_out(self) -> None:
        """Assign an item to every free worker, and start missing workers."""
        for place in range(self.num_workers):
            worker = self._workers.get(place) or (self._start(place) if self._is_short() else None)
            if worker is None or worker.attempt is not None or worker.transport.pid is None:
                continue
            if not worker.is_known:
                worker.is_known = True
                self.events.write("restarted" if place in self._lost else "worker_started", **worker.about)
                self._lost.discard(place)
            if (attempt := self._next_attempt(place)) is not None:
                worker.assign(attempt)

    def _is_short(self) -> bool:
        """Return whether there is more to do now than workers without an item, including those that still start."""
        num_idle = len(self._workers) - len(self._busy())
        return num_idle < (len(self._todo) or int(bool(self._alone) and not self._busy()))

    def _next_attempt(self, place: int) -> _Attempt | None:
        """Return the next attempt for a place. A last attempt runs alone: there may not be the memory for two."""
        if self._todo:
            return self._todo.popleft()
        if self._alone and not self._busy():
            for worker in [worker for worker in self._workers.values() if worker.place != place]:
                self._stop(worker, PATIENCE_S)
            return self._alone.popleft()
        return None

    def _start(self, place: int) -> _Worker:
        transport = self.start_transport(self.watch.heartbeat_s, logging.getLogger().level, place)
        worker = self._workers[place] = _Worker(place, transport)
        threading.Thread(target=_attend, args=(worker, self.start, self._messages), daemon=True).start()
        return worker

    def _handle_message(self, until_s: float) -> Iterator[tuple[int, ItemRecord]]:
        """Wait for a message, at most until a time, and handle it."""
        try:
            worker, message = self._messages.get(timeout=max(0.0, until_s - time.monotonic()))
        except queue.Empty:
            return
        if self._workers.get(worker.place) is not worker:  # it was given up
            return
        attempt = worker.attempt
        if message is None:
            yield from self._lose(worker, "worker_died")
        elif isinstance(message, Exception):
            node = worker.transport.node
            if node is not None and isinstance(message, CosflyError):
                message.where = f"node {node}" if message.where is None else f"node {node}: {message.where}"
            raise message
        elif isinstance(message, logging.LogRecord):
            logging.getLogger(message.name).handle(message)
        elif attempt is None or (isinstance(message, Sign) and message.item_id != attempt.item.item_id):
            return
        elif isinstance(message, Sign):
            if not worker.has_begun:
                worker.has_begun, worker.begun_s, worker.quiet_s = True, time.monotonic(), 0.0
            elif message.num_steps != worker.num_steps:
                worker.num_steps, worker.quiet_s = message.num_steps, 0.0
                self.on_steps(attempt.item, message.num_steps)
        else:
            seconds = time.monotonic() - worker.begun_s
            self._seconds.append(seconds)
            self._num_done += 1
            worker.attempt = None
            about = {"status": message.status, "seconds": round(seconds, 3), "steps": worker.num_steps}
            self.events.write("item_done", worker=worker.place, item=message.id, **about)
            yield attempt.item_index, message

    def _check(self) -> Iterator[tuple[int, ItemRecord]]:
        """Look for workers that neither report nor compute, and for items that do not get on.

        Time is counted in checks here: while this process itself was stopped, no worker could report.
        """
        for worker in self._busy():
            seen = worker.transport.look()
            cpu_s = worker.cpu_s if seen is None else seen.cpu_s
            lives = worker.has_reported or cpu_s != worker.cpu_s
            worker.failed_checks = 0 if lives else worker.failed_checks + 1
            worker.has_reported, worker.cpu_s = False, cpu_s
            worker.quiet_s += self.watch.check_s
            if seen is None:
                yield from self._lose(worker, "worker_died")
            elif worker.failed_checks >= self.watch.failed_checks:
                yield from self._lose(worker, "heartbeat_lost")
            elif worker.quiet_s > self._limit_s(worker):
                yield from self._lose(worker, "timed_out")

    def _limit_s(self, worker: _Worker) -> float:
        """Return how long an item may report no step; a limit that was set is not meant for reading and compiling."""
        limit_s = self.watch.item_limit_s
        if limit_s == 0 or worker.attempt is None:
            return math.inf
        if limit_s is not None and worker.has_begun:
            return limit_s
        typical_s = statistics.median(self._seconds) if self._seconds else 0.0
        return max(LEAST_LIMIT_S, TYPICAL_ITEMS * typical_s, limit_s or 0.0) * 2**worker.attempt.number

    def _lose(self, worker: _Worker, loss: Loss) -> Iterator[tuple[int, ItemRecord]]:
        """End a worker that is of no use any more; its item is tried again, or has failed."""
        self._stop(worker, 0.0)
        self._lost.add(worker.place)
        self.num_lost += 1
        attempt, about = worker.attempt, worker.about
        if attempt is not None:
            seconds = round(time.monotonic() - worker.begun_s, 3) if worker.has_begun else 0.0
            about |= {"item": attempt.item.item_id, "seconds": seconds, "steps": worker.num_steps}
            self.on_steps(attempt.item, 0)
        self.events.write(loss, **about)
        if self.num_lost > self.watch.restarts + self._num_done:
            raise EnvironmentMissing(
                "workers die or stall all the time",
                where=None if attempt is None else attempt.item.item_id,
                got=f"{self.num_lost} lost, {self._num_done} items done; the last: {LOSSES[loss]}",
                fix="see events.jsonl; free some memory, use fewer --workers or raise item_limit_s, then run the same "
                "command again: finished items are kept",
            )
        if attempt is None:
            return
        name, tries = attempt.item.item_id, attempt.number + 1
        if tries <= self.watch.retries:
            log.warning("%s: %s; it is tried again", name, LOSSES[loss])
            (self._alone if tries == self.watch.retries else self._todo).append(replace(attempt, number=tries))
            self.events.write("retried", item=name, attempt=tries)
        else:
            self.events.write("given_up", item=name)
            code, message = "worker_died" if loss == "worker_died" else "timed_out", f"{LOSSES[loss]}, {tries} times"
            yield attempt.item_index, Failed(id=name, code=code, message=f"{name}: {message}")

    def _stop(self, worker: _Worker, patience_s: float) -> None:
        """End a worker, at once or after the time in which it may end by itself."""
        del self._workers[worker.place]
        worker.inbox.put(None)
        worker.transport.kill(patience_s)


def _attend(worker: _Worker, start: Start, messages: queue.SimpleQueue) -> None:
    """Carry items to a worker and its messages to the pool, until either is done; None in `messages`: it is gone."""
    transport = worker.transport
    try:
        transport.send(start)
        messages.put((worker, Sign(None, 0)))  # it may be given an item
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
