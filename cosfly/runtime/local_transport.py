"""The transport to a worker process of this machine: a pipe.

`ray_engine.RayTransport` has the same methods for a process on a node of a cluster.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
from multiprocessing import resource_tracker

from cosfly.runtime.events import Vitals
from cosfly.runtime.worker import Item, Message, Start, signals_held_back, work_through


class LocalTransport:
    """Starts a worker process of this machine, which runs `work_through`, and exchanges messages with it.

    pid: The id of the process; None until it has started. node: The name of its machine; None: this machine.
    """

    node: str | None = None

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
        self.pid: int | None = self._process.pid

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
