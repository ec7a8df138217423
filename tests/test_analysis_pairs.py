"""Comparisons by seed: against counts over all signs and orders, statsmodels, and true to runs that stopped."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import statsmodels.api as sm
from analysis_runs import rows_reaching, write_cut, write_matrix, write_run, write_under_way
from scipy import stats
from statsmodels.formula.api import ols

from analysis.analyze import analyze
from analysis.loading.load import load
from analysis.report.study import paired_lines
from analysis.statistics.comparisons import study_pairs
from analysis.statistics.study.pairs import blocked, paired_comparisons, sign_flip_p

TOTAL = 20_000
TIMES = {"A0": (8000, 9900, 9000, 7300), "A2": (6000, 6300, 8900, 7000), "A3": (5100, 7000, 9100, 4000)}


def paired_of(root: Path, **options: float) -> pd.DataFrame:
    analysis = analyze(load(root), **options)
    table = paired_comparisons(analysis.measured, analysis.data.episodes, study_pairs(analysis.measured))
    return table.set_index(["reference", "index"])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n", [2, 3, 6])
def test_the_test_of_the_signs_counts_all_of_them(seed, n):
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 50, n).astype(float), rng.integers(0, 50, n).astype(float)
    differences, observed = second - first, float((second - first).mean())
    means = np.array([(differences * signs).mean() for signs in itertools.product((1, -1), repeat=n)])
    less, more = (means <= observed + 1e-9).mean(), (means >= observed - 1e-9).mean()
    assert sign_flip_p(first, second) == pytest.approx(min(1.0, 2 * min(less, more)))
    assert sign_flip_p(first, second) >= 2 / 2**n


def test_each_number_of_a_paired_comparison(tmp_path):
    write_matrix(tmp_path, TIMES, total=TOTAL, length=100)
    table = paired_of(tmp_path)
    assert set(table.index) == {("A0", "A2"), ("A0", "A3"), ("A2", "A3")}
    row = table.loc[("A0", "A2")]
    a, b = np.array(TIMES["A0"], float), np.array(TIMES["A2"], float)
    d = b - a
    assert (row["pairs"], row["unpaired"], row["faster"], row["slower"], row["undecided"]) == (4, 0, 4, 0, 0)
    assert row["difference"] == pytest.approx(d.mean())
    t = d.mean() / (d.std(ddof=1) / 2)
    assert row["t_score"] == pytest.approx(t)
    assert row["p_paired"] == pytest.approx(2 * stats.t.sf(abs(t), 3))
    half = stats.t.ppf(0.975, 3) * d.std(ddof=1) / 2
    assert (row["low"], row["high"]) == pytest.approx((d.mean() - half, d.mean() + half))
    assert row["correlation"] == pytest.approx(np.corrcoef(a, b)[0, 1])
    assert row["p_value"] == pytest.approx(stats.ttest_ind(b, a).pvalue)
    assert row["p_sign_flip"] == 2 / 16
    # Holm over the family of the baseline's comparisons; A3 against A2 is another question.
    raw = sorted(table.loc[[("A0", "A2"), ("A0", "A3")], "p_paired"])
    assert table.loc[[("A0", "A2"), ("A0", "A3")], "p_paired_holm"].min() == pytest.approx(2 * raw[0])
    assert math.isnan(table.loc[("A2", "A3"), "p_paired_holm"])
    assert table.loc[("A2", "A3"), "slower"] == 2


@pytest.mark.slow
def test_equal_first_episodes_are_counted(tmp_path):
    for cell, change in (("A0", 0.0), ("A2", 1.0), ("A3", 5.0)):
        for seed in (1, 2):
            rows = rows_reaching(9000, TOTAL)
            rows[30 * seed if cell == "A2" else 0 :, 1] += change * 1e-3
            write_run(tmp_path, cell, seed, rows, total=TOTAL)
    table = paired_of(tmp_path)
    assert table.loc[("A0", "A2"), "shared_episodes"] == 30
    assert table.loc[("A0", "A3"), "shared_episodes"] == 0


@pytest.mark.slow
def test_runs_without_a_partner_are_left_out_and_counted(tmp_path):
    write_matrix(tmp_path, {"A0": TIMES["A0"], "A2": TIMES["A2"][:2]}, total=TOTAL, length=100)
    row = paired_of(tmp_path).loc[("A0", "A2")]
    assert (row["pairs"], row["unpaired"]) == (2, 2)
    assert row["difference"] == pytest.approx((6000 - 8000 + 6300 - 9900) / 2)
    assert math.isnan(row["correlation"])


@pytest.mark.slow
def test_one_pair_has_no_test(tmp_path):
    write_matrix(tmp_path, {"A0": (8000,), "A2": (7000,)}, total=TOTAL, length=100)
    row = paired_of(tmp_path).loc[("A0", "A2")]
    assert row["difference"] == -1000
    assert math.isnan(row["p_paired"])
    assert math.isnan(row["p_sign_flip"])
    assert row["note"] == "one pair: no test"


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((8000, 9000, 7000), (None, 9100, 6000), (1, 2, 0)),
        ((None, 9000, 7000), (None, 9000, 6000), (1, 0, 2)),
        ((None, None, None), (9000, 8000, None), (2, 0, 1)),
    ],
)
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_runs_that_never_got_there_keep_their_order_and_give_restricted_means(tmp_path, first, second, expected):
    write_matrix(tmp_path, {"A0": first, "A2": second}, total=TOTAL, length=100)
    row = paired_of(tmp_path).loc[("A0", "A2")]
    assert (row["faster"], row["slower"], row["undecided"]) == expected
    assert math.isnan(row["difference"])
    within = [np.array([TOTAL if steps is None else steps for steps in sample]) for sample in (first, second)]
    assert row["restricted_difference"] == pytest.approx((within[1] - within[0]).mean())
    assert row["p_restricted"] == pytest.approx(sign_flip_p(*map(np.float64, within)))


@pytest.mark.slow
def test_runs_that_stopped_before_another_threshold_tell_their_order_only(tmp_path):
    # At 4900 all reach it; beyond that the runs of A2 end where nothing is known of them yet.
    for seed, (slow, fast) in enumerate(((9000, 6000), (9500, 7000), (6000, 8000)), start=1):
        rows = rows_reaching(slow, TOTAL)
        rows[rows[:, 1] >= 4900, 1] = 5000
        write_run(tmp_path, "A0", seed, rows, total=TOTAL)
        write_cut(tmp_path, "A2", seed, rows_reaching(fast, TOTAL), TOTAL)
    row = paired_of(tmp_path, threshold=4950).loc[("A0", "A2")]
    # Of the third seed it is known: the reference got there before its partner ended.
    assert (row["faster"], row["slower"], row["undecided"]) == (0, 1, 2)
    assert math.isnan(row["restricted_difference"])
    assert "only the order is known" in row["note"]
    assert paired_of(tmp_path).loc[("A0", "A2"), "difference"] == pytest.approx((6000 + 7000 + 8000 - 24_500) / 3)


@pytest.mark.slow
def test_a_biased_cell_is_not_tested(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 9000, 8500)}, total=TOTAL, length=100)
    write_cut(tmp_path, "A2", 1, rows_reaching(5000, TOTAL), TOTAL)
    write_cut(tmp_path, "A2", 2, rows_reaching(5500, TOTAL), TOTAL)
    write_under_way(tmp_path, "A2", 3, 4000, TOTAL)
    table = paired_of(tmp_path)
    row = table.loc[("A0", "A2")]
    assert math.isnan(row["difference"])
    assert "biased" in row["note"]
    (line,) = paired_lines(table.reset_index())
    assert line.startswith("A2 − A0: faster on 2, slower on 0 of 2 seeds; A2: biased")


def test_the_blocked_analysis_is_that_of_statsmodels(tmp_path):
    write_matrix(tmp_path, TIMES, total=TOTAL, length=100)
    (row,) = blocked(analyze(load(tmp_path)).measured).to_dict("records")
    assert (row["cells"], row["seeds"]) == ("A0, A2, A3", 4)
    long = pd.DataFrame([(cell, seed, y) for cell, own in TIMES.items() for seed, y in enumerate(own)])
    long.columns = ["cell", "seed", "y"]
    expected = sm.stats.anova_lm(ols("y ~ C(cell) + C(seed)", long).fit())
    assert row["f_score"] == pytest.approx(expected.loc["C(cell)", "F"])
    assert row["p_value"] == pytest.approx(expected.loc["C(cell)", "PR(>F)"])
    assert row["share_of_seeds"] == pytest.approx(expected.loc["C(seed)", "sum_sq"] / expected["sum_sq"].sum())
    assert row["p_friedman"] == pytest.approx(stats.friedmanchisquare(*TIMES.values()).pvalue)
    assert row["p_permutation"] == pytest.approx(slow_friedman(np.column_stack(list(TIMES.values()))))


def slow_friedman(times: np.ndarray) -> float:
    """Share of all orders within the seeds whose Friedman statistic is at least the observed one."""
    ranks = stats.rankdata(times, axis=1)
    observed = (ranks.sum(axis=0) ** 2).sum()
    orders = itertools.product(*(list(itertools.permutations(row)) for row in ranks))
    values = np.array([(np.sum(order, axis=0) ** 2).sum() for order in orders])
    return float((values >= observed - 1e-9).mean())


def test_blocks_with_runs_that_never_got_there_are_ranked(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 9000), "A2": (6000, None), "A4": (None, None)}, total=TOTAL, length=100)
    (row,) = blocked(analyze(load(tmp_path)).measured).to_dict("records")
    assert math.isnan(row["f_score"])
    times = np.array([[8000, 6000, TOTAL], [9000, TOTAL, TOTAL]])
    assert row["p_permutation"] == pytest.approx(slow_friedman(times))
    assert "ranks only" in row["note"]


def test_two_cells_are_no_family_for_blocks(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 9000), "A2": (6000, 7000)}, total=TOTAL, length=100)
    assert blocked(analyze(load(tmp_path)).measured).empty
