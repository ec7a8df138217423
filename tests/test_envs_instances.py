"""How often an environment is built, and why the check of its state needs new instances."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from guides import ROOT
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from acmr.config import EnvConfig
from acmr.envs import check_resume, describe, make_env
from acmr.envs.state import ANYTIME, BETWEEN_EPISODES, NEVER, try_resume
from acmr.settings.compose import environment_config

#: Runs the command line that follows, and counts calls of gymnasium.make until the trainer starts.
COUNTING = """
import runpy, sys
import gymnasium
from acmr.run.trainer import Trainer
make, train, built = gymnasium.make, Trainer.train, []
def counted(*args, **kwargs):
    built.append(args)
    return make(*args, **kwargs)
def told(self):
    print("built", len(built))
    train(self)
gymnasium.make, Trainer.train = counted, told
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize("words", [["env=humanoid"], ["env=ant", "env.drop_actuators=[0]", "env.drop_sensors=[0]"]])
@pytest.mark.slow
def test_a_run_builds_its_environment_three_times_before_the_first_step(words: list[str], tmp_path: Path) -> None:
    """One is tried out and plays for the check, one is put into its state, and one is trained in."""
    command = [sys.executable, "-c", COUNTING, str(ROOT / "run.py"), *words, "total_timesteps=1", "tracking=off"]
    done = subprocess.run([*command, f"output_dir={tmp_path}"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "built 3\n" in done.stdout


def test_what_has_been_tried_out_is_not_tried_out_again(monkeypatch: pytest.MonkeyPatch) -> None:
    built, make = [], gym.make
    monkeypatch.setattr(gym, "make", lambda *args, **kwargs: built.append(args) or make(*args, **kwargs))
    config = EnvConfig("a", "Hopper-v5", "a", kwargs={"healthy_reward": 1.25})
    describe(config)
    assert len(built) == 1
    # None of these changes the robot.
    for changed in ({"name": "b"}, {"source": "b"}, {"drop_sensors": [0]}, {"drop_actuators": [0]}):
        describe(EnvConfig(**{**vars(config), **changed}))
    assert len(built) == 1
    make_env(config)
    assert len(built) == 2
    # Each of these does.
    for changed in ({"kwargs": {"healthy_reward": 1.5}}, {"remove_bodies": ["foot"]}, {"max_episode_steps": 7}):
        other = EnvConfig(**{**vars(config), **changed})
        before = len(built)
        assert describe(other) != describe(config) or changed == {"kwargs": {"healthy_reward": 1.5}}
        assert len(built) == before + 1


def test_bounds_are_those_of_the_actions_that_are_left() -> None:
    config = environment_config("armless_humanoid")
    config.drop_actuators = [0, "left_knee"]
    about, space = describe(config), make_env(config).action_space
    assert isinstance(space, gym.spaces.Box)
    assert np.array_equal(np.array(about.action_low, space.dtype), space.low)
    assert np.array_equal(np.array(about.action_high, space.dtype), space.high)
    assert about.max_episode_steps == 1000
    assert "left_foot" in about.bodies


@pytest.mark.parametrize("name", ["humanoid", "armless_humanoid", "ant"])
def test_the_check_sees_the_same_with_an_instance_that_was_tried_out(name: str) -> None:
    config = environment_config(name)
    checked = check_resume(config)
    assert checked.when == ANYTIME
    assert checked == try_resume(lambda: make_env(config))


class Smooth(HopperEnv):
    """Charges for a change of action, and begins to remember the last one in its first step."""

    def step(self, action: Any) -> Any:
        last = vars(self).get("last", np.zeros_like(action))
        self.last = np.array(action)
        observation, reward, *rest = super().step(action)
        return observation, reward - float(np.abs(action - last).sum()), *rest

    def reset_model(self) -> Any:
        if "last" in vars(self):
            self.last[:] = 0.0
        return super().reset_model()


class Warming(HopperEnv):
    """Pays more from its first step ever on, which no reset takes back."""

    def step(self, action: Any) -> Any:
        was_warm = "warm" in vars(self)
        self.warm = ["yes"]
        observation, reward, *rest = super().step(action)
        return observation, reward + was_warm, *rest


gym.register("AcmrSmooth-v0", Smooth, max_episode_steps=50)
gym.register("AcmrWarming-v0", Warming, max_episode_steps=50)


@pytest.mark.parametrize(("env_id", "when"), [("AcmrSmooth-v0", BETWEEN_EPISODES), ("AcmrWarming-v0", NEVER)])
def test_only_new_instances_show_what_is_made_in_a_first_step(env_id: str, when: str) -> None:
    """Why no instance serves twice: with used ones the check would promise what a resumed run does not keep."""
    config = EnvConfig(env_id, env_id, env_id)
    assert check_resume(config).when == when

    def used() -> Any:
        env = make_env(config)
        env.reset(seed=3)
        for _ in range(5):
            env.step(np.zeros(3, np.float32))
        return env

    assert try_resume(used).when == ANYTIME
