"""Steps to threshold at its edges, and properties of all metrics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from analysis_runs import rows_reaching, write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from analysis.loading.load import load
from analysis.statistics.metrics import (
    area_under_curve,
    asymptotic_return,
    initial_return,
    jumpstart,
    measure,
    rolling_mean,
    steps_to_threshold,
    transfer_ratio,
)

#: A busy machine is no failure.
UNHURRIED = settings(deadline=None)
NAN = math.nan
RETURNS = hnp.arrays(np.float64, st.integers(1, 60), elements=st.floats(-1e4, 1e4) | st.just(NAN) | st.just(4900.0))


def reached(returns, threshold=4900.0, consecutive=5):
    result = steps_to_threshold([100 * (i + 1) for i in range(len(returns))], returns, threshold, consecutive)
    return None if result is None else (result.last, result.first)


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([4900.0] * 5, (500, 100)),  # met exactly, at the very start
        ([4899.999999] * 5, None),
        ([5000.0] * 4, None),  # the run ends within the fifth
        ([5000.0] * 4 + [100.0] + [5000.0] * 5, (1000, 600)),  # four, a miss, five
        ([5000.0] * 4 + [100.0] + [5000.0] * 4, None),
        ([5000.0] * 4 + [NAN] + [5000.0] * 5, (1000, 600)),
        ([NAN] * 20, None),
        ([0.0] * 3 + [5000.0] * 9, (800, 400)),
        ([], None),
    ],
)
def test_steps_to_threshold_on_the_edges(returns, expected):
    assert reached(returns) == expected


def brute_force(returns, threshold, consecutive):
    for end in range(consecutive, len(returns) + 1):
        if all(value >= threshold for value in returns[end - consecutive : end]):
            return 100 * end, 100 * (end - consecutive + 1)
    return None


@UNHURRIED
@given(RETURNS, st.floats(-1e4, 1e4) | st.just(4900.0), st.integers(1, 7))
def test_steps_to_threshold_is_the_first_window_that_holds(returns, threshold, consecutive):
    assert reached(returns.tolist(), threshold, consecutive) == brute_force(returns, threshold, consecutive)


@UNHURRIED
@given(RETURNS, st.integers(1, 6))
def test_a_higher_threshold_or_a_longer_streak_is_never_reached_sooner(returns, consecutive):
    times = [reached(returns.tolist(), threshold, consecutive) for threshold in (0.0, 1000.0, 4900.0)]
    times.append(reached(returns.tolist(), 4900.0, consecutive + 1))
    ends = [math.inf if time is None else time[0] for time in times]
    assert ends == sorted(ends)


@UNHURRIED
@given(RETURNS)
def test_what_comes_later_does_not_change_steps_to_threshold(returns):
    before = reached(returns.tolist(), 1000.0)
    if before is not None:
        assert reached([*returns.tolist(), NAN, 9e3, -9e3], 1000.0) == before


LENGTHS = st.lists(st.integers(1, 1000), min_size=1, max_size=50)


@UNHURRIED
@given(LENGTHS, st.floats(-1e4, 1e4))
def test_a_constant_return_is_every_mean(lengths, value):
    steps = np.cumsum(lengths)
    returns = np.full(len(lengths), value)
    for mean in (area_under_curve(steps, returns), asymptotic_return(steps, returns), rolling_mean(returns, 7)[-1]):
        assert mean == pytest.approx(value, abs=1e-6)
    assert initial_return(steps, lengths, returns) == pytest.approx(value, abs=1e-6)


@UNHURRIED
@given(LENGTHS, st.data())
def test_the_area_is_the_integral_of_the_staircase(lengths, data):
    returns = np.array(data.draw(st.lists(st.floats(-1e4, 1e4), min_size=len(lengths), max_size=len(lengths))))
    staircase = np.repeat(returns, lengths)
    steps = np.cumsum(lengths)
    assert area_under_curve(steps, returns) == pytest.approx(staircase.mean(), abs=1e-6)
    until = data.draw(st.integers(1, int(steps[-1])))
    assert area_under_curve(steps, returns, until) == pytest.approx(staircase[:until].mean(), abs=1e-6)
    assert staircase.min() - 1e-6 <= area_under_curve(steps, returns) <= staircase.max() + 1e-6


@UNHURRIED
@given(RETURNS, st.integers(1, 60))
def test_the_rolling_mean_is_the_mean_of_the_last_values(returns, window):
    means = rolling_mean(returns, window)
    for end in range(1, len(returns) + 1):
        last = returns[max(0, end - window) : end]
        expected = np.nan if np.isnan(last).all() else np.nanmean(last)
        assert means[end - 1] == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_the_initial_return_leaves_out_random_actions():
    steps, lengths, returns = [50, 100, 160, 230, 300], [50, 50, 60, 70, 70], [1.0, 2.0, 3.0, 4.0, 5.0]
    assert initial_return(steps, lengths, returns) == 3.0
    assert initial_return(steps, lengths, returns, start=100) == 4.0  # the episode that begins at step 100 counts
    assert initial_return(steps, lengths, returns, start=101, episodes=1) == 4.0
    assert math.isnan(initial_return(steps, lengths, returns, start=231))


def test_the_asymptotic_return_is_of_the_last_tenth():
    steps = np.arange(100, 10_001, 100)
    assert asymptotic_return(steps, np.arange(100.0)) == np.arange(90, 100).mean()
    assert math.isnan(asymptotic_return([], []))


def test_the_transfer_ratio_and_the_jumpstart():
    assert transfer_ratio(150.0, 100.0) == 0.5
    assert math.isnan(transfer_ratio(150.0, -1.0))
    assert jumpstart(300.0, 120.0) == 180.0


def test_metrics_of_runs(tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    write_run(tmp_path, "A0", 2, rows_reaching(None, 19_900), total=20_000)
    runs = measure(load(tmp_path), 4900, 5)
    assert runs["steps_to_threshold"].tolist() == pytest.approx([6000, NAN], nan_ok=True)
    assert runs["steps_to_threshold_first"].tolist() == pytest.approx([5600, NAN], nan_ok=True)
    assert runs["censored"].tolist() == [False, True]
    assert runs["time"].tolist() == [6000, 20_000]
    assert measure(load(tmp_path), 4900, 3)["steps_to_threshold"].iloc[0] == 5800
    assert measure(load(tmp_path), 9000, 5)["censored"].all()
    assert not measure(load(tmp_path), 100, 5)["censored"].any()
