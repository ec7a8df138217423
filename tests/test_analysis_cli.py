"""The command as a user types it: what it writes, what it says, its exit codes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from analysis_runs import rows_reaching, write_run

from acmr.cells import CELLS
from analysis import FORMATS
from analysis.cli import main
from analysis.figures import stills
from analysis.figures.paper import picture, save
from analysis.figures.style import apply
from analysis.loading.load import load
from analysis.loading.setting_differences import setting_differences

ROOT = Path(__file__).resolve().parent.parent


def command(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Runs the command in a process of its own, as from the project's folder."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    line = [sys.executable, "-m", "analysis", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, cwd=cwd, env=environment, check=False)


def test_the_same_figure_has_the_same_bytes(tmp_path):
    apply()
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        save(picture(np.linspace(0, 1, 300).reshape(10, 10, 3)), tmp_path / name, "picture", FORMATS)
    for kind in FORMATS:
        one, two = (tmp_path / name / f"picture.{kind}" for name in ("one", "two"))
        assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_figures_2_and_3_are_rendered_or_one_line_says_what_is_missing(tmp_path):
    rendering = stills.start(("humanoid", "no_such_robot"), tmp_path)
    (image, problem), (nothing, line) = (stills.finish(still) for still in rendering)
    if image is None:
        assert problem
        assert "\n" not in problem
    else:
        assert image.shape[:2] == (stills.SIZE, stills.SIZE)
        assert image.std() > 0.02
    assert nothing is None
    assert line
    assert "\n" not in line


@pytest.mark.slow
def test_results_are_not_made_again_if_nothing_has_changed(tmp_path, monkeypatch, capsys):
    directory = write_run(tmp_path / "runs" / "paper", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    monkeypatch.chdir(tmp_path)
    line = ["runs/paper", "--no-stills", "--format", "svg", "--if-changed"]
    report = tmp_path / "results" / "paper" / "report.html"
    assert main(line) == 0
    stale = report.with_name("comparisons.csv")
    stale.write_text("of a group that is gone")
    before = report.stat().st_mtime_ns
    capsys.readouterr()
    assert main(line) == 0
    assert "nothing has changed" in capsys.readouterr().out
    assert report.stat().st_mtime_ns == before
    with (directory / "episodes.csv").open("a") as file:
        file.write("20100,1.0,100,1.0,1.0,1.0\n")
    assert main(line) == 0
    assert "nothing has changed" not in capsys.readouterr().out
    assert report.stat().st_mtime_ns > before
    assert not stale.exists()
    assert main([*line, "--threshold", "100"]) == 0
    assert "nothing has changed" not in capsys.readouterr().out


def test_the_summary_alone_writes_nothing(tmp_path):
    write_run(tmp_path / "runs" / "paper", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    done = command("runs/paper", "--summary", cwd=tmp_path)
    assert done.returncode == 0
    assert "6,000" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"runs"}


BAD = {
    "runs/nowhere": "no such folder; give one with runs, as in runs/paper (python run.py matrix=paper makes it)",
    "runs/file": "is no folder",
    "runs/paper --threshold x": "'x': a finite return is needed, as in 4900",
    "runs/paper --threshold nan": "a finite return is needed",
    "runs/paper --consecutive 0": "a whole number of at least 1",
    "runs/paper --consecutive 2.5": "a whole number of at least 1",
    "runs/paper --window -3": "a whole number of at least 1",
    "runs/paper --format jpg": "one or more of pdf,png,svg",
    "runs/paper --reference A7": "must be one of H0, H1, A0",
    "runs/paper --treshold 3": "unrecognized arguments",
    "runs/paper --out runs/file/x": "Not a directory",
    "": "the following arguments are required: RUNS",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_gives_one_line_and_exit_code_2(line, tmp_path, monkeypatch, capsys):
    write_run(tmp_path / "runs" / "paper", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    (tmp_path / "runs" / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    try:
        code = main([*line.split(), "--no-stills"])
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    assert code == 2
    assert BAD[line] in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_an_empty_folder_says_what_is_missing(tmp_path, monkeypatch, capsys):
    (tmp_path / "runs" / "quick").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert main(["runs/quick"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert "no run with episodes" in lines[0]
    assert lines[1] == "missing: 21 of the 21 runs of the matrix; all of them: python run.py matrix=quick"
    assert lines[2] == "  H0 H1 A0 A1 A2 A3 A4: seed 1, 2, 3"
    assert lines[3] == "  each of them as in: python run.py experiment=H0 seed=1 profile=quick"


def test_a_folder_of_damaged_runs_says_why(tmp_path, monkeypatch, capsys):
    directory = write_run(tmp_path / "runs" / "paper", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    (directory / "episodes.csv").write_text("no,such,columns\n")
    monkeypatch.chdir(tmp_path)
    assert main(["runs/paper"]) == 1
    assert "armless_humanoid-none/seed_1 (damaged): episodes.csv: no column global_step" in capsys.readouterr().err


def test_help_says_what_there_is(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    said = capsys.readouterr().out
    assert stop.value.code == 0
    for option in (
        "RUNS",
        "--out",
        "--threshold",
        "--consecutive",
        "--reference",
        "--format",
        "python -m analysis runs/",
    ):
        assert option in said


def test_settings_that_differ_are_found(tmp_path):
    for cell in ("A0", "A2"):
        for seed in (1, 2):
            more = {"threads": 8} if (cell, seed) == ("A2", 2) else {}
            summary = {"git_commit": "abc" if cell == "A2" else "def", "machine": {"cpu": "one"}}
            write_run(tmp_path, cell, seed, rows_reaching(6000, 20_000), total=20_000, summary=summary, **more)
    defining, differing = setting_differences(load(tmp_path))
    assert defining["setting"].tolist() == ["freeze", "transfer.name"]
    assert defining["A2"].tolist() == ["true", "hidden"]
    assert differing.set_index("setting").to_dict("index") == {
        "threads": {"A0": "1", "A2": "1 (seed 1); 8 (seed 2)"},
        "git_commit": {"A0": "def", "A2": "abc"},
    }


def test_a_setting_that_some_runs_were_made_before_is_found(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    env = {"name": "armless_humanoid", "id": "Humanoid-v4", "kwargs": {"healthy_reward": 2.0}}
    write_run(tmp_path, "A2", 1, rows_reaching(6000, 20_000), total=20_000, stop="threshold", env=env)
    defining, differing = setting_differences(load(tmp_path))
    assert defining.set_index("setting").loc["env.kwargs.healthy_reward"].to_dict() == {"A0": "not set", "A2": "2.0"}
    assert differing.to_dict("records") == [{"setting": "stop", "A0": "horizon", "A2": "threshold"}]


@pytest.mark.slow
def test_any_part_of_the_matrix_makes_a_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for number, cell in enumerate(CELLS):
        root = tmp_path / f"part{number}"
        summary = number % 2 == 0
        write_run(root, cell, 1, rows_reaching(6000 if number % 3 else None, 20_000), total=20_000, summary=summary)
        assert main([root.name, "--summary"]) == 0
    root = tmp_path / "part0"
    assert main([root.name, "--out", "out", "--no-stills", "--format", "svg"]) == 0
    assert (tmp_path / "out" / "report.html").is_file()
    assert (tmp_path / "out" / "figure_4.svg").is_file()
    assert not (tmp_path / "out" / "figure_4.png").exists()
    assert "of the 21 runs" in capsys.readouterr().out
