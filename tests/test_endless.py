"""Environments in which no episode ends: said before the run, after it, and by the sweep and the status."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from guides import ROOT
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.wrappers import TimeLimit
from torture import SMALL, Run

from acmr.config import EnvConfig
from acmr.envs import describe
from acmr.evaluation import rollout
from acmr.evaluation.cli import main as evaluate
from sweeps.status import main as status

gym.register("AcmrEndless-v0", PendulumEnv)
gym.register("AcmrLong-v0", PendulumEnv, max_episode_steps=10_000)
gym.register("AcmrOwnLimit-v0", lambda **kwargs: TimeLimit(PendulumEnv(**kwargs), 30))
WARNING = (
    "warning: AcmrEndless-v0 has no time limit: an episode lasts until it ends by itself, and only episodes that end "
    "are recorded; type env.max_episode_steps=1000 to set one"
)


def run(folder: Path, env_id: str, *more: str) -> Run:
    return Run(folder, ("env=gym", f"env.id={env_id}", "total_timesteps=100", *SMALL, *more))


@pytest.mark.parametrize(
    ("env_id", "more", "warned", "ends"),
    [
        ("AcmrEndless-v0", (), True, False),
        ("AcmrLong-v0", (), False, False),
        ("AcmrEndless-v0", ("env.max_episode_steps=30",), False, True),
        ("AcmrOwnLimit-v0", (), False, True),
    ],
)
@pytest.mark.first_is_fast
def test_a_run_says_that_no_episode_may_end_and_that_none_did(
    env_id: str, more: tuple[str, ...], warned: bool, ends: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run(tmp_path, env_id, *more)
    ended = made()
    assert ended.code == 0, ended.said
    log = (made.folder / "run.log").read_text()
    summary = json.loads((made.folder / "summary.json").read_text())
    again = made()
    for said in (ended.said, log):
        assert (WARNING in said) is warned
        assert ("but no episode ended: nothing is known of its return" in said) is not ends
        assert ("not reached" in said or "reached at step" in said) is ends
    assert ("no episode ended" in again.said) is not ends
    assert summary["status"] == "complete"
    assert summary.get("note") == (None if ends else "no episode ended, so that nothing is known of the return")
    status([str(tmp_path)])
    assert ("no episode ended" in capsys.readouterr().out) is not ends


def test_the_limit_of_a_wrapper_of_one_s_own_counts() -> None:
    limits = {
        (env_id, limit): describe(EnvConfig("a", env_id, "a", max_episode_steps=limit)).max_episode_steps
        for env_id in ("AcmrEndless-v0", "AcmrOwnLimit-v0", "AcmrLong-v0")
        for limit in (None, 20, 50)
    }
    assert [*limits.values()] == [None, 20, 50, 30, 20, 30, 10_000, 20, 50]


@pytest.mark.slow
def test_an_evaluation_cuts_endless_episodes_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run(tmp_path, "AcmrEndless-v0")
    assert made().code == 0
    monkeypatch.setattr(rollout, "MOST_STEPS", 70)
    assert evaluate([str(made.folder), "--episodes", "2"]) == 0
    shown = capsys.readouterr()
    assert "warning: AcmrEndless-v0 has no time limit: an episode is cut off at 10,000 steps" in shown.err
    lengths = [each["episode_length"] for each in json.loads((made.folder / "evaluation.json").read_text())["each"]]
    assert lengths == [70, 70]


@pytest.mark.slow
def test_a_sweep_s_last_line_says_it(tmp_path: Path) -> None:
    module = "import gymnasium\nfrom gymnasium.envs.classic_control import PendulumEnv\n"
    (tmp_path / "endless.py").write_text(f"{module}gymnasium.register('Endless-v0', PendulumEnv)\n")
    words: list[Any] = ["env=gym", "env.id=endless:Endless-v0", "seed=1,2", "workers=1", "total_timesteps=20", *SMALL]
    command = [sys.executable, str(ROOT / "run.py"), "-m", *words, f"output_dir={tmp_path / 'runs'}"]
    environment = {"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1", "HOME": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].startswith("2 of 2 runs complete (2 of them: no episode ended): "), done.stdout
    assert len(re.findall(r"^complete  .* seed [12]: no episode ended$", done.stdout, re.MULTILINE)) == 2
