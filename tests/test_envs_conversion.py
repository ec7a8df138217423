"""Environments as people write them: what becomes of their arrays, lists, Nones and mistakes at each step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from torture import SMALL, Run

from acmr.config import ConfigError, EnvConfig
from acmr.envs import check_resume, describe, make_env
from acmr.envs.conversion import ConvertedEnv
from acmr.envs.state import ANYTIME
from acmr.settings.compose import environment_config

REAL = (-np.inf, np.inf)


class Given(gym.Env[Any, Any]):
    """Moves a point of three numbers; a subclass says how it is shown."""

    action_space = Box(-1, 1, (2,))
    observation_space: gym.Space[Any] = Box(*REAL, (3,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return self.shown(), {}

    def step(self, action: Any) -> Any:
        self.state[:2] += np.float32(0.1) * action
        self.state[2] = -self.state[0]
        return self.shown(), self.reward(), False, False, self.info()

    def shown(self) -> Any:
        return self.state.copy()

    def reward(self) -> Any:
        return -float(np.abs(self.state).sum())

    def info(self) -> Any:
        return {}


class Keeping(Given):
    """Gives the array that its next step overwrites."""

    def shown(self) -> Any:
        return self.state


class View(Given):
    """Gives a view of it."""

    def shown(self) -> Any:
        return self.state[::-1][::-1]


class Changing(Given):
    """Takes the action that it was given for its own."""

    def step(self, action: Any) -> Any:
        result = super().step(action)
        action *= 0.0
        return result


class KeepingReward(Given):
    """Gives its reward as an array that its next step overwrites."""

    paid = np.zeros(1)

    def reward(self) -> Any:
        self.paid[:] = super().reward()
        return self.paid


class KeepingParts(Given):
    """Gives a dictionary of arrays, and always the same one."""

    observation_space = Dict({"place": Box(*REAL, (2,)), "side": Box(*REAL, (1,))})

    def shown(self) -> Any:
        self.parts = vars(self).get("parts", {})
        self.parts.update(place=self.state[:2], side=self.state[2:])
        return self.parts


KEEPERS = (Keeping, View, Changing, KeepingReward, KeepingParts)
WRAPPED: dict[str, Any] = {"Wrapped": lambda: gym.wrappers.TransformReward(Keeping(), lambda reward: reward)}
for kind in (Given, *KEEPERS):
    gym.register(f"Acmr{kind.__name__}-v0", kind, max_episode_steps=20)
gym.register("AcmrWrapped-v0", WRAPPED["Wrapped"], max_episode_steps=20)


def of(env_id: str, **settings: Any) -> EnvConfig:
    return EnvConfig(name=env_id, id=env_id, source=env_id, **settings)


@pytest.mark.parametrize("name", [*(kind.__name__ for kind in KEEPERS), *WRAPPED])
def test_what_the_environment_overwrites_stays_what_it_was(name: str) -> None:
    mine, theirs = make_env(of(f"Acmr{name}-v0")), make_env(of("AcmrGiven-v0"))
    seen = [[env.reset(seed=3)[0]] for env in (mine, theirs)]
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        before = action.copy()
        results = [env.step(action) for env in (mine, theirs)]
        assert results[0][1:] == results[1][1:]
        assert np.array_equal(action, before)
        for observations, result in zip(seen, results, strict=True):
            observations.append(result[0])
    assert np.array_equal(np.stack(seen[0]), np.stack(seen[1]))
    assert len(np.unique(seen[0], axis=0)) == 21


@pytest.mark.parametrize("name", ["Keeping", "Changing", "KeepingParts", "Wrapped"])
@pytest.mark.first_is_fast
def test_a_run_in_it_is_that_of_one_that_gives_copies(name: str, tmp_path: Path) -> None:
    runs = [
        Run(tmp_path / each, ("env=gym", f"env.id=Acmr{each}-v0", "total_timesteps=160", *SMALL))
        for each in (name, "Given")
    ]
    for run in runs:
        ended = run()
        assert ended.code == 0, ended.said
    for file in ("episodes.csv", "teacher.safetensors"):
        mine, theirs = ((run.folder / file).read_bytes() for run in runs)
        assert mine == theirs, file


@pytest.mark.parametrize("value", ["1.0", None, [1, 2], {}, 1j], ids=repr)
def test_a_reward_is_one_number(value: Any) -> None:
    refused(type("Paying", (Given,), {"reward": lambda self: value}), "its reward is .*one number is needed")


def refused(kind: Callable[..., Any], message: str) -> None:
    """Checks that an environment is refused in one line before anything is made of it."""
    gym.register("AcmrRefused-v0", kind, max_episode_steps=5)
    try:
        # What differs is only what the id stands for, and descriptions are kept by their settings.
        for step, use in enumerate((make_env, describe, check_resume)):
            with pytest.raises(ConfigError, match=message) as caught:
                use(of("AcmrRefused-v0", max_episode_steps=5 + step))
            assert "\n" not in str(caught.value)
            assert str(caught.value).startswith("env.id=AcmrRefused-v0: this environment cannot run: ")
    finally:
        del gym.registry["AcmrRefused-v0"]


def accepted(kind: Callable[..., Any], **settings: Any) -> list[Any]:
    """One step in an environment."""
    gym.register("AcmrAccepted-v0", kind, max_episode_steps=5)
    try:
        env = ConvertedEnv(gym.make("AcmrAccepted-v0", disable_env_checker=True), "AcmrAccepted-v0")
        env.reset(seed=1)
        return list(env.step(np.zeros(2, np.float32)))
    finally:
        del gym.registry["AcmrAccepted-v0"]


@pytest.mark.parametrize(
    "value", [np.array([1.5]), [1.5], torch.tensor(1.5), np.float16(1.5), np.array([[1.5]])], ids=repr
)
def test_a_reward_may_be_anything_that_is_one_number(value: Any) -> None:
    reward = accepted(type("Paying", (Given,), {"reward": lambda self: value}))[1]
    assert (type(reward), reward) == (float, 1.5)


@pytest.mark.parametrize(
    "value", [[1, 2.5, 3], (1, 2.5, 3), torch.tensor([1, 2.5, 3]), [[1, 2.5, 3]], np.array([[1], [2.5], [3]])], ids=repr
)
def test_an_observation_may_be_anything_that_is_so_many_numbers(value: Any) -> None:
    observation = accepted(type("Showing", (Given,), {"shown": lambda self: value}))[0]
    assert (observation.dtype, observation.tolist()) == (np.float32, [1, 2.5, 3])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1, 2, 3, 4], r"shape \(4,\), but its space declares \(3,\)"),
        (np.zeros(2), r"shape \(2,\), but its space declares \(3,\)"),
        (np.zeros((2, 3)), r"shape \(2, 3\), but its space declares \(3,\)"),
        (7.0, r"shape \(\), but its space declares \(3,\)"),
        ("abc", "str of <U3, but numbers are needed"),
        ([1, "a", 3], "list of <U.*numbers are needed"),
        (None, "NoneType of object, but numbers are needed"),
        ([1, [2], 3], "no array of numbers"),
        ({"a": 1}, "dict of object, but numbers are needed"),
        (np.ma.masked_array([1.0, 2, 3], [False, True, False]), "is masked in part, but every number is needed"),
        ([1, np.nan, 3], "first observation is not finite"),
    ],
    ids=repr,
)
def test_an_observation_that_is_something_else_is_refused(value: Any, message: str) -> None:
    refused(type("Showing", (Given,), {"shown": lambda self: value}), message)


def test_integers_are_never_cut() -> None:
    pixels = {"observation_space": Box(0, 255, (3,), np.uint8)}
    observation = accepted(type("Pixels", (Given,), pixels | {"shown": lambda self: [1, 2.0, 255]}))[0]
    assert (observation.dtype, observation.tolist()) == (np.uint8, [1, 2, 255])
    for value in ([0.5, 1, 2], [1, 2, 256], [-1, 2, 3]):
        shown = {"shown": lambda self, value=value: value}
        refused(type("Pixels", (Given,), pixels | shown), "holds numbers that are no uint8")


def test_flags_may_be_numpy_s_and_are_not_none() -> None:
    class Flagged(Given):
        flag: Any = None

        def step(self, action: Any) -> Any:
            observation, reward, *_ = super().step(action)
            return observation, reward, self.flag, 0, {}

    for flag in (np.True_, 1, np.array([True])):
        assert accepted(type("Ended", (Flagged,), {"flag": flag}))[2:4] == [True, False]
    for flag in (None, "yes", 2, [True, False]):
        refused(type("Ended", (Flagged,), {"flag": flag}), "its terminated is .*True or False is needed")


def test_nothing_but_the_conversion_is_around_a_robot_and_its_time_limit() -> None:
    env = make_env(environment_config("armless_humanoid"))
    assert type(env) is ConvertedEnv
    assert isinstance(env.env, gym.wrappers.TimeLimit)
    assert env.env.env is env.unwrapped
    assert check_resume(environment_config("armless_humanoid")).when == ANYTIME
