"""Environments that fail in the middle of a run: why is said everywhere, and what was learned is kept."""

from __future__ import annotations

import json
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from torture import SMALL, Run

from acmr.config import ConfigError, EnvConfig
from acmr.envs import make_env
from acmr.evaluation.cli import main as evaluate
from acmr.settings.compose import environment_config
from sweeps.status import main as status


class Simulator:
    """What an environment talks to; it is gone until a test mends it."""

    mended = False


class SpeechlessError(Exception):
    """Cannot say what it is."""

    def __str__(self) -> str:
        raise AttributeError("no text")

    __repr__ = __str__


class Failing(gym.Env[Any, Any]):
    """Fails in some way in its 130th step."""

    observation_space = Box(-np.inf, np.inf, (3,))
    action_space = Box(-1, 1, (2,))

    def __init__(self, how: str) -> None:
        self.how, self.steps = how, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if self.how == "reset" and self.steps >= 130:
            raise ConnectionError("no simulator\nat port 7")
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        observation, reward, info = self.np_random.uniform(-1, 1, 3).astype(np.float32), 1.0, {}
        if self.steps == 130 and not Simulator.mended:
            if self.how == "raise":
                info["missing"]
            if self.how == "exit":
                raise SystemExit(0)
            if self.how == "speechless":
                raise SpeechlessError
            if self.how == "speechless reward":
                reward = SpeechlessError()
            if self.how == "numbers":
                observation = np.zeros(4, np.float32)
            if self.how == "reward":
                reward = None
        return observation, reward, False, False, info


gym.register("AcmrFailing-v0", Failing, max_episode_steps=30)

HOW = {
    "raise": r"KeyError: 'missing' \(test_faults_environment.py:\d+, in step\)",
    "exit": r"SystemExit: 0 \(test_faults_environment.py:\d+, in step\)",
    "speechless": r"SpeechlessError \(test_faults_environment.py:\d+, in step\)",
    "speechless reward": "its reward is SpeechlessError, but one number is needed",
    "reset": r"ConnectionError: no simulator at port 7 \(test_faults_environment.py:\d+, in reset\)",
    "numbers": r"its observation has the shape \(4,\), but its space declares \(3,\)",
    "reward": r"its reward is NoneType None, but one number is needed",
}


def failing(folder: Any, how: str) -> Run:
    words = ("env=gym", "env.id=AcmrFailing-v0", f"+env.kwargs.how='{how}'", "total_timesteps=200", *SMALL)
    return Run(folder, words)


@pytest.mark.parametrize("how", HOW)
def test_an_environment_that_fails_in_the_middle(how: str, tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run = failing(tmp_path, how)
    ended = run()
    step = 150 if how == "reset" else 130
    line = rf"failed at step {step}: env.id=AcmrFailing-v0: {HOW[how]}; mend that, then run the same command again; "
    line += r"it resumes at step 120"
    assert ended.code == 1, ended.said
    assert re.search(rf"^error: {re.escape(str(run.folder))}: {line}$", ended.said, re.MULTILINE), ended.said
    assert "Traceback" not in ended.said
    assert run.checkpoints == [90, 120]
    said = json.loads((run.folder / "status.json").read_text())
    assert said["state"] == "failed"
    assert re.fullmatch(line, said["cause"])
    last = (run.folder / "run.log").read_text().splitlines()[-1]
    assert re.search(rf" error: \S+: {line}$", last), last
    assert not (run.folder / "summary.json").exists()
    assert status([str(tmp_path)]) == 1
    shown = capsys.readouterr().out
    assert re.search(rf"^failed  .*: {line}$", shown, re.MULTILINE), shown
    assert "1 runs: 1 failed" in shown


def test_a_run_whose_environment_was_mended_goes_on_as_if_nothing_had_been(tmp_path: Any) -> None:
    def mend() -> None:
        Simulator.mended = True

    run, whole = failing(tmp_path / "failed", "raise"), failing(tmp_path / "whole", "raise")
    assert run().code == 1
    assert run(mend).code == whole(mend).code == 0
    assert run.outcome() == whole.outcome()
    assert json.loads((run.folder / "status.json").read_text())["state"] == "complete"
    assert "cause" not in json.loads((run.folder / "status.json").read_text())


class Unmade(Failing):
    """Cannot be made."""

    def __init__(self, error: str) -> None:
        raise {"exit": SystemExit(0), "value": ValueError("no\nrobot"), "key": KeyError("arm")}[error]


gym.register("AcmrUnmade-v0", Unmade)


@pytest.mark.parametrize(
    ("error", "says"), [("exit", "SystemExit: 0"), ("value", "ValueError: no robot"), ("key", "KeyError: 'arm'")]
)
def test_an_environment_that_cannot_be_made_is_refused_in_one_line(error: str, says: str) -> None:
    config = EnvConfig("unmade", "AcmrUnmade-v0", "unmade", kwargs={"error": error})
    with pytest.raises(ConfigError, match=rf"cannot run: {says} \(test_faults_environment.py:\d+\)$") as caught:
        make_env(config)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("code", ["raise SystemExit(0)", "import no_such_thing", "1 / 0", "def ("])
def test_a_module_that_cannot_be_imported_is_refused(code: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    name = f"broken_{abs(hash(code))}"
    (tmp_path / f"{name}.py").write_text(code)
    with pytest.raises(ConfigError, match=f"env.id={name}:Robot-v0: cannot import {name}: "):
        make_env(EnvConfig("broken", f"{name}:Robot-v0", "broken"))


def test_an_evaluation_says_in_one_line_what_the_environment_raised(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Simulator, "mended", True)
    run = failing(tmp_path, "raise")
    assert run().code == 0
    monkeypatch.setattr(Simulator, "mended", False)
    # A text in env.kwargs might name code; here the test chose it.
    assert evaluate([str(run.folder), "--episodes", "9", "--trust"]) == 2
    shown = capsys.readouterr()
    assert shown.out.count("return") == 4
    assert re.fullmatch(rf"error: env.id=AcmrFailing-v0: {HOW['raise']}\n", shown.err)


def test_any_other_error_is_a_failure_with_its_cause_too(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def break_the_learner() -> None:
        from acmr.agent.sac import SAC

        def update(agent: SAC, batch: object, global_step: int) -> None:
            raise MemoryError("out of\nmemory")

        SAC.update = update

    run = failing(tmp_path, "raise")
    ended = run(break_the_learner)
    assert ended.code == 70
    assert "Traceback" in ended.said
    said = json.loads((run.folder / "status.json").read_text())
    assert (said["state"], said["cause"]) == ("failed", "MemoryError: out of memory")
    assert " error: MemoryError: out of memory" in (run.folder / "run.log").read_text()
    assert status([str(tmp_path)]) == 1


def test_an_environment_that_cannot_be_closed_spoils_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(environment_config("Pendulum-v1"))
    monkeypatch.setattr(type(env.unwrapped), "close", lambda self: 1 / 0)
    env.close()


class Forgetful(Failing):
    """Cannot say what its state is."""

    def state_dict(self) -> Any:
        raise LookupError("nothing to say")

    def load_state_dict(self, state: Any) -> None:
        raise LookupError("nothing to take")


gym.register("AcmrForgetful-v0", Forgetful, max_episode_steps=30)


def test_what_fails_in_the_trial_leaves_no_directory(tmp_path: Any) -> None:
    words = ("env=gym", "env.id=AcmrForgetful-v0", "+env.kwargs.how=never", "total_timesteps=200", *SMALL)
    with pytest.raises(ConfigError, match=r"AcmrForgetful-v0 .*cannot run: LookupError: nothing to say") as caught:
        Run(tmp_path / "runs", words)()
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "runs").glob("*/"))
