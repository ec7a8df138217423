"""MuJoCo's warnings of an unstable simulation."""

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from acmr.envs import make_env
from acmr.envs.physics import PhysicsWarnings, no_log_file
from acmr.settings.compose import environment_config


def test_warnings_of_the_simulation_are_counted_and_leave_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = PhysicsWarnings(make_env(environment_config("ant")))
    bare = env.unwrapped
    assert isinstance(bare, MujocoEnv)
    env.reset(seed=1)
    action = np.zeros(8, np.float32)
    with no_log_file():
        env.step(action)
        assert env.counts == {}
        for wanted in (1, 2):
            bare.data.qvel[0] = np.nan
            env.step(action)
            assert env.counts["badqvel"] == wanted
        bare.data.qpos[0] = 1e30
        env.step(action)
    assert env.counts["badqpos"] == 1
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is None
