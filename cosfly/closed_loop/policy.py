"""A policy of somebody else in the closed loop: `module:Class`, whose code runs in a process of its own.

The class has `reset(goal, seed)` and `act(observation)`, which gives a decision (its number or token) or five numbers
as ACTION. What it does wrong is its own failure: it is told as its answer, and the flight goes on.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from cosfly.closed_loop.pilots import Outlook, PilotAnswer
from cosfly.closed_loop.stepper import ClosedLoopTrajectory, Moment
from cosfly.formats.captions import TOKENS
from cosfly.formats.pursuits import MOST_WORDS, Answer
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.goals import SLOTS, words_of
from cosfly.geometry.motion import in_axes_of
from cosfly.runtime.errors import InputError
from cosfly.runtime.worker import end_with_parent

START_LIMIT_S = 300.0  # a policy may read a model first
MOST_REPLY_BYTES = 65_536
END_S = 5.0  # for a process that has hung up to end
MOST_LATE = 3  # answers in a row: then its process ends, and it is not asked again in this episode

STATE = ("forward_mps", "left_mps", "up_mps", "height_m", "yaw_deg", "gimbal_pitch_deg", "time_s")
STATE_LOW = np.array([-40, -40, -40, -100, -180, -90, 0], dtype=np.float32)
STATE_HIGH = np.array([40, 40, 40, 1000, 180, 90, 3600], dtype=np.float32)


def observe(flight: ClosedLoopTrajectory, now: Moment, *, depth: bool = False) -> dict[str, Any]:
    """Return what a policy sees, which is what a real drone has, and no more: rgb (h, w, 3) uint8, state (7,)
    float32 as
    STATE, depth (h, w) float32 m, and goal: all that the person wears, which a look-alike does but for one thing."""
    ground_m = float(flight.airspace.ground.height_at(now.position_m[None])[0])
    pitch_deg, yaw_deg, _ = now.rotation_deg
    height_m, velocity = float(now.position_m[2]) - ground_m, in_axes_of(float(yaw_deg), now.velocity_mps)
    state = np.array([*velocity, height_m, wrap_deg(yaw_deg), pitch_deg, now.time_s], dtype=np.float32)
    goal = words_of(("figure", *SLOTS), flight.script.clothes.looks)["en"]
    seen = {"rgb": now.frame.rgb, "state": np.clip(state, STATE_LOW, STATE_HIGH), "goal": goal}
    return seen | {"depth": now.frame.depth} if depth else seen


class Policy:
    """The process of a policy, as a pilot (pilots.py) that flies one episode after the other."""

    num_frames = 1

    def __init__(self, spec: str, limit_s: float, seed: int) -> None:
        """
        Args:
            spec: module:Class, found from the working directory.
        """
        self.name, self._limit_s, self._seed = spec, limit_s, seed
        self._episode = ""
        self._process: subprocess.Popen | None = None
        self._failure: PilotAnswer | None = None
        self._start()

    def _start(self) -> None:
        self.close()
        self._connection, there = Pipe()
        program = f"from cosfly.closed_loop.policy import serve; serve({there.fileno()}, {os.getpid()}, {self.name!r})"
        command, fds = [sys.executable, "-c", program], (there.fileno(),)
        self._process = subprocess.Popen(
            command, pass_fds=fds, stdin=subprocess.DEVNULL, stdout=2, start_new_session=True
        )
        there.close()
        self._num_late, self._awaits = 0, True
        answer, words = self._ask(None, START_LIMIT_S)
        if answer != "ok":
            expected = "module:Class with reset(goal, seed) and act(observation), importable from here"
            got = f"{self.name}: {words}"
            raise InputError("a policy that cannot be made", where="--policy", got=got, expected=expected)

    def close(self) -> int | None:
        """End the process, and those that it started; gives its status."""
        if (process := self._process) is None:
            return None
        self._process = None
        self._connection.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        return process.wait()

    def decide(self, outlooks: Sequence[Outlook]) -> list[PilotAnswer]:
        """Return what it answers."""
        return [self._decide(outlook) for outlook in outlooks]

    def _decide(self, outlook: Outlook) -> PilotAnswer:
        begun_s, seen = time.monotonic(), observe(outlook.flight, outlook.moments[-1], depth=True)
        if outlook.episode != self._episode:
            self._episode, self._failure, self._num_late = outlook.episode, None, 0
            try:
                if self._process is None or self._awaits:
                    self._start()
                answer, words = self._ask(("reset", seen["goal"], self._seed), self._limit_s)
            except InputError as error:  # it could be made before
                answer, words = "none", str(error)
            if answer != "ok":
                self._failure = PilotAnswer("late" if answer == "late" else "none", words=words[:MOST_WORDS])
        if self._failure is not None:
            return self._failure
        answer, said = self._ask(("act", seen), self._limit_s)
        answer_s = time.monotonic() - begun_s
        if answer != "ok":
            return PilotAnswer(answer, words=str(said)[:MOST_WORDS], answer_s=answer_s)
        return self._read(said, outlook, answer_s)

    def _read(self, said: Any, outlook: Outlook, answer_s: float) -> PilotAnswer:
        if isinstance(said, int) and 0 <= said < len(TOKENS):
            said = TOKENS[said]
        if isinstance(said, str):
            if said in TOKENS:
                return PilotAnswer("ok", said, answer_s=answer_s)
        elif isinstance(said, list):
            command, drone = np.array(said), outlook.flight.drone
            low, high = drone.bounds
            if command.shape == low.shape and (command >= low).all() and (command <= high).all():
                return PilotAnswer("ok", answer_s=answer_s, command=drone.within_speed(command))
        return PilotAnswer("invalid", words=repr(said)[:MOST_WORDS], answer_s=answer_s)

    def _ask(self, call: tuple | None, limit_s: float) -> tuple[Answer, Any]:
        """Return what it answers; call None: what it says once it is made."""
        until_s, told = time.monotonic() + limit_s, None
        try:
            if self._awaits:  # it may still think about what it was asked before
                told = self._receive(until_s)
            if call is not None and not self._awaits:
                self._awaits = True
                self._connection.send(call)
                told = self._receive(until_s)
        except (EOFError, OSError):
            assert self._process is not None
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)  # of its own, so that its status is
            told = "none", f"its process ended with {self.close()}"
        except (ValueError, TypeError, RecursionError):  # as where a process that it forked writes there, too
            self.close()
            told = "none", "what came from it is no answer"
        self._num_late = self._num_late + 1 if told is None else 0
        answer, said = told or ("late", f"no answer in {limit_s:g} s")
        if self._process is None or self._num_late >= MOST_LATE:
            self._failure = PilotAnswer(answer, words=f"not asked any more: {said}")
            self.close()
        return answer, said

    def _receive(self, until_s: float) -> tuple[Answer, Any] | None:
        if not self._connection.poll(max(until_s - time.monotonic(), 0.0)):
            return None
        self._awaits = False
        answer, said = json.loads(self._connection.recv_bytes(MOST_REPLY_BYTES))
        numbers = said if isinstance(said, list) else []
        if answer not in ("ok", "unreadable", "none") or not all(isinstance(one, int | float) for one in numbers):
            raise ValueError(answer)
        return answer, said


def serve(fd: int, parent_pid: int, spec: str) -> None:
    """Be the process of a policy: make it, and answer until nobody asks."""
    end_with_parent(parent_pid)
    connection = Connection(fd)

    def tell(answer: str, said: Any = "") -> None:
        connection.send_bytes(json.dumps([answer, said]).encode())

    try:
        module, _, name = spec.partition(":")
        policy = getattr(importlib.import_module(module), name)()
        calls: dict[str, Callable[..., Any]] = {"reset": policy.reset, "act": policy.act}
    except Exception as error:
        tell("none", f"{type(error).__name__}: {error}"[:MOST_WORDS])
        return
    tell("ok")
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
        tell(*told)


def _plain(said: Any) -> tuple[str, Any]:
    """Return a decision's number or token, or a list of numbers; of all else that it cannot be read."""
    if isinstance(said, str):
        return "ok", said[:MOST_WORDS]
    numbers = np.asarray(said)
    if numbers.ndim == 0 and np.issubdtype(numbers.dtype, np.integer):
        return "ok", int(numbers)
    if numbers.ndim == 1 and numbers.size <= 64 and numbers.dtype.kind in "iuf":
        return "ok", numbers.astype(np.float64).tolist()
    return "unreadable", repr(said)[:MOST_WORDS]
