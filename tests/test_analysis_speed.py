"""How fast runs learned, as the figure shows it."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from analysis_runs import rows_reaching, write_run

from analysis.figures.data import training_speeds
from analysis.loading.load import load
from analysis.loading.speed import POINTS, read_speed
from analysis.statistics.metrics import measure

HEADER = "global_step,steps_per_second,critic_loss\n"


def write(folder: Path, rows: list[tuple[float, float]]) -> None:
    (folder / "metrics.csv").write_text(HEADER + "".join(f"{step},{speed},nan\n" for step, speed in rows))


def test_a_short_run_is_shown_row_by_row_once_it_learns(tmp_path):
    write(tmp_path, [(1000, 5000.0), (2000, 110.5), (3000, 90.0)])
    speed = read_speed(tmp_path, start=1000)
    assert speed.to_dict("list") == {"step": [2000.0, 3000.0], "steps_per_second": [110.5, 90.0]}
    assert len(read_speed(tmp_path)) == 3


@pytest.mark.parametrize("count", [POINTS, POINTS + 1, 1000, 1001])
def test_a_long_run_is_shown_as_medians(tmp_path, count):
    values = np.random.default_rng(count).uniform(50, 150, count)
    write(tmp_path, [(1000 * (row + 1), value) for row, value in enumerate(values)])
    speed = read_speed(tmp_path)
    size = int(np.ceil(count / POINTS))
    assert len(speed) <= POINTS
    chunks = [values[at : at + size] for at in range(0, count, size)]
    assert speed["steps_per_second"].tolist() == pytest.approx([float(np.median(chunk)) for chunk in chunks])
    assert speed["step"].tolist() == [1000.0 * min(count, at + size) for at in range(0, count, size)]


def test_a_compressed_file_is_read_as_well(tmp_path):
    (tmp_path / "metrics.csv.gz").write_bytes(gzip.compress(f"{HEADER}1000,95.5,nan\n".encode()))
    assert read_speed(tmp_path)["steps_per_second"].tolist() == [95.5]


@pytest.mark.parametrize(
    "content", [None, b"", b"global_step,loss\n1,2\n", b"\xff\xfe\x00", HEADER.encode(), b"\x1f\x8b damaged"]
)
def test_what_cannot_be_read_is_left_out(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.csv").write_bytes(content)
    assert read_speed(tmp_path).empty


def test_a_line_that_was_cut_off_costs_only_itself(tmp_path):
    (tmp_path / "metrics.csv").write_text(f"{HEADER}1000,95.5,nan\n2000,inf,nan\n3000,one,nan\n4000")
    assert read_speed(tmp_path)["steps_per_second"].tolist() == [95.5]


def test_every_run_that_is_drawn_has_its_speed(tmp_path):
    for cell, seed in (("H0", 1), ("A0", 1), ("A0", 2)):
        write_run(tmp_path, cell, seed, rows_reaching(9000, 20_000), total=20_000)
    next(tmp_path.glob("*/seed_2/metrics.csv")).unlink()
    data = load(tmp_path)
    speeds = training_speeds(tmp_path, measure(data, 4900, 5), data.groups)
    assert speeds.groupby("group")["run"].nunique().to_dict() == {"A0": 1, "H0": 1}
    assert set(speeds["steps_per_second"]) == {111.0}
    assert speeds["step"].min() > 100
    assert training_speeds(tmp_path, measure(data, 4900, 5), []).empty
