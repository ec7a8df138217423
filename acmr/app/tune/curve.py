"""What the learning curve of a run says before its end: one number at each tenth of its length."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from acmr.config import STEPS, ExperimentConfig
from acmr.records import steps_to_threshold
from acmr.run.summary import FINAL_EPISODES
from analysis.statistics.metrics import area_under_curve

#: Parts of a run after which it is looked at, and after how many of them it may be cut short.
TENTHS, _FIRST_JUDGED = 10, 3


def step_of(tenth: int, config: ExperimentConfig) -> int:
    """The environment step at which a tenth of a run is over; the first is tenth 1."""
    return config.most_steps * tenth // TENTHS


def first_judged(config: ExperimentConfig) -> int:
    """The first tenth after which a run may be cut short: before, it has acted at random for the most part."""
    return max(_FIRST_JUDGED, math.ceil(TENTHS * config.agent.learning_starts / config.most_steps) + 1)


def heights(episodes: pd.DataFrame, config: ExperimentConfig, metric: str, ended: bool) -> dict[int, float]:
    """What a run is worth at each tenth that it has passed, as far as it can be told, to compare it with others there.

    It follows from the episodes up to there alone, so that it is the same whenever it is asked for. For
    ``steps_to_threshold`` it is that once it is known; before, more than any run can take, and the more, the further
    the latest returns are from the threshold: of two runs that have not met it yet the nearer one is the better.

    Args:
        episodes: ``episodes.csv`` as far as it is written.
        config: The run.
        metric: What the search is after.
        ended: Whether no more episodes will come.
    """
    steps, returns = episodes["global_step"].to_numpy(), episodes["episodic_return"].to_numpy()
    # Until an episode has ended at the step or after it, one that ended before may still be on its way to the file.
    last = steps[-1] if len(steps) else 0
    found = {}
    for tenth in range(1, TENTHS + 1):
        step = step_of(tenth, config)
        if not (ended or (tenth < TENTHS and last >= step)):
            break
        count = int(np.searchsorted(steps, step, side="right"))
        value = _height(steps[:count], returns[:count], config, metric) if count else math.nan
        if math.isfinite(value):
            found[tenth] = value
    if ended and metric == STEPS:
        # Nothing was seen of it, or it diverged: worse than whatever was seen of another.
        found.setdefault(TENTHS, 2.0 * config.most_steps)
    return found


def _height(steps: NDArray[np.int64], returns: NDArray[np.float64], config: ExperimentConfig, metric: str) -> float:
    if metric == "area":
        return area_under_curve(steps, returns)
    latest = float(np.mean(returns[-FINAL_EPISODES:]))
    if metric != STEPS:
        # An evaluation is made at the end only; what comes nearest is the return in training.
        return latest
    reached = steps_to_threshold(steps.tolist(), returns.tolist(), config.threshold, config.consecutive)
    if reached is not None:
        return float(reached.last)
    lacking = max(0.0, config.threshold - latest)
    return config.most_steps * (1 + lacking / ((abs(config.threshold) or 1.0) + lacking))
