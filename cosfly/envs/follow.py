"""The environment: follow a pedestrian through a town. Observations contain only what a real drone can measure."""

import contextlib
from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces

from cosfly.closed_loop.controller import Controller, read_controls
from cosfly.closed_loop.policy import STATE_HIGH, STATE_LOW, observe
from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory, Moment
from cosfly.envs import episodes as benchmark
from cosfly.envs.episodes import SIZE_PX, BenchmarkEpisode, world_of
from cosfly.formats.captions import TOKENS
from cosfly.formats.people import COLORS, FIGURES, GARMENTS, Appearance
from cosfly.render.contract import FAR_M
from cosfly.runtime.errors import ConfigError, InputError

GOAL_CHARACTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ -,"
OBSERVATIONS = ("words", "numbers", "flat")
LOOKS: dict[str, list[str]] = {
    name: [*(FIGURES if name == "figure" else GARMENTS.get(name, ("", *COLORS)))]
    for name in Appearance.__dataclass_fields__
}
TOWNS = tuple(range(8))  # one training town of each preset
FULL_REWARD_M = 35.0  # greatest distance from drone to target with full reward
NO_REWARD_M = 70.0  # least distance without reward
CRASH_REWARD = -10.0


def reward_of(now: Moment, ended: str | None) -> float:
    """Return the reward of a step: 1 for a visible target within FULL_REWARD_M, falling to 0 at NO_REWARD_M.

    Only CRASH_REWARD is negative, so an early end of an episode never gains reward.
    """
    if ended == "crashed":
        return CRASH_REWARD
    distance_m = float(np.linalg.norm(now.position_m - now.target_m))
    share = float(np.clip((NO_REWARD_M - distance_m) / (NO_REWARD_M - FULL_REWARD_M), 0.0, 1.0))
    return share if now.target.visible else 0.0


def looks_numbers(looks: Appearance) -> np.ndarray:
    """Return the index in LOOKS of each field of an appearance, (9,) int64."""
    return np.array([LOOKS[name].index(value) for name, value in vars(looks).items()])


class FollowEnv(gymnasium.Env):
    """One drone and one pedestrian; a step is 0.5 s.

    An action is, with `decisions`, the index of one of the seventeen actions in table order; with `velocities`, (5,) as
    ACTION in the level axes of the drone, whose ground speed is limited to the greatest of the drone.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012
    # Set by `reset`:
    _now: Moment  # the present frame
    _controller: Controller

    def __init__(
        self, task: str, *, actions: str = "decisions", observation: str = "words", episodes: str = "train",
        towns: Sequence[int] = TOWNS, depth: bool = False, size_px: tuple[int, int] = SIZE_PX,
        render_mode: str | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            actions: decisions or velocities.
            observation: words; numbers, where the goal is `looks_numbers`; or flat, one array of all of it, 0 to 1.
            episodes: With train, reset chooses a random town and trajectory. Otherwise the name of a list, from which
                reset takes options["episode"] or a random one.
            towns: Indices of the training towns that reset chooses from. Each stays in memory once it is seen.
            depth: Add the depth image to observations.
            size_px: Width and height of the pictures.
        """
        for name, value, choices in (
            ("actions", actions, ("decisions", "velocities")), ("observation", observation, OBSERVATIONS),
        ):  # fmt: skip
            if value not in choices:
                problem = f"the argument `{name}` has an unknown value"
                raise ConfigError(problem, where=task, got=value, expected=f"one of {', '.join(choices)}")
        if not towns or not {*towns} <= {*range(len(benchmark.TRAINING))}:
            problem = "the argument `towns` is not a list of indices of training towns"
            expected = f"at least one number from 0 to {len(benchmark.TRAINING) - 1}"
            raise ConfigError(problem, where=task, got=repr(towns)[:80], expected=expected)
        self.task = task
        self.size_px = (size_px[0], size_px[1])
        self.has_depth = depth
        self.render_mode = render_mode
        self.towns = tuple(towns)
        self.listed = None if episodes == "train" else benchmark.read_list(f"{task}/{episodes}")[1]
        self.drone = Drone()
        self._controls = read_controls()
        low, high = (bound.astype(np.float32) for bound in self.drone.bounds)
        self.action_space = spaces.Discrete(len(TOKENS)) if actions == "decisions" else spaces.Box(low, high)
        self._dict_space = self._make_dict_space(in_words=observation == "words")
        self._flat_space = None
        self.observation_space: spaces.Space = self._dict_space
        if observation == "flat":
            self._flat_space = cast(spaces.Box, spaces.flatten_space(self._dict_space))
            self.observation_space = spaces.Box(0.0, 1.0, self._flat_space.shape)
        self._airspaces = dict[str, Airspace]()  # of the towns seen so far, in one GL context
        self._episode: BenchmarkEpisode | None = None
        self._simulation: ClosedLoopTrajectory | None = None

    def _make_dict_space(self, *, in_words: bool) -> spaces.Dict:
        """Return the space of observations that are not flat; in_words: the goal is a text."""
        width_px, height_px = self.size_px
        space: dict[str, spaces.Space] = {
            "rgb": spaces.Box(0, 255, (height_px, width_px, 3), np.uint8),
            "state": spaces.Box(STATE_LOW, STATE_HIGH),
            "goal": spaces.Text(200, charset=GOAL_CHARACTERS),
        }
        if self.has_depth:
            space["depth"] = spaces.Box(0.0, FAR_M, (height_px, width_px), np.float32)
        if not in_words:
            space["goal"] = spaces.MultiDiscrete([len(choices) for choices in LOOKS.values()])
        return spaces.Dict(space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Start an episode: that of index options["episode"] in the list, or a random one."""
        super().reset(seed=seed)
        if self.listed is None:
            town = benchmark.TRAINING[self.towns[int(self.np_random.integers(len(self.towns)))]]
            numbers = self.np_random.integers(100_000, size=benchmark.TRIES).tolist()
        else:
            index = (options or {}).get("episode")
            if index is None:
                index = int(self.np_random.integers(len(self.listed)))
            if not isinstance(index, int) or not 0 <= index < len(self.listed):
                raise InputError(
                    "the list of episodes has no episode with this number",
                    where=f"{self.task}: options['episode']",
                    got=repr(index)[:40],
                    expected=f"a whole number from 0 to {len(self.listed) - 1}",
                )
            name, number = self.listed[index]
            town = benchmark.HELD_OUT[name]
            numbers = [number]
        world = world_of(town)
        if not any(self._begin(benchmark.episode_of(self.task, world, number)) for number in numbers):
            raise InputError(
                "no pedestrian trajectory is suitable for an episode: no drone trajectory was found, or the target's "
                "visibility at the start does not suit the environment",
                where=f"{self.task}: {town.name}",
                got=f"{len(numbers)} unsuitable pedestrian trajectories",
                fix="call reset with another seed or episode",
            )
        return self._observation(), self._info()

    def _begin(self, episode: BenchmarkEpisode | None) -> bool:
        """Start an episode; return whether it suits the task: only with REACQUIRES the target is hidden at first."""
        if episode is None:
            return False
        world = episode.world
        if world.town.name not in self._airspaces:
            like = next(iter(self._airspaces.values()), None)
            self._airspaces[world.town.name] = world.airspace(self.task, self.size_px, like)
        self._episode = episode
        self._simulation = episode.simulation(self._airspaces[world.town.name])
        [self._now] = self._simulation.reset(num_drawn=1)
        self._controller = Controller(self._controls, self.drone, self._now)
        return self._now.target.visible != (self.task == benchmark.REACQUIRES)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Fly an action for 0.5 s; an episode that crashed or left the map is terminated, a finished one truncated."""
        if self._simulation is None or self._simulation.ended is not None:
            raise InputError("no episode is running", where=self.task, fix="call reset before step")
        action = self._checked(action)
        if isinstance(self.action_space, spaces.Discrete):
            command = self._controller.command(TOKENS[int(action)], self._now)
        else:
            command = self.drone.within_speed(np.asarray(action, dtype=np.float64))
        self._now = self._simulation.step(command)
        ended = self._simulation.ended
        reward = reward_of(self._now, ended)
        return self._observation(), reward, ended in ("crashed", "left"), ended == "finished", self._info()

    def _checked(self, action: Any) -> Any:
        """Return an action in the type of the action space; raise InputError if the space does not contain it."""
        space = self.action_space
        with contextlib.suppress(TypeError, ValueError):  # if it is not a number
            value = np.asarray(action)
            if isinstance(space, spaces.Box):
                action = value.astype(space.dtype)
            elif value.size == 1 and np.issubdtype(value.dtype, np.integer):
                action = value.reshape(())[()]
        if not space.contains(action):
            what = "the action is not in the action space of the environment"
            raise InputError(what, where=self.task, got=repr(action)[:120], expected=repr(space))
        return action

    def _observation(self) -> Any:
        assert self._simulation is not None
        observation = observe(self._simulation, self._now, depth=self.has_depth)
        if not isinstance(self._dict_space["goal"], spaces.Text):
            observation["goal"] = looks_numbers(self._simulation.script.clothes.looks)
        if self._flat_space is None:
            return observation
        low, high = self._flat_space.low, self._flat_space.high
        values = cast(np.ndarray, spaces.flatten(self._dict_space, observation))
        return ((values - low) / (high - low)).astype(np.float32)

    def _info(self) -> dict[str, Any]:
        """Return measures of the present frame, which a policy must not use."""
        assert self._episode is not None
        assert self._simulation is not None
        now = self._now
        return {
            "episode_id": benchmark.episode_id(self._episode.world.town.name, self._episode.number),
            "ended": self._simulation.ended or "",
            "in_view": now.target.in_view,
            "visible": now.target.visible,
            "visibility": now.target.visibility,
            "distance_m": now.distance_m,
            "height_m": now.height_m,
            "clearance_m": now.clearance_m,
        }

    def render(self) -> np.ndarray | None:
        """Return the present frame, (h, w, 3) uint8."""
        return self._now.frame.rgb.copy() if self.render_mode == "rgb_array" and self._simulation else None

    def close(self) -> None:
        """Close the renderer."""
        for airspace in self._airspaces.values():
            airspace.renderer.close()
        self._airspaces.clear()
        self._simulation = None
