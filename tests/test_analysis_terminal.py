"""The summary that the analysis prints: whole in a pipe, and in a terminal as wide as that is."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from analysis_runs import rows_reaching, write_run
from rich.console import Console

from analysis.report.terminal import print_summary

ROOT = Path(__file__).resolve().parents[1]
BASE = "Ant-v5-none-batch_size=1024-hidden_sizes=64+64-learning_starts=1000-max_episode_steps=250-q_lr="
GROUPS = [f"{BASE}{rate}-total_timesteps=100000" for rate in ("0.0001", "0.0003", "0.003")]


@pytest.mark.parametrize("columns", ["", "40", "80"])
def test_in_a_pipe_nothing_is_cropped(columns: str, tmp_path: Path) -> None:
    for group in GROUPS:
        summary = {"cell": None, "run": group, "env": "Ant-v5"}
        made = write_run(tmp_path / "made", "A1", 1, rows_reaching(50_000, 100_000), total=100_000, summary=summary)
        (tmp_path / "runs" / group).mkdir(parents=True)
        made.rename(tmp_path / "runs" / group / "seed_1")
        config = tmp_path / "runs" / group / "seed_1" / "config.yaml"
        config.write_text(config.read_text().replace("name: armless_humanoid", "name: Ant-v5"))
    environment = {key: value for key, value in os.environ.items() if key != "COLUMNS"} | {"PYTHONPATH": str(ROOT)}
    environment |= {"COLUMNS": columns} if columns else {}
    command = [sys.executable, "-m", "analysis", str(tmp_path / "runs"), "--summary"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    table = done.stdout.split("\n\n")[0]
    assert "…" not in table
    assert "log-rank p" in table
    longest = max(map(len, table.splitlines()[2:]))
    assert longest > 100, table


def shown(width: int, groups: list[str], biased: bool = False) -> list[str]:
    cells = pd.DataFrame(
        {
            "group": group,
            "reached": 3,
            "runs": 3,
            "mean": 1234567.0,
            "std": 8.0,
            "restricted_mean": 9.0,
            "biased": biased,
        }
        for group in groups
    )
    tests = [
        {"index": group, "reference": groups[0], "runs_reference": 3, "runs_index": 3, "t_score": 1.0, "p_value": 0.5,
         "p_log_rank": 0.25}
        for group in groups
    ]  # fmt: skip
    console = Console(width=width, file=io.StringIO(), highlight=False)
    print_summary(cells, pd.DataFrame(tests), "Steps", console)
    return console.file.getvalue().splitlines()[2:]


@pytest.mark.parametrize("width", [40, 60, 80, 120, 250])
@pytest.mark.parametrize("biased", [False, True])
def test_in_a_terminal_names_give_way_and_stay_different(width: int, biased: bool) -> None:
    lines = shown(width, GROUPS, biased)
    assert len(lines) == len(GROUPS)
    assert all(len(line) <= width for line in lines)
    assert len({line.split()[0] for line in lines}) == len(GROUPS), "three rates, three names"
    assert all("3 of 3" in line for line in lines)
    assert all((" (biased)" in line) is biased for line in lines)


def test_short_names_leave_room_for_all() -> None:
    assert shown(80, ["A0", "A[b]1"])[1].split() == [
        "A[b]1",
        "3",
        "of",
        "3",
        "1,234,567",
        "8",
        "A0",
        "1.000",
        "0.500",
        "0.250",
    ]
