"""Steps to threshold where some runs never reach it: they are censored, not dropped.

``times`` are the steps to threshold of the runs that reached it and the last steps of those that did not;
``reached`` says which is which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.statistics.two_samples import ALPHA, permutation_p

_NAN = float("nan")


@dataclass(frozen=True)
class SurvivalCurve:
    """A Kaplan-Meier estimate: a staircase.

    Attributes:
        steps: Where it may fall, (k,), the first is 0.
        share: Estimated share of runs not yet at the threshold from there on, (k,).
        censored: Steps at which runs were censored, ascending.
        low: Lower end of the 95% interval of each share, (k,).
        high: Upper end.
    """

    steps: NDArray[np.float64]
    share: NDArray[np.float64]
    censored: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def kaplan_meier(times: ArrayLike, reached: ArrayLike) -> SurvivalCurve:
    """Share of the runs that are not yet at the threshold (Kaplan and Meier, JASA 53, 1958).

    The intervals hold at each step for itself. They are Clopper and Pearson's, with the effective number of runs in the
    place of their number where some were censored: those still at risk, divided by the share (Dorey and Korn,
    Statistics in Medicine 6, 1987). Without censoring they are exact, so that they cover at least 95% with three runs,
    too, where intervals from Greenwood's variance do not even exist at the shares 0 and 1.

    Args:
        times: Steps, (n,), n >= 1.
        reached: Whether the run reached the threshold then, or was only watched until then, (n,).
    """
    steps, events = np.asarray(times, dtype=float), np.asarray(reached, dtype=bool)
    function = stats.ecdf(_data(steps, events)).sf
    moments, share = np.append(0.0, function.quantiles), np.append(1.0, function.probabilities)
    low, high = _share_interval(share, _effective_number(steps, moments, share))
    return SurvivalCurve(moments, share, np.sort(steps[~events]), low, high)


def at_risk(times: ArrayLike, moments: ArrayLike) -> NDArray[np.int64]:
    """How many runs were still watched and not yet at the threshold just before each moment, (n,), (k,) -> (k,)."""
    return (np.asarray(times, dtype=float)[None, :] >= np.asarray(moments, dtype=float)[:, None]).sum(axis=1)


def _effective_number(
    steps: NDArray[np.float64], moments: NDArray[np.float64], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Runs that would give each share as surely if none had been censored, (k,)."""
    left = (steps[None, :] > moments[:, None]).sum(axis=1)
    # Where the share has fallen to 0, or nobody is watched any more, it is as sure as it was before.
    known = np.where((left > 0) & (share > 0), left / np.where(share > 0, share, 1.0), np.nan)
    numbers = np.append(float(steps.size), known)
    last = np.maximum.accumulate(np.where(np.isnan(numbers), 0, np.arange(numbers.size)))
    return numbers[last][1:]


def _share_interval(
    share: NDArray[np.float64], number: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    left, gone = number * share, number * (1 - share)
    with np.errstate(all="ignore"):
        low, high = stats.beta.ppf(ALPHA / 2, left, gone + 1), stats.beta.ppf(1 - ALPHA / 2, left + 1, gone)
    return np.where(left > 0, low, 0.0), np.where(gone > 0, high, 1.0)


def restricted_mean(times: ArrayLike, reached: ArrayLike, horizon: float) -> float:
    """Mean steps to threshold within a horizon: the area under the Kaplan-Meier curve up to it.

    Equals the mean of min(T, horizon) where no run is censored before the horizon (Royston and Parmar, BMC Medical
    Research Methodology 13, 2013).

    Args:
        times: Steps, (n,).
        reached: Whether the run reached the threshold then, (n,).
        horizon: Steps up to which the time counts.

    Returns:
        Steps; NaN without runs.
    """
    if not np.size(times):
        return _NAN
    curve = kaplan_meier(times, reached)
    edges = np.minimum(np.append(curve.steps, np.inf), horizon)
    return float(np.sum(np.diff(edges) * curve.share))


def restricted_interval(reference: ArrayLike, index: ArrayLike, horizon: float) -> tuple[float, float]:
    """95% interval of the difference of two restricted means, index - reference, for few runs.

    A t-interval of min(T, horizon) with variances of their own and the degrees of freedom of the smaller sample, within
    +-horizon. A group without spread (every run censored at the horizon) is not taken for one without variance: it gets
    the other's. An inverted permutation test would take nothing for granted, but at 3 + 3 no difference is excluded by
    it, its least p-value being 0.1.

    In simulations (20,000 samples each of normal and of shifted exponential times; 2 + 2 to 10 + 10 runs) it covered
    95% to 100% with up to 70% of the runs of both groups censored at the horizon, and 92% to 97% with 80% to 85% of one
    group: the less of a distribution is seen, the less its spread is known.

    Args:
        reference: Steps of the reference's runs, censored ones with the last they were watched to, (n,).
        index: The same of the index, (m,).
        horizon: Steps up to which time counts; every run was watched so long, or reached before.

    Returns:
        Lower and upper end; NaN with fewer than two runs in a group, or without any spread.
    """
    first, second = (np.minimum(np.asarray(times, dtype=float), horizon) for times in (reference, index))
    n, m = first.size, second.size
    if min(n, m) < 2:
        return _NAN, _NAN
    variances = float(first.var(ddof=1)), float(second.var(ddof=1))
    if not any(variances):
        return _NAN, _NAN
    error = math.sqrt((variances[0] or variances[1]) / n + (variances[1] or variances[0]) / m)
    half = float(stats.t.ppf(1 - ALPHA / 2, min(n, m) - 1)) * error
    difference = float(second.mean() - first.mean())
    return max(difference - half, -horizon), min(difference + half, horizon)


def log_rank_scores(times: ArrayLike, reached: ArrayLike) -> NDArray[np.float64]:
    """Each run's part in the log-rank statistic: (reached) - Nelson-Aalen estimate of all runs at its time.

    Their sum over a group is its observed less its expected number of runs at the threshold (Peto and Peto, JRSS A 135,
    1972).

    Args:
        times: Steps of all runs, (n,).
        reached: Whether the run reached the threshold then, (n,).

    Returns:
        Scores, (n,), which sum to 0.
    """
    steps, events = np.asarray(times, dtype=float), np.asarray(reached, dtype=bool)
    moments, falls = np.unique(steps[events], return_counts=True)
    at_risk = (steps[None, :] >= moments[:, None]).sum(axis=1)
    hazard = np.concatenate(([0.0], np.cumsum(falls / np.maximum(at_risk, 1))))
    return events - hazard[np.searchsorted(moments, steps, side="right")]


@dataclass(frozen=True)
class LogRank:
    """A comparison of two groups with censored runs.

    Attributes:
        z: Log-rank statistic; negative: the index reaches the threshold earlier. NaN if no run reached it.
        p_asymptotic: From the normal distribution; too small for few runs.
        p: From the permutations, exact up to ``analysis.statistics.two_samples.MOST_PERMUTATIONS``.
    """

    z: float = _NAN
    p_asymptotic: float = _NAN
    p: float = _NAN


def log_rank(reference: ArrayLike, reference_reached: ArrayLike, index: ArrayLike, index_reached: ArrayLike) -> LogRank:
    """Log-rank test with a permutation p-value.

    The permutations go over the scores of :func:`log_rank_scores`. They are exact if the runs of both groups are
    watched equally long, as complete runs of one profile are.

    Args:
        reference: Steps of the reference's runs, (n,).
        reference_reached: Whether they reached the threshold, (n,).
        index: Steps of the index's runs, (m,).
        index_reached: Whether they reached the threshold, (m,).
    """
    first, second = np.asarray(reference, dtype=float), np.asarray(index, dtype=float)
    events = np.concatenate((np.asarray(reference_reached, bool), np.asarray(index_reached, bool)))
    if not (first.size and second.size and events.any()):
        return LogRank()
    scores = log_rank_scores(np.concatenate((first, second)), events)
    p = permutation_p(scores[: first.size], scores[first.size :])
    with np.errstate(all="ignore"):
        result = stats.logrank(_data(first, events[: first.size]), _data(second, events[first.size :]))
    # scipy's sign: positive where the first group has more events than expected, i.e. is the faster one.
    z, asymptotic = float(result.statistic), float(result.pvalue)
    return LogRank(z if math.isfinite(z) else _NAN, asymptotic if math.isfinite(z) else _NAN, p)


def _data(steps: NDArray[np.float64], events: NDArray[np.bool_]) -> stats.CensoredData:
    return stats.CensoredData(steps[events], right=steps[~events])
