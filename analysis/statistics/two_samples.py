"""Tests and effect sizes for two small samples of steps to threshold.

Everywhere the difference is index - reference, so that a negative number means that the index is faster
(paper, table 3). Samples are one number per seed, never one per episode. Where a number does not exist it is NaN.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, special, stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.power import TTestIndPower

#: Level of significance (paper, section 4.2); intervals cover 1 - ALPHA.
ALPHA = 0.05
#: Assignments up to which permutation tests enumerate all of them; beyond, that many are drawn.
MOST_PERMUTATIONS = 200_000

_NAN = float("nan")


@dataclass(frozen=True)
class TTest:
    """A two-sided t-test.

    Attributes:
        t: Statistic of index - reference.
        df: Degrees of freedom.
        p: Two-sided p-value.
        low: Lower end of the 95% interval of the difference of the means, in the samples' unit.
        high: Upper end.
    """

    t: float = _NAN
    df: float = _NAN
    p: float = _NAN
    low: float = _NAN
    high: float = _NAN


def t_test(reference: ArrayLike, index: ArrayLike, *, pooled: bool = True) -> TTest:
    """Student's t-test with pooled variance, the paper's (table 3), or Welch's.

    Args:
        reference: Sample of the reference, (n,).
        index: Sample of the index, (m,).
        pooled: Student's; False: Welch's, which does not take the variances for equal.

    Returns:
        The test; all NaN where a sample holds fewer than two values, for then its variance is not known.
    """
    first, second = _samples(reference, index)
    if min(first.size, second.size) < 2:
        return TTest()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # samples of equal values: t is infinite or NaN, as it should be
        result = stats.ttest_ind(second, first, equal_var=pooled)
        low, high = result.confidence_interval(1 - ALPHA)
    return TTest(*(float(value) for value in (result.statistic, result.df, result.pvalue, low, high)))


def p_from_t(t: float, df: float) -> float:
    """Two-sided p-value of a t statistic (to check published pairs of the two)."""
    return float(2 * stats.t.sf(abs(t), df))


def permutation_p(reference: ArrayLike, index: ArrayLike) -> float:
    """Two-sided permutation test of the difference of the means.

    Exact (every assignment is enumerated) up to ``MOST_PERMUTATIONS`` of them. Twice the smaller one-sided p-value, as
    :func:`scipy.stats.permutation_test` defines it; at 3 + 3 it cannot be below 2/20.

    Args:
        reference: Sample of the reference, (n,).
        index: Sample of the index, (m,).

    Returns:
        The p-value; NaN where a sample holds fewer than two values.
    """
    first, second = _samples(reference, index)
    if min(first.size, second.size) < 2:
        return _NAN
    result = stats.permutation_test(
        (second, first),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        vectorized=True,
        n_resamples=MOST_PERMUTATIONS - 1,
        batch=20_000,
        rng=np.random.default_rng(0),
    )
    return float(result.pvalue)


def smallest_permutation_p(n: int, m: int) -> float:
    """Least p-value that a two-sided permutation test can give with n + m values."""
    return min(1.0, 2 / math.comb(n + m, n))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Holm's adjustment for several tests, (k,) -> (k,).

    Args:
        p_values: The tests of one family. NaN is a test that was asked for and gave none (a group that never reached
            the threshold): it counts as p = 1, so that the family does not shrink, and stays NaN.
    """
    raw = np.asarray(p_values, dtype=float)
    if not raw.size:
        return raw
    adjusted = multipletests(np.where(np.isnan(raw), 1.0, raw), method="holm")[1]
    return np.where(np.isnan(raw), np.nan, adjusted)


@dataclass(frozen=True)
class Effect:
    """A standardized difference with its 95% interval (standard deviations)."""

    g: float = _NAN
    low: float = _NAN
    high: float = _NAN


def hedges_g(reference: ArrayLike, index: ArrayLike) -> Effect:
    """Hedges' g: the difference in pooled standard deviations, corrected for small samples.

    g = J d with d = t sqrt(1/n + 1/m) and J = Gamma(df/2) / (sqrt(df/2) Gamma((df - 1)/2)), df = n + m - 2
    (Hedges, Journal of Educational Statistics 6, 1981). The interval is that of the true difference in standard
    deviations, exact for normal samples of equal variance: its ends are the noncentralities under which the observed t
    lies at the upper and the lower 2.5%, times sqrt(1/n + 1/m) (Cumming and Finch, Educational and Psychological
    Measurement 61, 2001). J corrects the bias of an estimate and belongs to g alone: multiplied by it the interval of a
    true difference of 3 covers 0.71 at 2 + 2, 0.88 at 3 + 3 and 0.93 at 5 + 5 (40,000 samples each), without it 0.95.

    Args:
        reference: Sample of the reference, (n,).
        index: Sample of the index, (m,).
    """
    first, second = _samples(reference, index)
    return effect_of_t(t_test(first, second).t, first.size, second.size)


def effect_of_t(t: float, n: int, m: int) -> Effect:
    """The effect behind Student's t of n + m values (:func:`hedges_g`); NaN if t is not finite."""
    if not math.isfinite(t):
        return Effect()
    df, scale = n + m - 2, math.sqrt(1 / n + 1 / m)
    ends = (noncentrality(t, df, 1 - ALPHA / 2), noncentrality(t, df, ALPHA / 2))
    return Effect(small_sample_correction(df) * t * scale, ends[0] * scale, ends[1] * scale)


def small_sample_correction(df: float) -> float:
    """Hedges' J, by which a standardized difference overstates its true value on average."""
    return math.exp(special.gammaln(df / 2) - special.gammaln((df - 1) / 2)) / math.sqrt(df / 2)


def noncentrality(t: float, df: float, probability: float) -> float:
    """Noncentrality under which a t variable falls below ``t`` with the given probability; NaN if not found."""
    guess = float(special.nctdtrinc(df, probability, t))
    if not math.isfinite(guess):
        return _NAN
    width = 0.05 * abs(guess) + 0.1
    try:
        return float(optimize.brentq(lambda nc: stats.nct.cdf(t, df, nc) - probability, guess - width, guess + width))
    except ValueError:  # the distribution function itself loses its digits (|t| beyond some hundreds)
        return _NAN


def power(effect: float, n: int, m: int) -> float:
    """Chance that Student's two-sided test at 5% finds a true effect of this size (standard deviations)."""
    if min(n, m) < 2:
        return _NAN
    return float(TTestIndPower().power(effect, nobs1=n, alpha=ALPHA, ratio=m / n))


def detectable_effect(n: int, m: int, chance: float = 0.8) -> float:
    """Least true effect (standard deviations) that Student's test at 5% finds with the given chance."""
    if min(n, m) < 2:
        return _NAN
    return float(TTestIndPower().solve_power(None, nobs1=n, alpha=ALPHA, power=chance, ratio=m / n))


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """95% t-interval of a mean, (n,); NaN below two values. A bootstrap of three values would be too narrow."""
    sample = np.asarray(values, dtype=float)
    if sample.size < 2:
        return _NAN, _NAN
    half = float(stats.t.ppf(1 - ALPHA / 2, sample.size - 1) * stats.sem(sample))
    return float(sample.mean() - half), float(sample.mean() + half)


def _samples(reference: ArrayLike, index: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first, second = np.asarray(reference, dtype=float), np.asarray(index, dtype=float)
    if np.isnan(first).any() or np.isnan(second).any():
        raise ValueError("a sample holds NaN: censored runs belong to analysis.survival")
    return first, second
