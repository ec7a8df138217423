"""DeepMind's environments, which do not run with MuJoCo 4: a package of that name asks for what it does."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe
from acmr.envs.construct import construct

#: As in dm_control 1.0.50: a field of the model's that MuJoCo 3 had.
NEEDS_MUJOCO_3 = """
import warnings
import gymnasium as gym
import mujoco

warnings.warn("(65550) b'X11: The DISPLAY environment variable is missing'")

def walk(**kwargs):
    return mujoco.MjModel.from_xml_string("<mujoco/>").flex_vertedge

gym.register("dm_control/walker-walk-v0", walk)
"""


def config(env_id: str) -> EnvConfig:
    return EnvConfig("gym", env_id, "gym")


def test_dm_control_with_mujoco_4_is_told_the_cause_and_what_to_type(tmp_path: Path) -> None:
    (tmp_path / "dm_control.py").write_text(NEEDS_MUJOCO_3)
    code = (
        "from acmr.config import ConfigError, EnvConfig; from acmr.envs.construct import construct\n"
        "try: construct(EnvConfig('gym', 'dm_control:dm_control/walker-walk-v0', 'gym'))\n"
        "except ConfigError as error: print(error)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[1])])}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1
    assert "dm_control does not run with MuJoCo 4." in done.stdout
    assert "object has no attribute 'flex_vertedge'" in done.stdout
    assert "pip install 'mujoco<4', in an environment of its own" in done.stdout


def test_without_shimmy_one_is_told_how_the_id_is_typed() -> None:
    with pytest.raises(ConfigError, match=r"type env.id=shimmy:dm_control/walker-walk-v0, once pip install 'shimmy"):
        construct(config("dm_control/walker-walk-v0"))


@pytest.mark.parametrize("error", [AttributeError("'MjModel' object has no attribute 'x'"), ValueError("'MjModel'")])
def test_other_environments_errors_are_their_own(error: Exception) -> None:
    def broken(**kwargs: object) -> gym.Env:
        raise error

    gym.register("AcmrBroken-v0", broken)
    try:
        with pytest.raises(ConfigError, match="this environment cannot run: "):
            construct(config("AcmrBroken-v0"))
    finally:
        del gym.registry["AcmrBroken-v0"]


def test_a_function_that_is_registered_with_some_of_its_arguments_has_a_hash() -> None:
    def made(gravity: float) -> gym.Env:
        return PendulumEnv(g=gravity)

    hashes = []
    for gravity in (9.0, 10.0):
        gym.register("AcmrPartial-v0", partial(made, gravity=gravity), max_episode_steps=5)
        try:
            # What is told of an environment is kept by its settings, which have to differ.
            hashes.append(describe(replace(config("AcmrPartial-v0"), max_episode_steps=int(gravity))).model_hash)
        finally:
            del gym.registry["AcmrPartial-v0"]
    assert len(set(hashes)) == 2
