"""An environment's state: captured, put into another instance, and the same from there on in every number."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from acmr.config import EnvConfig
from acmr.envs import make_env
from acmr.envs.state import ANYTIME, BETWEEN_EPISODES, NEVER, RestorableEnv, capture, data_arrays, restore, try_resume
from acmr.settings.compose import environment_config
from acmr.stateful import State

OURS = ("humanoid", "armless_humanoid", "humanoid_v5", "armless_humanoid_v5", "ant", "ant_three_legs")
ROBOTS = (
    "Reacher-v5", "Pusher-v5", "InvertedPendulum-v5", "InvertedDoublePendulum-v5", "HalfCheetah-v5", "Hopper-v5",
    "Swimmer-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5",
)  # fmt: skip


def play(env: gym.Env, actions: np.ndarray) -> list[tuple]:
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append((observation.copy(), float(reward), bool(terminated), bool(truncated), dict(info)))
        if terminated or truncated:
            seen.append((env.reset()[0].copy(),))
    return seen


def same(first: list[tuple], second: list[tuple]) -> bool:
    if len(first) != len(second):
        return False
    return all(
        np.array_equal(a[0], b[0]) and a[1:4] == b[1:4] and repr(a[4:]) == repr(b[4:])
        for a, b in zip(first, second, strict=True)
    )


def actions_for(env: gym.Env, count: int, seed: int = 3) -> np.ndarray:
    low, high = env.action_space.low, env.action_space.high
    return np.random.default_rng(seed).uniform(low, high, (count, *low.shape)).astype(np.float32)


def twin(config: EnvConfig, state: State) -> gym.Env:
    env = make_env(config)
    env.reset(seed=99)
    play(env, actions_for(env, 5, seed=4))
    restore(env, state)
    return env


@pytest.mark.parametrize("name", [*OURS, *ROBOTS])
def test_every_robot_goes_on_exactly_from_any_step(name):
    config = environment_config(name)
    env = make_env(config)
    env.reset(seed=1)
    actions = actions_for(env, 90)
    play(env, actions[:7])
    for first in (7, 30):
        state = capture(env, whole=True)
        other = twin(config, state)
        arrays = {array: getattr(env.unwrapped.data, array).copy() for array in data_arrays(env.unwrapped.model)}
        for array, content in arrays.items():
            np.testing.assert_array_equal(getattr(other.unwrapped.data, array), content, err_msg=array)
        assert other.unwrapped.data.time == env.unwrapped.data.time
        assert same(play(other, actions[first : first + 40]), play(env, actions[first : first + 40]))


def test_mujocos_own_state_alone_gives_wrong_rewards():
    config = environment_config("humanoid")
    env = make_env(config)
    env.reset(seed=1)
    actions = actions_for(env, 12)
    play(env, actions[:8])
    whole = capture(env, whole=True)
    fresh = make_env(config)
    fresh.reset(seed=99)
    stale = {name: getattr(fresh.unwrapped.data, name).copy() for name in data_arrays(fresh.unwrapped.model)}
    # What the integration state itself holds may not be put back to the values of another moment.
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "qfrc_applied", "xfrc_applied", "act"):
        if name in stale:
            stale[name] = whole["robot"]["data"][name]
    alone = twin(config, whole | {"robot": whole["robot"] | {"data": stale}})
    got, wanted = alone.step(actions[8]), env.step(actions[8])
    np.testing.assert_array_equal(got[0], wanted[0])
    assert got[1] != wanted[1]


@pytest.mark.parametrize("limit", [8, 9, 20])
def test_the_time_limit_counts_on(limit):
    config = environment_config("ant")
    config.max_episode_steps = limit
    env = make_env(config)
    env.reset(seed=1)
    actions = actions_for(env, 60)
    play(env, actions[:5])
    assert same(play(twin(config, capture(env, True)), actions[5:]), play(env, actions[5:]))


def test_dropped_sensors_and_actuators():
    config = environment_config("Hopper-v5")
    config.drop_sensors, config.drop_actuators = ["qvel/*"], [0]
    env = make_env(config)
    env.reset(seed=1)
    actions = actions_for(env, 60)
    play(env, actions[:9])
    assert same(play(twin(config, capture(env, True)), actions[9:]), play(env, actions[9:]))
    assert try_resume(lambda: make_env(config)).when == ANYTIME


@pytest.mark.parametrize("name", ["humanoid", "Pendulum-v1", "MountainCarContinuous-v0"])
def test_between_episodes_the_random_numbers_are_enough(name):
    config = environment_config(name)
    env = make_env(config)
    env.reset(seed=1)
    actions = actions_for(env, 60)
    play(env, actions[:9])
    other = twin(config, capture(env, whole=False))
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])
    assert same(play(other, actions), play(env, actions))


@pytest.mark.parametrize(("name", "whole"), [("humanoid", True), ("humanoid", False), ("Pendulum-v1", False)])
def test_the_state_between_two_episodes_is_that_of_the_next_one(name, whole):
    config = environment_config(name)
    config.max_episode_steps = 12
    env, actions = RestorableEnv(make_env(config), whole), actions_for(make_env(config), 40)
    other = RestorableEnv(make_env(config), whole)
    env.reset(seed=1)
    any(any(env.step(action)[2:4]) for action in actions[:12])
    state = env.state_dict()
    assert set(state) == {"random", "layers", *(("elapsed_steps", "robot") if whole else ())}
    other.load_state_dict(state)
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])
    assert same(play(other, actions), play(env, actions))


class Tiring(HopperEnv):
    """Remembers something that is no part of MuJoCo's state."""

    def __init__(self, **kwargs):
        self.tired, self.path = 0, np.zeros(2)
        super().__init__(**kwargs)

    def step(self, action):
        self.tired += 1
        self.path += 0.1
        observation, reward, *rest = super().step(action)
        return observation, reward - self.tired - self.path[0], *rest

    def reset_model(self):
        self.tired, self.path = 0, np.zeros(2)
        return super().reset_model()


class Hiding(Tiring):
    """Remembers it where nobody looks."""

    def __init__(self, **kwargs):
        self.box = [0]
        super().__init__(**kwargs)

    def step(self, action):
        self.box[0] += 1
        observation, reward, *rest = super().step(action)
        return observation, reward - self.box[0], *rest

    def reset_model(self):
        self.box = [0]
        return super().reset_model()


class Growing(Hiding):
    """Remembers it from one episode to the next."""

    def reset_model(self):
        held = self.box
        observation = super().reset_model()
        self.box = held
        return observation


class Collecting(HopperEnv):
    """Keeps an array that grows with each step and fits into no new instance."""

    def step(self, action):
        result = super().step(action)
        self.heights = np.append(self.heights, result[0][0])
        return result

    def reset_model(self):
        self.heights = np.zeros(1)
        return super().reset_model()


gym.register("AcmrCollecting-v0", Collecting, max_episode_steps=50)
gym.register("AcmrTiring-v0", Tiring, max_episode_steps=50)
gym.register("AcmrHiding-v0", Hiding, max_episode_steps=50)
gym.register("AcmrGrowing-v0", Growing, max_episode_steps=50)


class Telling(Hiding):
    """Hides it, and says itself what it is."""

    def state_dict(self):
        return {"box": list(self.box)}

    def load_state_dict(self, state):
        self.box = state["box"]


class Counting(gym.Wrapper):
    """Adds to each reward how many steps it has seen in all episodes."""

    seen = 0

    def step(self, action):
        self.seen += 1
        observation, reward, *rest = super().step(action)
        return observation, float(reward) + self.seen, *rest


class Counted(Counting):
    """Says itself how many."""

    def state_dict(self):
        return {"seen": self.seen}

    def load_state_dict(self, state):
        self.seen = state["seen"]


gym.register("AcmrTelling-v0", Telling, max_episode_steps=50)
gym.register("AcmrCounting-v0", lambda **kwargs: Counting(HopperEnv(**kwargs)), max_episode_steps=50)
gym.register("AcmrCounted-v0", lambda **kwargs: Counted(HopperEnv(**kwargs)), max_episode_steps=50)
gym.register("AcmrCountedPendulum-v0", lambda **kwargs: Counted(PendulumEnv(**kwargs)), max_episode_steps=20)


@pytest.mark.parametrize(
    ("name", "when"),
    [
        ("humanoid", ANYTIME),
        ("AcmrTiring-v0", ANYTIME),
        ("AcmrHiding-v0", BETWEEN_EPISODES),
        ("AcmrGrowing-v0", NEVER),
        ("AcmrCollecting-v0", BETWEEN_EPISODES),
        ("Pendulum-v1", BETWEEN_EPISODES),
        ("AcmrTelling-v0", ANYTIME),
        ("AcmrCounting-v0", NEVER),
        ("AcmrCounted-v0", ANYTIME),
        ("AcmrCountedPendulum-v0", BETWEEN_EPISODES),
    ],
)
def test_a_check_finds_out_when_an_environment_can_be_stored(name, when):
    config = environment_config(name)
    seen = try_resume(lambda: make_env(config))
    assert seen.when == when
    assert seen.trace == try_resume(lambda: make_env(config)).trace


def test_a_state_that_does_not_fit_is_refused():
    env = make_env(environment_config("ant"))
    env.reset(seed=1)
    state = capture(env, whole=True)
    robot = state["robot"]
    for wrong in (
        robot | {"data": {name: array for name, array in robot["data"].items() if name != "xipos"}},
        robot | {"data": {name: array[:-1] for name, array in robot["data"].items()}},
        {name: part for name, part in robot.items() if name != "integration"},
    ):
        with pytest.raises((KeyError, ValueError, TypeError)):
            restore(make_env(environment_config("ant")), state | {"robot": wrong})
