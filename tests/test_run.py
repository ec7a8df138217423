"""The program as a user starts it: real processes, real environments, real files."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from acmr.cells import cell_of, planned_cells
from acmr.transfer.teacher import load_teacher

PAPER = [cell.name for cell in planned_cells([])]
ROOT = Path(__file__).resolve().parent.parent
SHORT = ["profile=quick", "total_timesteps=1400", "tracking=off", "log_every=400"]


def run(*arguments: str, cwd: Path = ROOT, expect: int = 0) -> subprocess.CompletedProcess[str]:
    """Starts run.py, and shows what it said if it ends otherwise than expected."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == expect, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def seven(tmp_path_factory) -> Path:
    """One short run of each of the seven cells, made through run.py itself."""
    output = tmp_path_factory.mktemp("runs")
    for cell in ("H0", *(name for name in PAPER if name != "H0")):
        run(f"experiment={cell}", f"output_dir={output}", *SHORT)
    return output


def folders(output: Path) -> dict[str, Path]:
    found = {}
    for path in output.glob("quick/*/seed_1/summary.json"):
        summary = json.loads(path.read_text())
        key = (summary["env"], summary["transfer"], summary["freeze"])
        roles = {"ant": "source", "ant_three_legs": "target"}
        found[cell_of(roles[key[0]], *key[1:], {})] = path.parent
    return found


def test_each_cell_leaves_a_whole_run(seven):
    assert set(folders(seven)) == set(PAPER)
    for cell, folder in folders(seven).items():
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["status"] == "complete"
        assert summary["global_step"] == 1400
        assert summary["cell"] is None  # shortened: not the paper's
        assert summary["run"] == folder.parent.name
        assert (summary["censored"], summary["steps_to_threshold"]) == (True, None)
        rows = list(csv.DictReader((folder / "episodes.csv").open()))
        assert len(rows) == summary["episodes"] > 0
        assert list(rows[0])[:4] == ["global_step", "episodic_return", "episode_length", "mean_forward_velocity"]
        terms = [name for name in rows[0] if name.startswith("reward_")]
        assert len(terms) == 4
        for row in rows:
            assert sum(float(row[name]) for name in terms) == pytest.approx(float(row["episodic_return"]), abs=1e-4)
        steps = [int(row["global_step"]) for row in rows]
        assert steps == [sum(int(row["episode_length"]) for row in rows[: i + 1]) for i in range(len(rows))]
        metrics = list(csv.DictReader((folder / "metrics.csv").open()))
        assert [int(row["global_step"]) for row in metrics] == [400, 800, 1200]
        assert yaml.safe_load((folder / "config.yaml").read_text())["total_timesteps"] == 1400, cell


def test_transfers_copied_the_teacher_of_the_same_seed(seven):
    teacher = load_teacher(folders(seven)["H0"])
    assert teacher.description.environment == "ant"
    assert teacher.description.dims.observation == 27
    for cell, folder in folders(seven).items():
        report = json.loads((folder / "transfer.json").read_text())
        final = load_teacher(folder)
        if cell in ("H0", "A0"):
            assert report["teacher"] is None
            continue
        assert report["teacher"]["sha256"] == teacher.description.sha256
        for layer in report["copied"]:
            for part in ("weight", "bias"):
                same = torch.equal(final.tensors[f"{layer}.{part}"], teacher.tensors[f"{layer}.{part}"])
                assert same == (layer in report["frozen"]), (cell, layer)


@pytest.mark.slow
def test_same_seed_same_bytes_and_another_seed_other_ones(seven, tmp_path):
    folder = folders(seven)["A0"]
    run("experiment=A0", f"output_dir={tmp_path}", *SHORT)
    run("experiment=A0", "seed=2", f"output_dir={tmp_path}", *SHORT)
    again = tmp_path / folder.relative_to(seven)
    other = again.parent / "seed_2"
    for name in ("episodes.csv", "teacher.safetensors", "transfer.json"):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name
    assert (other / "teacher.safetensors").read_bytes() != (folder / "teacher.safetensors").read_bytes()


@pytest.mark.slow
def test_a_complete_run_is_left_alone_and_force_repeats_it(seven):
    folder = folders(seven)["A0"]
    before = (folder / "summary.json").stat().st_mtime_ns
    said = run("experiment=A0", f"output_dir={seven}", *SHORT).stdout
    assert "complete already" in said
    assert "force=true" in said
    assert (folder / "summary.json").stat().st_mtime_ns == before
    networks = (folder / "teacher.safetensors").read_bytes()
    run("experiment=A0", f"output_dir={seven}", "force=true", *SHORT)
    assert (folder / "summary.json").stat().st_mtime_ns > before
    assert (folder / "teacher.safetensors").read_bytes() == networks


def test_a_directory_with_other_settings_is_refused(seven):
    config, summary = (folders(seven)["A1"] / name for name in ("config.yaml", "summary.json"))
    original, sealed = config.read_text(), summary.read_text()
    try:
        # As older runs left it, which nobody can tell was changed since.
        summary.write_text(json.dumps({"status": "complete"}))
        config.write_text(original.replace("gamma: 0.99", "gamma: 0.5"))
        said = run("experiment=A1", f"output_dir={seven}", *SHORT, expect=2).stderr
        assert "holds a run with other settings (agent.gamma)" in said
    finally:
        config.write_text(original)
        summary.write_text(sealed)


@pytest.mark.slow
def test_a_teacher_by_path(seven, tmp_path):
    teacher = folders(seven)["H0"]
    for path in (teacher, teacher / "teacher.safetensors"):
        run("experiment=A3", f"transfer.teacher={path}", f"output_dir={tmp_path}", *SHORT)
    runs = list(tmp_path.glob("quick/*/seed_1"))
    assert len(runs) == 1  # one teacher, however its path is written
    assert "teacher=" in runs[0].parent.name


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["sed=1"], "did you mean seed or seeding?"),
        (["transfer=hiden"], "did you mean transfer=hidden?"),
        (["transfer=none", "freeze=true"], "type freeze=false, or type transfer=hidden"),
        (["transfer=direct"], "the source environment ant has 27 sensors and 8 actuators, the student 23 sens"),
        (["total_timesteps=-5"], "an integer of at least 1"),
        (["experiment=A2"], "train it with: python run.py profile=quick env=ant seed=1"),
        (["experiment=A2", "transfer.teacher=nowhere"], "no such teacher file"),
        (["env=gym", "env.id=Hoper-v5"], "Hopper-v5"),
        (["device=tpu"], "must be cpu or cuda"),
        (["tracking.tracker=acmr.nowhere.Tracker"], "no such class (ModuleNotFoundError: No module named"),
        (["output_dir=/dev/null/x"], "cannot be written"),
    ],
)
@pytest.mark.first_is_fast
def test_what_cannot_be_run_says_so_in_one_line_and_creates_nothing(arguments, says, tmp_path):
    done = run("profile=quick", "tracking=off", *arguments, cwd=tmp_path, expect=2)
    assert says in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_any_gymnasium_environment(tmp_path, monkeypatch):
    # A graphics library that is missing matters to pictures only.
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    common = ["env=gym", "env.id=Hopper-v5", f"output_dir={tmp_path}", *SHORT]
    run(*common)
    run(*common, "env.drop_sensors=[qvel/*]", "transfer=expand")
    (student,) = tmp_path.glob("quick/Hopper-v5-expand-*/seed_1")
    assert load_teacher(student).description.dims.observation == 5


@pytest.mark.slow
def test_the_real_humanoid_and_its_armless_student(tmp_path):
    steps = ["total_timesteps=5050", "tracking=off", f"output_dir={tmp_path}"]
    run("env=humanoid", *steps)
    for cell in ("A2", "A4"):
        run(f"experiment={cell}", *steps)
    report = json.loads(next(tmp_path.glob("paper/armless_humanoid-expand-frozen*/seed_1/transfer.json")).read_text())
    assert report["fresh"] == [
        "actor.input_adapter", "actor.mean_adapter", "actor.log_std_adapter", "critic_1.input_adapter",
        "critic_2.input_adapter",
    ]  # fmt: skip
    # 270 -> 376, 17 -> 11 twice, and 281 -> 393 in each critic, weights and biases.
    assert report["parameters"]["fresh"] == 271 * 376 + 2 * 18 * 11 + 2 * 282 * 393
    # Actor 376-256-256-(17, 17), critics 393-256-256-1.
    actor = 377 * 256 + 257 * 256 + 2 * 257 * 17
    critic = 394 * 256 + 257 * 256 + 257
    assert report["parameters"]["copied"] == report["parameters"]["frozen"] == actor + 2 * critic


def test_help_lists_groups_and_settings():
    said = run("--help").stdout
    for word in ("transfer: direct, expand, hidden, named, none", "total_timesteps: 1000000", "experiment=A2 seed=3"):
        assert word in said
