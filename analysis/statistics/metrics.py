"""One number per run: how fast and how well it learned.

Steps to threshold is the paper's measure (section 4.2). The others are the transfer metrics of Taylor and Stone,
"Transfer Learning for Reinforcement Learning Domains: A Survey", JMLR 10 (2009), section 2.
All returns are raw episodic returns; all functions are pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from acmr.records import VELOCITY_COLUMN, steps_to_threshold
from analysis.loading.load import RunSet
from analysis.loading.read_run import UNFINISHED

#: Episodes over which a run's initial performance is averaged.
INITIAL_EPISODES = 10
#: Last part of a run over which its asymptotic performance is averaged.
FINAL_PART = 0.1

__all__ = [
    "area_under_curve",
    "asymptotic_return",
    "initial_return",
    "judge",
    "jumpstart",
    "measure",
    "rolling_mean",
    "steps_to_threshold",
    "transfer_ratio",
]


def initial_return(
    global_steps: ArrayLike,
    lengths: ArrayLike,
    returns: ArrayLike,
    start: float = 0,
    episodes: int = INITIAL_EPISODES,
) -> float:
    """Mean return of the first episodes that began once the agent itself chose its actions.

    A run begins with ``learning_starts`` random actions, also one with a transfer, unless it has
    ``agent.start=policy``: before them there is nothing of the agent to see.

    Args:
        global_steps: Step at each episode's end, (episodes,), ascending.
        lengths: Steps in each episode, (episodes,).
        returns: Raw return of each episode, (episodes,).
        start: Step from which the agent chooses its actions; NaN if that is not known.
        episodes: Episodes to average.

    Returns:
        The mean, NaN if there are none or ``start`` is not known.
    """
    begins = np.asarray(global_steps, dtype=float) - np.asarray(lengths, dtype=float)
    return _mean(np.asarray(returns, dtype=float)[begins >= start][:episodes])


def jumpstart(student: float, baseline: float) -> float:
    """Gain of the initial performance by the transfer (Taylor and Stone, 2009), in units of return.

    Args:
        student: :func:`initial_return` with the transfer.
        baseline: The same without it.
    """
    return student - baseline


def asymptotic_return(global_steps: ArrayLike, returns: ArrayLike, part: float = FINAL_PART) -> float:
    """Mean return of the episodes that end in the last part of a run (asymptotic performance, Taylor and Stone, 2009).

    Args:
        global_steps: Step at each episode's end, (episodes,), ascending.
        returns: Raw return of each episode, (episodes,).
        part: Share of the run's steps that counts as its end, in (0, 1].

    Returns:
        The mean, NaN without episodes.
    """
    steps = np.asarray(global_steps, dtype=float)
    if not steps.size:
        return float("nan")
    return _mean(np.asarray(returns, dtype=float)[steps > (1 - part) * steps[-1]])


def area_under_curve(global_steps: ArrayLike, returns: ArrayLike, until: float = np.inf) -> float:
    """Area under the learning curve over the steps it spans (total reward, Taylor and Stone, 2009).

    The curve is a staircase: an episode's return stands over the steps from the end of the one before to its own end.
    Divided by those steps the area is a mean return, so that runs of different lengths can be compared. Episodes whose
    return is NaN are left out, with their steps.

    Args:
        global_steps: Step at each episode's end, (episodes,), ascending.
        returns: Raw return of each episode, (episodes,).
        until: Step where the area ends; a run's last episode at the latest.

    Returns:
        Return per step of width one, NaN without episodes.
    """
    steps = np.minimum(np.asarray(global_steps, dtype=float), until)
    values = np.asarray(returns, dtype=float)
    widths = np.diff(steps, prepend=0.0)
    known = np.isfinite(values)
    total = widths[known].sum()
    return float((widths[known] * values[known]).sum() / total) if total > 0 else float("nan")


def transfer_ratio(student: float, baseline: float) -> float:
    """(area with transfer - area without) / area without (Taylor and Stone, 2009).

    Args:
        student: :func:`area_under_curve` with the transfer.
        baseline: The same without it; a ratio needs it above zero, otherwise NaN is returned.
    """
    return (student - baseline) / baseline if baseline > 0 else float("nan")


def rolling_mean(values: ArrayLike, window: int) -> NDArray[np.float64]:
    """Mean of each value and those before it, ``window`` in all (fewer at the start), (n,) -> (n,); NaN is left out."""
    series = pd.Series(np.asarray(values, dtype=float))
    return series.rolling(window, min_periods=1).mean().to_numpy(dtype=float)


def measure(data: RunSet, threshold: float, consecutive: int) -> pd.DataFrame:
    """Every metric of every run.

    Args:
        data: The runs.
        threshold: Return to reach.
        consecutive: Episodes that must reach it without a miss between them.

    Returns:
        The runs' frame with the columns ``steps_to_threshold``, ``steps_to_threshold_first`` (NaN if not reached),
        ``censored``, ``time`` (steps to threshold, or the horizon if censored), ``watched`` (step up to which the run
        was watched, or would have been had it not reached; NaN: not known), ``initial_return``,
        ``asymptotic_return``, ``area_under_curve``, ``final_length`` (steps), ``final_velocity`` (m/s), and ``bias``,
        empty (:func:`analysis.statistics.early_ends.settle` fills it).
    """
    rows: dict[str, dict[str, Any]] = {}
    starts = data.runs["acts_from"].to_dict()
    for name, episodes in data.episodes.groupby("run", observed=False, sort=False):
        start = float(starts[str(name)])
        rows[str(name)] = _measure_run(episodes, start, threshold, consecutive)
    measured = pd.DataFrame.from_dict(rows, orient="index", columns=_MEASURES)
    return judge(data.runs.join(measured))


def judge(runs: pd.DataFrame) -> pd.DataFrame:
    """Which runs are censored, and up to which step each was watched, by its steps to a threshold, whichever that is.

    Args:
        runs: The runs with ``steps_to_threshold`` (NaN: not reached) and the measures of a run's end.

    Returns:
        The frame with ``censored``, ``time``, ``watched`` and ``bias`` (see :func:`measure`), and without the measures
        of the end of runs that were cut short.
    """
    runs = runs.copy()
    runs["censored"] = runs["steps_to_threshold"].isna()
    runs["time"] = runs["steps_to_threshold"].fillna(runs["horizon"].astype(float))
    # Once it has reached the threshold a run needs no more watching: that it ends then, or has come no further yet,
    # makes nobody's horizon shorter.
    limit = runs["stop_after"].fillna(runs["total_timesteps"])
    whole = ~runs["cut"] & (runs["state"] != UNFINISHED)
    runs["watched"] = runs["horizon"].astype(float).where(whole | runs["censored"], limit)
    # Of what comes after a run was cut short nothing is known; and an area over fewer steps, those up to its success,
    # is no measure of the same thing.
    runs.loc[runs["cut"], list(END_MEASURES)] = float("nan")
    runs["bias"] = ""
    return runs


#: What only a run that took all its steps can tell.
END_MEASURES = ("asymptotic_return", "area_under_curve", "final_length", "final_velocity")
_MEASURES = ["steps_to_threshold", "steps_to_threshold_first", "initial_return", *END_MEASURES]


def _measure_run(episodes: pd.DataFrame, start: float, threshold: float, consecutive: int) -> dict[str, float]:
    steps, returns = episodes["global_step"].to_numpy(), episodes["episodic_return"].to_numpy()
    lengths = episodes["episode_length"].to_numpy()
    reached = steps_to_threshold(steps.tolist(), returns.tolist(), threshold, consecutive)
    return {
        "steps_to_threshold": float("nan") if reached is None else float(reached.last),
        "steps_to_threshold_first": float("nan") if reached is None else float(reached.first),
        "initial_return": initial_return(steps, lengths, returns, start),
        "asymptotic_return": asymptotic_return(steps, returns),
        "area_under_curve": area_under_curve(steps, returns),
        "final_length": asymptotic_return(steps, lengths),
        "final_velocity": asymptotic_return(steps, episodes[VELOCITY_COLUMN].to_numpy()),
    }


def _mean(values: NDArray[np.float64] | Sequence[float]) -> float:
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else float("nan")
