"""Whether two cells are alike: two one-sided tests against a margin that was set beforehand (TOST).

A test that finds no difference is no proof that there is none. Here the null hypothesis is a difference of at least the
margin, in either direction; it is rejected if the 90% interval of the difference lies within it (Schuirmann, Journal of
Pharmacokinetics and Biopharmaceutics 15, 1987).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.comparisons import bias
from analysis.statistics.study.pairs import shared_seeds
from analysis.statistics.two_samples import ALPHA

_NAN = float("nan")

#: Differences up to this share of a full run count as none: 50,000 steps of a million.
MARGIN_SHARE = 0.05
COLUMNS = [
    *("reference", "index", "margin", "runs_reference", "runs_index", "difference", "low", "high", "p_tost"),
    *(
        "equivalent",
        "least_margin",
        "pairs",
        "paired_low",
        "paired_high",
        "p_tost_paired",
        "least_margin_paired",
        "note",
    ),
]


@dataclass(frozen=True)
class Tost:
    """Two one-sided tests.

    Attributes:
        p: The greater of their p-values; below 0.05 the difference is smaller than the margin.
        low: Lower end of the 90% interval of the difference, index - reference.
        high: Upper end.
    """

    p: float = _NAN
    low: float = _NAN
    high: float = _NAN

    @property
    def least_margin(self) -> float:
        """Margins beyond this one would have been met; for readers whose margin is another."""
        return max(abs(self.low), abs(self.high))


def tost(reference: ArrayLike, index: ArrayLike, margin: float, *, paired: bool = False) -> Tost:
    """Tests whether two means differ by less than a margin.

    Args:
        reference: Sample of the reference, (n,).
        index: Sample of the index, (m,); (n,) and in the same order if they are paired.
        margin: Greatest difference that counts as none, in the samples' unit.
        paired: By pairs; False: Welch's tests, for nothing says that the variances are equal.

    Returns:
        The tests; all NaN below two values a sample, or where neither sample has any spread.
    """
    first, second = np.asarray(reference, dtype=float), np.asarray(index, dtype=float)
    spread = np.ptp(second - first) > 0 if paired and first.size else np.ptp(np.append(first - first[:1], 0)) > 0
    spread = spread or (not paired and second.size > 1 and np.ptp(second) > 0)
    if min(first.size, second.size) < 2 or not spread:
        return Tost()
    test = stats.ttest_rel if paired else stats.ttest_ind
    kind: dict[str, Any] = {} if paired else {"equal_var": False}
    with warnings.catch_warnings():
        # Nearly equal values or differences: the statistic is huge, as it should be.
        warnings.simplefilter("ignore", RuntimeWarning)
        above = test(second + margin, first, alternative="greater", **kind)
        below = test(second - margin, first, alternative="less", **kind)
        low, high = test(second, first, **kind).confidence_interval(1 - 2 * ALPHA)
    return Tost(max(float(above.pvalue), float(below.pvalue)), float(low), float(high))


def margin_of(runs: pd.DataFrame) -> float:
    """The margin, in steps: a share of the longest run's planned length, or of its length where none is planned."""
    planned = runs["total_timesteps"].max()
    return MARGIN_SHARE * float(runs["horizon"].max() if pd.isna(planned) else planned)


def equivalence(runs: pd.DataFrame, pairs: Iterable[tuple[str, str]], margin: float) -> pd.DataFrame:
    """Each comparison as a question of likeness.

    Args:
        runs: The runs with their metrics, as they count.
        pairs: (reference, index) of each comparison.
        margin: Steps that count as no difference.

    Returns:
        ``COLUMNS``: the difference of the means with its 90% interval, the p-value of the two one-sided tests,
        whether it is below 5%, and the least margin with which it would be; the same by pairs of one seed.
    """
    table = pd.DataFrame([_compare(runs, margin, *pair) for pair in pairs], columns=COLUMNS)
    return table.astype({"equivalent": object})


def _compare(runs: pd.DataFrame, margin: float, reference: str, index: str) -> dict[str, Any]:
    first, second = (runs[(runs["group"] == group) & runs["counted"]].set_index("seed") for group in (reference, index))
    row: dict[str, Any] = {"reference": reference, "index": index, "margin": margin, "equivalent": "", "note": ""}
    row |= {"runs_reference": len(first), "runs_index": len(second)}
    seeds = shared_seeds(first, second)
    row["pairs"] = len(seeds)
    if said := bias(first) or bias(second):
        return row | {"note": said}
    if first["censored"].any() or second["censored"].any():
        return row | {"note": "some run never reached the threshold: no means, and no likeness of them"}
    a, b = first["time"].to_numpy(float), second["time"].to_numpy(float)
    test = tost(a, b, margin)
    own = tost(first.loc[seeds, "time"].to_numpy(float), second.loc[seeds, "time"].to_numpy(float), margin, paired=True)
    row |= {"difference": float(b.mean() - a.mean()), "low": test.low, "high": test.high, "p_tost": test.p}
    row |= {"least_margin": test.least_margin, "paired_low": own.low, "paired_high": own.high}
    row |= {"p_tost_paired": own.p, "least_margin_paired": own.least_margin}
    if math.isfinite(test.p):
        return row | {"equivalent": "yes" if test.p < ALPHA else "not shown"}
    return row | {"note": "fewer than two runs a cell, or no spread"}
