"""docs/howto-cell.md, done literally: its cell stands in tables, comparisons, figures and the report."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from guides import ROOT, blocks, copy_checkout, do

#: A copy of the project, with trainings and an analysis of its own.
pytestmark = pytest.mark.slow
GUIDE = ROOT / "docs" / "howto-cell.md"
#: As the trainings of the guide would, lays out runs of A0, A2 and A5; with the rows of the copy.
RUNS = """
from pathlib import Path
from analysis_runs import write_matrix
times = {"A0": (8000, 9900, 9000), "A2": (6000, 6300, 5900), "A5": (5000, 5200, 4700)}
write_matrix(Path("runs/quick"), times, total=20_000, length=100, profile="quick")
"""


def inside(folder: Path, *command: str) -> str:
    """Runs Python in the copy, which it imports, with the tests' helpers."""
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{folder}:{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, str, str]:
    """The folder in which the guide was followed; what planning and analysis said."""
    folder = copy_checkout(tmp_path_factory.mktemp("guide") / "checkout")
    said = {"plan=true": "", "-m analysis": ""}
    for block in blocks(GUIDE):
        if "-m analysis" in block.text:
            inside(folder, "-c", RUNS)
        for words in said:
            if words in block.text and block.language == "bash":
                said[words] = do(block, folder)
                break
        else:
            do(block, folder)
    return folder, *said.values()


def test_it_is_run_by_its_name(done):
    _, planned, _ = done
    rows = [line.split() for line in planned.splitlines() if " A5 " in line]
    name = "runs/quick/ant_three_legs-hidden-frozen-q_lr=0.0005"
    assert rows == [["stage", "2", "A5", f"{name}/seed_{seed}"] for seed in (1, 2, 3)]


def test_it_stands_in_every_table(done):
    folder, _, said = done
    out = folder / "results" / "quick"
    row = pd.read_csv(out / "table2.csv").set_index("Experiment").loc["A5"]
    assert row[["Environment", "Configuration", "transfer", "settings", "runs"]].tolist() == [
        "Target", "Slow critics", "hidden", "agent.q_lr=0.0005", 3,
    ]  # fmt: skip
    table = pd.read_csv(out / "table3.csv").set_index("index")
    assert table.loc["A5", "reference"] == "A0"
    assert table.loc["A5", "t_score"] < 0
    # Holm's least p-value is multiplied by the comparisons that were made: A2 and A5 have runs.
    assert table.loc["A5", "p_holm"] == pytest.approx(2 * table.loc["A5", "p_value"])
    assert not (out / "comparisons.csv").exists()
    assert re.search(r"^A5 +3 of 3 +4,967", said, re.MULTILINE)


def test_it_is_drawn_and_reported(done):
    folder, _, _ = done
    out = folder / "results" / "quick"
    page = (out / "report.html").read_text()
    assert "A5 (3 runs)." in page
    assert "A1, A2, A3, A4, A5 answer one question five times" in page
    assert page.count('title="ant_three_legs-hidden-frozen-q_lr=0.0005/seed_') == 3
    assert "experiment=H0,H1,A0,A1,A2,A3,A4,A5" in page
    # In its own color: raw returns, curve, and the dashed line at its steps to threshold.
    navy = "stroke: #000080"
    assert (out / "figure_5.svg").read_text().count(navy) >= 3
    assert navy not in (out / "figure_4.svg").read_text()


def test_the_tests_that_go_over_every_cell_include_it(done):
    folder, _, _ = done
    shutil.copytree(ROOT / "tests", folder / "tests")
    said = inside(folder, "-m", "pytest", "-q", "-k", "A5 or rows", "tests/test_cells.py", "tests/test_config.py")
    assert re.search(r"\b[4-9] passed", said), said
