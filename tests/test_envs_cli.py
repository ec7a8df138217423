"""python -m acmr.envs"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from guides import ROOT, copy_checkout, follow

from acmr.envs import describe
from acmr.settings.compose import environment_config


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "acmr.envs", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def listed(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int | str | None:
    """Runs the command line in this process; returns the exit code."""
    monkeypatch.setattr(sys, "argv", ["acmr.envs", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("acmr.envs", run_name="__main__")
    return ended.value.code


def test_names_of_one_environment_from_any_folder(tmp_path: Path) -> None:
    done = run(tmp_path, "armless_humanoid")
    assert (done.returncode, done.stderr) == (0, "")
    comments = [line for line in done.stdout.splitlines() if line.startswith("#")]
    rows = [line.split() for line in done.stdout.splitlines() if not line.startswith("#")]
    assert "270 observations, 11 actions, 1000 steps an episode" in comments[1]
    assert "left_foot" in comments[2]
    assert "arm" not in comments[2]
    description = describe(environment_config("armless_humanoid"))
    assert [row[:3] for row in rows[:270]] == [
        ["observation", str(index), name] for index, name in enumerate(description.observation_names)
    ]
    assert rows[270] == ["action", "0", "abdomen_y", "[-0.4,", "0.4]"]
    assert len(rows) == 281
    assert not list(tmp_path.iterdir())


def test_list_of_environments_with_one_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "absent.yaml").write_text("name: absent\nid: no_such_module:Absent-v0\nsource: absent\n")
    done = run(tmp_path, "--config-dir", str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    # In the order of their names the one that cannot be made comes first.
    lines = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines()}
    assert "cannot import no_such_module" in " ".join(lines["absent"])
    assert lines["humanoid"][:4] == ["376", "17", "1000", "Humanoid-v4"]
    assert lines["ant_three_legs"][:3] == ["23", "6", "1000"]
    assert lines["paper_target"] == ["=", "armless_humanoid"]
    assert "env.id=Hopper-v5" in lines["gym"]


def test_unknown_name(tmp_path: Path) -> None:
    done = run(tmp_path, "humanod")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: humanod: ")
    assert "near: humanoid," in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_reader_that_stops_early(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = f"{sys.executable} -u -m acmr.envs humanoid | head -n 1"
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("# humanoid: Humanoid-v4")
    assert done.stderr == ""


def test_gymnasium_ids(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert listed(monkeypatch, "Hopper-v5") == 0
    shown = capsys.readouterr().out
    assert "# 11 observations, 3 actions, 1000 steps an episode" in shown
    assert "observation    0  qpos/rootz\n" in shown
    assert listed(monkeypatch, "Pendulum-v1") == 0
    assert "observation    2  obs/2\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gym", "gym: takes any Gymnasium id"),
        ("Hoper-v5", "near: Hopper-v5"),
        ("CartPole-v1", "Discrete"),
        ("no_such_package:Robot-v0", "cannot import no_such_package"),
    ],
)
def test_errors_are_one_line(
    name: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert listed(monkeypatch, name) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_the_commands_of_the_guide(tmp_path: Path) -> None:
    folder = copy_checkout(tmp_path / "checkout")
    said = follow(ROOT / "docs" / "howto-environment.md", folder)
    assert "one_armed_humanoid" not in said.partition("# armless_humanoid")[0]  # not written yet
    assert "# my_robots:Cart-v0" in said
    assert "# 2 observations, 1 actions, 200 steps an episode" in said
