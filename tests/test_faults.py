"""Signals, numbers that are no longer finite, a second process: each has an end that says what to do."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from torture import ANT, SMALL, Run, at_step, same

from acmr.envs.physics import PhysicsWarnings

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(
    ("number", "name", "code"),
    [(signal.SIGTERM, "SIGTERM", 143), (signal.SIGINT, "Ctrl-C", 130), (signal.SIGHUP, "SIGHUP", 129)],
)
def test_a_signal_stops_at_the_end_of_the_step(number, name, code, untouched, tmp_path):
    run = Run(tmp_path, ANT)
    ended = run(at_step(123, lambda: os.kill(os.getpid(), number)))
    assert ended.code == code
    assert f"stopped by {name} at step 123; run the same command to resume: it resumes at step 123" in ended.said
    assert run.checkpoints == [120, 123]
    assert json.loads((run.folder / "status.json").read_text())["state"] == "stopped"
    assert run(at_step(130)).said.count("resumed at step 123 of 300") == 1
    same(run.finish(), untouched(ANT))


def test_a_signal_waits_for_the_end_of_the_episode_where_that_is_needed(tmp_path):
    overrides = ("env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=30", "total_timesteps=100", *SMALL)
    run = Run(tmp_path, overrides)
    ended = run(at_step(35, lambda: os.kill(os.getpid(), signal.SIGTERM)))
    assert ended.code == 143
    assert "stopped by SIGTERM at step 60" in ended.said


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_reaches_the_whole_group(tmp_path):
    words = [word for word in ANT if not word.startswith(("total", "tracking"))]
    command = [sys.executable, str(ROOT / "run.py"), f"output_dir={tmp_path}", "total_timesteps=100000", *words]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    wait_for(lambda: list(tmp_path.glob("paper/*/seed_1/checkpoint/step_*.json")))
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, out + err
    assert re.search(r"stopped by Ctrl-C at step ([\d,]+); run the same command to resume", out)
    assert err == ""


def wait_for(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_one_process_a_run(tmp_path, untouched):
    run = Run(tmp_path, ANT)
    first = run.start(at_step(100, lambda: time.sleep(3)))
    wait_for(lambda: run.checkpoints)
    others = [run.start() for _ in range(3)]
    for other in others:
        ended = run.wait(other)
        assert ended.code == 75, ended.said
        assert re.search(rf"error: \S+seed_1: held by process {first} on \S+ since \d{{4}}-", ended.said)
    assert run.wait(first).code == 0
    same(run.outcome(), untouched(ANT))


def test_the_lock_dies_with_its_holder(tmp_path):
    run = Run(tmp_path, ANT)
    child = run.start(at_step(60, lambda: time.sleep(600)))
    wait_for(lambda: run.checkpoints)
    os.kill(child, signal.SIGKILL)
    run.wait(child)
    assert run().code == 0


@pytest.mark.parametrize("kill", [None, 100])
def test_numbers_that_explode_end_the_run(kill, tmp_path):
    overrides = (*ANT, "agent.q_lr=1e30", "agent.policy_lr=1e30")
    run = Run(tmp_path, overrides)
    if kill:
        run(at_step(70))
    ended = run()
    assert ended.code == 3, ended.said
    summary = json.loads((run.folder / "summary.json").read_text())
    assert summary["status"] == "diverged"
    assert 70 < summary["step"] == summary["global_step"] < 80
    assert summary["cause"] == "the policy's action is not finite"
    assert "diverged at step" in ended.said
    assert "the checkpoint of step 40 is kept" in ended.said
    assert run.checkpoints == [40]
    assert not (run.folder / "teacher.safetensors").exists()
    again = run()
    assert again.code == 3
    assert f"diverged at step {summary['step']} ({summary['cause']}); force=true runs it anew" in again.said


class Poisoned(PendulumEnv):
    """Gives something that is not finite in its hundredth step."""

    def __init__(self, what: str, **kwargs) -> None:
        super().__init__(**kwargs)
        self.what, self.steps = what, 0

    def step(self, action):
        self.steps += 1
        observation, reward, *rest = super().step(action)
        if self.steps == 100 and self.what == "observation":
            observation = observation * np.float32(np.nan)
        if self.steps == 100 and self.what == "reward":
            reward = -np.inf
        return observation, reward, *rest


gym.register("AcmrPoisoned-v0", Poisoned, max_episode_steps=30)


@pytest.mark.parametrize(("what", "cause"), [("observation", "an observation"), ("reward", "a reward")])
def test_what_the_environment_gives_must_be_finite(what, cause, tmp_path):
    overrides = ("env=gym", "env.id=AcmrPoisoned-v0", f"+env.kwargs.what={what}", "total_timesteps=300", *SMALL)
    run = Run(tmp_path, overrides)
    ended = run()
    assert ended.code == 3, ended.said
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["step"], summary["cause"]) == (100, f"{cause} is not finite")


def test_a_learner_that_is_not_finite_is_never_stored(tmp_path):
    from acmr.agent.sac import SAC

    def poison() -> None:
        update = SAC.update

        def poisoned(agent: SAC, batch: object, global_step: int) -> None:
            update(agent, batch, global_step)
            if global_step == 119:
                agent._target_parameters.values[0] = float("inf")

        SAC.update = poisoned

    run = Run(tmp_path, (*ANT, "agent.policy_frequency=1000"))
    ended = run(poison)
    assert ended.code == 3
    # The row of metrics at step 140 is the first to look at the targets; the checkpoint of step 120 was not made.
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["step"], run.checkpoints) == (140, [40, 80])


def test_warnings_of_the_simulation_are_counted_across_kills(tmp_path):
    def disturb() -> None:
        step = PhysicsWarnings.step
        count = 0

        def disturbed(env: PhysicsWarnings, action: object) -> object:
            nonlocal count
            count += 1
            if count == 50:
                env.unwrapped.data.qvel[0] = np.nan
            return step(env, action)

        PhysicsWarnings.step = disturbed

    run = Run(tmp_path, ANT)

    def disturb_and_die() -> None:
        disturb()
        at_step(150)()

    run(disturb_and_die)
    assert run(disturb).code == 0
    summary = json.loads((run.folder / "summary.json").read_text())
    assert summary["physics_warnings"] == {"badqvel": 2}
    assert not list(Path.cwd().glob("MUJOCO_LOG.TXT"))
