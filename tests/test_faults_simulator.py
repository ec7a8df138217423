"""Environments that fail below Python, and ones that leave something running behind them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env

ROOT = Path(__file__).resolve().parents[1]


class PanicError(BaseException):
    """No ``Exception``: so do simulators in Rust fail."""


class PanickingEnv(gym.Env[np.ndarray, np.ndarray]):
    """Fails like them, where it is told to."""

    observation_space = action_space = Box(-1, 1, (2,), np.float32)

    def __init__(self, where: str = "step") -> None:
        self._fail("init", where)
        self._where = where

    def reset(self, **more: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self._fail("reset", self._where)
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self._fail("step", self._where)

    @staticmethod
    def _fail(here: str, where: str) -> None:
        if here == where:
            raise PanicError("index out of bounds")


@pytest.mark.parametrize("where", ["init", "reset", "step"])
def test_what_is_no_exception_of_python_s_is_one_line_too(where: str) -> None:
    gym.register("Panicking-v0", PanickingEnv, max_episode_steps=9)
    try:
        with pytest.raises(ConfigError, match=r"PanicError: index out of bounds"):
            describe(EnvConfig(name="panicking", id="Panicking-v0", source="panicking", kwargs={"where": where}))
    finally:
        del gym.registry["Panicking-v0"]


@pytest.mark.parametrize("where", ["reset", "step"])
def test_ctrl_c_within_an_environment_stays_one(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(EnvConfig(name="pendulum", id="Pendulum-v1", source="pendulum"))

    def interrupt(*words: Any, **more: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(env.unwrapped, where, interrupt)
    if where == "step":
        env.reset(seed=1)
    with pytest.raises(KeyboardInterrupt):
        env.reset(seed=1) if where == "reset" else env.step(np.zeros(1, np.float32))


#: An environment that begins what never ends; a pool's threads wait for work until they are told to go.
RESTLESS = """
import os, threading, time
from concurrent.futures import ThreadPoolExecutor
import gymnasium as gym
from gymnasium.envs.classic_control.pendulum import PendulumEnv
class Restless(PendulumEnv):
    def __init__(self, **more):
        super().__init__(**more)
        if os.environ["KIND"] == "pool":
            self.pool = ThreadPoolExecutor(1)
            self.pool.submit(len, "")
        else:
            threading.Thread(target=time.sleep, args=[1e6], name="viewer").start()
    def step(self, action):
        if os.environ["KIND"] == "failing":
            raise ValueError("the simulator is gone")
        return super().step(action)
gym.register("Restless-v0", Restless, max_episode_steps=50)
"""


@pytest.mark.parametrize(("kind", "code"), [("sleep", 0), ("failing", 2), ("pool", 0)])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_thread_of_an_environment_s_keeps_no_process(kind: str, code: int, tmp_path: Path) -> None:
    (tmp_path / "restless.py").write_text(RESTLESS)
    words = "env=gym env.id=restless:Restless-v0 total_timesteps=120 agent.hidden_sizes=[8] agent.batch_size=8 "
    done = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *words.split(), "agent.learning_starts=50", "tracking=off"],
        cwd=tmp_path, env={**os.environ, "KIND": kind, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert ("a thread that is not this program's does not end (viewer" in done.stderr) == (kind != "pool")
    assert len(list(tmp_path.glob("runs/*/*/seed_1/summary.json"))) == (code == 0)
