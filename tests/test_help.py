"""``--help``, own folders in every command, and launchers of Hydra's own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from guides import ROOT

from acmr.app.meanings import meanings
from acmr.settings.compose import setting_keys

TINY = ("env=ant", "profile=quick", "total_timesteps=1100", "tracking=off", "progress=off")


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    places = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "TMPDIR": str(folder / "tmp")}
    (folder / "tmp").mkdir(exist_ok=True)
    command = [sys.executable, *words]
    return subprocess.run(
        command, cwd=folder, env={**os.environ, **places}, capture_output=True, text=True, timeout=200
    )


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A folder with settings of the user's, and the module that they name."""
    (tmp_path / "own" / "env").mkdir(parents=True)
    (tmp_path / "own" / "env" / "swing.yaml").write_text("name: swing\nid: swings:Swing-v0\nsource: swing\n")
    (tmp_path / "swings.py").write_text(
        "import gymnasium as gym\n"
        "from gymnasium.envs.classic_control.pendulum import PendulumEnv\n"
        "gym.register('Swing-v0', PendulumEnv, max_episode_steps=50)\n"
    )
    return tmp_path


def test_every_setting_has_a_meaning():
    said = meanings()
    # Free rooms have no settings until somebody adds one.
    rooms = {key for key in said if key.endswith((".options", ".kwargs"))}
    assert set(said) - rooms == set(setting_keys()) - rooms
    assert all(len(meaning) > 10 for meaning in said.values())
    assert said["agent.q_lr"] == "Learning rate of the critics and of the temperature (Adam)."


def test_help_says_what_settings_mean_and_lists_sweeps(tmp_path):
    done = run(tmp_path, str(ROOT / "run.py"), "--help")
    assert done.returncode == 0, done.stderr
    studies = sorted(path.stem for path in (ROOT / "sweeps" / "matrix").glob("*.yaml"))
    for line in (
        f"matrix=NAME           a whole study: {', '.join(studies)}",
        "workers=N",
        "retries=N",
        "agent.q_lr",
        "  q_lr: 0.001",
    ):
        assert f"\n{line}" in done.stdout
    assert "    Learning rate of the critics and of the temperature (Adam).\n" in done.stdout


@pytest.mark.slow
def test_every_command_finds_the_user_s_folder(own):
    done = run(own, "-m", "acmr.envs", "swing", "--config-dir", "own")
    assert "3 observations, 1 actions, 50 steps an episode" in done.stdout, done.stderr
    assert "swing " in run(own, "-m", "acmr.envs", "--config-dir", "own").stdout
    for module in ("acmr.envs", "acmr.evaluation"):
        refused = run(own, "-m", module, "swing", "--config-dir", "nowhere")
        assert refused.stderr == "error: --config-dir nowhere: there is no such folder\n"


@pytest.mark.slow
def test_a_run_in_an_own_environment_is_evaluated_with_the_folder_that_names_it(own):
    words = ("--config-dir", "own", "env=swing", *TINY[1:])
    assert run(own, str(ROOT / "run.py"), *words).returncode == 0
    (played,) = own.glob("runs/quick/swing-*/seed_1")
    # Its stored settings may not import a module; the user's own folder may.
    assert "if you trust it, type --trust" in run(own, "-m", "acmr.evaluation", str(played)).stderr
    done = run(own, "-m", "acmr.evaluation", str(played), "--episodes", "1", "--config-dir", "own")
    assert done.returncode == 0, done.stderr
    assert "mean" in done.stdout


@pytest.mark.parametrize("launcher", ["submitit_local", "joblib", "basic"])
def test_launchers_that_cannot_run_a_sweep_are_refused(tmp_path, launcher):
    done = run(tmp_path, str(ROOT / "run.py"), "-m", "seed=1,2", f"hydra/launcher={launcher}", *TINY)
    assert done.returncode == 2
    assert done.stderr.startswith(
        f"error: hydra/launcher={launcher}: sweeps have no adapter for it; type hydra/launcher=local"
    )


@pytest.mark.slow
def test_bash_completes_groups_choices_and_settings():
    asked = {
        "transfer=h": "transfer=hidden",
        "seeding=": "seeding=independent seeding=paired",
        "agent.q": "agent.q_lr=",
    }
    lines = [f'PATH="{Path(sys.executable).parent}:$PATH"', 'eval "$(python run.py -sc install=bash)"', "COMP_CWORD=2"]
    for typed in asked:
        line = f"python run.py {typed}"
        lines += [f'COMP_LINE="{line}"', "COMP_POINT=${#COMP_LINE}", f"COMP_WORDS=({line})", "COMPREPLY=()"]
        lines += ["hydra_bash_completion", 'echo "${COMPREPLY[@]}"']
    done = subprocess.run(["bash", "-c", "\n".join(lines)], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == list(asked.values()), done.stderr
