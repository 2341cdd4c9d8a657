"""The pool of worker processes: hands out items, watches the workers, replaces lost ones and repeats their items.

Everything that can block on a worker (sending an item, receiving a message) happens in one thread per worker, so that
no worker can hold up the stage.
"""

from __future__ import annotations

import logging
import math
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from cosfly.runtime.errors import CosflyError, EnvironmentMissing
from cosfly.runtime.events import LOSSES, EventLog, Loss
from cosfly.runtime.ray_engine import RayConfig, RayTransport
from cosfly.runtime.run_dir import Failed, ItemRecord
from cosfly.runtime.worker import Heartbeat, Item, LocalTransport, Message, Start

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
    """The place of the workers, and the time limits after which one has stalled: the paper's (sec:dataset_watchdog).

    ray: The Ray cluster; None runs the workers on this machine.
    item_limit_s: The longest time in which an item may report no step; 0 disables the limit. None sets it to ten
        minutes or 20 times the median duration of an item, whichever is longer, and doubles it with each attempt.
    """

    ray: RayConfig | None = None
    item_limit_s: float | None = None
    heartbeat_s: float = 2.0
    check_s: float = 5.0
    probe_s: float = 1.5
    failed_checks: int = 3  # consecutive checks with neither a heartbeat nor processor time until a worker is lost
    retries: int = 2  # of one item
    restarts: int = 20  # lost workers, in addition to one per finished item, until the stage stops


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
            raise EnvironmentMissing(
                "too many worker processes died or stalled",
                where=None if attempt is None else attempt.item.item_id,
                got=f"{self.num_lost} workers lost, {self._num_done} items done; in the last loss, {LOSSES[loss]}",
                fix=f"see events.jsonl; free some memory, use fewer --workers or raise item_limit_s, {RUN_AGAIN}",
            )
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
