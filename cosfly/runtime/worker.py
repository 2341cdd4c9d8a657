"""A worker process: does the items that come through its pipe, reports progress, and ends when its parent does.

`pool` is the other end of the pipe.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import logging.handlers
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from cosfly.runtime.console import set_levels
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.run_dir import Dropped, Failed, ItemRecord, Kept

log = logging.getLogger(__name__)

LEFT_TO_THE_PARENT = frozenset({signal.SIGINT, signal.SIGTERM})  # it ends its workers, and alone reports it
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # prctl(2)
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # mallopt(3) of glibc
GREATEST_KEPT_BYTES = 32 << 20  # an array, the most that glibc takes
MOST_KEPT_BYTES = 64 << 20  # together


# --- items ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Item:
    """One unit of work. `item_id` is unique within the stage and stable between runs.

    num_steps: The number of steps, as frames, that the work reports with `advance`; None where it is not known before.
    """

    item_id: str
    payload: Any = None
    num_steps: int | None = None


@dataclass(frozen=True)
class Outcome:
    """The outcome of an item that did not fail: `result` is JSON-able, `drop_reason` is None for a kept item."""

    result: dict = field(default_factory=dict)
    drop_reason: str | None = None


Work = Callable[[Item], Outcome]
Start = Callable[[], Work]  # the first message to a worker: a partial of a module-level function

_place = 0
_on_steps: Callable[[int], None] | None = None
_num_steps = 0


def worker_place() -> int:
    """Return the index of this process among a stage's workers; one that replaces another takes over its index."""
    return _place


def advance(num_steps: int = 1) -> None:
    """Report that the current item is getting on: a heartbeat, and a step of the progress bar."""
    global _num_steps
    _num_steps += num_steps
    if _on_steps is not None:
        _on_steps(_num_steps)


def attempt(work: Work, item: Item, on_steps: Callable[[int], None] | None = None) -> ItemRecord:
    """Run one item and return its record; only a fatal error is raised.

    on_steps: It is called with the number of steps done whenever the item's work calls `advance`.
    """
    global _on_steps, _num_steps
    _on_steps, _num_steps = on_steps, 0
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
    finally:
        _on_steps = None
    seconds = round(time.monotonic() - start_s, 3)
    if outcome.drop_reason is None:
        return Kept(id=item.item_id, result=outcome.result, seconds=seconds)
    return Dropped(id=item.item_id, result=outcome.result, reason=outcome.drop_reason, seconds=seconds)


# --- messages ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sign:
    """A heartbeat: the process lives and has done `num_steps` of its item; item_id None: it has none yet."""

    item_id: str | None
    num_steps: int


# An exception: the stage cannot go on, because of a fatal error or because the worker cannot be made.
Message = Sign | Exception | logging.LogRecord | ItemRecord


# --- the process ------------------------------------------------------------------------------------------------------


def work_through(connection: Connection, parent_pid: int, heartbeat_s: float, log_level: int, place: int) -> None:
    """Receive a Start, then do items until None comes; records, heartbeats and log lines go back through the pipe."""
    global _place
    end_with_parent(parent_pid)
    for number in LEFT_TO_THE_PARENT:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)
    sender = _Sender(connection)
    logging.getLogger().handlers = [sender]
    set_levels(log_level)
    _place = place
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        # A frame's arrays are megabytes each; pages that are freed and asked for again are cleared one by one.
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, GREATEST_KEPT_BYTES)
        mallopt(TRIM_THRESHOLD, MOST_KEPT_BYTES)
    threading.Thread(target=sender.send_heartbeats, args=(heartbeat_s,), daemon=True).start()
    try:
        make: Start | None = _received(connection)
        work = make() if make else None
        while work and (item := _received(connection)):
            sender.begin(item)
            record = attempt(work, item)
            sender.is_busy = False
            sender.send(Sign(record.id, _num_steps))
            sender.send(record)
    # The boundary of the process: an error that ends the work is sent, or the pool would take it for a death.
    except Exception as error:
        if not isinstance(error, CosflyError):
            if type(error).__module__ != "builtins":  # many of those do not cross the pipe; their words do
                error = RuntimeError(f"a bug in a worker: {type(error).__name__}: {error}")
            error.add_note(traceback.format_exc())  # a bug keeps its traceback, which does not cross the pipe
        sender.send(error)


def _received(connection: Connection) -> Any:
    """Return the next message of the parent; None: no more."""
    try:
        return connection.recv()
    except EOFError:
        return None


class _Sender(logging.handlers.QueueHandler):
    """Sends a worker's messages, from whichever thread."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(None)  # type: ignore[arg-type]  # there is no queue: `enqueue` sends
        self._connection, self._sending = connection, threading.Lock()
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
        self._item_id, self.is_busy = item.item_id, True
        self.send(Sign(item.item_id, 0))

    def send_heartbeats(self, heartbeat_s: float) -> None:
        while True:
            time.sleep(heartbeat_s)
            if self.is_busy:
                self.send(Sign(self._item_id, _num_steps))


# --- the system -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM while a process starts, which inherits that: the exceptions that they raise are lost
    in the hooks of a fork, and would hit a worker's imports."""
    came, is_main = list[int](), threading.current_thread() is threading.main_thread()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_THE_PARENT)
    # Another thread may take the signal all the same; its handler runs in the main one, here.
    handlers = {number: signal.getsignal(number) for number in LEFT_TO_THE_PARENT}
    ours = [number for number, handler in handlers.items() if callable(handler)] if is_main else []
    try:
        for number in ours:
            signal.signal(number, lambda one, _: came.append(one))
        yield
    finally:
        for number in ours:
            signal.signal(number, handlers[number])
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for one in came:
            signal.raise_signal(one)


def return_freed_memory() -> None:
    """Return all freed memory to the system: glibc keeps what lies between pieces that are still in use."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def end_with_parent(parent_pid: int) -> None:
    """Make the system kill this process with its parent; on other systems than Linux the pipe reports its end."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent_pid:  # it died before the call
            os._exit(1)


def adopt_orphans() -> None:
    """Make this process the parent of processes that its own workers leave behind, so that it can find them."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
