"""Every statistic against a closed form, a brute-force count or another library."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from lifelines import KaplanMeierFitter
from lifelines.statistics import logrank_test
from lifelines.utils import restricted_mean_survival_time
from scipy import stats

from analysis.statistics.survival import kaplan_meier, log_rank, log_rank_scores, restricted_mean
from analysis.statistics.two_samples import (
    detectable_effect,
    hedges_g,
    holm,
    mean_interval,
    noncentrality,
    p_from_t,
    permutation_p,
    power,
    smallest_permutation_p,
    t_test,
)

#: A busy machine is no failure.
UNHURRIED = settings(deadline=None)
FEWER = settings(deadline=None, max_examples=40)
A, B = [412_000.0, 455_000.0, 503_000.0], [350_000.0, 361_000.0, 377_000.0]
STEPS = st.lists(st.integers(1, 10**6).map(float), min_size=2, max_size=5)
RUN = st.tuples(st.integers(1, 40).map(float), st.booleans())
RUNS, FEW_RUNS = st.lists(RUN, min_size=2, max_size=9), st.lists(RUN, min_size=2, max_size=5)


@pytest.mark.parametrize(
    ("t", "p"), [(-0.247, 0.817), (-4.129, 0.0145), (-4.377, 0.0119), (0.668, 0.5407), (-6.875, 0.0023)]
)
def test_the_papers_t_and_p_belong_together(t, p):
    assert p_from_t(t, 4) == pytest.approx(p, abs=0.001)


def test_the_t_test_by_hand():
    variance = (np.var(A, ddof=1) + np.var(B, ddof=1)) / 2
    t = (np.mean(B) - np.mean(A)) / math.sqrt(variance * 2 / 3)
    half = stats.t.ppf(0.975, 4) * math.sqrt(variance * 2 / 3)
    test = t_test(A, B)
    assert (test.t, test.df) == (pytest.approx(t, rel=1e-12), 4)
    assert test.t < 0  # the index is faster
    assert test.p == pytest.approx(p_from_t(t, 4), rel=1e-12)
    assert (test.low + test.high) / 2 == pytest.approx(np.mean(B) - np.mean(A), rel=1e-12)
    assert (test.high - test.low) / 2 == pytest.approx(half, rel=1e-12)


def test_welch_by_hand():
    parts = np.var(A, ddof=1) / 3, np.var(B, ddof=1) / 3
    test = t_test(A, B, pooled=False)
    assert test.t == pytest.approx((np.mean(B) - np.mean(A)) / math.sqrt(sum(parts)), rel=1e-12)
    assert test.df == pytest.approx(sum(parts) ** 2 / sum(part**2 / 2 for part in parts), rel=1e-12)


@FEWER
@given(STEPS, STEPS)
def test_turning_the_samples_round_turns_the_sign(first, second):
    assume(np.ptp(first) > 0 and np.ptp(second) > 0)
    one, other = t_test(first, second), t_test(second, first)
    assert one.t == pytest.approx(-other.t)
    assert one.p == pytest.approx(other.p)
    assert permutation_p(first, second) == pytest.approx(permutation_p(second, first))
    assert hedges_g(first, second).g == pytest.approx(-hedges_g(second, first).g)


@pytest.mark.parametrize("first", [[], [1.0]])
def test_one_value_gives_no_test(first):
    for test in (t_test(first, A), t_test(A, first), t_test(first, first)):
        assert all(math.isnan(value) for value in vars(test).values())
    assert math.isnan(permutation_p(first, A))
    assert math.isnan(hedges_g(first, A).g)
    assert math.isnan(power(0.8, len(first), 3))
    assert math.isnan(detectable_effect(3, len(first)))
    assert all(map(math.isnan, mean_interval(first)))


def test_censored_values_are_not_taken_for_numbers():
    with pytest.raises(ValueError, match="survival"):
        t_test(A, [1.0, math.nan])


def permutation_by_hand(first, second):
    """Twice the smaller tail, over every way to deal out the values."""
    pooled = [*first, *second]
    differences = []
    for chosen in itertools.combinations(range(len(pooled)), len(second)):
        inside = [pooled[i] for i in chosen]
        outside = [pooled[i] for i in range(len(pooled)) if i not in chosen]
        differences.append(np.mean(inside) - np.mean(outside))
    seen, slack = np.mean(second) - np.mean(first), 1e-6
    tails = np.mean(np.array(differences) <= seen + slack), np.mean(np.array(differences) >= seen - slack)
    return min(1.0, 2 * min(tails))


@UNHURRIED
@given(STEPS, STEPS)
def test_the_permutation_test_counts_every_assignment(first, second):
    assert permutation_p(first, second) == pytest.approx(permutation_by_hand(first, second))


def test_ties_count_for_both_tails():
    for first, second in (([1.0, 1.0, 2.0], [1.0, 2.0, 2.0]), ([5.0] * 3, [5.0] * 3), ([1.0] * 2, [2.0] * 3)):
        assert permutation_p(first, second) == pytest.approx(permutation_by_hand(first, second))


@pytest.mark.parametrize(("n", "p"), [(2, 1 / 3), (3, 0.1), (5, 2 / 252)])
def test_the_smallest_p_value_of_a_permutation_test(n, p):
    low, high = np.arange(n, dtype=float), 100 + np.arange(n, dtype=float)
    assert smallest_permutation_p(n, n) == pytest.approx(p)
    assert permutation_p(low, high) == pytest.approx(p)


def test_large_samples_are_drawn_not_enumerated_and_repeatably():
    rng = np.random.default_rng(1)
    first, second = rng.normal(0, 1, 15), rng.normal(0.8, 1, 15)
    p = permutation_p(first, second)
    assert p == permutation_p(first, second)
    assert p == pytest.approx(t_test(first, second).p, rel=0.25)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.01, math.nan, 0.04]) == pytest.approx([0.03, math.nan, 0.08], nan_ok=True)
    assert holm([]).size == 0


def test_hedges_g_by_hand():
    pooled = math.sqrt((np.var(A, ddof=1) + np.var(B, ddof=1)) / 2)
    correction = math.gamma(2) / (math.sqrt(2) * math.gamma(1.5))
    effect = hedges_g(A, B)
    assert effect.g == pytest.approx(correction * (np.mean(B) - np.mean(A)) / pooled, rel=1e-9)
    assert effect.low < effect.g < effect.high


@pytest.mark.parametrize("t", [-60.0, -6.875, -0.247, 0.0, 4.377, 30.0])
@pytest.mark.parametrize("df", [2, 4, 8])
@pytest.mark.parametrize("probability", [0.025, 0.975])
def test_the_interval_of_g_inverts_the_noncentral_t(t, df, probability):
    assert stats.nct.cdf(t, df, noncentrality(t, df, probability)) == pytest.approx(probability, abs=1e-6)


@pytest.mark.parametrize(("n", "m", "truth"), [(2, 2, 1.0), (2, 2, 3.0), (3, 3, 3.0), (2, 4, -3.0), (5, 5, 0.0)])
@pytest.mark.first_is_fast
def test_the_interval_of_g_covers_as_often_as_it_says(n, m, truth):
    rng = np.random.default_rng(0)
    effects = [hedges_g(rng.normal(0, 1, n), rng.normal(truth, 1, m)) for _ in range(800)]
    # Beyond some hundreds of t the distribution function itself fails.
    known = [effect for effect in effects if math.isfinite(effect.low)]
    assert len(known) > 780
    assert np.mean([effect.low <= truth <= effect.high for effect in known]) == pytest.approx(0.95, abs=0.025)


def test_power_is_the_share_of_simulated_tests_that_find_the_effect():
    rng = np.random.default_rng(0)
    for effect in (0.8, detectable_effect(3, 3)):
        first, second = rng.normal(0, 1, (3, 20_000)), rng.normal(effect, 1, (3, 20_000))
        found = np.mean(stats.ttest_ind(first, second).pvalue < 0.05)
        assert power(effect, 3, 3) == pytest.approx(found, abs=0.01)
    assert power(detectable_effect(3, 5), 3, 5) == pytest.approx(0.8, abs=1e-6)


def test_the_interval_of_a_mean():
    low, high = mean_interval(A)
    assert stats.ttest_1samp(A, low).pvalue == pytest.approx(0.05)
    assert stats.ttest_1samp(A, high).pvalue == pytest.approx(0.05)


@FEWER
@given(RUNS)
def test_kaplan_meier_and_the_restricted_mean_agree_with_lifelines(runs):
    times, events = np.array([run[0] for run in runs]), np.array([run[1] for run in runs])
    fitter = KaplanMeierFitter().fit(times, events)
    curve = kaplan_meier(times, events)
    expected = fitter.survival_function_at_times(curve.steps).to_numpy()
    assert curve.share == pytest.approx(expected, abs=1e-12)
    assert curve.censored.tolist() == sorted(times[~events])
    for horizon in (times.max(), times.mean()):
        theirs = restricted_mean_survival_time(fitter, t=horizon)
        assert restricted_mean(times, events, horizon) == pytest.approx(theirs, rel=1e-9)


@UNHURRIED
@given(RUNS)
def test_the_restricted_mean_is_a_plain_mean_if_all_are_watched_to_the_horizon(runs):
    times = np.array([time if event else 50.0 for time, event in runs])
    events = np.array([event for _, event in runs])
    assert restricted_mean(times, events, 50.0) == pytest.approx(np.minimum(times, 50.0).mean())


@FEWER
@given(FEW_RUNS, FEW_RUNS)
def test_the_log_rank_statistic_agrees_with_lifelines(first, second):
    (a, x), (b, y) = (map(np.array, zip(*runs, strict=True)) for runs in (first, second))
    assume(x.any() or y.any())
    ours, theirs = log_rank(a, x, b, y), logrank_test(a, b, x, y)
    if math.isfinite(ours.z):  # it has no variance if the last runs at risk are all of one group
        assert ours.z**2 == pytest.approx(theirs.test_statistic, rel=1e-9, abs=1e-9)
        assert ours.p_asymptotic == pytest.approx(theirs.p_value, abs=1e-9)


@UNHURRIED
@given(RUNS)
def test_log_rank_scores_sum_to_nothing(runs):
    times, events = map(np.array, zip(*runs, strict=True))
    assert log_rank_scores(times, events).sum() == pytest.approx(0, abs=1e-9)


def test_log_rank_scores_are_observed_less_expected():
    times, events = np.array([3.0, 5.0, 9.0, 9.0, 4.0, 9.0]), np.array([1, 1, 0, 0, 1, 1], bool)
    expected = 0.0
    for moment in np.unique(times[events]):
        at_risk = times >= moment
        expected += (events & (times == moment)).sum() * at_risk[:3].sum() / at_risk.sum()
    assert log_rank_scores(times, events)[:3].sum() == pytest.approx(events[:3].sum() - expected)


def test_the_log_rank_test_keeps_cells_that_never_reach():
    never = np.full(3, 1e6), np.zeros(3, bool)
    fast = np.array(A), np.ones(3, bool)
    assert log_rank(*never, *fast).z < 0 < log_rank(*fast, *never).z
    assert log_rank(*fast, *never).p == pytest.approx(0.1)
    assert log_rank(*fast, *never).p_asymptotic < 0.05  # too optimistic at n = 3
    assert all(map(math.isnan, vars(log_rank(*never, *never)).values()))
