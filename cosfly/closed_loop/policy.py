"""A policy of the user in the closed loop: `module:Class`, whose code runs in its own process.

The class has `reset(goal, seed)` and `act(observation)`, which returns a decision (its number or token) or five numbers
as ACTION. Its errors are recorded as its answers, and the episode goes on.
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

from cosfly.closed_loop.engines import EngineDecision, Observation
from cosfly.closed_loop.stepper import ClosedLoopTrajectory, Moment
from cosfly.formats.captions import TOKENS
from cosfly.formats.episodes import MOST_WORDS, Answer
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.goals import SLOTS, words_of
from cosfly.geometry.motion import in_axes_of
from cosfly.runtime.errors import InputError
from cosfly.runtime.worker import end_with_parent

START_LIMIT_S = 300.0  # a policy may load a model
MOST_REPLY_BYTES = 65_536
END_S = 5.0  # for a process that closed its connection
MOST_LATE = 3  # late answers in a row that end its process for this episode

STATE = ("forward_mps", "left_mps", "up_mps", "height_m", "yaw_deg", "gimbal_pitch_deg", "time_s")
STATE_LOW = np.array([-40, -40, -40, -100, -180, -90, 0], dtype=np.float32)
STATE_HIGH = np.array([40, 40, 40, 1000, 180, 90, 3600], dtype=np.float32)


def observe(simulation: ClosedLoopTrajectory, now: Moment, *, depth: bool = False) -> dict[str, Any]:
    """Return the observation of a policy, which contains only what a real drone has.

    rgb (h, w, 3) uint8; state (7,) float32 as STATE; depth (h, w) float32 m; goal: all clothes of the target, of
    which a hard distractor shares all but one.
    """
    ground_m = float(simulation.airspace.ground.height_at(now.position_m[None])[0])
    pitch_deg, yaw_deg, _ = now.rotation_deg
    height_m = float(now.position_m[2]) - ground_m
    velocity_mps = in_axes_of(float(yaw_deg), now.velocity_mps)
    state = np.array([*velocity_mps, height_m, wrap_deg(yaw_deg), pitch_deg, now.time_s], dtype=np.float32)
    goal = words_of(("figure", *SLOTS), simulation.script.clothes.looks)["en"]
    seen = {"rgb": now.frame.rgb, "state": np.clip(state, STATE_LOW, STATE_HIGH), "goal": goal}
    return seen | {"depth": now.frame.depth} if depth else seen


class Policy:
    """The process of a policy, a decision engine that flies one episode after the other."""

    num_frames = 1

    def __init__(self, spec: str, limit_s: float, seed: int) -> None:
        """Start the process of `spec`, a module:Class that is importable from the working directory."""
        self.name = spec
        self._limit_s = limit_s
        self._seed = seed
        self._episode = ""
        self._process: subprocess.Popen | None = None
        self._failure: EngineDecision | None = None
        self._start()

    def _start(self) -> None:
        self.close()
        self._connection, remote = Pipe()
        program = f"from cosfly.closed_loop.policy import serve; serve({remote.fileno()}, {os.getpid()}, {self.name!r})"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program], pass_fds=(remote.fileno(),), stdin=subprocess.DEVNULL, stdout=2,
            start_new_session=True,
        )  # fmt: skip
        remote.close()
        self._num_late = 0
        self._awaits_reply = True
        answer, message = self._ask(None, START_LIMIT_S)
        if answer != "ok":
            raise InputError(
                "the policy cannot be created",
                where="--policy",
                got=f"{self.name}: {message}",
                expected="an importable module:Class with the methods reset(goal, seed) and act(observation)",
            )

    def close(self) -> int | None:
        """End the process and its children; return its exit status."""
        if (process := self._process) is None:
            return None
        self._process = None
        self._connection.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        return process.wait()

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        """Ask about one episode after the other."""
        return [self._decide(observation) for observation in observations]

    def _decide(self, observation: Observation) -> EngineDecision:
        begun_s = time.monotonic()
        seen = observe(observation.simulation, observation.moments[-1], depth=True)
        if observation.episode != self._episode:
            self._episode = observation.episode
            self._failure = None
            self._num_late = 0
            try:
                if self._process is None or self._awaits_reply:
                    self._start()
                answer, message = self._ask(("reset", seen["goal"], self._seed), self._limit_s)
            except InputError as error:  # although it could be created before
                answer, message = "none", str(error)
            if answer != "ok":
                self._failure = EngineDecision("late" if answer == "late" else "none", words=message[:MOST_WORDS])
        if self._failure is not None:
            return self._failure
        answer, value = self._ask(("act", seen), self._limit_s)
        answer_s = time.monotonic() - begun_s
        if answer != "ok":
            return EngineDecision(answer, words=str(value)[:MOST_WORDS], answer_s=answer_s)
        if isinstance(value, int) and 0 <= value < len(TOKENS):
            value = TOKENS[value]
        if isinstance(value, str) and value in TOKENS:
            return EngineDecision("ok", value, answer_s=answer_s)
        if isinstance(value, list):
            command = np.array(value)
            drone = observation.simulation.drone
            low, high = drone.bounds
            if command.shape == low.shape and (command >= low).all() and (command <= high).all():
                return EngineDecision("ok", answer_s=answer_s, command=drone.within_speed(command))
        return EngineDecision("invalid", words=repr(value)[:MOST_WORDS], answer_s=answer_s)

    def _ask(self, call: tuple | None, limit_s: float) -> tuple[Answer, Any]:
        """Return the reply to a call, or, with call None, the first message of the process."""
        until_s = time.monotonic() + limit_s
        reply = None
        try:
            if self._awaits_reply:  # it may still work on the previous call
                reply = self._receive(until_s)
            if call is not None and not self._awaits_reply:
                self._awaits_reply = True
                self._connection.send(call)
                reply = self._receive(until_s)
        except (EOFError, OSError):
            assert self._process is not None
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)  # for its own exit status
            reply = "none", f"its process ended with status {self.close()}"
        except (ValueError, TypeError, RecursionError):  # for instance if a forked child writes to the connection
            self.close()
            reply = "none", "its process sent an invalid message"
        self._num_late = self._num_late + 1 if reply is None else 0
        answer, value = reply or ("late", f"no answer in {limit_s:g} s")
        if self._process is None or self._num_late >= MOST_LATE:
            self._failure = EngineDecision(answer, words=f"not asked any more: {value}")
            self.close()
        return answer, value

    def _receive(self, until_s: float) -> tuple[Answer, Any] | None:
        if not self._connection.poll(max(until_s - time.monotonic(), 0.0)):
            return None
        self._awaits_reply = False
        answer, value = json.loads(self._connection.recv_bytes(MOST_REPLY_BYTES))
        numbers = value if isinstance(value, list) else []
        if answer not in ("ok", "unreadable", "none") or not all(isinstance(number, int | float) for number in numbers):
            raise ValueError(f"the policy process sent an unknown reply: {answer!r}")
        return answer, value


def serve(fd: int, parent_pid: int, spec: str) -> None:
    """Run a policy in this process: create it, and answer calls until the connection closes."""
    end_with_parent(parent_pid)
    connection = Connection(fd)

    def send(answer: str, value: Any = "") -> None:
        connection.send_bytes(json.dumps([answer, value]).encode())

    def failed(error: Exception) -> tuple[str, str]:
        return "none", f"{type(error).__name__}: {error}"[:MOST_WORDS]

    try:
        module, _, name = spec.partition(":")
        policy = getattr(importlib.import_module(module), name)()
        calls: dict[str, Callable[..., Any]] = {"reset": policy.reset, "act": policy.act}
    except Exception as error:
        send(*failed(error))
        return
    send("ok")
    while True:
        try:
            name, *arguments = connection.recv()
        except EOFError:
            return
        try:
            value = calls[name](*arguments)
            reply = _plain(value) if name == "act" else ("ok", "")
        except Exception as error:
            reply = failed(error)
        send(*reply)


def _plain(value: Any) -> tuple[str, Any]:
    """Return a decision's number or token, or a list of numbers; anything else is unreadable."""
    if isinstance(value, str):
        return "ok", value[:MOST_WORDS]
    numbers = np.asarray(value)
    if numbers.ndim == 0 and np.issubdtype(numbers.dtype, np.integer):
        return "ok", int(numbers)
    if numbers.ndim == 1 and numbers.size <= 64 and numbers.dtype.kind in "iuf":
        return "ok", numbers.astype(np.float64).tolist()
    return "unreadable", repr(value)[:MOST_WORDS]
