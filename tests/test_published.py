"""The runs in results/paper: whole, made with the settings that their cells have now, and of use to others."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from acmr.config import HORIZON, STOP_KEYS
from acmr.settings.compose import as_override, compose_config, parse
from acmr.storage.run_dir import differing_keys
from analysis.analyze import analyze
from analysis.loading.load import load
from docs import results

ROOT = Path(__file__).resolve().parent.parent
PUBLISHED = ROOT / "results" / "paper"
TEACHER = PUBLISHED / "humanoid-none" / "seed_1"
RUNS = sorted(path.parent for path in PUBLISHED.glob("*/*/summary.json"))
ADDED = sorted(path.parent for path in (ROOT / "results" / "arms_added").glob("*/*/summary.json"))


@cache
def cells() -> dict[str, str]:
    """Which cell each run is of, as the analysis sees it."""
    return load(PUBLISHED).runs["cell"].to_dict()


def summary_of(run: Path) -> dict:
    """Its summary, with the cell that its settings make it now: N2 was run before it was a cell."""
    summary = json.loads((run / "summary.json").read_text())
    return summary | {"cell": summary["cell"] or cells()[run.relative_to(PUBLISHED).as_posix()]}


def test_they_are_analyzed_without_a_remark():
    measured = analyze(load(PUBLISHED)).measured
    assert len(measured) == len(RUNS) >= 2
    assert set(measured["state"]) == {"complete"}
    # Among others: the steps to threshold in a summary are those of the episodes beside it.
    assert set(measured["reason"]) == {""}


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.parent.name}-{run.name}")
def test_each_is_the_papers_cell(run):
    summary = summary_of(run)
    stops = {key: value for key, value in summary.items() if key in STOP_KEYS and value not in (None, HORIZON)}
    end = (summary["steps_to_threshold"] or summary["stop_after"]) if stops else 1_000_000
    assert (summary["global_step"], summary["total_timesteps"]) == (end, 1_000_000)
    assert summary["profile"] == "paper"
    assert not summary["git_commit"].endswith("-dirty")
    words = [f"{key}={value}" for key, value in stops.items()]
    meant = parse(compose_config([f"experiment={summary['cell']}", f"seed={summary['seed']}", *words]))
    assert differing_keys(yaml.safe_load((run / "config.yaml").read_text()), meant) == []
    assert str(ROOT) not in "".join(path.read_text() for path in run.glob("*.[jy]*"))


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.parent.name}-{run.name}")
def test_the_page_of_results_tells_the_same(run):
    summary = summary_of(run)
    page = (ROOT / "docs" / "results.md").read_text().splitlines()
    rows = [line for line in page if line.startswith(f"| {summary['cell']} | {summary['seed']} |")]
    assert rows, "docs/results.md has no row for this run"
    steps = summary["steps_to_threshold"]
    for told in (
        f"{steps:,}" if steps else "not reached",
        f"{summary['episodes']:,}",
        f"{summary['final_return']:,.0f}",
        f"{summary['steps_per_second']:.0f}",
    ):
        assert f" {told} |" in rows[0], told


def test_the_tables_on_the_pages_are_what_their_command_prints():
    for path, page in results.filled().items():
        assert page == path.read_text(), "type python -m docs.results"


@pytest.mark.slow
def test_a_student_learns_from_the_published_teacher(tmp_path):
    command = [sys.executable, "run.py", "experiment=A2", f"transfer.teacher={TEACHER.relative_to(ROOT)}"]
    command += ["total_timesteps=60", "agent.learning_starts=40", "agent.buffer_size=60", "agent.batch_size=8"]
    command += [f"output_dir={tmp_path}", "tracking=off"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False, env=dict(os.environ))
    assert done.returncode == 0, done.stdout + done.stderr
    (folder,) = tmp_path.glob("paper/*/seed_1")
    assert "hidden-frozen" in folder.parent.name
    copied = json.loads((folder / "transfer.json").read_text())["copied"]
    assert len(copied) == 3
    teacher, student = load_file(TEACHER / "teacher.safetensors"), load_file(folder / "teacher.safetensors")
    # The copied layers are frozen: after 20 updates they still are the teacher's, bit for bit, and the others moved.
    for layer in copied:
        for name in (f"{layer}.weight", f"{layer}.bias"):
            assert student[name].tobytes() == teacher[name].tobytes(), name
    assert np.isfinite(student["actor.mean.weight"]).all()


@pytest.mark.parametrize("run", ADDED, ids=lambda run: run.name)
def test_each_with_arms_again_is_what_the_page_says(run):
    summary = json.loads((run / "summary.json").read_text())
    teacher = json.loads((run / "transfer.json").read_text())["teacher"]
    words = ["env=humanoid", "transfer=named", f"seed={summary['seed']}", "stop=threshold", "stop_after=500000"]
    meant = parse(compose_config([*words, f"transfer.teacher={as_override(teacher['path'])}"]))
    assert differing_keys(yaml.safe_load((run / "config.yaml").read_text()), meant) == []
    assert not summary["git_commit"].endswith("-dirty")
    assert teacher["environment"] == "armless_humanoid"
    # Of the students by name whose teacher was H0 of this seed, the one that returned most without arms.
    students = {
        other.relative_to(PUBLISHED).as_posix(): json.loads((other / "evaluation.json").read_text())["mean_return"]
        for other in RUNS
        if "-named" in other.parent.name
        and json.loads((other / "transfer.json").read_text())["teacher"]["seed"] == summary["seed"]
    }
    assert f"runs/paper/{max(students, key=lambda name: students[name])}/" in teacher["path"]
    assert analyze(load(ADDED[0].parent.parent)).measured["steps_to_threshold"].notna().all()


def test_the_published_runs_are_taken_up_by_the_matrix(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "paper").symlink_to(PUBLISHED)
    command = [sys.executable, str(ROOT / "run.py"), "matrix=paper", "plan=true", f"output_dir={tmp_path / 'runs'}"]
    # Full runs stand for those that stop.
    command += ["stop=threshold", "stop_after=500000"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, env=dict(os.environ))
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    # The matrix is the paper's; what goes beyond it, in cells or in seeds, is published too.
    papers = [run for run in RUNS if "-named" not in run.parent.name and run.name in ("seed_1", "seed_2", "seed_3")]
    assert sum(line.startswith("complete ") for line in lines) == len(papers)
    assert sum("seed" in line and not line.startswith("complete ") for line in lines) == 21 - len(papers)
