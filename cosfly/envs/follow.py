"""The environment: follow a pedestrian through a town. Observations contain only what a real drone has."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from cosfly.closed_loop.controller import Controller, read_controls
from cosfly.closed_loop.policy import STATE_HIGH, STATE_LOW, observe
from cosfly.closed_loop.settings import CONTROLLER_FILE, Drone
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, Moment
from cosfly.envs import episodes as benchmark
from cosfly.envs.episodes import SIZE_PX, BenchmarkEpisode, world_of
from cosfly.formats.captions import TOKENS
from cosfly.render.contract import FAR_M
from cosfly.runtime.errors import ConfigError, InputError

GOAL_CHARACTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ -,"
# Distance from drone to target with full reward, and with none.
FULL_REWARD_M, NO_REWARD_M = 35.0, 70.0
CRASH_REWARD = -10.0


def reward_of(now: Moment, ended: str | None) -> float:
    """Return the reward of a step: 1 for a visible target within FULL_REWARD_M, falling to 0 at NO_REWARD_M.

    Only a crash, CRASH_REWARD, is negative, so an early end never pays.
    """
    if ended == "crashed":
        return CRASH_REWARD
    away_m = float(np.linalg.norm(now.position_m - now.target_m))
    return float(np.clip((NO_REWARD_M - away_m) / (NO_REWARD_M - FULL_REWARD_M), 0.0, 1.0)) * now.target.visible


class FollowEnv(gymnasium.Env):
    """One drone and one pedestrian; a step is 0.5 s.

    action: with `decisions` the number of one of the seventeen actions in table order; with `velocities` (5,) as
    ACTION, in the level axes of the drone, with ground speed limited to the drone's greatest.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self, task: str, *, actions: str = "decisions", episodes: str = "train", depth: bool = False,
        size_px: tuple[int, int] = SIZE_PX, render_mode: str | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            actions: decisions or velocities.
            episodes: train draws a town and a trajectory; otherwise the name of a list, from which reset takes
                options["episode"], or draws. size_px: width and height of the pictures.
        """
        if actions not in ("decisions", "velocities"):
            raise ConfigError("unknown kind of actions", where=task, got=actions, expected="decisions or velocities")
        self.task, self.size_px, self.has_depth, self.render_mode = task, (size_px[0], size_px[1]), depth, render_mode
        self.listed = None if episodes == "train" else benchmark.read_list(f"{task}/{episodes}")[1]
        self.drone, self._controls = Drone(), read_controls(CONTROLLER_FILE, TOKENS)
        low, high = (bound.astype(np.float32) for bound in self.drone.bounds)
        self.action_space = spaces.Discrete(len(TOKENS)) if actions == "decisions" else spaces.Box(low, high)
        width_px, height_px = self.size_px
        seen: dict[str, spaces.Space] = {
            "rgb": spaces.Box(0, 255, (height_px, width_px, 3), np.uint8),
            "state": spaces.Box(STATE_LOW, STATE_HIGH),
            "goal": spaces.Text(200, charset=GOAL_CHARACTERS),
        }
        if depth:
            seen["depth"] = spaces.Box(0.0, FAR_M, (height_px, width_px), np.float32)
        self.observation_space = spaces.Dict(seen)
        self._airspace: Airspace | None = None
        self._episode: BenchmarkEpisode | None = None
        self._simulation: ClosedLoopTrajectory | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start an episode: the one of options["episode"] in the list, counted from 0, or a random one."""
        super().reset(seed=seed)
        wanted = (options or {}).get("episode")
        if self.listed is not None:
            k = int(self.np_random.integers(len(self.listed))) if wanted is None else wanted
            if not isinstance(k, int) or not 0 <= k < len(self.listed):
                expected = f"0 to {len(self.listed) - 1}"
                raise InputError("the list has no such episode", where=self.task, got=repr(k)[:40], expected=expected)
            town, number = self.listed[k]
            if not self._begin(benchmark.episode_of(self.task, world_of(benchmark.HELD_OUT[town]), number)):
                raise InputError(
                    "no episode can be made: no drone trajectory was found, or it is too short",
                    where=f"{self.task}: {town}",
                    got=f"trajectory {number}",
                    fix="choose another options['episode']",
                )
        else:
            world = world_of(benchmark.TRAINING[int(self.np_random.integers(len(benchmark.TRAINING)))])
            numbers = self.np_random.integers(100_000, size=benchmark.TRIES).tolist()
            if not any(self._begin(benchmark.episode_of(self.task, world, number)) for number in numbers):
                raise InputError("no trajectory of the town can be an episode", where=self.task, got=world.town.name)
        return self._seen(), self._info()

    def _begin(self, episode: BenchmarkEpisode | None) -> bool:
        """Start an episode; return whether it is suitable."""
        if episode is None:
            return False
        if self._airspace is None or self._episode is None or self._episode.world is not episode.world:
            self.close()
            self._airspace = episode.world.airspace(self.task, self.size_px)
        self._episode, self._simulation = episode, episode.simulation(self._airspace)
        self._now = self._simulation.reset()[-1]
        self._controller = Controller(self._controls, self.drone, self._now)
        return self._now.target.visible != (self.task == benchmark.REACQUIRES)  # else it must be found again

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        """Fly an action for 0.5 s. terminated: crashed or left the map; truncated: the episode is over."""
        if self._simulation is None or self._simulation.ended is not None:
            raise InputError("no episode is open", where=self.task, fix="call reset first")
        if not self.action_space.contains(action):
            got, expected = repr(action)[:120], repr(self.action_space)
            raise InputError("the action is outside its bounds", where=self.task, got=got, expected=expected)
        if isinstance(self.action_space, spaces.Discrete):
            command = self._controller.command(TOKENS[int(action)], self._now)
        else:
            command = self.drone.within_speed(np.asarray(action, dtype=np.float64))
        self._now = self._simulation.step(command)
        ended, reward = self._simulation.ended, reward_of(self._now, self._simulation.ended)
        return self._seen(), reward, ended in ("crashed", "left"), ended == "finished", self._info()

    def _seen(self) -> dict[str, Any]:
        assert self._simulation is not None
        return observe(self._simulation, self._now, depth=self.has_depth)

    def _info(self) -> dict[str, Any]:
        """Return measures of the present frame, which a policy must not use."""
        assert self._episode is not None
        assert self._simulation is not None
        now, target = self._now, self._now.target
        return {
            "episode": benchmark.episode_id(self._episode.world.town.name, self._episode.number),
            "ended": self._simulation.ended or "",
            "in_view": target.in_view, "visible": target.visible, "visibility": target.visibility,
            "distance_m": now.distance_m, "height_m": now.height_m, "clearance_m": now.clearance_m,
        }  # fmt: skip

    def render(self) -> np.ndarray | None:
        """Return the present frame, (h, w, 3) uint8."""
        return self._now.frame.rgb.copy() if self.render_mode == "rgb_array" and self._simulation else None

    def close(self) -> None:
        """Close the renderer."""
        if self._airspace is not None:
            self._airspace.renderer.close()
        self._airspace = self._simulation = None
