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

from analysis.statistics.two_samples import permutation_p

_NAN = float("nan")


@dataclass(frozen=True)
class SurvivalCurve:
    """A Kaplan-Meier estimate: a staircase.

    Attributes:
        steps: Where it may fall, (k,), the first is 0.
        share: Estimated share of runs not yet at the threshold from there on, (k,).
        censored: Steps at which runs were censored, ascending.
    """

    steps: NDArray[np.float64]
    share: NDArray[np.float64]
    censored: NDArray[np.float64]


def kaplan_meier(times: ArrayLike, reached: ArrayLike) -> SurvivalCurve:
    """Share of the runs that are not yet at the threshold (Kaplan and Meier, JASA 53, 1958).

    Args:
        times: Steps, (n,), n >= 1.
        reached: Whether the run reached the threshold then, or was only watched until then, (n,).
    """
    steps, events = np.asarray(times, dtype=float), np.asarray(reached, dtype=bool)
    function = stats.ecdf(_data(steps, events)).sf
    return SurvivalCurve(
        steps=np.concatenate(([0.0], function.quantiles)),
        share=np.concatenate(([1.0], function.probabilities)),
        censored=np.sort(steps[~events]),
    )


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
