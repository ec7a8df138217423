"""Observations that are made of parts, info that comes and goes, actions at the bounds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiBinary, MultiDiscrete, Sequence, Text, Tuple
from gymnasium.wrappers import FlattenObservation
from hypothesis import given, settings
from hypothesis import strategies as st
from torture import SMALL, Run

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import ConfigError, EnvConfig
from acmr.envs import check_resume, describe, make_env
from acmr.envs.conversion import ConvertedEnv

REAL = (-np.inf, np.inf)
ARM = Dict({"arm": Dict({"angle": Box(*REAL, (2,))}), "grip": Discrete(3), "push": MultiBinary(2)})
PLACE = Dict({"position": Box(*REAL, (2,)), "mode": Discrete(2)})
PAIR = Tuple((Box(*REAL, (2,)), MultiDiscrete([2, 2])))
SPACES: dict[str, tuple[gym.Space[Any], list[str]]] = {
    "Dict": (PLACE, ["mode_0", "mode_1", "position_0", "position_1"]),
    "Nested": (ARM, ["arm/angle_0", "arm/angle_1", *(f"grip_{k}" for k in range(3)), "push_0", "push_1"]),
    "Tuple": (PAIR, ["obs/0_0", "obs/0_1", "obs/1_0", "obs/1_1", "obs/1_2", "obs/1_3"]),
    "Matrix": (Dict({"m": Box(*REAL, (2, 2), np.float64), "s": Box(*REAL, ())}), ["m_0", "m_1", "m_2", "m_3", "s_0"]),
    "Twice": (Dict({"a": Dict({"b": Box(*REAL, (1,))}), "a/b": Box(*REAL, (1,))}), ["obs/0", "obs/1"]),
    "Bell": (Dict({"a\x07": Box(*REAL, (2,))}), ["obs/0", "obs/1"]),
    "Digits": (Dict({"1": Box(*REAL, (1,))}), ["obs/1_0"]),
    "Choice": (Discrete(4), [f"obs/{k}" for k in range(4)]),
}


class Sampled(gym.Env[Any, Any]):
    """Observes samples of a space."""

    action_space = Box(-1, 1, (2,))

    def __init__(self, name: str) -> None:
        self.observation_space = SPACES[name][0]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.sample(), {}

    def step(self, action: Any) -> Any:
        return self.sample(), 0.0, False, False, {}

    def sample(self) -> Any:
        self.observation_space.seed(int(self.np_random.integers(1 << 30)))
        return self.observation_space.sample()


gym.register("AcmrSampled-v0", Sampled, max_episode_steps=20)


def sampled(name: str, **more: Any) -> EnvConfig:
    return EnvConfig("sampled", "AcmrSampled-v0", "sampled", kwargs={"name": name}, **more)


@pytest.mark.parametrize("name", SPACES)
def test_parts_lie_side_by_side_under_names_of_their_keys(name: str) -> None:
    mine, about = make_env(sampled(name)), describe(sampled(name))
    theirs = FlattenObservation(gym.make("AcmrSampled-v0", name=name))
    assert list(about.observation_names) == SPACES[name][1]
    assert about.remarks("it")[0].startswith(
        f"observations of it: a {type(SPACES[name][0]).__name__}, laid side by side"
    )
    assert mine.observation_space == theirs.observation_space
    action = np.zeros(2, np.float32)
    assert np.array_equal(mine.reset(seed=4)[0], theirs.reset(seed=4)[0])
    for _ in range(10):
        seen, wanted = mine.step(action)[0], theirs.step(action)[0]
        assert (seen.dtype, seen.tolist()) == (wanted.dtype, wanted.tolist())
    check_resume(sampled(name))


def test_parts_can_be_dropped_by_their_names() -> None:
    left = describe(sampled("Nested", drop_sensors=["arm/*", "grip_1"])).observation_names
    assert left == ("grip_0", "grip_2", "push_0", "push_1")


def test_a_run_says_what_its_observation_is_made_of(tmp_path: Path) -> None:
    words = ("env=gym", "env.id=AcmrSampled-v0", "+env.kwargs.name=Dict", "total_timesteps=120", *SMALL)
    run = Run(tmp_path, words)
    ended = run()
    assert ended.code == 0, ended.said
    line = (
        "observations of AcmrSampled-v0: a Dict, laid side by side as 4 numbers: mode_0, mode_1, position_0, position_1"
    )
    assert line in ended.said
    assert line in (run.folder / "run.log").read_text()
    names = json.loads((run.folder / "teacher.json").read_text())["observation_names"]
    assert names == SPACES["Dict"][1]


class Wrong(Sampled):
    """Observes what its space does not hold."""

    def __init__(self, name: str, value: Any) -> None:
        super().__init__(name)
        self.value = value

    def sample(self) -> Any:
        return self.value


gym.register("AcmrWrong-v0", Wrong, max_episode_steps=20)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("Dict", {"position": [0, 1], "mode": 2}, r"\['mode'\] is 2, which is not in Discrete\(2\)"),
        (
            "Dict",
            {"position": [0, 1, 2], "mode": 1},
            r"\['position'\] has the shape \(3,\), but its space declares \(2,\)",
        ),
        ("Dict", {"position": [0, 1]}, r"\['mode'\] is missing"),
        ("Dict", {"position": [0, 1], "mood": 1}, r"\['mode'\] is missing"),
        ("Dict", {"position": [0, 1], "mode": 1, "mood": 1}, "has 'mood', which its space does not declare"),
        ("Dict", [0, 1], r"\['mode'\] is missing"),
        ("Dict", 3, "is int 3, but its space declares 2 parts"),
        ("Nested", {"arm": {}, "grip": 0, "push": [0, 1]}, r"\['arm'\]\['angle'\] is missing"),
        ("Nested", {"arm": None, "grip": 0, "push": [0, 1]}, r"\['arm'\] is NoneType None, but its space declares 1"),
        ("Nested", {"arm": {"angle": "ab"}, "grip": 0, "push": [0, 1]}, r"\['arm'\]\['angle'\] is str of"),
        ("Tuple", [[0, 1], [0, 1], [2]], r"is list \[.*\], but its space declares 2 parts"),
        ("Tuple", [[0, 1], [0.5, 1]], r"\[1\] holds numbers that are no int64"),
    ],
)
def test_parts_that_are_not_those_of_the_space_are_refused(name: str, value: Any, message: str) -> None:
    config = EnvConfig("wrong", "AcmrWrong-v0", "wrong", kwargs={"name": name, "value": value})
    with pytest.raises(ConfigError, match=f"cannot run: its observation.*{message}") as caught:
        describe(config)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("space", [Text(3), Sequence(Box(0, 1)), Graph(Box(0, 1), None), Dict({"a": Text(3)})], ids=str)
def test_spaces_without_a_number_of_numbers_are_refused(space: gym.Space[Any]) -> None:
    SPACES["Odd"] = (space, [])
    with pytest.raises(
        ConfigError, match=f"its observations are a {type(space).__name__} space.*Dict and Tuple of these"
    ):
        make_env(sampled("Odd"))


class Spaced(gym.Env[Any, Any]):
    """Has the spaces that it is given, and none where it is given none."""

    def __init__(self, **spaces: Any) -> None:
        vars(self).update(spaces)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        return self.observation_space.sample(), 0.0, False, False, {}


gym.register("AcmrSpaced-v0", Spaced, max_episode_steps=20)
LARGEST = np.finfo(np.float32).max


@pytest.mark.parametrize(
    ("spaces", "says"),
    [
        (
            {"observation_space": ...},
            "its observation_space is nothing, but one of gymnasium.spaces is needed; set self",
        ),
        ({"action_space": ...}, "its action_space is nothing"),
        ({"observation_space": None}, "its observation_space is nothing"),
        ({"observation_space": (3,)}, r"its observation_space is tuple \(3,\), but one of gymnasium.spaces"),
        ({"action_space": Box}, "its action_space is type <class"),
        ({"observation_space": Dict({})}, r"its observation_space Dict\(\) holds no numbers"),
        ({"observation_space": Tuple((Dict({}), Box(-1, 1, (0,))))}, "its observation_space .* holds no numbers"),
        ({"observation_space": Box(*REAL, (3, 0))}, "its observation_space .* holds no numbers"),
        ({"action_space": Box(-1, 1, (0,))}, "its action_space .* holds no numbers"),
        ({"action_space": Box(-LARGEST, LARGEST, (2,))}, "to 3.4028234663852886e.38, which is too wide for"),
        ({"action_space": Box(-1e200, 1e200, (2,), np.float64)}, "too wide for the policy's float32; scale them"),
        ({"action_space": Box(1e6, 1e6 + 0.01, (1,), np.float64)}, "from 1000000.0 to 1000000.01, which is too narrow"),
        ({"action_space": Box(np.array([-1.0, 0]), np.array([1, 1e-45]), dtype=np.float64)}, "0.0 to 1e-45.*narrow"),
    ],
    ids=lambda value: str(value)[:60],
)
def test_spaces_that_are_none_or_empty_or_out_of_range_are_refused(spaces: dict[str, Any], says: str) -> None:
    kwargs = {"observation_space": Box(*REAL, (2,)), "action_space": Box(-1, 1, (1,)), **spaces}
    given_spaces = {name: space for name, space in kwargs.items() if space is not ...}
    with pytest.raises(ConfigError, match=f"^env.id=AcmrSpaced-v0: .*{says}") as caught:
        make_env(EnvConfig("spaced", "AcmrSpaced-v0", "spaced", kwargs=given_spaces))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("low", [np.float32(-1), np.float64(0), np.float16(-3)], ids=repr)
def test_an_action_may_have_no_dimension(low: Any) -> None:
    spaces = {"observation_space": Box(*REAL, ()), "action_space": Box(low, low.dtype.type(2), (), low.dtype.type)}
    config = EnvConfig("spaced", "AcmrSpaced-v0", "spaced", kwargs=spaces)
    about, env = describe(config), make_env(config)
    assert (about.action_names, about.action_low) == (("action/0",), (float(low),))
    assert env.reset()[0].shape == env.step(np.ones(1, np.float32))[0].shape == (1,)
    assert check_resume(config).when


class Telling(gym.Env[Any, Any]):
    """Has things in its info that come and go, by the step."""

    observation_space = Box(*REAL, (2,))
    action_space = Box(-1, 1, (1,))
    steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), None

    def step(self, action: Any) -> Any:
        self.steps += 1
        odd = self.steps % 2 == 1
        info: dict[Any, Any] = {"reward_none": 1.0 if odd else None, "reward_array": np.array([2.0]), 7: "seven"}
        info |= {"reward_text": "n/a", "ragged": [[1], [2, 3]], "big": 10**400, "reward_many": [1.0, 2.0]}
        if odd:
            info |= {"reward_some": np.float32(0.5), "x_velocity": 3}
        if self.steps > 15:
            info |= {"reward_late": 1.0}
        return np.zeros(2, np.float32), 1.0, False, False, info


gym.register("AcmrTelling-v1", Telling, max_episode_steps=20)


def test_info_that_comes_and_goes_has_the_columns_that_the_trial_saw(tmp_path: Path) -> None:
    about = describe(EnvConfig("telling", "AcmrTelling-v1", "telling"))
    assert about.reward_terms == ("reward_none", "reward_array", "reward_some")
    assert about.has_forward_velocity
    run = Run(tmp_path, ("env=gym", "env.id=AcmrTelling-v1", "total_timesteps=100", *SMALL))
    assert run().code == 0
    rows = [line.split(",") for line in (run.folder / "episodes.csv").read_text().split()]
    assert rows[0][3:] == ["mean_forward_velocity", "reward_none", "reward_array", "reward_some"]
    assert [[float(text) for text in row[3:]] for row in rows[1:]] == [[3.0, 10.0, 40.0, 5.0]] * 5


@pytest.mark.parametrize("info", [7, "text", [("reward_a", 1.0)], np.zeros(2)], ids=repr)
def test_info_is_a_dictionary(info: Any) -> None:
    telling = type("Odd", (Telling,), {"step": lambda self, action: (np.zeros(2, np.float32), 1.0, False, False, info)})
    env = ConvertedEnv(telling(), "Odd-v0")
    env.reset()
    with pytest.raises(ConfigError, match=r"env.id=Odd-v0: its info is .*, but a dictionary is needed"):
        env.step(np.zeros(1, np.float32))


class Bounded(Telling):
    """Refuses actions that its space does not hold, as environments do."""

    def __init__(self, low: Any, high: Any, dtype: Any) -> None:
        self.action_space = Box(low, high, dtype=dtype)

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        return np.zeros(2, np.float32), 0.0, False, False, {}


@given(
    ends=st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6)), min_size=1, max_size=6),
    dtype=st.sampled_from([np.float32, np.float64, np.float16]),
    sign=st.sampled_from([-1.0, 1.0]),
)
@settings(max_examples=300)
def test_a_saturated_policy_stays_within_the_bounds(ends: list[tuple[float, float]], dtype: Any, sign: float) -> None:
    if dtype is np.float16:
        ends = [(low % 100, size % 100 + 1) for low, size in ends]
    low = np.array([low for low, _ in ends], dtype)
    high = np.array([low + size for low, size in ends], dtype)
    if not (low < high).all():
        return
    env = ConvertedEnv(Bounded(low, high, dtype), "Bounded-v0")
    env.reset()
    architecture = Architecture.plain(Dimensions(2, len(low)), (4,), low.astype(np.float32), high.astype(np.float32))
    networks = Networks(architecture, torch.Generator().manual_seed(0))
    # As the networks compute it where the policy is sure: the scale and the bias are rounded apart.
    action = sign * networks.actor.action_scale.numpy() + networks.actor.action_bias.numpy()
    env.step(action)
