"""A policy of the user in the closed loop: `module:Class`, whose code runs in the worker that flies the episodes.

The class has `reset(goal, seed)` and `act(observation)`, which returns a decision (its number or token) or five numbers
as ACTION. Its errors are recorded as its answers, and the episode goes on.
"""

import contextlib
import importlib
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.closed_loop.engines import EngineDecision, Observation
from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import ClosedLoopTrajectory, Moment
from cosfly.formats.captions import TOKENS
from cosfly.formats.episodes import MOST_WORDS
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.goals import SLOTS, words_of
from cosfly.geometry.motion import in_axes_of
from cosfly.runtime.errors import InputError, TeacherError

MOST_LATE = 10  # a policy is stopped after this number of late answers in a row
STATE = ("forward_mps", "left_mps", "up_mps", "height_m", "yaw_deg", "gimbal_pitch_deg", "time_s")
STATE_LOW = np.array([-40, -40, -40, -100, -180, -90, 0], dtype=np.float32)
STATE_HIGH = np.array([40, 40, 40, 1000, 180, 90, 3600], dtype=np.float32)


def observe(simulation: ClosedLoopTrajectory, now: Moment, *, depth: bool = False) -> dict[str, Any]:
    """Return the observation of a policy, which contains only what a real drone has.

    rgb (h, w, 3) uint8; state (7,) float32 as STATE; depth (h, w) float32 m; goal: all clothes of the target, of
    which a hard distractor shares all but one.
    """
    pitch_deg, yaw_deg, _ = now.rotation_deg
    height_m = float(now.position_m[2]) - simulation.airspace.ground_z_m
    velocity_mps = in_axes_of(float(yaw_deg), now.velocity_mps)
    state = np.array([*velocity_mps, height_m, wrap_deg(yaw_deg), pitch_deg, now.time_s], dtype=np.float32)
    goal = words_of(("figure", *SLOTS), simulation.script.clothes.looks)["en"]
    observation = {"rgb": now.frame.rgb, "state": np.clip(state, STATE_LOW, STATE_HIGH), "goal": goal}
    if depth:
        observation["depth"] = now.frame.depth
    return observation


class Policy:
    """A policy of the user, a decision engine that flies one episode after the other."""

    num_frames = 1

    def __init__(self, spec: str, limit_s: float, seed: int) -> None:
        """Create the policy of `spec`, a module:Class that is importable from the working directory."""
        self.name = spec
        self._limit_s = limit_s
        self._seed = seed
        self._episode = ""
        self._num_late = 0  # in a row
        module, _, name = spec.partition(":")
        sys.path.insert(0, str(Path.cwd()))
        try:
            policy = getattr(importlib.import_module(module), name)()
            self._reset, self._act = policy.reset, policy.act
        except Exception as error:
            raise InputError(
                "the policy class cannot be imported or created",
                where="fly.student",
                got=f"{spec}: {type(error).__name__}: {error}",
                expected="a module:Class in the current directory, with reset(goal, seed) and act(observation)",
            ) from error

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        """Ask about one episode after the other."""
        return [self._decide(observation) for observation in observations]

    def _decide(self, observation: Observation) -> EngineDecision:
        inputs = observe(observation.simulation, observation.moments[-1], depth=True)
        begun_s = time.monotonic()
        try:
            with _time_limit(self._limit_s):
                if observation.episode != self._episode:
                    self._reset(inputs["goal"], self._seed)
                    self._episode = observation.episode
                value = self._act(inputs)
        except _LateError:
            decision = EngineDecision("late", words=f"no answer in {self._limit_s:g} s")
        except (Exception, SystemExit) as error:
            decision = EngineDecision("none", words=f"{type(error).__name__}: {error}"[:MOST_WORDS])
        else:
            decision = decision_of(value, observation.simulation.drone)
        self._num_late = self._num_late + 1 if decision.answer == "late" else 0
        if self._num_late == MOST_LATE:
            raise TeacherError(
                "the policy did not answer in time and was stopped",
                where=self.name,
                got=f"{self._num_late} decisions in a row without an answer in {self._limit_s:g} s",
                fix="correct the policy, or raise fly.answer_limit_s",
            )
        return replace(decision, answer_s=time.monotonic() - begun_s)


def decision_of(value: Any, drone: Drone) -> EngineDecision:
    """Return the decision of an answer: a token, its number, or a command within the limits of the drone."""
    if isinstance(value, str):
        return EngineDecision("ok", value) if value in TOKENS else EngineDecision("invalid", words=value[:MOST_WORDS])
    words = repr(value)[:MOST_WORDS]
    numbers = np.asarray(value)
    if numbers.ndim == 0 and np.issubdtype(numbers.dtype, np.integer):
        is_known = 0 <= int(numbers) < len(TOKENS)
        return EngineDecision("ok", TOKENS[int(numbers)]) if is_known else EngineDecision("invalid", words=words)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iuf":
        return EngineDecision("unreadable", words=words)
    low, high = drone.bounds
    if numbers.shape != low.shape or not ((numbers >= low) & (numbers <= high)).all():
        return EngineDecision("invalid", words=words)
    return EngineDecision("ok", command=drone.within_speed(numbers.astype(np.float64)))


class _LateError(BaseException):
    """The policy did not answer in time; no `except Exception` of its own catches it."""


@contextlib.contextmanager
def _time_limit(limit_s: float) -> Iterator[None]:
    """Raise _LateError if a block takes longer; only in the main thread, where the work of a worker runs."""

    def stop(*_: Any) -> None:
        raise _LateError

    previous = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
