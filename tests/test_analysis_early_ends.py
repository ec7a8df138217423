"""While runs that stop at their threshold are under way, the fast ones have ended: what is then made of their cell."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
from analysis_runs import rows_reaching, write_cut, write_matrix, write_run, write_under_way

from analysis.analyze import Analysis, analyze
from analysis.cli import main
from analysis.loading.load import load
from analysis.loading.missing import matrix_command, missing_runs

TOTAL, LIMIT = 20_000, 15_000
A0 = (8000, 9900, 9000)
P_VALUES = ["t_score", "p_value", "p_holm", "p_permutation", "p_restricted", "p_log_rank", "restricted_difference"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_matrix(tmp_path / "runs", {"A0": A0}, total=TOTAL, length=100)
    return tmp_path / "runs"


def ended(root: Path, seed: int, steps: float | None, cell: str = "A2") -> None:
    write_cut(root, cell, seed, rows_reaching(steps, TOTAL), TOTAL, after=LIMIT)


def under_way(root: Path, seed: int, step: int, cell: str = "A2") -> Path:
    return write_under_way(root, cell, seed, step, TOTAL, after=LIMIT)


def row_of(root: Path, index: str = "A2") -> dict:
    return analyze(load(root)).table3.set_index("index").loc[index].to_dict()


def is_biased(analysis: Analysis, cell: str = "A2") -> bool:
    return bool(analysis.cells.set_index("group").loc[cell, "biased"])


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ({2: 5900, 3: 600}, "and seeds 2 (unfinished at step 5,900), 3 (unfinished at step 600) have not ended"),
        ({2: 9000}, "and seed 3 (missing) has not ended"),
        ({}, "and seeds 2 (missing), 3 (missing) have not ended"),
    ],
)
@pytest.mark.first_is_fast
def test_a_cell_of_which_the_fast_runs_have_ended_is_biased(root, others, said):
    ended(root, 1, 6000)
    for seed, step in others.items():
        under_way(root, seed, step)
    row = row_of(root)
    assert (row["biased_reference"], row["biased_index"], row["n_index"], row["mean_index"]) == (False, True, 1, 6000)
    assert all(math.isnan(row[name]) for name in P_VALUES)
    assert said in row["note"]
    open_seeds = ",".join(str(seed) for seed in (2, 3) if others.get(seed, 0) < 6000)
    command = f"python run.py matrix=paper experiment=A2 seed={open_seeds} stop=threshold stop_after={LIMIT}"
    assert row["note"].endswith(f"Type {command}")


@pytest.mark.slow
def test_runs_past_the_slowest_that_ended_count_as_not_reached_yet(root):
    ended(root, 1, 6000)
    ended(root, 2, 6300)
    folder = under_way(root, 3, 6200)
    assert row_of(root)["biased_index"]
    # Its last episode ended at 6,200; it says itself that it is past 6,300.
    (folder / "status.json").write_text('{"state": "running", "global_step": 6301, "total_timesteps": 15000}')
    analysis = analyze(load(root))
    row = analysis.table3.set_index("index").loc["A2"]
    assert not is_biased(analysis)
    assert (row["runs_index"], row["censored_index"], row["horizon"]) == (3, 1, 6301)
    assert math.isnan(row["t_score"])  # the mean of those that have ended would flatter
    assert row["restricted_mean_index"] == pytest.approx((6000 + 6300 + 6301) / 3)
    assert math.isfinite(row["p_log_rank"])
    run = analysis.measured[~analysis.measured.index.isin(load(root).runs.query("counted").index)].iloc[0]
    assert (run["state"], run["time"]) == ("unfinished", 6301)
    assert "counts: not reached by step 6,301" in run["reason"]
    assert math.isnan(run["asymptotic_return"])
    assert [(miss.cell, miss.seed) for miss in analysis.missing if miss.cell == "A2"] == [("A2", 3)]


def test_all_ended_is_not_biased_and_neither_are_full_runs(root):
    for seed, steps in enumerate((6000, None, 5900), start=1):
        ended(root, seed, steps)
    write_run(root, "A3", 1, rows_reaching(6000, TOTAL), total=TOTAL)
    write_run(root, "A3", 2, rows_reaching(7000, TOTAL), total=TOTAL)
    write_run(root, "A3", 3, rows_reaching(None, 3000), total=TOTAL, summary=False)
    analysis = analyze(load(root))
    assert not analysis.cells["biased"].any()
    assert analysis.notices == []
    assert analysis.table3.set_index("index").loc["A3", "note"] == "A3: 2 of 3 runs"
    assert math.isfinite(analysis.table3.set_index("index").loc["A3", "p_value"])


def test_a_full_run_beside_stopped_ones_is_compared_with_them(root):
    write_run(root, "A2", 1, rows_reaching(5000, TOTAL), total=TOTAL)
    ended(root, 2, 5900)
    write_run(root, "A2", 3, rows_reaching(None, 4000), total=TOTAL, summary=False)
    assert row_of(root)["biased_index"]


def test_a_run_that_has_reached_but_not_ended_is_known(root):
    ended(root, 1, 6000)
    ended(root, 2, 6300)
    write_run(root, "A2", 3, rows_reaching(4000, 5000), total=TOTAL, summary=False)
    analysis = analyze(load(root))
    row = analysis.table3.set_index("index").loc["A2"]
    assert (row["n_index"], row["mean_index"], row["horizon"]) == (3, pytest.approx((6000 + 6300 + 4000) / 3), LIMIT)
    assert math.isfinite(row["p_value"])


@pytest.mark.parametrize(("steps", "used"), [({4: 7000}, (1, 2, 3)), ({4: 7000, 5: 7500}, (1, 2, 3, 4, 5))])
@pytest.mark.first_is_fast
def test_further_seeds_wait_for_one_another_while_the_papers_are_used(root, steps, used):
    for seed, reached in {1: 6000, 2: 6300, 3: 5900, **steps}.items():
        ended(root, seed, reached)
    write_run(root, "A0", 5, rows_reaching(9000, TOTAL), total=TOTAL)
    analysis = analyze(load(root))
    own = analysis.measured[analysis.measured["cell"] == "A2"]
    assert tuple(own.loc[own["counted"], "seed"]) == used
    assert not is_biased(analysis)
    waiting = own[~own["counted"]]
    assert set(waiting["state"]) <= {"waiting"}
    assert all("counts once seed 5 of its group is known" in reason for reason in waiting["reason"])


def test_the_reference_may_be_the_biased_one(tmp_path):
    ended(tmp_path, 1, 8000, "A0")
    under_way(tmp_path, 2, 500, "A0")
    for seed, steps in enumerate((6000, 6300, 5900), start=1):
        ended(tmp_path, seed, steps)
    row = row_of(tmp_path)
    assert (row["biased_reference"], row["biased_index"]) == (True, False)
    assert all(math.isnan(row[name]) for name in P_VALUES)


@pytest.mark.parametrize("asked", [4900.0, 100.0])
@pytest.mark.first_is_fast
def test_the_slowest_is_the_one_that_ended_last_whatever_is_asked_for(root, asked):
    for seed, steps in ((1, 6000), (2, 6300)):
        ended(root, seed, steps)
    # At this step a lower threshold has been met by all; but which runs have ended was decided later.
    under_way(root, 3, 6250)
    assert is_biased(analyze(load(root), threshold=asked)) == (asked == 4900.0)


def test_what_is_typed_goes_on_as_the_runs_began(root):
    ended(root, 1, 6000)
    under_way(root, 2, 500)
    data = load(root)
    lines = {(run.cell, run.seed): run.command for run in missing_runs(data)}
    stop = f"stop=threshold stop_after={LIMIT}"
    assert lines["A2", 2] == f"python run.py experiment=A2 seed=2 {stop}"
    assert lines["A2", 3] == f"python run.py experiment=A2 seed=3 {stop}"
    assert lines["A3", 1] == f"python run.py experiment=A3 seed=1 {stop}"
    assert lines["H0", 1] == "python run.py experiment=H0 seed=1"  # students need the whole of it
    assert matrix_command(data) == f"python run.py matrix=paper experiment=H0,H1,A1,A2,A3,A4 seed=1,2,3 {stop}"


@pytest.mark.slow
def test_the_mark_is_seen_wherever_the_cell_is(root, tmp_path, capsys):
    ended(root, 1, 6000)
    under_way(root, 2, 500)
    out = tmp_path / "out"
    assert main([str(root), "--out", str(out), "--no-stills", "--format", "svg"]) == 0
    said = capsys.readouterr().out
    assert "A2 (biased)" in said
    assert "A2: biased, so no test" in said
    for name in ("table3.md", "table3.tex", "cells.md", "report.html"):
        assert "A2 (biased)" in (out / name).read_text(), name
    assert "A2: biased, so no test" in (out / "report.html").read_text()
    with (out / "table3.csv").open() as file:
        rows = {row["index"]: row for row in csv.DictReader(file)}
    assert (rows["A2"]["biased_index"], rows["A2"]["p_value"], rows["A1"]["biased_index"]) == ("True", "NaN", "False")
    assert "biased: only its fast runs have ended" in (out / "published_table3.md").read_text()
