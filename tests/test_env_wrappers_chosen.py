"""``env.wrappers``: wrappers of the user's choice, with names carried through, exact states and raw returns."""

from __future__ import annotations

import shlex
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import acmr
from acmr.config import ConfigError, EnvConfig
from acmr.envs import check_resume, describe, make_env
from acmr.envs.state import ANYTIME
from acmr.records import RAW_REWARD_KEY
from acmr.settings.compose import as_override, compose_config, environment_config, parse
from acmr.settings.run_spec import specify
from acmr.settings.stored import stored_environment

NORMALIZED: list[dict[str, Any]] = [{"name": "NormalizeObservation"}]
STACKED: list[dict[str, Any]] = [{"name": "FrameStackObservation", "stack_size": 3}]
#: Wrappers of Gymnasium's that remember something, or that change what is returned.
REMEMBERING: list[list[dict[str, Any]]] = [
    NORMALIZED,
    STACKED,
    [*NORMALIZED, *STACKED, {"name": "NormalizeReward", "gamma": 0.9}],
    [*STACKED, *NORMALIZED],
    [{"name": "FrameStackObservation", "stack_size": 2, "padding_type": "zero"}],
    [{"name": "DelayObservation", "delay": 3}],
    [{"name": "TimeAwareObservation"}, {"name": "StickyAction", "repeat_action_probability": 0.4}],
    [{"name": "RepeatAction", "num_repeats": 3}, {"name": "ClipReward", "max_reward": 0.1}],
    [{"name": "RescaleAction", "min_action": -2.0, "max_action": 0.5}, {"name": "RecordEpisodeStatistics"}],
]


class Backwards(gym.ObservationWrapper):
    """Turns the observation around, and says nothing of it."""

    def observation(self, observation):
        return observation[::-1].copy()


class Noisy(Backwards):
    """Of which each number means what it meant."""

    keeps_names = True


class Named(Backwards):
    observation_names = tuple(f"b/{row}" for row in range(27))


def ant(*wrappers: dict[str, Any], **changes: Any) -> EnvConfig:
    return replace(environment_config("ant"), wrappers=list(wrappers), **changes)


def own(wrapper: type) -> dict[str, Any]:
    return {"name": f"{__name__}:{wrapper.__name__}"}


# --- names ---


def test_stacked_frames_say_how_long_ago_and_the_latest_keeps_its_name():
    names, plain = describe(ant(*STACKED)).observation_names, describe(ant()).observation_names
    assert names[54:] == plain
    assert names[:27] == tuple(f"{name}@2" for name in plain)
    env = make_env(ant(*STACKED))
    env.reset(seed=0)
    before = env.step(np.zeros(8, np.float32))[0]
    now = env.step(np.zeros(8, np.float32))[0]
    at, ago = names.index("qvel/ankle_2"), names.index("qvel/ankle_2@1")
    assert now[ago] == before[at] != now[at]


def test_what_was_stacked_is_dropped_by_its_name():
    kept = describe(ant(*STACKED, drop_sensors=["*@2", "qvel/hip_1"])).observation_names
    assert len(kept) == 53
    assert not any("@2" in name for name in kept)
    assert "qvel/hip_1@1" in kept


@pytest.mark.parametrize(
    ("wrappers", "expected"),
    [
        (NORMALIZED, lambda plain: plain),
        ([{"name": "TimeAwareObservation"}], lambda plain: (*plain, "time")),
        ([{"name": "NormalizeReward"}, {"name": "RepeatAction", "num_repeats": 2}], lambda plain: plain),
        ([own(Backwards)], lambda plain: tuple(f"obs/{row}" for row in range(27))),
        ([own(Noisy)], lambda plain: plain),
        ([own(Named)], lambda plain: Named.observation_names),
        ([own(Named), *STACKED[:1]], lambda plain: tuple(f"b/{row}" for row in range(27))),
    ],
    ids=["normalized", "time", "reward and action", "silent", "keeps", "says", "says, then stacked"],
)
def test_names_are_carried_through_where_they_can_be(wrappers, expected):
    about, plain = describe(ant(*wrappers)), describe(ant())
    latest = 27 + ("time" in about.observation_names)
    assert about.observation_names[-latest:] == expected(plain.observation_names)
    assert about.action_names == plain.action_names


# --- refusals ---


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        ({"name": "FrameStak"}, "Gymnasium has no wrapper FrameStak (near: FrameStackObservation"),
        ({"name": "FrameStackObservation"}, "missing 1 required positional argument: 'stack_size'"),
        ({"name": "FrameStackObservation", "size": 3}, "no argument size; it takes stack_size, padding_type"),
        ({"name": "FrameStackObservation", "stack_size": 0}, "greater than zero"),
        ({"name": "Autoreset"}, "resets within an episode"),
        ({"name": "os:system"}, "a class derived from gymnasium.Wrapper is needed"),
        ({"name": "no_such_module:Name"}, "cannot import no_such_module:Name"),
        ({"name": "DiscretizeAction", "bins": 3}, "only Box spaces"),
    ],
)
def test_what_cannot_be_put_around_is_refused_in_one_line(wrapper, message):
    with pytest.raises(ConfigError) as refused:
        describe(ant(wrapper))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_wrapper_without_a_name_is_refused_before_anything_is_made():
    with pytest.raises(ConfigError, match="each needs its name"):
        acmr.train("env=ant", "env.wrappers=[{stack_size: 3}]")


@pytest.mark.parametrize(
    ("wrapper", "named"),
    [
        ({"name": "evil_module:Wrapper"}, "env.wrappers[0].name=evil_module:Wrapper"),
        ({"name": "RecordVideo", "video_folder": "/somewhere"}, "env.wrappers[0].video_folder"),
        ({"name": "FrameStackObservation", "stack_size": 10**9}, "keep this machine busy"),
    ],
)
def test_a_stored_wrapper_chooses_no_code_and_no_file(wrapper, named):
    stored = {"env": {**vars(ant()), "name": "mine", "wrappers": [wrapper]}}
    with pytest.raises(ConfigError, match="if you trust it") as refused:
        stored_environment(stored, "config.yaml", "type --trust")
    assert named in str(refused.value)
    assert stored_environment(stored, "config.yaml", "type --trust", trust=True).wrappers == [wrapper]
    for damaged in ("x", [1], [{}], [{"name": 3}]):
        with pytest.raises(ConfigError, match="damaged"):
            stored_environment({"env": {**stored["env"], "wrappers": damaged}}, "config.yaml", "type --trust")


# --- the command line ---


def test_the_printed_command_makes_the_same_run_in_a_shell():
    words = ["env=ant", "profile=quick", "env.wrappers=[{name:FrameStackObservation,stack_size:3,padding_type:zero},"
             "{name:'a_module:Wrapper',scale:[1,2.5]}]"]  # fmt: skip
    made = specify(parse(compose_config(words)))
    assert made.config.env.wrappers[1] == {"name": "a_module:Wrapper", "scale": [1, 2.5]}
    again = specify(parse(compose_config(shlex.split(made.command.partition("run.py ")[2]))))
    assert (again.config, again.directory) == (made.config, made.directory)
    assert as_override({"a": {"b": None}}) == "{a:{b:null}}"


# --- states and returns ---


@pytest.mark.parametrize("wrappers", REMEMBERING, ids=lambda entries: "+".join(entry["name"] for entry in entries))
def test_it_goes_on_exactly_from_any_step(wrappers):
    assert check_resume(ant(*wrappers)).when == ANYTIME


@pytest.mark.parametrize("wrappers", REMEMBERING, ids=lambda entries: "+".join(entry["name"] for entry in entries))
def test_returns_are_of_what_the_robot_itself_is_paid(wrappers):
    """Against the same robot without wrappers, driven by what reached it."""
    env, plain = make_env(ant(*wrappers)), make_env(ant())
    driven: list[np.ndarray] = []
    robot: Any = env.unwrapped
    step = robot.step
    robot.step = lambda action: (driven.append(np.array(action)), step(action))[1]
    env.reset(seed=3)
    plain.reset(seed=3)
    rng = np.random.default_rng(0)
    space = env.action_space
    for _ in range(40):
        before = len(driven)
        _, _, ended, _, info = env.step(rng.uniform(space.low, space.high).astype(np.float32))
        paid = [plain.step(action)[1] for action in driven[before:]]
        assert info[RAW_REWARD_KEY] == sum(paid)
        if ended:
            break
        assert len(paid) == (3 if wrappers[0]["name"] == "RepeatAction" else 1)
