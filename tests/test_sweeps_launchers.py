"""Which launchers a sweep takes, how many workers they start, and what is refused."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from guides import blocks, copy_checkout, follow
from hydra import compose, initialize_config_dir
from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.config import ConfigError
from acmr.settings.compose import CONFIG_FOLDER, launchers, register_schema
from sweeps.launchers.base import LauncherAdapter, make_adapter
from sweeps.launchers.hydra_launcher import FixedConfigs
from sweeps.launchers.local import LocalAdapter
from sweeps.launchers.slurm import SlurmAdapter

ROOT = Path(__file__).resolve().parent.parent
CONTEXT = HydraContext(FixedConfigs(), None)


def composed(*words: str) -> DictConfig:
    register_schema()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        return compose("config", overrides=list(words), return_hydra_config=True)


def adapter(*words: str, threads: int = 1, workers: int | None = None) -> LauncherAdapter:
    return make_adapter(composed(*words), CONTEXT, threads, workers)


@pytest.fixture(autouse=True)
def _environment(monkeypatch):
    # Adapters lead Python to the project in what they start.
    monkeypatch.setenv("PYTHONPATH", "")


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A folder of programs with the one that a node has where jobs may be submitted."""
    program = tmp_path / "bin" / "sbatch"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")


@pytest.mark.usefixtures("cluster")
def test_every_launcher_of_the_project_has_an_adapter_and_a_number_of_workers():
    assert {"local", "slurm"} <= set(launchers())
    for name in launchers():
        made = adapter(f"hydra/launcher={name}")
        assert made.workers >= 1
        assert adapter(f"hydra/launcher={name}", workers=3).workers == 3


@pytest.mark.parametrize("name", ["basic", "joblib", "submitit_local", "submitit_slurm"])
def test_a_launcher_without_an_adapter_is_refused_and_told_what_there_is(name):
    with pytest.raises(ConfigError) as caught:
        adapter(f"hydra/launcher={name}")
    line = str(caught.value)
    assert line.startswith(f"hydra/launcher={name}: sweeps have no adapter for it; type ")
    assert all(f"hydra/launcher={known}" in line for known in launchers())
    assert "\n" not in line


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("nowhere.Adapter", "_target_=nowhere.Adapter cannot be imported (No module named 'nowhere')"),
        ("sweeps.launchers.local.Lokal", "has no attribute 'Lokal'"),
        ("os.path.join", "sweeps have no adapter for it"),
        ("sweeps.plan.Plan", "sweeps have no adapter for it"),
    ],
)
def test_a_target_that_is_no_adapter_is_refused_in_one_line(target, says):
    with pytest.raises(ConfigError) as caught:
        adapter(f"hydra.launcher._target_={target}")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_preset_of_a_launcher_is_one_file_and_keeps_its_adapter(tmp_path):
    folder = tmp_path / "hydra" / "launcher"
    folder.mkdir(parents=True)
    (folder / "night.yaml").write_text("defaults:\n  - local\n  - _self_\n\nn_jobs: 7\n")
    made = adapter(f"hydra.searchpath=[pkg://sweeps,'file://{tmp_path}']", "hydra/launcher=night")
    assert type(made) is LocalAdapter
    assert made.workers == 7


@pytest.mark.parametrize("wanted", [0, -2, True, 1.5, "many"])
def test_a_number_of_workers_that_is_none_is_refused(wanted):
    with pytest.raises(ConfigError, match=f"workers={wanted}: an integer of at least 1 is needed"):
        _ = adapter(workers=wanted).workers


def test_trainings_with_many_threads_share_the_cores():
    assert adapter(threads=10_000).workers == 1
    assert adapter(workers=-1).workers == adapter().workers >= 1


def test_slurm_without_its_programs_is_refused(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ConfigError, match=r"there is no sbatch here; .* or type hydra/launcher=local"):
        adapter("hydra/launcher=slurm")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("submitit_local", "hydra/launcher=submitit_local: sweeps have no adapter for it; type hydra/launcher=local"),
        ("slrum", "hydra/launcher=slrum: must be one of local, slurm; did you mean hydra/launcher=slurm?"),
    ],
)
def test_on_the_command_line_a_wrong_launcher_is_one_line_and_nothing_starts(tmp_path, name, says):
    words = [sys.executable, ROOT / "run.py", "-m", "seed=1,2", f"hydra/launcher={name}", f"output_dir={tmp_path}/runs"]
    told = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert (told.returncode, told.stdout) == (2, "")
    assert told.stderr.startswith(f"error: {says}")
    assert told.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def priorities(folder: Path) -> set[int]:
    """Of the trainings whose settings lie in a folder."""
    found = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"@{folder}/" in (process / "cmdline").read_text():
                found.add(os.getpriority(os.PRIO_PROCESS, int(process.name)))
        except OSError:
            continue
    return found


@pytest.mark.slow
def test_the_guide_makes_a_launcher_that_steps_back(tmp_path):
    guide, root = ROOT / "docs" / "howto-launcher.md", copy_checkout(tmp_path / "copy")
    seen = set()
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(follow, guide, root)
        while not following.done():
            seen |= priorities(root / "runs")
            time.sleep(0.1)
    assert "3 of 3 runs complete" in following.result()
    assert seen == {min(19, os.getpriority(os.PRIO_PROCESS, 0) + 15)}


def test_the_preset_of_the_page_on_clusters_is_one_of_slurm(tmp_path, cluster):
    (preset,) = (block.text for block in blocks(ROOT / "docs" / "cluster.md") if block.language == "yaml")
    (tmp_path / "hydra" / "launcher").mkdir(parents=True)
    (tmp_path / "hydra" / "launcher" / "short.yaml").write_text(preset)
    made = adapter(f"hydra.searchpath=[pkg://sweeps,'file://{tmp_path}']", "hydra/launcher=short")
    assert type(made) is SlurmAdapter
    assert (made.settings.partition, made.settings.timeout_min, made.workers) == ("short", 60, 256)
