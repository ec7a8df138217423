"""Runs that stop at their threshold: what they tell counts, and what they cannot tell is left out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from analysis_runs import (
    realistic_rows,
    rows_reaching,
    write_cut,
    write_matrix,
    write_run,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from analysis.analyze import Analysis, analyze
from analysis.cli import main
from analysis.figures.data import learning_curves, leaving, mean_curve
from analysis.loading.load import load
from analysis.statistics.comparisons import compare
from analysis.statistics.summaries import scores, transfer_table
from analysis.statistics.survival import kaplan_meier

TOTAL = 20_000
#: Steps to threshold; None: never.
TIMES = {"A0": (8000, 9900, 9000), "A2": (6000, 6300, 5900), "A4": (None, 15_000, None)}


def write_stopped(root: Path, times: dict[str, tuple[float | None, ...]], after: int | None = None) -> None:
    for cell, values in times.items():
        for seed, steps in enumerate(values, start=1):
            write_cut(root, cell, seed, rows_reaching(steps, TOTAL), TOTAL, after)


def analysis_of(root: Path, **options: float) -> Analysis:
    return analyze(load(root), **options)


#: What no cut may change.
KEPT = [
    *("n_reference", "n_index", "mean_reference", "std_reference", "mean_index", "std_index", "t_score", "p_value"),
    *("p_holm", "p_permutation", "hedges_g", "censored_reference", "censored_index", "horizon"),
    *("restricted_mean_reference", "restricted_mean_index", "restricted_difference", "p_restricted"),
    *("log_rank_z", "p_log_rank", "p_log_rank_asymptotic", "note"),
]


@settings(max_examples=4, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32 - 1), st.sampled_from([None, 14_000]), st.booleans())
@pytest.mark.slow
def test_cutting_runs_at_their_threshold_changes_nothing_that_is_asked_of_steps(tmp_path_factory, seed, after, mixed):
    root = tmp_path_factory.mktemp("runs")
    rng = np.random.default_rng(seed)
    for cell in ("A0", "A2", "H0"):
        for number in (1, 2, 3):
            rows = realistic_rows(rng, TOTAL, float(rng.uniform(2000, 16_000)))
            # With a limit the full runs are those of that length.
            total = after or TOTAL
            write_run(root / "full", cell, number, rows[rows[:, 0] <= total], total=total)
            write = write_run if mixed and rng.random() < 0.4 else write_cut
            write(root / "cut", cell, number, rows[rows[:, 0] <= total], total=total)
    full, short = (analysis_of(root / name) for name in ("full", "cut"))
    for column in ("steps_to_threshold", "steps_to_threshold_first", "initial_return"):
        assert short.measured[column].tolist() == pytest.approx(full.measured[column].tolist(), nan_ok=True)
    pd.testing.assert_frame_equal(short.table3[KEPT], full.table3[KEPT])
    columns = ["runs", "reached", "mean", "std", "low", "high", "restricted_mean", "biased"]
    pd.testing.assert_frame_equal(short.cells[columns], full.cells[columns])
    for cell in ("A0", "A2", "H0"):
        curves = [
            kaplan_meier(own["time"], ~own["censored"].astype(bool))
            for own in (kind.measured[kind.measured["group"] == cell] for kind in (short, full))
        ]
        assert curves[0].steps.tolist() == curves[1].steps.tolist()
        assert curves[0].share.tolist() == curves[1].share.tolist()


def test_a_limit_below_the_full_length_is_where_runs_are_censored(tmp_path):
    write_stopped(tmp_path, TIMES, after=14_000)
    analysis = analysis_of(tmp_path)
    a4 = analysis.measured[analysis.measured["cell"] == "A4"]
    assert (a4["time"].tolist(), a4["censored"].tolist()) == ([14_000] * 3, [True] * 3)
    row = analysis.table3.set_index("index").loc["A4"]
    assert (row["horizon"], row["restricted_mean_index"], row["restricted_mean_reference"]) == (
        14_000, 14_000, pytest.approx(np.mean(TIMES["A0"]))
    )  # fmt: skip
    assert "unequal" not in row["note"]
    assert row["p_log_rank"] == pytest.approx(0.1)


def test_a_limit_of_its_own_is_an_unequal_length(tmp_path):
    write_matrix(tmp_path, {"A0": TIMES["A0"]}, total=TOTAL, length=100)
    write_stopped(tmp_path, {"A2": TIMES["A2"]}, after=14_000)
    row = analysis_of(tmp_path).table3.set_index("index").loc["A2"]
    assert row["horizon"] == 14_000
    assert "runs of unequal length" in row["note"]
    assert math.isfinite(row["t_score"])


@pytest.mark.parametrize(
    ("options", "censored", "times"),
    [
        ({"threshold": 5200.0}, True, [8000, 9900, 9000]),
        ({"consecutive": 6}, True, [8000, 9900, 9000]),
        ({"consecutive": 2}, False, [7700, 9600, 8700]),
        ({"threshold": 100.0}, False, None),
    ],
)
def test_asked_for_more_a_stopped_run_knows_nothing_beyond_its_end(tmp_path, options, censored, times):
    write_stopped(tmp_path / "cut", {"A0": TIMES["A0"]})
    write_matrix(tmp_path / "full", {"A0": TIMES["A0"]}, total=TOTAL, length=100)
    short, full = (analysis_of(tmp_path / name, **options) for name in ("cut", "full"))
    assert set(short.measured["censored"]) == {censored}
    assert short.measured["time"].tolist() == (times or full.measured["time"].tolist())
    if censored:
        note = compare(short.measured, "A0", "A0")["note"]
        assert "3 of 3 runs stopped at a threshold of their own before they met this one" in note
        assert full.measured["time"].tolist() != short.measured["time"].tolist()


def test_what_comes_after_the_end_is_left_out(tmp_path):
    write_matrix(tmp_path, {"A0": TIMES["A0"]}, total=TOTAL, length=100)
    write_stopped(tmp_path, {"A2": TIMES["A2"], "A4": (None, None, None)})
    analysis = analysis_of(tmp_path)
    measured = analysis.measured.set_index("cell", append=True)
    ends = measured[["asymptotic_return", "area_under_curve", "final_length", "final_velocity"]].notna().all(axis=1)
    # A run that may stop but never met its threshold took all its steps.
    assert ends.groupby("cell").agg(["any", "all"]).to_dict("index") == {
        "A0": {"any": True, "all": True}, "A2": {"any": False, "all": False}, "A4": {"any": True, "all": True}
    }  # fmt: skip
    assert set(scores(analysis.measured)) == {"A0", "A4"}
    table = transfer_table(analysis.measured, ["A0", "A2", "A4"]).set_index("group")
    assert table["full_runs"].tolist() == [3, 0, 3]
    assert table.loc["A2", ["asymptotic_return", "asymptotic_gain", "transfer_ratio"]].isna().all()
    assert math.isfinite(table.loc["A2", "jumpstart"])


def test_curves_end_with_the_run_and_the_mean_says_where_it_is_left(tmp_path):
    write_stopped(tmp_path, {"A0": (5000, 10_000, None)})
    data = load(tmp_path)
    measured = analyze(data).measured
    curves = learning_curves(measured, data.episodes, ["A0"], 5)
    last = curves.dropna().groupby("seed")["step"].max().tolist()
    assert last == pytest.approx([5000, 10_000, 20_000], abs=80)
    assert leaving(curves, "A0", "episodic_return")[0].tolist() == last[:2]
    steps, values = mean_curve(curves, "A0", "episodic_return")
    assert (
        values[steps > 10_000].tolist()
        == curves.loc[(curves["seed"] == 3) & (curves["step"] > 10_000), "episodic_return"].tolist()
    )


def test_of_a_stopped_and_a_full_run_the_full_one_counts(tmp_path, capsys):
    write_cut(tmp_path, "A0", 1, rows_reaching(8000, TOTAL), TOTAL)
    write_cut(tmp_path, "A0", 2, rows_reaching(9900, TOTAL), TOTAL, after=9000)
    write_cut(tmp_path, "A0", 3, rows_reaching(9000, TOTAL), TOTAL)
    write_matrix(tmp_path, {"A0": TIMES["A0"]}, total=TOTAL, length=100)
    analysis = analysis_of(tmp_path)
    counted = analysis.measured[analysis.measured["counted"]]
    assert counted.index.tolist() == [f"armless_humanoid-none/seed_{seed}" for seed in (1, 2, 3)]
    others = analysis.measured[~analysis.measured["counted"]]
    assert set(others["state"]) == {"superseded"}
    assert set(others["reason"]) == {f"{name} is the full run of the same group and seed" for name in counted.index}
    assert analysis.notices == []


@pytest.mark.parametrize(
    ("stopped", "after", "said"),
    [
        (8100, None, "their steps to threshold differ: 8,100 here, 8,000 in armless_humanoid-none/seed_1"),
        (None, 9000, "their steps to threshold differ: not reached by 9,000 here, 8,000 in"),
        (7000, 9000, "their steps to threshold differ: 7,000 here, 8,000 in"),
        (9000, 7000, ""),
        (8000, None, ""),
    ],
)
def test_runs_that_contradict_each_other_are_named(tmp_path, capsys, stopped, after, said):
    write_matrix(tmp_path / "runs", {"A0": (8000,)}, total=TOTAL, length=100)
    write_cut(tmp_path / "runs", "A0", 1, rows_reaching(stopped, TOTAL), TOTAL, after=after)
    assert main([str(tmp_path / "runs"), "--summary"]) == 0
    output = capsys.readouterr().out
    assert "(superseded): armless_humanoid-none/seed_1 is the full run" in output
    assert said in output
    assert ("differ" in output) == bool(said)
    assert [said in line for line in analysis_of(tmp_path / "runs").notices] == [True] * bool(said)


def test_of_two_stopped_runs_the_one_watched_longer_counts(tmp_path):
    for after in (7000, 12_000, None):
        write_cut(tmp_path, "A0", 1, rows_reaching(9000, TOTAL), TOTAL, after=after)
    runs = load(tmp_path).runs
    assert runs[runs["counted"]].index.tolist() == ["armless_humanoid-none-stop=threshold/seed_1"]
    assert runs["state"].tolist().count("superseded") == 2


def test_a_full_run_under_way_does_not_hide_a_stopped_one(tmp_path):
    write_cut(tmp_path, "A0", 1, rows_reaching(9000, TOTAL), TOTAL)
    write_run(tmp_path, "A0", 1, rows_reaching(9000, 12_000), total=TOTAL, summary=False)
    runs = load(tmp_path).runs
    assert runs[runs["counted"]].index.tolist() == ["armless_humanoid-none-stop=threshold/seed_1"]
    assert runs.loc["armless_humanoid-none/seed_1", "state"] == "duplicate"
