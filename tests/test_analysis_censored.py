"""Comparisons with censored runs: intervals that cover, adjusted p-values, and means that do not flatter."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from analysis_runs import write_matrix
from scipy import stats
from statsmodels.stats.multitest import multipletests

from analysis.analyze import Analysis, analyze
from analysis.cli import main
from analysis.loading.load import load
from analysis.statistics.survival import at_risk, kaplan_meier, restricted_interval

TOTAL = 20_000
#: Two of five cells have censored runs, one none that reached.
TIMES = {
    "A0": (8000, 9900, 9000, 8500),
    "A1": (6000, 6300, None, 6100),
    "A2": (12_000, 13_000, 12_500, 12_200),
    "A3": (None, None, 3000, 3100),
    "A4": (None, None, None, None),
}


def analysis_of(root: Path, times: dict = TIMES) -> Analysis:
    write_matrix(root, times, total=TOTAL, length=100)
    return analyze(load(root))


def normal(rng: np.random.Generator, mean: float, spread: float, size: tuple[int, int]) -> np.ndarray:
    return rng.normal(mean, spread, size)


def exponential(rng: np.random.Generator, mean: float, spread: float, size: tuple[int, int]) -> np.ndarray:
    return mean - spread + rng.exponential(spread, size)


@pytest.mark.parametrize("draw", [normal, exponential])
@pytest.mark.parametrize(("n", "m"), [(2, 2), (3, 3), (3, 5), (10, 10)])
@pytest.mark.parametrize(
    ("horizon", "least"),
    # Hardly any run is censored; half of the reference's; most of both; four in five of the reference's.
    [(600.0, 0.94), (500.0, 0.94), (450.0, 0.93), (430.0, 0.9)],
)
def test_the_interval_of_the_restricted_difference_covers(draw, n, m, horizon, least):
    rng = np.random.default_rng(0)
    reference, index = draw(rng, 500, 80, (3000, n)), draw(rng, 460, 60, (3000, m))
    means = [np.minimum(draw(rng, *of, (400_000, 1)), horizon).mean() for of in ((500, 80), (460, 60))]
    truth = means[1] - means[0]
    ends = np.array([restricted_interval(one, other, horizon) for one, other in zip(reference, index, strict=True)])
    known = np.isfinite(ends[:, 0])
    hits = (ends[known, 0] <= truth) & (truth <= ends[known, 1])
    assert hits.mean() > least


def test_the_interval_of_the_restricted_difference_by_hand():
    # Without censoring, of equal sizes: Welch's, with the degrees of freedom of one sample.
    first, second = [5.0, 7.0, 9.0], [1.0, 2.0, 6.0]
    half = stats.t.ppf(0.975, 2) * math.sqrt(np.var(first, ddof=1) / 3 + np.var(second, ddof=1) / 3)
    assert restricted_interval(first, second, 100) == pytest.approx((-4 - half, -4 + half))
    assert restricted_interval(first, second, 9) == (-9, pytest.approx(-4 + half))
    # A group of which every run was censored is not known better than the other.
    half = stats.t.ppf(0.975, 2) * math.sqrt(2 * np.var(second, ddof=1) / 3)
    low, high = restricted_interval([10.0] * 3, second, 10)
    assert (low, high) == (-10, pytest.approx(-7 + half))
    for few in ([], [5.0], [10.0] * 3):
        assert all(map(math.isnan, restricted_interval(few, [10.0] * 4, 10)))


def test_every_kind_of_test_is_adjusted_within_the_family(tmp_path):
    table = analysis_of(tmp_path).table3.set_index("index")
    family = ["A1", "A2", "A3", "A4"]
    assert table.loc["A1", ["p_value", "p_holm", "p_permutation_holm"]].isna().all()  # one run is censored
    for kind in ("p_restricted", "p_log_rank"):
        assert table.loc[family, kind].notna().all()
        expected = multipletests(table.loc[family, kind], method="holm")[1]
        assert table.loc[family, f"{kind}_holm"].tolist() == pytest.approx(expected.tolist())
        assert table.loc[["H0", "H1"], f"{kind}_holm"].isna().all()
    assert (table.loc[family, "p_log_rank_holm"] > table.loc[family, "p_log_rank"]).any()


def test_the_restricted_difference_has_its_interval(tmp_path):
    table = analysis_of(tmp_path).table3.set_index("index")
    for cell in ("A1", "A2", "A3", "A4"):
        row = table.loc[cell]
        times = [[TOTAL if time is None else time for time in TIMES[name]] for name in ("A0", cell)]
        expected = restricted_interval(*times, TOTAL)
        assert (row["restricted_difference_low"], row["restricted_difference_high"]) == pytest.approx(expected)
        assert expected[0] < row["restricted_difference"] < expected[1]


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_without_censoring_the_band_is_the_exact_one_of_a_share(n):
    curve = kaplan_meier(np.arange(1.0, n + 1), np.ones(n, bool))
    for left, low, high in zip(range(n, -1, -1), curve.low, curve.high, strict=True):
        exact = stats.binomtest(left, n).proportion_ci(method="exact")
        assert (low, high) == pytest.approx((exact.low, exact.high))


@pytest.mark.parametrize("n", [3, 6, 20])
@pytest.mark.parametrize("censoring", [1.5, 3.0, 100.0])
@pytest.mark.first_is_fast
def test_the_band_of_a_share_covers_where_runs_are_censored(n, censoring):
    rng, hits = np.random.default_rng(0), []
    for _ in range(1000):
        times, watched = rng.exponential(1, n), rng.uniform(0, censoring, n)
        curve = kaplan_meier(np.minimum(times, watched), times <= watched)
        at = np.searchsorted(curve.steps, 0.7, side="right") - 1
        hits.append(curve.low[at] <= math.exp(-0.7) <= curve.high[at])
    assert np.mean(hits) > 0.945


def test_runs_at_risk_are_those_still_watched():
    times = [3, 5, 5, 9]
    assert at_risk(times, [0, 3, 4, 5, 6, 9, 10]).tolist() == [4, 4, 3, 3, 1, 1, 0]


def printed(folder: Path, name: str) -> dict[str, list[str]]:
    """Rows of a Markdown table by the name that they are about."""
    lines = (folder / f"{name}.md").read_text().replace("\\", "").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    column = rows[0].index("index" if name != "cells" else "group")
    return {row[column]: row for row in rows}


@pytest.mark.slow
def test_a_mean_of_the_fast_runs_is_marked_wherever_it_is_printed(tmp_path, capsys):
    write_matrix(tmp_path / "runs", TIMES, total=TOTAL, length=100)
    out = tmp_path / "out"
    assert main([str(tmp_path / "runs"), "--out", str(out), "--no-stills", "--format", "svg"]) == 0
    said = capsys.readouterr().out
    # A3's two runs that reached look best of all; its restricted mean is worse than the baseline's.
    table = printed(out, "table3")
    assert table["A3"][:8] == ["A0", "A3", "4", "2 of 4", "8,850", "810", "3,050*", "71*"]
    assert table["A1"][3:7] == ["3 of 4", "8,850", "810", "6,133*"]
    assert table["A2"][3] == "4"
    assert table["A4"][3:7] == ["0 of 4", "8,850", "810", "NaN"]
    head = table["index"]
    assert table["A3"][head.index("restricted mean index")] == "11,525"
    assert table["A3"][head.index("restricted difference, 95% to")] != "NaN"
    assert printed(out, "cells")["A3"][3:5] == ["3,050*", "71*"]
    for text in (
        (out / "table3.md").read_text(),
        (out / "cells.md").read_text(),
        (out / "report.html").read_text(),
        said,
    ):
        assert "*Of the runs that reached the threshold" in text.replace("\\", "")
    latex = (out / "table3.tex").read_text().replace("{*}", "*")
    assert "2 of 4" in latex
    assert "3,050*" in latex
    assert "*Of the runs that reached" in latex
    assert "\\resizebox{\\textwidth}" in latex
    line = next(line for line in said.splitlines() if line.startswith("A3"))
    assert line.split()[:7] == ["A3", "2", "of", "4", "3,050*", "71*", "11,525"]
    with (out / "table3.csv").open() as file:
        rows = {row["index"]: row for row in csv.DictReader(file)}
    # Numbers stay numbers for programs.
    assert (rows["A3"]["n_index"], float(rows["A3"]["mean_index"])) == ("2", 3050)


@pytest.mark.slow
def test_where_every_run_reached_nothing_is_marked(tmp_path, capsys):
    times = {cell: values for cell, values in TIMES.items() if cell in ("A0", "A2")}
    write_matrix(tmp_path / "runs", times, total=TOTAL, length=100)
    assert main([str(tmp_path / "runs"), "--summary"]) == 0
    said = capsys.readouterr().out
    assert "*" not in said
    assert "restricted" not in said
