"""The program as it is installed: a wheel in a fresh environment, used in a folder that knows nothing of a checkout."""

import os
import re
import shlex
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from guides import ROOT, copy_checkout

TINY = (
    "profile=quick", "total_timesteps=1200", "agent.learning_starts=1000", "agent.hidden_sizes=[8,8]", "tracking=off",
    "progress=off",
)  # fmt: skip
#: An environment and its settings, in the user's own folder.
MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control.pendulum import PendulumEnv
gym.register("Swing-v0", PendulumEnv, max_episode_steps=200)
"""
SETTINGS = "name: swing\nid: my_robots:Swing-v0\nsource: swing\n"


def test_the_wheel_names_every_package():
    told = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = {path.parent for top in ("acmr", "sweeps", "analysis") for path in (ROOT / top).rglob("*.py")}
    assert {str(path.relative_to(ROOT)).replace("/", ".") for path in there} == set(told) - {
        "hydra_plugins",
        "acmr.conf",
    }


def environment_in(folder: Path) -> Path:
    """A fresh environment that finds the libraries of this one, but not the checkout that is installed in it."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    found = next(folder.glob("lib/*/site-packages"))
    # Files such as the one that an editable installation leaves are read in an environment's own folder only.
    (found / "libraries.pth").write_text(sysconfig.get_path("purelib"))
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The environment with the wheel; the wheel lies beside it."""
    folder = tmp_path_factory.mktemp("installed")
    # A copy: building leaves folders behind.
    source, venv = copy_checkout(folder / "source"), environment_in(folder / "venv")
    for words in (["wheel", "-w", folder, source], ["install", "--force-reinstall"]):
        wheels = list(folder.glob("*.whl"))
        command = [venv / "bin" / "pip", *words, *wheels, "--quiet", "--no-deps"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
    return venv


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder, in which all commands are typed; it has a folder called as one of our packages, too."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "analysis").mkdir()
    (folder / "analysis" / "__init__.py").write_text("raise ImportError('the package of the user')")
    (folder / "my_robots.py").write_text(MODULE)
    (folder / "own" / "env").mkdir(parents=True)
    (folder / "own" / "env" / "swing.yaml").write_text(SETTINGS)
    return folder


def acmr(venv: Path, folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    away = ("PYTHONPATH", "VIRTUAL_ENV", "ACMR_STARTED_AS")
    variables = {**{key: value for key, value in os.environ.items() if key not in away}, "OMP_NUM_THREADS": "1"}
    command = [venv / "bin" / "acmr", *words]
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=240)
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.slow
def test_the_wheel_holds_every_file_that_is_read(installed):
    (wheel,) = installed.parent.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, inside in (
        ("conf", "acmr/conf"),
        ("sweeps/matrix", "sweeps/matrix"),
        ("hydra_plugins", "hydra_plugins"),
    ):
        here = [path for path in (ROOT / folder).rglob("*") if path.suffix in (".yaml", ".py")]
        assert here
        assert {f"{inside}/{path.relative_to(ROOT / folder)}" for path in here} <= names
    for folder in ("analysis/report/templates", "analysis/report/data"):
        assert {str(path.relative_to(ROOT)) for path in (ROOT / folder).iterdir()} <= names
    assert not [name for name in names if name.startswith(("tests", "docs", "bench"))]


@pytest.mark.slow
def test_a_training_a_sweep_and_an_analysis_anywhere(installed, user):
    def run(*words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        return acmr(installed, user, *words, code=code)

    # What is printed can be typed here: there is no run.py.
    refused = run("transfer=hidden", *TINY, code=2).stderr
    assert refused.count("\n") == 1
    printed = re.search(r"train it with: acmr (.*) \(or both, one after the other: acmr (.*);", refused)
    assert printed is not None
    assert "complete" in run(*shlex.split(printed[1]), "tracking=off", "progress=off").stdout
    assert "complete" in run("train", "transfer=hidden", *TINY).stdout
    # The student and its teacher are there by now.
    assert "1 of 1 runs complete" in run(*shlex.split(printed[2])).stdout
    swept = run("-m", "transfer=hidden,expand", "seed=1,2", *TINY).stdout
    assert "5 of 5 runs complete: runs/quick" in swept
    # The teacher and the student of seed 1 were there before, and are the same runs.
    assert "6 runs: 6 complete" in run("status").stdout
    assert "21 runs" in run("matrix=quick", "plan=true").stdout
    run("analyze", "runs/quick", "--no-stills")
    assert (user / "results" / "quick" / "report.html").is_file()
    assert "swing" in run("--config-dir", "own", "env=swing", *TINY).stdout
    assert "3 observations, 1 actions" in run("envs", "my_robots:Swing-v0").stdout
    (played,) = (user / "runs" / "quick").glob("ant-none-*/seed_1")
    assert "mean" in run("evaluate", str(played.relative_to(user)), "--episodes", "1").stdout
    code = f"import acmr; print(acmr.load({str(played)!r}).names.actions, len(acmr.results('runs/quick').runs))"
    told = subprocess.run([installed / "bin" / "python", "-P", "-c", code], cwd=user, capture_output=True, text=True)
    assert told.stdout.startswith("('hip_4', "), told.stderr
    assert sorted(path.name for path in user.iterdir()) == ["analysis", "my_robots.py", "own", "results", "runs"]


@pytest.mark.slow
def test_its_help_its_version_and_a_word_that_is_none(installed, user):
    shown = acmr(installed, user, "--help").stdout
    assert "acmr analyze RUNS" in shown
    assert "env: ant, " in shown
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert acmr(installed, user, "--version").stdout == f"acmr {version}\n"
    assert acmr(installed, user, "status", "--help").stdout.startswith("usage: acmr status")
    assert "did you mean acmr status?" in acmr(installed, user, "statu", code=2).stderr
    assert "did you mean transfer=hidden?" in acmr(installed, user, "transfer=hiden", code=2).stderr


@pytest.mark.parametrize("where", ["{tmp}/venv", "venv"])
@pytest.mark.slow
def test_make_uses_the_environment_that_it_is_told(tmp_path, where):
    folder = copy_checkout(tmp_path / "checkout")
    place = folder / where.format(tmp=tmp_path)
    environment_in(place)
    (place / ".ready").touch()
    # As long as it is newer than what it follows from, nothing is installed.
    os.utime(place / ".ready", (2e9, 2e9))
    told = tmp_path / "told"
    next(place.glob("lib/*/site-packages")).joinpath("sitecustomize.py").write_text(
        f"import sys; open({str(told)!r}, 'w').write(sys.prefix)"
    )
    command = ["make", f"VENV={where.format(tmp=tmp_path)}", "status", f"RUNS={tmp_path}"]
    # Words of the make that runs these tests are none of this one's.
    variables = {key: value for key, value in os.environ.items() if not key.startswith("MAKE") and key != "ARGS"}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=variables)
    assert done.returncode == 0, done.stderr
    assert Path(told.read_text()) == place
