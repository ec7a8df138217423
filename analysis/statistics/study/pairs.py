"""Comparisons that know of the seeds: runs of one seed are a pair, or a block.

Runs of one seed share the seed of the environment, the random first actions and the streams that fresh weights are
drawn from, and students their teacher. Where that makes runs of one seed alike, differences within the seeds vary less
than those between runs of any seeds; where it does not, degrees of freedom are given away for nothing. A run with
``seeding=independent`` shares none of that and is no part of a pair.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from acmr.cells import CELLS
from analysis.statistics.comparisons import bias, common_horizon, stopped_before
from analysis.statistics.two_samples import ALPHA, MOST_PERMUTATIONS, holm, t_test

_NAN = float("nan")

#: The tests by pairs and their p-values adjusted within a family, as in table 3.
_ADJUSTED = {
    "p_paired": "p_paired_holm",
    "p_sign_flip": "p_sign_flip_holm",
    "p_restricted": "p_restricted_holm",
}
COLUMNS = [
    *("reference", "index", "pairs", "unpaired", "shared_episodes", "faster", "slower", "undecided", "correlation"),
    *("difference", "low", "high", "t_score", "p_paired", "p_paired_holm", "p_sign_flip", "p_sign_flip_holm"),
    *("p_value", "censored", "horizon", "restricted_difference", "p_restricted", "p_restricted_holm", "note"),
]
BLOCK_COLUMNS = [
    *("family", "cells", "seeds", "f_score", "df_cells", "df_rest", "p_value", "friedman", "p_friedman"),
    *("p_permutation", "share_of_seeds", "note"),
]


def paired_comparisons(runs: pd.DataFrame, episodes: pd.DataFrame, pairs: Iterable[tuple[str, str]]) -> pd.DataFrame:
    """Each comparison by the seeds that both groups have.

    Args:
        runs: The runs with their metrics, as they count.
        episodes: All episodes.
        pairs: (reference, index) of each comparison.

    Returns:
        ``COLUMNS``: ``pairs`` seeds of both groups and ``unpaired`` runs without a partner; ``shared_episodes``, the
        least number of first episodes that are equal within a pair; ``faster``, ``slower`` and ``undecided`` seeds by
        the index; ``correlation`` of the steps over the seeds (Pearson); the mean ``difference`` with its t-interval,
        the paired t-test and the exact test over all signs; ``p_value``, the unpaired t-test of the same runs. Where a
        run never reached, restricted means take the place of means.
    """
    table = pd.DataFrame([_compare(runs, episodes, *pair) for pair in pairs], columns=COLUMNS)
    families = pd.Series([CELLS[index].family if index in CELLS else "" for index in table["index"]], dtype=object)
    # A comparison of two cells of one family answers another question than theirs with the baseline.
    of_baseline = np.array([name not in CELLS or not CELLS[name].family for name in table["reference"]], dtype=bool)
    for family in set(families.dropna()):
        rows = (families == family) & of_baseline & (table["pairs"] > 0)
        for name, adjusted in _ADJUSTED.items():
            table[adjusted] = table[adjusted].astype(float)
            table.loc[rows, adjusted] = holm(table.loc[rows, name].astype(float))
    return table


def _compare(runs: pd.DataFrame, episodes: pd.DataFrame, reference: str, index: str) -> dict[str, Any]:
    first, second = (_by_seed(runs, group) for group in (reference, index))
    seeds = shared_seeds(first, second)
    row: dict[str, Any] = {"reference": reference, "index": index, "pairs": len(seeds), "note": ""}
    row["unpaired"] = len(first) + len(second) - 2 * len(seeds)
    if not seeds:
        apart = set(first.index) & set(second.index)
        return row | {"note": "runs of one seed are independent" if apart else "no seed of both"}
    a, b = first.loc[seeds], second.loc[seeds]
    names = zip(a["run"], b["run"], strict=True)
    row["shared_episodes"] = min(_shared(episodes, *pair) for pair in names)
    faster, slower = _ahead(b, a), _ahead(a, b)
    row |= {"faster": int(faster.sum()), "slower": int(slower.sum()), "undecided": int((~(faster | slower)).sum())}
    row["censored"] = int((a["censored"].to_numpy(bool) | b["censored"].to_numpy(bool)).sum())
    if said := bias(first) or bias(second):
        return row | {"note": said}
    if stopped_before(a).any() or stopped_before(b).any():
        return row | {"note": "some run stopped at its own threshold before it met this one: only the order is known"}
    return row | (_restricted(a, b) if row["censored"] else _differences(a, b))


def _by_seed(runs: pd.DataFrame, group: str) -> pd.DataFrame:
    own = runs[(runs["group"] == group) & runs["counted"]]
    return own.reset_index(names="run").set_index("seed")


def shared_seeds(*groups: pd.DataFrame) -> list[int]:
    """Seeds that all groups have, and whose random numbers all of those runs draw from.

    Args:
        groups: Runs, indexed by seed, with the column ``apart``.
    """
    return sorted(set.intersection(*(set(own.index[~own["apart"]]) for own in groups)))


def _shared(episodes: pd.DataFrame, first: str, second: str) -> int:
    """How many of their first episodes are equal, by step and return."""
    columns = ["global_step", "episodic_return"]
    a, b = (episodes.loc[episodes["run"] == name, columns].to_numpy(dtype=float) for name in (first, second))
    length = min(len(a), len(b))
    same = (a[:length] == b[:length]).all(axis=1)
    return int(length if same.all() else np.argmin(same))


def _ahead(one: pd.DataFrame, other: pd.DataFrame) -> NDArray[np.bool_]:
    """Where a run is known to have reached the threshold before its partner, (pairs,)."""
    reached = ~one["censored"].to_numpy(bool)
    mine, theirs = one["time"].to_numpy(float), other["time"].to_numpy(float)
    # A partner that was watched to this very step without reaching is behind, too.
    behind = (mine < theirs) | ((mine == theirs) & other["censored"].to_numpy(bool))
    return reached & behind


def _differences(a: pd.DataFrame, b: pd.DataFrame) -> dict[str, Any]:
    first, second = (frame["time"].to_numpy(float) for frame in (a, b))
    row: dict[str, Any] = {"difference": float((second - first).mean())}
    if len(first) < 2:
        return row | {"note": "one pair: no test"}
    spread = np.ptp(first) > 0 and np.ptp(second) > 0
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # equal differences: t is infinite or NaN, as it should be
        test = stats.ttest_rel(second, first)
        low, high = test.confidence_interval(1 - ALPHA)
    row |= {"low": float(low), "high": float(high), "t_score": float(test.statistic), "p_paired": float(test.pvalue)}
    row["correlation"] = float(stats.pearsonr(first, second).statistic) if spread and len(first) > 2 else _NAN
    return row | {"p_sign_flip": sign_flip_p(first, second), "p_value": t_test(first, second).p}


def _restricted(a: pd.DataFrame, b: pd.DataFrame) -> dict[str, Any]:
    horizon = common_horizon(pd.concat([a, b]))
    first, second = (np.minimum(frame["time"].to_numpy(float), horizon) for frame in (a, b))
    row = {"horizon": horizon, "restricted_difference": float((second - first).mean())}
    return row | {"p_restricted": sign_flip_p(first, second), "note": "some run never reached: restricted means"}


def sign_flip_p(reference: NDArray[np.float64], index: NDArray[np.float64]) -> float:
    """Two-sided exact test of paired differences: every sign of each difference is as likely as the other.

    Args:
        reference: One value a pair, (n,).
        index: Its partner, (n,).

    Returns:
        The p-value, not below 2 / 2^n; NaN for fewer than two pairs.
    """
    if len(reference) < 2:
        return _NAN
    result = stats.permutation_test(
        (index, reference),
        lambda x, y, axis: (x - y).mean(axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=MOST_PERMUTATIONS - 1,
        batch=20_000,
        rng=np.random.default_rng(0),
    )
    return float(result.pvalue)


def blocked(runs: pd.DataFrame) -> pd.DataFrame:
    """All cells of a family and their baseline at once, the seeds being blocks.

    Args:
        runs: The runs with their metrics, as they count.

    Returns:
        ``BLOCK_COLUMNS``, one row a family with three cells or more: F of the cells in the additive model
        steps = cell + seed, Friedman's statistic of the ranks within each seed with its exact p-value (over all orders
        within the seeds), and the share of all variation that lies between the seeds. Runs that never reached count
        with the common horizon, in the ranks only.
    """
    families = dict.fromkeys(cell.family for cell in CELLS.values() if cell.family)
    rows = [_blocks(runs, str(family)) for family in families]
    return pd.DataFrame([row for row in rows if row], columns=BLOCK_COLUMNS)


def _blocks(runs: pd.DataFrame, family: str) -> dict[str, Any] | None:
    members = [cell for cell in CELLS.values() if cell.family == family]
    names = list(dict.fromkeys([*(cell.baseline or "" for cell in members), *(cell.name for cell in members)]))
    there = {name: _by_seed(runs, name) for name in names}
    cells = [name for name, own in there.items() if len(own)]
    if len(cells) < 3:
        return None
    seeds = shared_seeds(*(there[name] for name in cells))
    row: dict[str, Any] = {"family": family, "cells": ", ".join(cells), "seeds": len(seeds), "note": ""}
    if said := next(filter(None, (bias(there[name]) for name in cells)), ""):
        return row | {"note": said}
    used = pd.concat([there[name].loc[seeds] for name in cells])
    if len(seeds) < 2 or stopped_before(used).any():
        why = (
            "fewer than two seeds pair all cells" if len(seeds) < 2 else "some run stopped before it met the threshold"
        )
        return row | {"note": why}
    horizon = common_horizon(used)
    times = np.column_stack([there[name].loc[seeds, "time"].to_numpy(float) for name in cells])
    if used["censored"].any():
        row |= {"note": "some run never reached: ranks only"} | _ranks(np.minimum(times, horizon))
        return row
    return row | _additive(times) | _ranks(times)


def _additive(times: NDArray[np.float64]) -> dict[str, float]:
    """F-test of the columns in the additive model with a constant for each row, (seeds, cells)."""
    n, k = times.shape
    by_cell, by_seed, middle = times.mean(axis=0), times.mean(axis=1), times.mean()
    cells, seeds = n * float(((by_cell - middle) ** 2).sum()), k * float(((by_seed - middle) ** 2).sum())
    total = float(((times - middle) ** 2).sum())
    rest = total - cells - seeds
    df = (k - 1, (k - 1) * (n - 1))
    score = (cells / df[0]) / (rest / df[1]) if rest > 0 else _NAN
    shares = {"share_of_seeds": seeds / total if total > 0 else _NAN}
    return {"f_score": score, "df_cells": df[0], "df_rest": df[1], "p_value": float(stats.f.sf(score, *df))} | shares


def _ranks(times: NDArray[np.float64]) -> dict[str, float]:
    ranks = stats.rankdata(times, axis=1)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # nothing but ties
        friedman = stats.friedmanchisquare(*times.T)

    def spread(*columns: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        # With fixed ranks in each block Friedman's statistic grows with this sum alone.
        return np.square(np.stack([column.sum(axis=axis) for column in columns])).sum(axis=0)

    exact = stats.permutation_test(
        tuple(ranks.T),
        spread,
        permutation_type="samples",
        alternative="greater",
        vectorized=True,
        n_resamples=MOST_PERMUTATIONS - 1,
        batch=20_000,
        rng=np.random.default_rng(0),
    )
    values = {"friedman": float(friedman.statistic), "p_friedman": float(friedman.pvalue)}
    return values | {"p_permutation": float(exact.pvalue)}
