"""All parts of the study in one."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from analysis.loading.load import RunSet
from analysis.statistics.comparisons import study_pairs
from analysis.statistics.study.sensitivity import grid, overview, sensitivity


@dataclass(frozen=True)
class Study:
    """What stands beyond table 3.

    Attributes:
        points: Each comparison at each threshold and criterion (:mod:`analysis.statistics.study.sensitivity`).
        sensitivity: The same to be read, a column for each threshold.
        overview: How far each comparison hangs on them.
    """

    points: pd.DataFrame
    sensitivity: pd.DataFrame
    overview: pd.DataFrame


def study(data: RunSet, measured: pd.DataFrame, threshold: float, consecutive: int, reference: str) -> Study:
    """The study of a set of runs.

    Args:
        data: The runs.
        measured: The runs with their metrics, as they count.
        threshold: Return to reach.
        consecutive: Episodes in a row.
        reference: Group in A0's place.
    """
    pairs = study_pairs(measured, reference)
    points = sensitivity(data, pairs, threshold, consecutive)
    return Study(points=points, sensitivity=grid(points), overview=overview(points))
