"""A policy of somebody else in the closed loop: `module:Class`, whose code runs in a process of its own.

The class has `reset(goal, seed)` and `act(observation)`, which gives a decision (its number or token) or five numbers
as ACTION. What it does wrong is its own failure: it is told as its answer, and the flight goes on.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from cosfly.closed_loop.pilots import Outlook, PilotAnswer
from cosfly.envs.follow import observe
from cosfly.errors import InputError
from cosfly.products.actions import shipped_actions
from cosfly.products.pursuits import MOST_WORDS

START_LIMIT_S = 300.0  # a policy may read a model first
MOST_LATE = 3  # answers in a row: then its process ends, and it is not asked again in this episode


class Policy:
    """The process of a policy, as a pilot (cosfly/closed_loop/pilots.py) that flies one episode after the other."""

    num_frames = 1

    def __init__(self, spec: str, limit_s: float, seed: int, goal_of: Callable[[str], str]) -> None:
        """
        Args:
            spec: module:Class, found from the working directory. goal_of: the goal of an episode.
        Raises:
            InputError: it cannot be imported or made.
        """
        self.name, self._limit_s, self._seed, self._goal_of = spec, limit_s, seed, goal_of
        self._tokens, self._episode = shipped_actions().tokens, ""
        self._process: subprocess.Popen | None = None
        self._failure: PilotAnswer | None = None
        self._start()

    def _start(self) -> None:
        self.close()
        self._connection, there = Pipe()
        program = f"from cosfly.envs.policy import serve; serve({there.fileno()}, {self.name!r})"
        command, fds = [sys.executable, "-c", program], (there.fileno(),)
        self._process = subprocess.Popen(command, pass_fds=fds, stdin=subprocess.DEVNULL, start_new_session=True)
        there.close()
        self._num_late, self._awaits = 0, False
        answer, words = self._receive(START_LIMIT_S)
        if answer != "ok":
            expected = "module:Class with reset(goal, seed) and act(observation), importable from here"
            got = f"{self.name}: {words}"
            raise InputError("a policy that cannot be made", where="--policy", got=got, expected=expected)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._connection.close()
            self._process = None

    def decide(self, outlooks: Sequence[Outlook]) -> list[PilotAnswer]:
        """Give what it answers."""
        return [self._decide(outlook) for outlook in outlooks]

    def _decide(self, outlook: Outlook) -> PilotAnswer:
        goal, begun_s = self._goal_of(outlook.episode), time.monotonic()
        if outlook.episode != self._episode:
            self._episode, self._failure, self._num_late = outlook.episode, None, 0
            try:
                if self._process is None or self._awaits:
                    self._start()
                answer, words = self._ask("reset", goal, self._seed)
            except InputError as error:  # it could be made before
                answer, words = "none", str(error)
            if answer != "ok":
                self._failure = PilotAnswer("late" if answer == "late" else "none", words=words[:MOST_WORDS])
        if self._failure is not None:
            return self._failure
        answer, said = self._ask("act", observe(outlook.flight, outlook.moments[-1], goal, depth=True))
        answer_s = time.monotonic() - begun_s
        if answer != "ok":
            return PilotAnswer(answer, words=str(said)[:MOST_WORDS], answer_s=answer_s)
        return self._read(said, outlook, answer_s)

    def _read(self, said: Any, outlook: Outlook, answer_s: float) -> PilotAnswer:
        if isinstance(said, int) and 0 <= said < len(self._tokens):
            said = self._tokens[said]
        if isinstance(said, str):
            if said in self._tokens:
                return PilotAnswer("ok", said, answer_s=answer_s)
        elif isinstance(said, list):
            command, drone = np.array(said), outlook.flight.drone
            low, high = drone.bounds
            if command.shape == low.shape and (command >= low).all() and (command <= high).all():
                return PilotAnswer("ok", answer_s=answer_s, command=drone.within_speed(command))
        return PilotAnswer("invalid", words=repr(said)[:MOST_WORDS], answer_s=answer_s)

    def _ask(self, *call: Any) -> tuple[Any, Any]:
        """Give what it answers; of one that still thinks about an earlier question, that it is late."""
        until_s = time.monotonic() + self._limit_s
        while self._awaits:
            answer, words = self._receive(until_s - time.monotonic())
            if answer in ("late", "none") and self._awaits:
                return self._failed(answer, words)
        try:
            self._connection.send(call)
        except OSError:
            return self._failed("none", self._end())
        self._awaits = True
        answer, words = self._receive(until_s - time.monotonic())
        return self._failed(answer, words) if self._awaits else (answer, words)

    def _receive(self, limit_s: float) -> tuple[Any, Any]:
        try:
            if not self._connection.poll(max(limit_s, 0.0)):
                return "late", f"no answer in {self._limit_s:g} s"
            told = self._connection.recv()
        except (EOFError, OSError):
            return "none", self._end()
        self._awaits, self._num_late = False, 0
        return told

    def _end(self) -> str:
        assert self._process is not None
        return f"its process ended with {self._process.wait()}"

    def _failed(self, answer: str, words: str) -> tuple[str, str]:
        """Note a failure without an answer; after the last that is borne its process ends."""
        self._num_late += 1
        if answer == "none" or self._num_late >= MOST_LATE:
            self._failure = PilotAnswer("late" if answer == "late" else "none", words=f"not asked any more: {words}")
            self.close()
        return answer, words


def serve(fd: int, spec: str) -> None:
    """Be the process of a policy: make it, and answer until nobody asks."""
    connection, parent = Connection(fd), os.getppid()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    try:
        module, _, name = spec.partition(":")
        policy = getattr(importlib.import_module(module), name)()
        calls: dict[str, Callable[..., Any]] = {"reset": policy.reset, "act": policy.act}
    except Exception as error:
        connection.send(("none", f"{type(error).__name__}: {error}"[:MOST_WORDS]))
        return
    connection.send(("ok", ""))
    while True:
        try:
            name, *given = connection.recv()
        except EOFError:
            return
        try:
            said = calls[name](*given)
            told = _plain(said) if name == "act" else ("ok", "")
        except Exception as error:
            told = "none", f"{type(error).__name__}: {error}"[:MOST_WORDS]
        connection.send(told)


def _plain(said: Any) -> tuple[str, Any]:
    """Give a decision's number or token, or a list of numbers; of all else that it cannot be read."""
    if isinstance(said, str):
        return "ok", said[:MOST_WORDS]
    numbers = np.asarray(said)
    if numbers.ndim == 0 and np.issubdtype(numbers.dtype, np.integer):
        return "ok", int(numbers)
    if numbers.ndim == 1 and numbers.size <= 64 and np.issubdtype(numbers.dtype, np.number):
        return "ok", numbers.astype(np.float64).tolist()
    return "unreadable", repr(said)[:MOST_WORDS]


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
