"""A worker process: works on the items that it receives through a pipe, and ends with its parent.

`pool` is at the other end of the pipe.
"""

import atexit
import contextlib
import ctypes
import logging
import logging.handlers
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from cosfly.runtime.console import set_levels
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.events import Vitals
from cosfly.runtime.run_dir import Dropped, Failed, ItemRecord, Kept

log = logging.getLogger(__name__)

LEFT_TO_THE_PARENT = frozenset({signal.SIGINT, signal.SIGTERM})  # the parent ends its workers and reports the signal
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # options of prctl(2)
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3) in glibc
GREATEST_KEPT_BYTES = 32 << 20  # freed arrays up to this size are kept for reuse; glibc accepts no more
MOST_KEPT_BYTES = 64 << 20  # of all freed arrays together


# --- items ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Item:
    """One unit of work."""

    item_id: str  # unique within the stage and stable between runs
    payload: Any = None
    num_steps: int | None = None  # steps, such as frames, that the work reports with `advance`; None if unknown


@dataclass(frozen=True)
class Outcome:
    """The outcome of an item that did not fail."""

    result: dict = field(default_factory=dict)  # JSON-able
    drop_reason: str | None = None  # None for a kept item


Work = Callable[[Item], Outcome]
Start = Callable[[], Work]  # the first message to a worker: a partial of a module-level function

# The state of this process, which works on one item at a time. `attempt` and `_Sender.begin` set it for each item.
_worker_index = 0
_num_steps = 0  # finished steps of the current item
_on_steps: Callable[[int], None] | None = None  # called with `_num_steps` when it changes


def worker_index() -> int:
    """Return the index of this process among a stage's workers; one that replaces another takes over its index."""
    return _worker_index


def advance(num_steps: int = 1) -> None:
    """Report steps of the current item: they move the progress bar and show that the item makes progress."""
    global _num_steps
    _num_steps += num_steps
    if _on_steps is not None:
        _on_steps(_num_steps)


def attempt(work: Work, item: Item, on_steps: Callable[[int], None] | None = None) -> ItemRecord:
    """Run one item and return its record; only a fatal error is raised.

    on_steps: Called with the number of finished steps whenever the work calls `advance`.
    """
    global _on_steps, _num_steps
    _on_steps = on_steps
    _num_steps = 0
    start_s = time.monotonic()
    try:
        outcome = work(item)
    except CosflyError as error:
        if error.fatal:
            raise
        return Failed(id=item.item_id, code=error.code, message=str(error))
    except Exception as error:  # a bug in one item must not lose the others
        log.error("%s: this item failed because of a bug in cosfly:\n%s", item.item_id, traceback.format_exc())
        return Failed(id=item.item_id, code="bug", message=f"{type(error).__name__}: {error}")
    finally:
        _on_steps = None
    seconds = round(time.monotonic() - start_s, 3)
    if outcome.drop_reason is None:
        return Kept(id=item.item_id, result=outcome.result, seconds=seconds)
    return Dropped(id=item.item_id, result=outcome.result, reason=outcome.drop_reason, seconds=seconds)


# --- messages ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Heartbeat:
    """A sign that the process is alive."""

    item_id: str | None  # None before the first item
    num_steps: int  # finished steps of the item


# An Exception ends the stage: a fatal error, or the worker could not be made.
Message = Heartbeat | Exception | logging.LogRecord | ItemRecord


# --- the process ------------------------------------------------------------------------------------------------------


def work_through(connection: Connection, parent_pid: int, heartbeat_s: float, log_level: int, index: int) -> None:
    """Receive a Start, then work on items until None comes; send records, heartbeats and log lines back."""
    global _worker_index
    end_with_parent(parent_pid)
    for signal_number in LEFT_TO_THE_PARENT:
        signal.signal(signal_number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)
    sender = _Sender(connection)
    logging.getLogger().handlers = [sender]
    set_levels(log_level)
    _worker_index = index
    _keep_freed_memory()
    threading.Thread(target=sender.send_heartbeats, args=(heartbeat_s,), daemon=True).start()
    try:
        start: Start | None = _received(connection)
        work = start() if start else None
        while work and (item := _received(connection)):
            sender.begin(item)
            record = attempt(work, item)
            sender.is_busy = False
            sender.send(Heartbeat(record.id, _num_steps))
            sender.send(record)
    # Errors that end the work are sent: otherwise the pool would report that the process died.
    except Exception as error:
        if not isinstance(error, CosflyError):
            if type(error).__module__ != "builtins":  # many errors of libraries cannot be pickled
                error = RuntimeError(f"a bug in a worker: {type(error).__name__}: {error}")
            error.add_note(traceback.format_exc())  # a traceback cannot be pickled
        sender.send(error)


def _received(connection: Connection) -> Any:
    """Return the next message of the parent; None if there are no more."""
    try:
        return connection.recv()
    except EOFError:
        return None


class _Sender(logging.handlers.QueueHandler):
    """Sends the messages of a worker from any of its threads."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(None)  # type: ignore[arg-type]  # there is no queue: `enqueue` sends
        self._connection = connection
        self._sending = threading.Lock()
        self._item_id: str | None = None
        self.is_busy = True

    def enqueue(self, record: logging.LogRecord) -> None:
        self.send(record)

    def send(self, message: Message) -> None:
        try:
            with self._sending:
                self._connection.send(message)
        except OSError:
            os._exit(1)  # the parent is gone

    def begin(self, item: Item) -> None:
        global _num_steps
        _num_steps = 0
        self._item_id = item.item_id
        self.is_busy = True
        self.send(Heartbeat(item.item_id, 0))

    def send_heartbeats(self, heartbeat_s: float) -> None:
        while True:
            time.sleep(heartbeat_s)
            if self.is_busy:
                self.send(Heartbeat(self._item_id, _num_steps))


# --- its other end ----------------------------------------------------------------------------------------------------


class LocalTransport:
    """Starts a worker process of this machine, which runs `work_through`, and exchanges messages with it by a pipe.

    `ray_engine.RayTransport` has the same methods for a process on a node of a cluster.
    """

    node: str | None = None  # the name of the process's machine; None: this machine

    def __init__(self, heartbeat_s: float, log_level: int, worker_index: int) -> None:
        context = multiprocessing.get_context("spawn")  # fork would copy GL and thread-pool state
        self.connection, worker_connection = context.Pipe()
        # Few and small arguments: this process waits until the new one has read them.
        args = (worker_connection, os.getpid(), heartbeat_s, log_level, worker_index)
        self._process = context.Process(target=work_through, args=args, daemon=True)
        # Otherwise the first worker starts the tracker, which unblocks the signals that are held back below.
        resource_tracker.ensure_running()
        with signals_held_back():
            self._process.start()
            # A Ctrl-C is raised at the end of this block, and a second one may interrupt the code that ends the worker.
            # The worker ignores the SIGTERM that Python sends at its exit.
            atexit.register(self._process.kill)
        worker_connection.close()
        self.pid: int | None = self._process.pid  # None until it has started

    def send(self, message: Start | Item | None) -> None:
        """Send a message: first the Start, then one item at a time, finally None. May block."""
        self.connection.send(message)

    def receive(self) -> Message:
        """Return the next message of the process; raises EOFError or OSError if the process is gone."""
        return self.connection.recv()

    def look(self) -> Vitals | None:
        """Return the vitals of the process without blocking; None if it is gone."""
        return Vitals.of(self._process.pid or 0) if self._process.is_alive() else None

    def kill(self, patience_s: float) -> None:
        """End the process and wait until it is gone; it may end by itself within `patience_s`."""
        if patience_s:
            self._process.join(patience_s)
        self._process.kill()
        self._process.join()
        atexit.unregister(self._process.kill)


# --- the system -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM while a process starts, and raise them afterwards.

    The exceptions of their handlers would be lost in the hooks of a fork, or interrupt the imports of the new process,
    which inherits the blocked signals.
    """
    received = list[int]()
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_THE_PARENT)
    # Another thread may still receive the signal; Python then runs the handler in the main thread.
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        current = {number: signal.getsignal(number) for number in LEFT_TO_THE_PARENT}
        handlers = {number: handler for number, handler in current.items() if callable(handler)}
    try:
        for number in handlers:
            signal.signal(number, lambda number, _: received.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
        for received_number in received:
            signal.raise_signal(received_number)


def _keep_freed_memory() -> None:
    """Let glibc keep freed arrays for reuse: those of a frame have megabytes, and pages of the system are cleared."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, GREATEST_KEPT_BYTES)
        mallopt(TRIM_THRESHOLD, MOST_KEPT_BYTES)


def return_freed_memory() -> None:
    """Return all freed memory to the system: glibc keeps the gaps between pieces that are still in use."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def end_with_parent(parent_pid: int) -> None:
    """Ensure that Linux kills this process when its parent ends; on other systems the closed pipe ends a worker."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent_pid:  # the parent died before the call
            os._exit(1)


def adopt_orphans() -> None:
    """Make this process the parent of processes that its workers leave behind, so that it can find them."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
