"""All parts of the study in one."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from analysis.loading.load import RunSet
from analysis.statistics.comparisons import study_pairs
from analysis.statistics.study.aggregates import aggregates, improvements
from analysis.statistics.study.cost import costs
from analysis.statistics.study.equivalence import equivalence, margin_of
from analysis.statistics.study.pairs import blocked, paired_comparisons
from analysis.statistics.study.sensitivity import grid, overview, sensitivity


@dataclass(frozen=True)
class Study:
    """What stands beyond table 3.

    Attributes:
        points: Each comparison at each threshold and criterion (:mod:`analysis.statistics.study.sensitivity`).
        sensitivity: The same to be read, a column for each threshold.
        overview: How far each comparison hangs on them.
        paired: Each comparison by seeds.
        blocks: The cells of a family at once, the seeds being blocks.
        equivalence: Each comparison as a question of likeness.
        aggregates: Interquartile means of each group.
        improvement: Chances that a run of the index is better than one of the reference.
        cost: Steps with the teacher's, and without.
    """

    points: pd.DataFrame
    sensitivity: pd.DataFrame
    overview: pd.DataFrame
    paired: pd.DataFrame
    blocks: pd.DataFrame
    equivalence: pd.DataFrame
    aggregates: pd.DataFrame
    improvement: pd.DataFrame
    cost: pd.DataFrame


def study(
    data: RunSet, measured: pd.DataFrame, threshold: float, consecutive: int, reference: str, margin: float | None
) -> Study:
    """The study of a set of runs.

    Args:
        data: The runs.
        measured: The runs with their metrics, as they count.
        threshold: Return to reach.
        consecutive: Episodes in a row.
        reference: Group in A0's place.
        margin: Steps that count as no difference; None: a share of a full run.
    """
    pairs = study_pairs(measured, reference)
    points = sensitivity(data, pairs, threshold, consecutive)
    return Study(
        points=points,
        sensitivity=grid(points),
        overview=overview(points),
        paired=paired_comparisons(measured, data.episodes, pairs),
        blocks=blocked(measured),
        equivalence=equivalence(measured, pairs, margin_of(measured) if margin is None else margin),
        aggregates=aggregates(measured, data.groups),
        improvement=improvements(measured, pairs),
        cost=costs(data.root, measured, data.groups, reference),
    )
