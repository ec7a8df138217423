"""Differences at other thresholds, counts and smoothed returns: against the slow way, and true to runs that stopped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from analysis_runs import realistic_rows, rows_reaching, write_cut, write_run, write_under_way

from acmr.records import steps_to_threshold
from analysis.analyze import analyze
from analysis.loading.load import load
from analysis.report.study import sensitivity_lines
from analysis.statistics.study.sensitivity import (
    ALL,
    FULL,
    MEANS,
    RESTRICTED,
    Criterion,
    criteria,
    crossings,
    thresholds,
)

TOTAL = 20_000


def curve(seed: int, half: float) -> np.ndarray:
    return realistic_rows(np.random.default_rng(seed), TOTAL, half, noise=0.04)


def write_study(root: Path, cut: tuple[str, ...] = ()) -> None:
    """A0, A2 and H0 with three seeds; the named cells stop at their threshold in seeds 2 and 3."""
    for cell, half in (("A0", 5000), ("A2", 4000), ("H0", 6000)):
        for seed in (1, 2, 3):
            rows = curve(seed + 10 * ord(cell[1]), half + 700 * seed)
            if cell in cut and seed > 1:
                write_cut(root, cell, seed, rows, TOTAL)
            else:
                write_run(root, cell, seed, rows, total=TOTAL)


def points_of(root: Path, **options: float) -> pd.DataFrame:
    return analyze(load(root), **options).study.points


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    """A study of full runs and its points."""
    root = tmp_path_factory.mktemp("full")
    write_study(root)
    return root, points_of(root)


def at(points: pd.DataFrame, index: str, basis: str = ALL, criterion: str = "5 in a row", limit: float = 4900):
    rows = points[(points["index"] == index) & (points["basis"] == basis)]
    rows = rows[(rows["criterion"] == criterion) & (rows["threshold"] == limit)]
    assert len(rows) == 1
    return rows.iloc[0]


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (4900, [4500, 4600, 4700, 4800, 4900, 5000, 5100, 5200]),
        (1000, [920, 940, 960, 980, 1000, 1020, 1040, 1060]),
        (-200, [-216, -212, -208, -204, -200, -196, -192, -188]),
        (0, [-4, -3, -2, -1, 0, 1, 2, 3]),
        (0.5, [0.46, 0.47, 0.48, 0.49, 0.5, 0.51, 0.52, 0.53]),
    ],
)
def test_the_thresholds_lie_around_the_one_that_is_asked_for(own, expected):
    assert thresholds(own) == pytest.approx(expected)
    assert own in thresholds(own)


def test_the_count_that_is_asked_for_is_among_the_criteria():
    assert [str(one) for one in criteria(5)] == [
        *("1 in a row", "3 in a row", "5 in a row", "10 in a row"),
        *("mean of 5", "mean of 10", "mean of 50"),
    ]
    assert Criterion(7) in criteria(7)
    assert len(criteria(7)) == len(criteria(5)) + 1


def slow(steps: list[int], returns: list[float], limit: float, criterion: Criterion) -> float:
    if not criterion.smoothed:
        found = steps_to_threshold(steps, returns, limit, criterion.episodes)
        return float(found.last) if found else float("nan")
    for last in range(criterion.episodes, len(returns) + 1):
        if sum(returns[last - criterion.episodes : last]) / criterion.episodes >= limit:
            return float(steps[last - 1])
    return float("nan")


@pytest.mark.parametrize("seed", range(6))
def test_each_crossing_is_that_of_a_slow_loop(seed):
    rng = np.random.default_rng(seed)
    returns = np.round(rng.normal(4800, 200, 90), 0)
    returns[rng.random(90) < 0.03] = np.nan
    steps = np.cumsum(rng.integers(1, 1000, 90))
    limits, looked = thresholds(4900), criteria(5)
    found = crossings(steps, returns, limits, looked)
    expected = [[slow(steps.tolist(), returns.tolist(), limit, one) for limit in limits] for one in looked]
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found).sum() > 10


def test_a_run_shorter_than_the_window_meets_nothing_and_an_empty_one_neither():
    found = crossings(np.array([5, 9]), np.array([9000.0, 9000.0]), [4900.0], criteria(5))
    assert np.isnan(found[1:]).all()
    assert found[0, 0] == 5
    assert np.isnan(crossings(np.array([], dtype=int), np.array([]), [4900.0], criteria(5))).all()


@pytest.mark.parametrize(("limit", "count"), [(4500, 1), (4900, 5), (5000, 3), (5100, 3)])
@pytest.mark.first_is_fast
def test_each_difference_is_that_of_an_analysis_with_this_threshold(full, limit, count):
    root, points = full
    assert set(points["basis"]) == {ALL}
    table = analyze(load(root), threshold=limit, consecutive=count).table3.set_index("index")
    for index in ("A2", "H0"):
        row, expected = at(points, index, criterion=f"{count} in a row", limit=limit), table.loc[index]
        if row["measure"] == MEANS:
            assert row["difference"] == pytest.approx(expected["difference"])
            assert row["p_value"] == pytest.approx(expected["p_value"])
            assert row["low"] == pytest.approx(expected["difference_low"])
        else:
            assert row["difference"] == pytest.approx(expected["restricted_difference"])
            assert row["high"] == pytest.approx(expected["restricted_difference_high"])
        assert bool(row["own"]) == ((limit, count) == (4900, 5))


@pytest.mark.parametrize("cut", [("A2",), ("A0", "A2"), ("A0", "A2", "H0")])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_runs_that_stopped_say_what_the_full_ones_say_or_nothing(tmp_path, full, cut):
    write_study(tmp_path, cut)
    points = points_of(tmp_path)
    told = points[(points["basis"] == ALL)].merge(full[1], on=["reference", "index", "criterion", "threshold"])
    unknown = told["unknown_reference_x"] + told["unknown_index_x"] > 0
    assert unknown.any()
    assert not unknown.all()
    assert told.loc[unknown, "difference_x"].isna().all()
    known = told[~unknown]
    np.testing.assert_allclose(known["difference_x"], known["difference_y"])
    # Whatever the runs tell at the threshold that they stopped at, they tell exactly.
    asked = told[told["own_x"]]
    np.testing.assert_allclose(asked["difference_x"], asked["difference_y"])
    assert (asked["measure_x"] == MEANS).all()


@pytest.mark.slow
def test_the_full_runs_alone_stand_beside_all(tmp_path):
    write_study(tmp_path / "cut", ("A0", "A2"))
    for cell, half in (("A0", 5000), ("A2", 4000)):
        write_run(tmp_path / "first", cell, 1, curve(1 + 10 * ord(cell[1]), half + 700), total=TOTAL)
    points, first = points_of(tmp_path / "cut"), points_of(tmp_path / "first")
    alone = points[(points["index"] == "A2") & (points["basis"] == FULL)]
    np.testing.assert_allclose(alone["difference"], first.loc[first["index"] == "A2", "difference"])
    assert alone["difference"].notna().sum() > 40
    assert set(alone["runs_index"]) == set(alone["runs_reference"]) == {1}
    assert set(points.loc[(points["index"] == "H0") & (points["basis"] == FULL), "runs_index"]) == {3}


@pytest.mark.slow
def test_a_cell_of_which_the_fast_runs_have_ended_has_no_difference(tmp_path):
    for seed, steps in enumerate((8000, 9000, 10_000), start=1):
        write_cut(tmp_path, "A0", seed, rows_reaching(steps, TOTAL), TOTAL)
    write_cut(tmp_path, "A2", 1, rows_reaching(5000, TOTAL), TOTAL)
    write_under_way(tmp_path, "A2", 2, 4000, TOTAL)
    study = analyze(load(tmp_path)).study
    own = study.points[study.points["index"] == "A2"]
    assert own.loc[own["threshold"] <= 4900, "difference"].isna().all()
    assert "A2 − A0, all runs (1 + 3): not known at any of 56 settings" in sensitivity_lines(study.overview)


@pytest.mark.slow
def test_a_run_that_never_got_there_gives_restricted_means(tmp_path):
    for seed, (slow_one, fast_one) in enumerate(((9000, 6000), (None, 7000), (11_000, 5000)), start=1):
        write_run(tmp_path, "A0", seed, rows_reaching(slow_one, TOTAL), total=TOTAL)
        write_run(tmp_path, "A2", seed, rows_reaching(fast_one, TOTAL), total=TOTAL)
    points = points_of(tmp_path)
    row = at(points, "A2")
    assert row["measure"] == RESTRICTED
    assert row["difference"] == pytest.approx(6000 - (9000 + TOTAL + 11_000) / 3)
    nobody = at(points, "A2", limit=5200)
    assert nobody["measure"] == RESTRICTED
    assert np.isnan(nobody["difference"])


@pytest.mark.slow
def test_the_table_to_be_read_tells_the_same(tmp_path):
    write_study(tmp_path, ("A2",))
    found = analyze(load(tmp_path)).study
    points, table = found.points, found.sensitivity
    row = table[(table["index"] == "A2") & (table["criterion"] == "5 in a row") & (table["runs"] == "all, 3 + 3")]
    assert row["4900"].item() == f"{at(points, 'A2')['difference']:,.0f}".replace("-", "−")
    unknown = points[(points["index"] == "A2") & (points["unknown_index"] > 0) & (points["basis"] == ALL)]
    assert len(unknown) > 3
    for setting in unknown.to_dict("records"):
        own = table[(table["index"] == "A2") & (table["criterion"] == setting["criterion"])]
        assert set(own.loc[own["runs"] == "all, 3 + 3", f"{setting['threshold']:g}"]) <= {""}
    overview = found.overview.set_index(["index", "basis"])
    own = points[(points["index"] == "H0") & (points["basis"] == ALL)]["difference"]
    assert overview.loc[("H0", ALL), "faster"] == (own < 0).sum()
    assert overview.loc[("H0", ALL), "highest"] == own.max()


def test_no_comparison_no_table(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(8000, TOTAL), total=TOTAL)
    found = analyze(load(tmp_path)).study
    assert len(found.points) == len(found.sensitivity) == len(found.overview) == 0
    assert list(found.sensitivity.columns) == ["index", "reference", "runs", "criterion"]
