"""Failed sensors and actuators."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env
from acmr.envs.wrappers.partial import PartialEnv, kept_rows
from acmr.settings.compose import environment_config

ANT = environment_config("ant")
NAMES = ("qpos/root/z", "qpos/knee", "qvel/root/z", "qvel/knee")


def rows(wanted: list[int | str], names: tuple[str, ...] = NAMES) -> list[int]:
    return kept_rows(wanted, names, key="drop_sensors", environment="robot").tolist()


class Recorder(gym.Env[Any, Any]):
    """Keeps the commands it got."""

    observation_space = Box(-1, 1, (3,))
    action_space = Box(np.array([-1, 1, -4, 0], np.float32), np.array([1, 3, -2, 5], np.float32))

    def __init__(self) -> None:
        self.commands: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.arange(3, dtype=np.float32), {"options": options}

    def step(self, action: Any) -> Any:
        self.commands.append(action)
        return np.arange(3, dtype=np.float32), 0.0, False, False, {}


@given(
    sensors=st.sets(st.integers(0, 26), max_size=26),
    actuators=st.sets(st.integers(0, 7), max_size=7),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=25, deadline=None)
def test_what_is_left_equals_the_rows_of_the_whole(sensors: set[int], actuators: set[int], seed: int) -> None:
    whole, part = make_env(ANT), make_env(replace(ANT, drop_sensors=[*sensors], drop_actuators=[*actuators]))
    seen = [row for row in range(27) if row not in sensors]
    moved = [row for row in range(8) if row not in actuators]
    assert part.observation_space.shape == (len(seen),)
    assert part.action_space.shape == (len(moved),)
    assert np.array_equal(part.reset(seed=seed)[0], whole.reset(seed=seed)[0][seen])
    rng = np.random.default_rng(seed)
    for _ in range(5):
        command = np.zeros(8, np.float32)
        command[moved] = rng.uniform(-1, 1, len(moved))
        mine, theirs = part.step(command[moved]), whole.step(command)
        assert np.array_equal(mine[0], theirs[0][seen])
        assert mine[1:] == theirs[1:]


@given(st.lists(st.integers(-4, 3), max_size=6))
def test_an_index_a_name_and_an_index_from_the_end_mean_the_same(wanted: list[int]) -> None:
    if len({index % 4 for index in wanted}) < 4:
        assert rows([*wanted]) == rows([NAMES[index] for index in wanted]) == rows([index % 4 for index in wanted])


@pytest.mark.parametrize(
    ("wanted", "left"),
    [
        ([], [0, 1, 2, 3]),
        (["qvel/*"], [0, 1]),
        (["*knee"], [0, 2]),
        (["q???/root/z", -1], [1]),
        (["*/root/[xyz]"], [1, 3]),
        ([0, 0, "qpos/root/z"], [1, 2, 3]),
    ],
)
def test_names_globs_and_indices(wanted: list[int | str], left: list[int]) -> None:
    assert rows(wanted) == left


def test_a_name_with_a_bracket_is_found_before_it_is_a_glob() -> None:
    assert rows(["a[1]"], ("a[1]", "a1", "b")) == [1, 2]


def test_dropped_actuators_get_a_neutral_command() -> None:
    recorder = Recorder()
    env = PartialEnv(recorder, np.array([0, 2]), np.array([3]))
    assert env.action_space == Box(0, 5, (1,))
    assert env.reset(options={"a": 1})[1] == {"options": {"a": 1}}
    for command in (4.5, 0.5):
        assert env.step(np.array([command], np.float32))[0].tolist() == [0, 2]
    assert [command.tolist() for command in recorder.commands] == [[0, 2, -3, 4.5], [0, 2, -3, 0.5]]
    assert recorder.commands[0].dtype == np.float32


def test_description_has_what_is_left() -> None:
    config = replace(
        environment_config("armless_humanoid"), drop_sensors=["c*", "qfrc_*"], drop_actuators=["*_knee", 0]
    )
    env, description = make_env(config), describe(config)
    assert len(description.observation_names) == 33 == len(env.reset(seed=0)[0])
    assert description.action_names[0] == "abdomen_z"
    assert len(description.action_names) == 8
    assert describe(environment_config("armless_humanoid")).model_hash == description.model_hash


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCarContinuous-v0", "Hopper-v5"])
def test_any_box_environment_can_lose_sensors(env_id: str) -> None:
    whole = make_env(EnvConfig(env_id, env_id, env_id))
    part = make_env(EnvConfig(env_id, env_id, env_id, drop_sensors=[-1]))
    assert np.array_equal(part.reset(seed=1)[0], whole.reset(seed=1)[0][:-1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"drop_sensors": ["hip_1"]},
            r"env.drop_sensors=\[hip_1\]: nothing is called 'hip_1' \(near: qpos/hip_1, .*envs ant ",
        ),
        ({"drop_sensors": ["qvle/hip_1"]}, r"near: qvel/hip_1"),
        ({"drop_sensors": ["elbow*"]}, r"nothing is called 'elbow\*'.*python -m acmr.envs ant lists them all"),
        ({"drop_sensors": [0, 27]}, r"env.drop_sensors=\[0,27\]: index 27 is not in -27..26"),
        ({"drop_actuators": [-9]}, r"env.drop_actuators=\[-9\]: index -9 is not in -8..7"),
        ({"drop_actuators": ["Hip_1"]}, r"near: hip_1"),
        ({"drop_actuators": ["*"]}, r"env.drop_actuators=\[\*\]: nothing would be left of ant's 8"),
        ({"drop_sensors": ["qpos/*", "qvel/*"]}, r"nothing would be left of ant's 27"),
    ],
)
def test_what_cannot_be_dropped_gives_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        make_env(replace(ANT, **changes))
    assert "\n" not in str(caught.value)
