"""A worker process: does the items that come through its pipe, tells that it lives, and ends when its parent does.

`worker_pool` is the other end of the pipe.
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


LEFT_TO_THE_PARENT = frozenset({signal.SIGINT, signal.SIGTERM})  # it ends its workers, and alone speaks of it
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # prctl(2)
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # mallopt(3) of glibc
GREATEST_KEPT_BYTES = 32 << 20  # an array, the most that glibc takes
MOST_KEPT_BYTES = 64 << 20  # together


@dataclass(frozen=True)
class Sign:
    """The process lives, and so many steps of the item in hand are done; item_id None: it is not at work on one."""

    item_id: str | None
    num_steps: int


@dataclass(frozen=True)
class Abort:
    """The stage cannot go on: a fatal error, or the worker cannot be made."""

    error: Exception


Message = Sign | Abort | logging.LogRecord | ItemRecord


@dataclass(frozen=True)
class WorkerOptions:
    """How a worker works, whatever it makes. Little: a process that starts its worker waits until this is read."""

    parent_pid: int
    heartbeat_s: float
    log_level: int
    place: int = 0


@dataclass(frozen=True)
class Start:
    """The first thing that a worker gets through its pipe; `make_worker` is a module-level function."""

    make_worker: Callable[..., Work]
    worker_args: tuple


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Hold back Ctrl-C and its like while a process starts, which inherits that: what they raise is lost in hooks of a
    fork, and would hit a worker's imports."""
    came, is_main = list[int](), threading.current_thread() is threading.main_thread()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_THE_PARENT)
    # Another thread may take the signal all the same; what is done then is done in the main one, here.
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


def keep_freed_memory() -> None:
    """Let this process keep up to 64 MiB of what it frees, for the next frame: its arrays are megabytes each, and what
    the system gives anew it clears page by page.

    Where another C library allocates, nothing changes.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, GREATEST_KEPT_BYTES)
        mallopt(TRIM_THRESHOLD, MOST_KEPT_BYTES)


def return_freed_memory() -> None:
    """Return the system all that this process has freed: glibc keeps for good what lies between pieces still in use.

    Where another C library allocates, nothing changes.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def work_through(connection: Connection, worker_options: WorkerOptions) -> None:
    """Take a Start, then do items until None comes. Everything that is to be said goes back through the pipe."""
    end_with_parent(worker_options.parent_pid)
    for number in LEFT_TO_THE_PARENT:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)
    voice = _Voice(connection)
    logging.getLogger().handlers = [voice]
    set_levels(worker_options.log_level)
    take_place(worker_options.place)
    keep_freed_memory()
    threading.Thread(target=voice.tell_life, args=(worker_options.heartbeat_s,), daemon=True).start()
    try:
        start: Start | None = _received(connection)
        work = start.make_worker(*start.worker_args) if start else None
        while work and (item := _received(connection)):
            voice.begin(item)
            with counted_steps(voice.count):
                record = attempt(work, item)
            voice.finish(record)
    # The border of the process: what ends the work is told, or the pool would take it for a death.
    except Exception as error:
        if not isinstance(error, CosflyError):
            if type(error).__module__ != "builtins":  # many of those do not cross the pipe; their words do
                error = RuntimeError(f"a bug in a worker: {type(error).__name__}: {error}")
            error.add_note(traceback.format_exc())  # a bug keeps its traceback, which does not cross the pipe
        voice.send(Abort(error))


def _received(connection: Connection) -> Any:
    """Wait for what the parent sends; None: no more."""
    try:
        return connection.recv()
    except EOFError:
        return None


def end_with_parent(parent_pid: int) -> None:
    """Have the system kill this process with its parent; elsewhere than on Linux the pipe tells."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent_pid:  # it died before we asked
            os._exit(1)


def adopt_orphans() -> None:
    """Become the parent of what the processes below this one leave behind, so that it can be found; on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)


class _Voice(logging.handlers.QueueHandler):
    """Sends what a worker has to say, from whichever thread."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(None)  # type: ignore[arg-type]  # there is no queue: `enqueue` sends
        self._connection, self._sending = connection, threading.Lock()
        self._item_id: str | None = None
        self._num_steps, self._is_busy = 0, True

    def enqueue(self, record: logging.LogRecord) -> None:
        self.send(record)

    def send(self, message: Message) -> None:
        try:
            with self._sending:
                self._connection.send(message)
        except OSError:
            os._exit(1)  # the parent is gone

    def begin(self, item: Item) -> None:
        self._item_id, self._num_steps, self._is_busy = item.item_id, 0, True
        self.send(Sign(item.item_id, 0))

    def count(self, num_steps: int) -> None:
        self._num_steps = num_steps

    def finish(self, record: ItemRecord) -> None:
        self._is_busy = False
        self.send(Sign(record.id, self._num_steps))
        self.send(record)

    def tell_life(self, heartbeat_s: float) -> None:
        while True:
            time.sleep(heartbeat_s)
            if self._is_busy:
                self.send(Sign(self._item_id, self._num_steps))
