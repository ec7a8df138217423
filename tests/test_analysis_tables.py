"""Table 3 against scipy on runs whose steps to threshold are known; the other tables and their files."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from analysis_runs import rows_reaching, run_directory, write_matrix, write_run
from scipy import stats
from statsmodels.stats.multitest import multipletests

from acmr.cells import CELLS
from analysis.analyze import Analysis, analyze
from analysis.loading.load import InputError, load
from analysis.report.published import published_table3, side_by_side
from analysis.report.tables import _latex_cell, paper_columns, write_table
from analysis.statistics.summaries import scores, steps_table, table1, table2, transfer_table

#: (reference, index) of the paper's table 3.
PAPER_ROWS = [("A0", "A1"), ("A0", "A2"), ("A0", "A3"), ("A0", "A4"), ("A0", "H0"), ("H0", "H1")]
#: As the issue and the paper's table 3 have them.
FIRST_COLUMNS = [
    *("reference", "index", "n_reference", "n_index", "mean_reference", "std_reference"),
    *("mean_index", "std_index", "t_score", "p_value"),
]
TOTAL = 20_000
#: The paper's cells; others are in tables only where they have runs.
PAPERS = [cell.name for cell in CELLS.values() if cell.published]
PAPER_LIKE = {
    "H0": (9100, 11_700, 10_050),
    "H1": (1800, 2500, 2200),
    "A0": (8000, 9900, 9000),
    "A1": (8100, 9200, 9000),
    "A2": (6000, 6300, 5900),
    "A3": (5500, 6000, 6200),
    "A4": (None, None, None),
}
#: Every cell the same n, different ones, ties within and between cells, two runs, one run, no run.
CASES = {
    "as in the paper": PAPER_LIKE,
    "none censored": PAPER_LIKE | {"A4": (15_000, 14_000, 16_000)},
    "unequal n": PAPER_LIKE | {"A1": (8100, 9200), "A2": (6000, 6300, 5900, 5000, 6100), "H1": (900, 1000, 1100, 1500)},
    "two runs": {cell: times[:2] for cell, times in PAPER_LIKE.items()},
    "ties": PAPER_LIKE | {"A1": (8000, 9900, 9000), "A2": (8000, 8000, 9000), "A3": (9900, 9900, 8000)},
    "no spread in one cell": PAPER_LIKE | {"A1": (7000, 7000, 7000)},
    "no spread at all": dict.fromkeys(PAPERS, (7000, 7000, 7000)) | {"A1": (8000, 8000, 8000)},
}


def analysis_of(root, times, **options) -> Analysis:
    write_matrix(root, times, total=TOTAL, length=100)
    return analyze(load(root), **options)


@pytest.mark.filterwarnings("ignore:Precision loss:RuntimeWarning")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.first_is_fast
def test_every_number_matches_scipy(tmp_path, case):
    times = CASES[case]
    table = analysis_of(tmp_path, times).table3
    assert list(zip(table["reference"], table["index"], strict=True)) == PAPER_ROWS
    assert list(table.columns)[: len(FIRST_COLUMNS)] == FIRST_COLUMNS
    for row in table.to_dict("records"):
        reference, index = ([time for time in times[row[role]] if time] for role in ("reference", "index"))
        exact = {"rel": 1e-9, "abs": 1e-9, "nan_ok": True}
        assert (row["n_reference"], row["n_index"]) == (len(reference), len(index))
        for role, sample in (("reference", reference), ("index", index)):
            assert row[f"mean_{role}"] == pytest.approx(np.mean(sample) if sample else math.nan, **exact)
            assert row[f"std_{role}"] == pytest.approx(np.std(sample, ddof=1) if sample else math.nan, **exact)
        if not index:
            assert math.isnan(row["t_score"])
            assert math.isnan(row["p_value"])
            continue
        with np.errstate(all="ignore"):
            student, welch = (stats.ttest_ind(index, reference, equal_var=equal) for equal in (True, False))
            interval = student.confidence_interval()
        assert (row["t_score"], row["p_value"]) == (
            pytest.approx(student.statistic, **exact),
            pytest.approx(student.pvalue, **exact),
        )
        assert row["df"] == len(index) + len(reference) - 2
        assert (row["welch_t"], row["welch_p"]) == (
            pytest.approx(welch.statistic, **exact),
            pytest.approx(welch.pvalue, **exact),
        )
        assert row["difference_low"] == pytest.approx(interval.low, **exact)
        assert row["difference_high"] == pytest.approx(interval.high, **exact)


def test_the_published_values_come_out_of_the_very_formula(tmp_path):
    table = analysis_of(tmp_path, PAPER_LIKE).table3
    a0, a2 = np.array(PAPER_LIKE["A0"]), np.array(PAPER_LIKE["A2"])
    pooled = (a0.var(ddof=1) + a2.var(ddof=1)) / 2
    assert table["t_score"][1] == pytest.approx((a2.mean() - a0.mean()) / math.sqrt(pooled * 2 / 3))
    assert table["df"][1] == 4


def test_holm_goes_over_the_four_transfers_and_keeps_the_one_that_never_reached(tmp_path):
    table = analysis_of(tmp_path, PAPER_LIKE).table3.set_index("index")
    family = table.loc[["A1", "A2", "A3"], "p_value"].tolist()
    expected = multipletests([*family, 1.0], method="holm")[1][:3]
    assert table.loc[["A1", "A2", "A3"], "p_holm"].tolist() == pytest.approx(expected.tolist())
    assert table.loc[["A4", "H0", "H1"], "p_holm"].isna().all()


def test_a_cell_that_never_reached_is_compared_with_its_censored_runs(tmp_path):
    row = analysis_of(tmp_path, PAPER_LIKE).table3.iloc[3]
    assert (row["n_index"], row["runs_index"], row["censored_index"]) == (0, 3, 3)
    assert row["restricted_mean_index"] == TOTAL == row["horizon"]
    assert row["restricted_difference"] == pytest.approx(TOTAL - np.mean(PAPER_LIKE["A0"]))
    assert (row["p_log_rank"], row["p_restricted"]) == pytest.approx((0.1, 0.1))
    assert row["log_rank_z"] > 0  # slower
    assert "never" in row["note"] or "no run reached" in row["note"]


def test_where_some_runs_never_reached_no_t_test_flatters_the_cell(tmp_path):
    row = analysis_of(tmp_path, PAPER_LIKE | {"A2": (6000, None, 5900)}).table3.iloc[1]
    assert (row["n_index"], row["runs_index"], row["censored_index"]) == (2, 3, 1)
    assert row["mean_index"] == 5950
    assert math.isnan(row["t_score"])
    assert math.isnan(row["difference"])
    assert row["restricted_mean_index"] == pytest.approx((6000 + TOTAL + 5900) / 3)
    assert "1 of 3 runs never reached" in row["note"]


def test_one_run_gives_no_test_and_says_so(tmp_path):
    table = analysis_of(tmp_path, {"A0": (8000,), "A1": (7000,), "H0": (8000, 8200)}).table3.set_index("index")
    assert table["t_score"].isna().all()
    assert "A1: n = 1, no t-test" in table.loc["A1", "note"]
    assert "A1: 1 of 3 runs" in table.loc["A1", "note"]
    assert table.loc["A1", "mean_index"] == 7000
    assert table.loc["A2", "note"].endswith("A2: no complete run")


def test_two_of_three_seeds_are_computed_and_marked(tmp_path):
    row = analysis_of(tmp_path, PAPER_LIKE | {"A2": (6000, 6300)}).table3.iloc[1]
    assert row["n_index"] == 2
    assert math.isfinite(row["p_value"])
    assert row["note"] == "A2: 2 of 3 runs"


def test_unfinished_runs_do_not_enter_and_diverged_ones_do(tmp_path):
    write_matrix(tmp_path, PAPER_LIKE, total=TOTAL, length=100)
    (run_directory(tmp_path, "A1", 1) / "summary.json").unlink()  # has reached the threshold already
    rows = rows_reaching(None, 9000)
    write_run(tmp_path, "A2", 4, rows, total=TOTAL, summary={"status": "diverged", "step": 9010})
    analysis = analyze(load(tmp_path))
    table = analysis.table3.set_index("index")
    assert table.loc["A1", "n_index"] == 2
    assert table.loc["A1", "mean_index"] == np.mean(PAPER_LIKE["A1"][1:])
    assert (table.loc["A2", "censored_index"], table.loc["A2", "runs_index"]) == (1, 4)
    unfinished = analysis.measured[analysis.measured["state"] == "unfinished"]
    assert unfinished["steps_to_threshold"].tolist() == [PAPER_LIKE["A1"][0]]


def test_the_threshold_is_the_runs_own_unless_given(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(6000, TOTAL, threshold=700), total=TOTAL, threshold=700.0)
    assert analyze(load(tmp_path)).measured["steps_to_threshold"].tolist() == [6000]
    assert analyze(load(tmp_path), threshold=4900).measured["censored"].tolist() == [True]
    assert analyze(load(tmp_path), consecutive=2).measured["steps_to_threshold"].tolist() == [5700]
    write_run(tmp_path, "A0", 2, rows_reaching(6000, TOTAL), total=TOTAL)
    with pytest.raises(InputError, match=r"differs \(700, 4900\).*--threshold 700"):
        analyze(load(tmp_path))


def test_another_reference_takes_the_place_of_a0(tmp_path):
    table = analysis_of(tmp_path, PAPER_LIKE, reference="A1").table3
    assert list(table["reference"]) == ["A1"] * 5 + ["H0"]
    assert list(table["index"]) == ["A0", "A2", "A3", "A4", "H0", "H1"]
    with pytest.raises(InputError, match="--reference B7: must be one of H0, H1"):
        analyze(load(tmp_path), reference="B7")


def test_groups_that_are_no_cells_are_compared_apart(tmp_path):
    write_matrix(tmp_path, PAPER_LIKE, total=TOTAL, length=100)
    for seed in (1, 2, 3):
        sweep = tmp_path / "armless_humanoid-none-q_lr=0.0001" / f"seed_{seed}"
        sweep.parent.mkdir(exist_ok=True)
        write_run(tmp_path / "x", "A0", seed, rows_reaching(5000 + 100 * seed, TOTAL), summary=False).rename(sweep)
        (sweep / "config.yaml").unlink()
    analysis = analyze(load(tmp_path))
    assert len(analysis.table3) == len(PAPER_ROWS)
    row = analysis.others.iloc[0]
    assert (row["reference"], row["index"], row["n_index"]) == ("A0", "armless_humanoid-none-q_lr=0.0001", 3)
    assert row["p_value"] == pytest.approx(stats.ttest_ind((5100, 5200, 5300), PAPER_LIKE["A0"]).pvalue)


def test_the_published_table_is_the_papers():
    table = published_table3()
    assert list(zip(table["reference"], table["index"], strict=True)) == PAPER_ROWS
    printed = [(-0.247, 0.817), (-4.129, 0.015), (-4.377, 0.012), (math.nan, math.nan), (0.668, 0.540), (-6.875, 0.002)]
    assert table[["t_score", "p_value"]].to_numpy() == pytest.approx(np.array(printed), nan_ok=True)
    assert table["source"].str.contains("Table 3").all()


@pytest.mark.first_is_fast
def test_agreement_with_the_published_table(tmp_path):
    both = side_by_side(analysis_of(tmp_path, PAPER_LIKE).table3)
    assert both["sign"].tolist() == ["agrees"] * 6
    assert both["replicates"].tolist() == ["inside", "inside", "inside", "-", "inside", "inside"]
    # Nothing is predicted of a cell that never got there in the paper.
    assert both.set_index("index").loc["A4", ["g_published", "g_predicted_low", "g_ours"]].isna().all()
    other = PAPER_LIKE | {"A1": (12_000, 12_100, 12_200), "A2": (8000, 9800, 9000), "A4": (9000, None, 9100)}
    both = side_by_side(analysis_of(tmp_path / "other", other | {"H1": ()}).table3).set_index("index")
    assert both.loc["A1", ["sign", "replicates"]].tolist() == ["differs", "outside"]
    assert both.loc["A2", ["sign", "replicates"]].tolist() == ["agrees", "outside"]
    assert both.loc["H1", "replicates"] == "-"
    assert "here 2 of 3 runs did" in both.loc["A4", "remark"]
    assert both.loc["H1", "remark"] == "not run yet"


def test_tables_1_and_2_are_the_papers(tmp_path):
    assert table1().to_numpy().tolist() == [["No", "Conf. 1", "Conf. 3"], ["Yes", "Conf. 2", "Conf. 4"]]
    write_matrix(tmp_path, {"A0": (6000, 7000)}, total=TOTAL, length=100)
    table = table2(load(tmp_path)).set_index("Experiment")
    assert table.loc["H1", ["Environment", "Configuration"]].tolist() == ["Source", "POC"]
    assert table.loc["A4", ["Environment", "Configuration"]].tolist() == ["Target", "Conf. 4"]
    assert table["runs"].to_dict() == dict.fromkeys(PAPERS, 0) | {"A0": 2}


def test_table_files(tmp_path):
    table = analysis_of(tmp_path / "runs", PAPER_LIKE).table3
    write_table(table, tmp_path, "table3", "A & B", paper_columns(table))
    with (tmp_path / "table3.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["t_score"] for line in lines][3] == "NaN" == lines[3]["p_value"]
    back = [float(line["t_score"]) for line in lines]
    assert back == pytest.approx(table["t_score"].tolist(), rel=0, abs=0, nan_ok=True)
    latex = (tmp_path / "table3.tex").read_text()
    assert all(word in latex for word in (r"\toprule", r"\midrule", r"\bottomrule", "T-score", "A0 & A4 & 3 & 0"))
    # The heading one word a line, negative numbers with a minus sign.
    assert r" & \shortstack[r]{n\\reference} & " in latex
    assert "$-$" in latex
    # Also behind a bracket, and where the sign is the typographic one, which LaTeX alone does not know.
    assert [_latex_cell(text) for text in ("-5", "(−12,000)", "−3", "A2 − A0")] == [
        *("$-$5", "($-$12,000)", "$-$3", "A2 − A0"),
    ]
    assert " -" not in latex
    write_table(table1(), tmp_path, "table1", "A & B")
    narrow = (tmp_path / "table1.tex").read_text()
    assert r"\begin{table}" in narrow
    assert "footnotesize" in latex.replace(narrow, "")
    assert "footnotesize" not in narrow
    assert len((tmp_path / "table3.md").read_text().splitlines()) == 2 + len(PAPER_ROWS)


def test_one_row_a_run_and_arrays_for_rliable(tmp_path):
    analysis = analysis_of(tmp_path, PAPER_LIKE)
    table = steps_table(analysis.measured)
    assert table.groupby("cell")["steps_to_threshold"].apply(lambda s: set(s.dropna())).to_dict() == {
        cell: {time for time in times if time} for cell, times in PAPER_LIKE.items()
    }
    arrays = scores(analysis.measured)
    assert {name: array.shape for name, array in arrays.items()} == dict.fromkeys(PAPERS, (3, 1))
    assert (arrays["A0"] == 4900).all()


def test_the_transfer_table_measures_against_the_baseline(tmp_path):
    analysis = analysis_of(tmp_path, PAPER_LIKE)
    table = transfer_table(analysis.measured, analysis.data.groups).set_index("group")
    assert table["baseline"].to_dict() == {
        "H0": "",
        "H1": "H0",
        "A0": "",
        **dict.fromkeys(("A1", "A2", "A3", "A4"), "A0"),
    }
    area = table["area_under_curve"]
    assert table.loc["A2", "transfer_ratio"] == pytest.approx((area["A2"] - area["A0"]) / area["A0"])
    assert table.loc["A2", "transfer_ratio"] > 0 > table.loc["A4", "transfer_ratio"]


def test_a_summary_that_tells_other_steps_is_noted(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(6000, TOTAL), total=TOTAL, summary={"steps_to_threshold": 777})
    assert "summary.json says 777" in analyze(load(tmp_path)).measured["reason"].iloc[0]
