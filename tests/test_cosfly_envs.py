"""cosfly/envs: the environments as Gymnasium has them, episodes, rewards that no cheat earns, policies that fail."""

import json
import os
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from commands import invoke
from gymnasium.utils.env_checker import check_env
from processes import ran

import cosfly.envs
from cosfly.closed_loop.policy import Policy
from cosfly.closed_loop.settings import FlyConfig
from cosfly.closed_loop.stage import STEP_S, watch_of
from cosfly.envs import episodes
from cosfly.envs.episodes import HELD_OUT, TASKS, TRAINING, read_list
from cosfly.envs.follow import FULL_REWARD_M, LOOKS, NO_REWARD_M, reward_of
from cosfly.formats.captions import TOKENS
from cosfly.formats.episodes import read_episode
from cosfly.formats.people import Appearance
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import ConfigError, InputError, TeacherError
from cosfly.runtime.pool import Watch

FOLLOW, SMALL = "cosfly/Follow-v0", (160, 96)
ROOT = Path(cosfly.envs.__file__).parents[2]


@pytest.fixture(scope="module")
def follow():
    env = gymnasium.make(FOLLOW, episodes="test", actions="velocities", size_px=SMALL, depth=True).unwrapped
    yield env
    env.close()


def flown(env, seed, actions):
    seen, _ = env.reset(seed=seed)
    frames, rewards = [seen], []
    for action in actions:
        seen, reward, terminated, truncated, _ = env.step(action)
        frames.append(seen)
        rewards.append(reward)
        if terminated or truncated:
            break
    return frames, rewards


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_an_environment_is_as_gymnasium_wants_it_without_a_warning(task):
    towns = (0, 1) if task == FOLLOW else (0,)  # a town takes a second
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(task, size_px=SMALL, towns=towns).unwrapped)


def test_equal_seeds_and_actions_give_equal_bytes_and_other_seeds_others(follow):
    actions = [np.array([2.0, 0.5, 0.1, 5.0, -40.0], dtype=np.float32)] * 3
    (first, _), (again, _), (other, _) = (flown(follow, seed, actions) for seed in (4, 4, 5))
    for one, same in zip(first, again, strict=True):
        assert all(np.array_equal(one[name], same[name]) for name in one)
    assert not np.array_equal(first[-1]["rgb"], other[-1]["rgb"])
    assert set(first[0]) == {"rgb", "depth", "state", "goal"}, "what a drone knows and no more"
    assert follow.observation_space.contains(first[0])
    assert first[0]["goal"].startswith(("the man in", "the woman in"))


@pytest.mark.slow
def test_an_episode_looks_the_same_whatever_was_flown_before(follow):
    [first], _ = flown(follow, 6, [])  # draws in the context of another town
    alone = gymnasium.make(FOLLOW, episodes="test", actions="velocities", size_px=SMALL, depth=True).unwrapped
    [fresh], _ = flown(alone, 6, [])
    flown(follow, 4, [])
    [again], _ = flown(follow, 6, [])
    assert len(follow._airspaces) > 1
    assert len({airspace.renderer.context for airspace in follow._airspaces.values()}) == 1
    for seen in (first, again):
        assert all(np.array_equal(seen[name], fresh[name]) for name in fresh)
    alone.close()


def test_actions_are_cast_before_their_bounds_are_checked_and_refused_in_a_line(follow):
    decisions = gymnasium.make(FOLLOW, episodes="test", size_px=SMALL).unwrapped
    velocities = np.array([1.0, 0, 0, 0, -30]), np.array([1, 0, 0, 0, -30]), [1, 0, 0, 0, -30.0]
    for env, taken, refused in (
        (follow, velocities, (np.array([99, 0, 0, 0, 0], dtype=np.float32), 3, None)),
        (decisions, (3, np.int64(3), np.array([3], dtype=np.int32)), (17, 2.5, [1, 2], "hover")),
    ):
        env.reset(seed=0)
        for action in taken:
            env.step(action)
        for action in refused:
            with pytest.raises(InputError, match="not in the action space"):
                env.step(action)
    decisions.close()


def test_a_step_after_the_end_is_refused_in_a_line(follow):
    flown(follow, 0, [np.array([0, 0, -4, 0, -30], dtype=np.float32)] * 40)  # into the ground
    with pytest.raises(InputError, match="reset"):
        follow.step(np.zeros(5, dtype=np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["numbers", "flat"])
def test_an_observation_without_text(observation):
    env = gymnasium.make(FOLLOW, episodes="test", observation=observation, size_px=SMALL).unwrapped
    check_env(env, skip_render_check=True)
    seen, info = env.reset(seed=1)
    assert env.observation_space.contains(seen)
    assert not {"episode", "final_info", "final_obs", "terminal_observation", "TimeLimit.truncated"} & {*info}
    if observation == "numbers":
        looks = dict(zip(LOOKS, seen["goal"].tolist(), strict=True))
        worn = {name: choices[looks[name]] for name, choices in LOOKS.items()}
        assert Appearance(**worn) == env._simulation.script.clothes.looks
    else:
        assert seen.max() <= 1
        assert seen.min() >= 0
        assert seen.std() > 0.1
    env.close()


def test_unknown_arguments_are_refused_in_a_line():
    for arguments in ({"observation": "text"}, {"actions": "moves"}, {"towns": ()}, {"towns": (0, 64)}):
        with pytest.raises(ConfigError, match="argument"):
            gymnasium.make(FOLLOW, **arguments)


# Programs of others, unmodified.
TRAINERS = {
    "statistics and SyncVectorEnv": """
import gymnasium, numpy as np
envs = gymnasium.vector.SyncVectorEnv(
    [lambda: gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make("cosfly.envs:cosfly/FollowFlat-v0"))] * 2)
envs.reset(seed=1)
for _ in range(81):
    seen, _, _, _, info = envs.step(np.array([14, 14]))
assert "episode" in info or seen.shape[0] == 2
""",
    "stable_baselines3": """
import gymnasium, cosfly.envs
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
keys = {"observation": "numbers", "size_px": (64, 48)}
for actions in ("decisions", "velocities"):
    envs = make_vec_env("cosfly/Follow-v0", n_envs=2, env_kwargs=keys | {"actions": actions})
    PPO("MultiInputPolicy", envs, n_steps=96, batch_size=32, n_epochs=1, device="cpu").learn(192)
    envs.close()
""",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINERS)
def test_wrappers_and_trainers_of_others_run_unmodified(name, tmp_path):
    if name == "stable_baselines3":
        pytest.importorskip(name)
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    ran(sys.executable, "-c", TRAINERS[name], cwd=tmp_path, env=os.environ | {"PYTHONPATH": path})


@pytest.mark.slow
def test_cheats_do_not_pay(follow):
    at = SimpleNamespace(position_m=np.array([0.0, 0, 20]), target_m=np.array([15.0, 0, 1]), target=SimpleNamespace())
    for visible, ended, above_m, low, high in (
        (True, None, 20.0, 1, 1), (False, None, 20.0, 0, 0), (True, None, 1 + NO_REWARD_M, 0, 0),
        (True, None, 1 + FULL_REWARD_M + 10, 0.1, 0.9), (True, "crashed", 20.0, -10, -10),
    ):  # fmt: skip
        at.target.visible, at.position_m = visible, np.array([0.0, 0, above_m])
        assert low <= reward_of(at, ended) <= high
    up = [np.array([0, 0, 4, 0, -89], dtype=np.float32)] * 80
    _, high_up = flown(follow, 0, up)
    assert sum(high_up) < 25  # of 80
    assert len(high_up) == 80


@pytest.mark.slow
def test_environments_with_texts_are_stepped_as_vectors_in_processes():
    # Gymnasium reads texts in shared memory once, before there are any; it forks, which GL and threads do not survive.
    how = {"shared_memory": False, "context": "spawn"}
    envs = gymnasium.make_vec(FOLLOW, num_envs=2, vectorization_mode="async", vector_kwargs=how, size_px=SMALL)
    try:
        seen, _ = envs.reset(seed=[1, 2])
        seen, rewards, *_ = envs.step(np.array([0, 0]))
        alone = gymnasium.make(FOLLOW, size_px=SMALL)
        alone.reset(seed=2)
        mine, reward, *_ = alone.step(0)
        assert np.array_equal(seen["rgb"][1], mine["rgb"])
        assert (rewards[1], seen["goal"][1]) == (reward, mine["goal"])
        alone.close()
    finally:
        envs.close()


def test_nobody_trains_on_held_out_towns():
    held = {(town.preset, town.seed) for town in HELD_OUT.values()}
    assert not held & {(town.preset, town.seed) for town in TRAINING}
    configs = [read_yaml(path) for path in (Path(cosfly.envs.__file__).parents[2] / "configs").glob("*.yaml")]
    assert len(configs) >= 4
    seeds = {part.get("seed", 0) for one in configs for part in (one, *(one.get("towns") or {}).values())}
    assert not seeds & {town.seed for town in HELD_OUT.values()}
    assert not {*HELD_OUT} & {str(name) for one in configs for name in one.get("towns") or {}}


def test_lists_are_fixed_and_their_digests_are_those_of_the_document():
    text = (ROOT / "docs/closed-loop.md").read_text(encoding="utf-8")
    for task in TASKS:
        env, episodes, digest = read_list(f"{task}/test")
        assert (env, len(episodes), len({*episodes})) == (task, 20, 20)
        assert digest[:12] in text, f"{task}: {digest[:12]}"


@pytest.mark.slow
@pytest.mark.parametrize("decision", [TOKENS.index("hover"), None])
def test_who_hovers_or_decides_at_random_sees_the_person_in_a_fifth_of_the_frames_at_most(decision):
    env = gymnasium.make(FOLLOW, episodes="test", size_px=SMALL).unwrapped
    rng = np.random.default_rng(7)
    num_seen, num_episodes = 0, len(read_list(FOLLOW)[1])
    for episode in range(num_episodes):
        env.reset(options={"episode": episode})
        is_over = False
        while not is_over:
            *_, terminated, truncated, info = env.step(rng.integers(len(TOKENS)) if decision is None else decision)
            num_seen += info["visible"]
            is_over = terminated or truncated
    env.close()
    assert num_seen / (num_episodes * episodes.NUM_DECISIONS) <= 0.2


POLICIES = """
import os, sys, time
import numpy as np

class Fine:
    answer = 0
    def reset(self, goal, seed):
        self.goal, self.count = goal, 0
    def act(self, observation):
        assert observation["goal"] == self.goal
        self.count += 1
        return self.answer
class Token(Fine): answer = "hover"
class Command(Fine): answer = np.array([1.0, 0, 0, 0, -30])
class Word(Fine): answer = "fly!"
class Beyond(Fine): answer = [99.0, 0, 0, 0, 0]
class Seventeen(Fine): answer = 17
class Nothing(Fine): answer = None
class Raises(Fine):
    def act(self, observation): raise RuntimeError("oops")
class Quits(Fine):
    def act(self, observation): sys.exit(3)
class Never(Fine):
    def act(self, observation):
        while True: pass
class Slow(Fine):
    def act(self, observation):
        while not os.path.exists("go"): time.sleep(0.01)
        return 0
class Complex(Fine): answer = np.zeros(5, complex)
class BadReset(Fine):
    def reset(self, goal, seed): raise ValueError("no")
"""


@pytest.fixture
def ask(follow, tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    follow.reset(seed=0)
    observation = SimpleNamespace(simulation=follow._simulation, moments=[follow._now])

    def answers(name, limit_s=60.0, slow_at=None):
        policy = Policy(f"own:{name}", limit_s, 0)
        found, go = [], tmp_path / "go"
        for number, one in enumerate("aaaab"):
            policy._limit_s = limit_s if number != slow_at else 0.5
            go.touch() if number != slow_at else go.unlink()
            found.append(policy.decide([SimpleNamespace(**vars(observation), episode=one)])[0])
        return found

    return answers


@pytest.mark.slow
@pytest.mark.parametrize(("name", "wanted"), [
    ("Token", "ok"), ("Command", "ok"), ("Word", "invalid"), ("Beyond", "invalid"), ("Seventeen", "invalid"), ("Nothing", "unreadable"), ("Raises", "none"),
    ("Quits", "none"), ("Never", "late"), ("BadReset", "none"), ("Complex", "unreadable"),
])  # fmt: skip
def test_what_a_policy_does_is_told_as_its_answer(ask, name, wanted):
    assert [one.answer for one in ask(name, 60.0 if wanted != "late" else 0.4)] == [wanted] * 5


def test_a_slow_answer_is_late_once_and_the_next_ones_are_in_time(ask):
    assert [one.answer for one in ask("Slow", slow_at=1)] == ["ok", "late", "ok", "ok", "ok"]


def test_a_policy_that_hangs_is_stopped_in_a_line(ask, follow, monkeypatch):
    monkeypatch.setattr("cosfly.closed_loop.policy.MOST_LATE", 3)
    policy = Policy("own:Never", 0.1, 0)
    seen = SimpleNamespace(simulation=follow._simulation, moments=[follow._now], episode="a")
    assert [policy.decide([seen])[0].answer for _ in range(2)] == ["late", "late"]
    with pytest.raises(TeacherError, match=r"own:Never: the policy did not answer in time .*fly\.answer_limit_s"):
        policy.decide([seen])
    # What Python cannot interrupt ends with its worker, once.
    watch = watch_of(FlyConfig(student="policy:own:Never", answer_limit_s=5), Watch())
    assert (watch.item_limit_s, watch.retries) == (5 + STEP_S, 0)
    assert watch_of(FlyConfig(student="rules"), Watch()) == Watch()


@pytest.mark.slow
def test_a_whole_list_gives_records_and_a_score(tmp_path, in_this_process, monkeypatch):
    monkeypatch.setattr(episodes, "NUM_DECISIONS", 8)
    episodes.episode_of.cache_clear()
    (tmp_path / "own.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    invoke("fly", "--env", FOLLOW, "--student", "policy:own:Word", "--out", out, "--workers", "1")
    records = [read_episode(path) for path in sorted((out / "episodes").glob("*.json"))]
    assert len(records) == 20
    assert {frame.answer for one in records for frame in one.decisions} == {"invalid"}
    episodes.episode_of.cache_clear()
    assert json.loads((out / "score.json").read_text())["list_sha256"] == read_list(FOLLOW)[2]
