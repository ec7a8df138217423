"""Equivalence, replication, rliable's measures and costs: against formulas written out, simulations and slow counts."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from analysis_runs import rows_reaching, run_directory, write_cut, write_matrix, write_run
from scipy import stats
from statsmodels.stats.weightstats import ttost_ind, ttost_paired

from analysis.analyze import analyze
from analysis.cli import main
from analysis.loading.load import load
from analysis.report.study import study_lines
from analysis.statistics.study.aggregates import (
    LEAST_RUNS,
    aggregates,
    improvement,
    improvements,
    iqm,
    profile,
    stratified_interval,
)
from analysis.statistics.study.cost import costs
from analysis.statistics.study.equivalence import equivalence, margin_of, tost
from analysis.statistics.study.replication import predicted_effect, published_effect, verdict
from analysis.statistics.two_samples import hedges_g

TOTAL = 20_000


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("margin", [0.5, 2.0, 10.0])
def test_two_one_sided_tests_are_those_of_statsmodels(seed, margin):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(0, 1, 4), rng.normal(0.3, 2, 4)
    p = ttost_ind(second, first, -margin, margin, usevar="unequal")[0]
    found = tost(first, second, margin)
    assert found.p == pytest.approx(p)
    assert tost(first, second, margin, paired=True).p == pytest.approx(ttost_paired(second, first, -margin, margin)[0])
    # Alike is what has its 90% interval within the margin, and the least margin is where that begins.
    assert (found.p < 0.05) == (-margin < found.low and found.high < margin)
    assert tost(first, second, found.least_margin).p == pytest.approx(0.05)


@pytest.mark.parametrize("samples", [((1.0,), (1.0, 2.0)), ((), (1.0, 2.0)), ((2.0, 2.0), (2.0, 2.0))])
def test_what_cannot_be_tested_for_likeness_has_no_p(samples):
    assert math.isnan(tost(*samples, 1.0).p)


@pytest.mark.slow
def test_the_margin_is_a_twentieth_of_a_full_run_unless_it_is_given(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 8100, 8050), "A1": (8020, 8110, 8060)}, total=TOTAL, length=100)
    write_cut(tmp_path, "A2", 1, rows_reaching(7000, TOTAL), TOTAL)
    analysis = analyze(load(tmp_path))
    assert margin_of(analysis.measured) == 1000
    assert analysis.study.equivalence.set_index("index").loc["A1", ["margin", "equivalent"]].tolist() == [1000, "yes"]
    (narrow,) = equivalence(analysis.measured, [("A0", "A1")], 10).to_dict("records")
    assert (narrow["margin"], narrow["equivalent"]) == (10, "not shown")


def test_cells_with_runs_that_never_got_there_are_not_called_alike(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 8100, None), "A1": (8020, 8110, 8060)}, total=TOTAL, length=100)
    (row,) = equivalence(analyze(load(tmp_path)).measured, [("A0", "A1")], 1e6).to_dict("records")
    assert row["equivalent"] == ""
    assert math.isnan(row["p_tost"])
    assert "never reached" in row["note"]


@pytest.mark.parametrize("t", [-4.129, 0.668, 3.0])
def test_a_published_t_is_the_effect_of_samples_that_have_it(t):
    first = np.array([-1.0, 0.0, 1.0])
    second = first + t * math.sqrt(2 / 3)  # pooled standard deviation 1
    expected = hedges_g(first, second)
    assert vars(published_effect(t)) == pytest.approx(vars(expected))


@pytest.mark.parametrize(("n", "true"), [(3, 0.0), (3, 3.0), (5, 1.0)])
@pytest.mark.first_is_fast
def test_the_predicted_interval_covers_what_it_says(n, true):
    """The next study's g lies in 95% of all intervals; 120 pairs of studies leave a standard error of 0.02."""
    rng = np.random.default_rng(int(10 * n + true))
    hits = 0
    for _ in range(120):
        first, second = rng.normal(0, 1, 3), rng.normal(true, 1, 3)
        predicted = predicted_effect(stats.ttest_ind(second, first).statistic, n, n)
        ours = hedges_g(rng.normal(0, 1, n), rng.normal(true, 1, n)).g
        hits += verdict(ours, predicted) == "inside"
    assert hits / 120 > 0.89


def test_nothing_is_predicted_without_a_t_or_for_one_run():
    assert math.isnan(predicted_effect(math.nan, 3, 3).low)
    assert math.isnan(predicted_effect(-4.0, 1, 3).low)
    assert verdict(math.nan, predicted_effect(-4.0, 3, 3)) == "-"
    assert verdict(40.0, predicted_effect(-4.0, 3, 3)) == "outside"


def slow_iqm(values: list[float]) -> float:
    """Mean of what is left when the lowest and the highest quarter (rounded down) are taken away."""
    ordered, cut = sorted(values), len(values) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


@pytest.mark.parametrize("n", [1, 3, 4, 9, 12])
def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end(n):
    values = np.random.default_rng(n).normal(0, 1, n)
    assert iqm(values) == pytest.approx(slow_iqm(values.tolist()))
    assert iqm(values[: n // 2], values[n // 2 :]) == pytest.approx(slow_iqm(values.tolist()))


@pytest.mark.parametrize(("first", "second"), [((1, 2, 3), (2, 3, 4)), ((5, 5), (5, 5, 5)), ((9,), (1, 2))])
def test_the_chance_of_an_improvement_counts_all_pairs(first, second):
    expected = np.mean([(y > x) + 0.5 * (y == x) for x in first for y in second])
    assert improvement(first, second) == pytest.approx(expected)


def test_a_performance_profile_is_the_share_above_each_limit():
    assert profile([1.0, 2.0, 4.0], [0, 1, 2, 3, 4]).tolist() == pytest.approx([1, 2 / 3, 1 / 3, 1 / 3, 0])


def test_the_bootstrap_draws_within_each_task():
    rng = np.random.default_rng(0)
    low_task, high_task = rng.normal(0, 0.1, LEAST_RUNS), rng.normal(100, 0.1, LEAST_RUNS)
    # Drawn from both together, the number of high ones would vary, and their mean by tens.
    low, high = stratified_interval(
        [low_task, high_task], lambda *tasks, axis: np.concatenate(tasks, -1).mean(axis=axis)
    )
    assert 49.8 < low < high < 50.2
    draws = rng.choice(low_task, (4000, LEAST_RUNS))
    expected = np.quantile(stats.trim_mean(draws, 0.25, axis=1), [0.025, 0.975])
    assert stratified_interval([low_task], iqm) == pytest.approx(expected, abs=0.02)
    assert np.isnan(stratified_interval([low_task[1:]], iqm)).all()


def test_the_aggregates_of_a_folder(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 9000, 8500, None), "A2": (6000, 7000)}, total=TOTAL, length=100)
    write_cut(tmp_path, "A2", 3, rows_reaching(7500, TOTAL), TOTAL)
    measured = analyze(load(tmp_path)).measured
    table = aggregates(measured, ["A0", "A2", "H0"]).set_index("group")
    assert list(table.index) == ["A0", "A2"]
    assert table.loc["A0", "iqm_steps"] == slow_iqm([8000, 9000, 8500, TOTAL])
    assert (table.loc["A2", "runs"], table.loc["A2", "full_runs"]) == (3, 2)
    (row,) = improvements(measured, [("A0", "A2")]).to_dict("records")
    assert row["p_faster"] == 1.0
    assert (row["full_reference"], row["full_index"]) == (4, 2)
    assert math.isnan(row["p_faster_low"])


def write_teacher(root: Path, cell: str, seed: int, steps: int | None) -> None:
    teacher = None if steps is None else {"path": "x", "global_step": steps}
    report = {"method": "hidden", "teacher": teacher}
    (run_directory(root, cell, seed) / "transfer.json").write_text(json.dumps(report))


def test_costs_are_those_of_the_teachers_that_were_used(tmp_path):
    times = {"H0": (9000, 9600), "A0": (8000, 9000), "A2": (6000, 7000), "A1": (9000, 9500)}
    write_matrix(tmp_path, times, total=TOTAL, length=100)
    for seed, steps in ((1, 20_000), (2, 30_000)):
        write_teacher(tmp_path, "A2", seed, steps)
        write_teacher(tmp_path, "A0", seed, None)
    data = load(tmp_path)
    table = costs(tmp_path, analyze(data).measured, data.groups, "A0").set_index("group")
    assert table.loc["A0", ["own_steps", "teacher_steps", "total_steps"]].tolist() == [8500, 0, 8500]
    assert table.loc["A2", ["own_steps", "teacher_steps", "total_steps"]].tolist() == [6500, 25_000, 31_500]
    assert table.loc["A2", ["saved_steps", "teacher_to_threshold"]].tolist() == [2000, 9300]
    assert table.loc["A2", "students_to_repay"] == 13  # 25,000 / 2,000, rounded up
    # What its teachers cost is not known where the report of the transfer is not there.
    assert math.isnan(table.loc["A1", "teacher_steps"])
    assert table.loc["H0", "baseline"] == "A0"


def test_a_damaged_report_of_a_transfer_is_no_error(tmp_path):
    write_matrix(tmp_path, {"A0": (8000,), "A2": (6000,)}, total=TOTAL, length=100)
    data = load(tmp_path)
    measured = analyze(data).measured
    for content in ("{", "[]", '{"teacher": {"global_step": "many"}}', '{"teacher": 3}'):
        (run_directory(tmp_path, "A2", 1) / "transfer.json").write_text(content)
        table = costs(tmp_path, measured, data.groups, "A0").set_index("group")
        assert math.isnan(table.loc["A2", "teacher_steps"])


@pytest.mark.slow
def test_the_summary_prints_the_study(tmp_path, capsys):
    write_matrix(tmp_path, {"A0": (8000, 9000), "A2": (6000, 7000)}, total=TOTAL, length=100)
    for seed in (1, 2):
        write_teacher(tmp_path, "A2", seed, TOTAL)
    assert main([str(tmp_path), "--summary", "--margin", "5000"]) == 0
    said = capsys.readouterr().out
    for words in (
        "Sensitivity to threshold and criterion\n  A2 − A0, all runs (2 + 2): index faster at",
        "By seed\n  A2 − A0: faster on 2, slower on 0 of 2 seeds; −2,000",
        "Alike within 5,000 steps\n  A2 − A0: ",
        "With the teacher's steps\n  A2: 6,500 of its own, 26,500 with its teacher's; 10 students make up",
    ):
        assert words in said
    assert main([str(tmp_path), "--summary"]) == 0
    assert "Alike within 1,000 steps" in capsys.readouterr().out


def test_one_cell_has_a_study_without_comparisons(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(8000, TOTAL), total=TOTAL)
    study = analyze(load(tmp_path)).study
    assert study_lines(study) == {}
    assert len(study.aggregates) == 1
