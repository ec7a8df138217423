"""Settings files of the user's own, brought in all of Hydra's ways: single runs, sweeps, teachers, printed commands."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from acmr.config import ConfigError
from acmr.settings import compose
from acmr.settings.compose import compose_config, groups, launchers, options, parse
from acmr.settings.run_spec import specify, teacher_spec
from acmr.settings.sources import SWEEPS, Sources, stored_sources

ROOT = Path(__file__).resolve().parents[1]
#: A file of each group.
OWN = {
    "env/my_source.yaml": "name: my_source\nid: Ant-v5\nsource: my_source\n",
    "env/my_target.yaml": "defaults: [my_source]\nname: my_target\nremove_bodies: [back_leg]\n",
    "env/mine_target.yaml": "defaults: [my_target]\n",
    "transfer/warm.yaml": "defaults: [hidden]\ncopy_log_alpha: true\n",
    "agent/slow.yaml": "defaults: [sac, _self_]\ntau: 0.01\n",
    "tracking/quiet.yaml": "tracker: null\nproject: mine\n",
    "profile/mine.yaml": (
        "# @package _global_\nprofile: mine\npair: {source: my_source, target: my_target}\ntotal_timesteps: 120\n"
        "env: {max_episode_steps: 30}\nagent: {hidden_sizes: [8, 8], batch_size: 8, learning_starts: 40}\n"
    ),
    "experiment/B9.yaml": (
        "# @package _global_\ndefaults:\n  - override /env: mine_target\n  - override /transfer: warm\nfreeze: true\n"
    ),
    "matrix/mine.yaml": (
        "# @package _global_\ndefaults:\n  - override /profile: mine\n  - override /agent: slow\n"
        "  - override /tracking: quiet\nhydra:\n  mode: MULTIRUN\n  sweeper:\n    params: {experiment: B9, seed: '1'}\n"
    ),
}
STUDENT = "mine/my_target-hidden-frozen-copy_log_alpha=true-tau=0.01/seed_1"
SINGLE = ("profile=mine", "experiment=B9", "agent=slow", "tracking=quiet")
#: All of Hydra's ways but a package.
WAYS = ["--config-dir own", "-cd {own}", "hydra.searchpath=[own]", "hydra.searchpath=[file://{own}]"]


@pytest.fixture
def own(tmp_path: Path) -> Path:
    folder = tmp_path / "own"
    for name, text in OWN.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def found(own: Path, monkeypatch: pytest.MonkeyPatch) -> Sources:
    """Composes with the user's files in this process, too."""
    places = Sources((f"file://{compose.CONFIG_FOLDER}", f"file://{own}", SWEEPS), "config", ("--config-dir", "own"))
    monkeypatch.setattr(compose, "_given", places)
    return places


def run(folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "run.py"), *words, "output_dir=runs"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **more}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.first_is_fast
def test_a_sweep_finds_them_and_plans_their_teachers(way: str, own: Path) -> None:
    done = run(own.parent, *shlex.split(way.format(own=own)), "matrix=mine", "plan=true")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "stage 1    H0  runs/mine/my_source-none/seed_1  (added: the teacher" in done.stdout
    assert f"stage 2    runs/{STUDENT}" in done.stdout


@pytest.mark.parametrize("way", [WAYS[0], WAYS[3]])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_single_run_finds_them_and_prints_a_command_that_does(way: str, own: Path) -> None:
    done = run(own.parent, *shlex.split(way.format(own=own)), *SINGLE)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    printed = shlex.split(done.stderr.partition("train it with: python run.py ")[2].partition(" (or both")[0])
    # As it stands, from anywhere; --cfg shows what Hydra makes of it and trains nothing.
    shown = run(own, "--cfg", "job", *printed)
    assert shown.returncode == 0, shown.stderr
    assert "name: my_source" in shown.stdout


def test_a_package_of_settings_is_found_by_its_name(own: Path) -> None:
    for folder in (own, *(path for path in own.iterdir() if path.is_dir())):
        (folder / "__init__.py").touch()
    words = ("hydra.searchpath=[pkg://own]", "matrix=mine", "plan=true")
    done = run(own.parent, *words, PYTHONPATH=str(own.parent))
    assert f"stage 2    runs/{STUDENT}" in done.stdout, done.stderr


@pytest.mark.slow
def test_a_whole_folder_in_the_place_of_conf(own: Path) -> None:
    whole = own.parent / "whole"
    shutil.copytree(ROOT / "conf", whole)
    shutil.copytree(own, whole, dirs_exist_ok=True)
    (whole / "config.yaml").rename(whole / "study.yaml")
    words = ("--config-path", str(whole), "--config-name", "study")
    done = run(own.parent, *words, "matrix=mine", "plan=true")
    assert f"stage 2    runs/{STUDENT}" in done.stdout, done.stderr
    refused = run(own.parent, *words, *SINGLE)
    assert f"python run.py --config-path {whole} --config-name study profile=mine env=my_source" in refused.stderr


@pytest.mark.slow
def test_a_sweep_trains_what_it_has_planned_whatever_becomes_of_the_files(own: Path) -> None:
    done = run(own.parent, "--config-dir", "own", "matrix=mine")
    assert done.returncode == 0, done.stdout + done.stderr
    summary = own.parent / "runs" / STUDENT / "summary.json"
    assert json.loads(summary.read_text())["status"] == "complete"
    (sweep,) = (own.parent / "runs" / ".sweeps").iterdir()
    shutil.rmtree(own)
    stored = stored_sources(sweep, sweep / "conf")
    assert set(stored.options("env")) > {"my_source", "my_target", "ant"}
    assert stored.words == ("--config-dir", str(own))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--config-dir", "nowhere"], "error: --config-dir nowhere: there is no such folder"),
        (["hydra.searchpath=[own,nowhere]"], "error: hydra.searchpath: nowhere: there is no such folder"),
        (["hydra.searchpath=[file:///nowhere]"], "error: hydra.searchpath: /nowhere: there is no such folder"),
        (
            ["hydra.searchpath=[pkg://nowhere.conf]"],
            "error: hydra.searchpath: pkg://nowhere.conf: there is no such package",
        ),
        (["--config-path", "/nowhere"], "error: Primary config directory not found."),
        (
            ["--config-dir", "own", "env=my_targt"],
            "env=my_targt: must be one of ant, ant_leg_added, ant_leg_lost, ant_three_legs",
        ),
        (["--config-dir", "own", "env=my_targt"], "did you mean env=my_target?"),
        (["--config-dir", "own", "-m", "env=my_target,my_surce"], "did you mean env=my_source?"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(words: list[str], says: str, own: Path) -> None:
    done = run(own.parent, *words)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (own.parent / "runs").exists()


def test_what_may_be_chosen_is_what_hydra_finds(found: Sources) -> None:
    assert set(groups()) == {
        "agent", "env", "experiment", "freeze", "matrix", "profile", "seeding", "tracking", "transfer",
    }  # fmt: skip
    assert set(options("matrix")) == {"demo", "mine", "paper", "quick", "shifts"}
    assert "slow" in options("agent")
    # Hydra's own launchers train no sweep of teachers and students.
    assert launchers() == ["local", "slurm"]


def test_teachers_and_commands_follow_from_them(found: Sources) -> None:
    spec = specify(parse(compose_config(SINGLE)))
    assert spec.command == (
        "python run.py --config-dir own profile=mine transfer=hidden freeze=true agent.tau=0.01 "
        "transfer.copy_log_alpha=true seed=1"
    )
    assert teacher_spec(spec.config).name == "my_source-none"


def test_a_primary_file_without_the_schema_is_refused(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (own / "config.yaml").write_text("seed: 1\n")
    monkeypatch.setattr(compose, "_given", Sources((f"file://{own}",)))
    with pytest.raises(ConfigError, match=r"^config\.yaml: the first of its defaults must be schema"):
        parse(compose_config([]))
