"""Two groups of runs -> one row of table 3.

Only runs that have come to their end enter (``counted``): of the unfinished ones, the fast ones would be known first,
and a cell would look faster than it is. A group of which that may still be so (``bias``) is described and not tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from acmr.cells import CELLS, REFERENCE, TARGET, planned_cells
from acmr.records import COMPLETE
from analysis.loading.load import InputError
from analysis.statistics.survival import log_rank, restricted_interval, restricted_mean
from analysis.statistics.two_samples import (
    detectable_effect,
    hedges_g,
    holm,
    permutation_p,
    power,
    t_test,
)

#: Family of the groups that are no cells.
_OTHERS = ""
#: A large effect (Cohen, 1988), for the power.
LARGE_EFFECT = 0.8

#: Orders of cells that the paper claims and does not test, (reference, index): A2 is to be the best, just before A3.
UNTESTED = (("A2", "A3"),)

#: Each kind of test, with and without censored runs, and its p-values adjusted within a family.
_ADJUSTED = {
    "p_value": "p_holm",
    "p_permutation": "p_permutation_holm",
    "p_restricted": "p_restricted_holm",
    "p_log_rank": "p_log_rank_holm",
}

PAPER_COLUMNS = [
    *("reference", "index", "n_reference", "n_index", "mean_reference", "std_reference"),
    *("mean_index", "std_index", "t_score", "p_value"),
]
COLUMNS = [
    *PAPER_COLUMNS,
    *("df", "difference", "difference_low", "difference_high", "p_holm"),
    *("welch_t", "welch_df", "welch_p", "p_permutation", "p_permutation_holm"),
    *("hedges_g", "hedges_g_low", "hedges_g_high", "power_large_effect", "detectable_effect"),
    *("runs_reference", "runs_index", "censored_reference", "censored_index", "horizon"),
    *("restricted_mean_reference", "restricted_mean_index", "restricted_difference"),
    *("restricted_difference_low", "restricted_difference_high", "p_restricted", "p_restricted_holm"),
    *("log_rank_z", "p_log_rank_asymptotic", "p_log_rank", "p_log_rank_holm"),
    *("biased_reference", "biased_index", "note"),
]


def compare_cells(runs: pd.DataFrame, reference: str = REFERENCE, planned: int = 3) -> pd.DataFrame:
    """Table 3: each cell against its baseline.

    Args:
        runs: The runs with their metrics (:func:`analysis.statistics.metrics.measure`).
        reference: Group that stands in A0's place.
        planned: Seeds that a group is planned to have, for the notes.

    Returns:
        One row a cell with ``COLUMNS``, in the paper's order: the target's cells first. With another reference, A0 is
        one of the others.
    """
    return _compare(runs, cell_pairs(runs, reference), planned)


def cell_pairs(runs: pd.DataFrame, reference: str = REFERENCE) -> list[tuple[str, str]]:
    """What table 3 compares, (reference, index), in the paper's order: the target's cells first."""
    pairs = []
    for cell in sorted(planned_cells(runs["group"]), key=lambda cell: cell.role != TARGET):
        baseline = reference if REFERENCE in (cell.name, cell.baseline) else cell.baseline
        if baseline is not None and baseline != cell.name:
            pairs.append((baseline, cell.name))
    return pairs


def study_pairs(runs: pd.DataFrame, reference: str = REFERENCE, most_others: int = 8) -> list[tuple[str, str]]:
    """What the study beyond table 3 compares: its pairs, the paper's untested claims, other groups; with runs only.

    Args:
        runs: The runs with their metrics.
        reference: Group that stands in A0's place.
        most_others: Groups that are no cells, at most.
    """
    others = sorted(set(runs.loc[runs["cell"].isna(), "group"]) - {reference})[:most_others]
    pairs = [*cell_pairs(runs, reference), *UNTESTED, *((reference, other) for other in others)]
    there = set(runs.loc[runs["counted"], "group"])
    return [pair for pair in pairs if there.issuperset(pair)]


def compare_groups(runs: pd.DataFrame, reference: str = REFERENCE, planned: int = 3) -> pd.DataFrame:
    """The groups that are no cells (sweeps, foreign runs), each against the reference; columns as in table 3."""
    others = sorted(set(runs.loc[runs["cell"].isna(), "group"]) - {reference})
    return _compare(runs, [(reference, other) for other in others], planned)


def check_reference(reference: str, groups: list[str]) -> None:
    """Refuses a reference that is neither a cell nor a group that there is.

    Raises:
        InputError: With the groups that there are.
    """
    if reference not in (*CELLS, *groups):
        names = [*CELLS, *(group for group in groups if group not in CELLS)]
        raise InputError(f"--reference {reference}: must be one of {', '.join(names)}")


def compare(runs: pd.DataFrame, reference: str, index: str, planned: int = 3) -> dict[str, Any]:
    """One row: the paper's test, what should stand beside it, and the comparison that keeps censored runs.

    A mean of steps to threshold exists only where every run reached it. Where some did not, the means are of those that
    did, and no t-test is made: dropping the slowest runs would flatter the cell. The restricted means and the log-rank
    test then carry the comparison.
    """
    first, second = _counted(runs, reference), _counted(runs, index)
    a, b = _reached(first), _reached(second)
    row: dict[str, Any] = {"reference": reference, "index": index, **_describe(a, "reference"), **_describe(b, "index")}
    row |= {"biased_reference": bool(bias(first)), "biased_index": bool(bias(second))}
    testable = not (bias(first) or bias(second))
    if testable and not (first["censored"].any() or second["censored"].any()):
        row |= _tests(a, b)
    row |= {
        "power_large_effect": power(LARGE_EFFECT, len(first), len(second)),
        "detectable_effect": detectable_effect(len(first), len(second)),
    }
    for frame, role in ((first, "reference"), (second, "index")):
        row |= {f"runs_{role}": len(frame), f"censored_{role}": int(frame["censored"].sum())}
    if testable:
        row |= _censored(first, second)
    doubts = _doubts(first, second) if testable else []
    row["note"] = "; ".join(_notes(reference, first, planned) + _notes(index, second, planned) + doubts)
    return row


def _compare(runs: pd.DataFrame, pairs: list[tuple[str, str]], planned: int) -> pd.DataFrame:
    table = pd.DataFrame([compare(runs, a, b, planned) for a, b in pairs], columns=COLUMNS)
    text = {"reference", "index", "note"}
    whole = {f"{what}_{role}" for what in ("n", "runs", "censored") for role in ("reference", "index")}
    kinds = {column: "int64" if column in whole else "float64" for column in COLUMNS if column not in text}
    kinds |= dict.fromkeys(("biased_reference", "biased_index"), "bool")
    table = table.astype(kinds)
    asked = (table["runs_reference"] > 0) & (table["runs_index"] > 0)
    families = pd.Series([CELLS[index].family if index in CELLS else _OTHERS for index in table["index"]], dtype=object)
    for family in set(families.dropna()):
        rows = asked & (families == family)
        for name, adjusted in _ADJUSTED.items():
            table.loc[rows, adjusted] = holm(table.loc[rows, name])
    return table


def _counted(runs: pd.DataFrame, group: str) -> pd.DataFrame:
    return runs[(runs["group"] == group) & runs["counted"]]


def _reached(runs: pd.DataFrame) -> NDArray[np.float64]:
    return runs.loc[~runs["censored"], "steps_to_threshold"].to_numpy(dtype=float)


def _describe(sample: NDArray[np.float64], role: str) -> dict[str, float]:
    return {
        f"n_{role}": sample.size,
        f"mean_{role}": float(sample.mean()) if sample.size else float("nan"),
        f"std_{role}": float(sample.std(ddof=1)) if sample.size > 1 else float("nan"),
    }


def _tests(reference: NDArray[np.float64], index: NDArray[np.float64]) -> dict[str, float]:
    student, welch = t_test(reference, index), t_test(reference, index, pooled=False)
    effect = hedges_g(reference, index)
    both = reference.size and index.size
    return {
        "t_score": student.t,
        "p_value": student.p,
        "df": student.df,
        "difference": float(index.mean() - reference.mean()) if both else float("nan"),
        "difference_low": student.low,
        "difference_high": student.high,
        "welch_t": welch.t,
        "welch_df": welch.df,
        "welch_p": welch.p,
        "p_permutation": permutation_p(reference, index),
        "hedges_g": effect.g,
        "hedges_g_low": effect.low,
        "hedges_g_high": effect.high,
    }


def _censored(first: pd.DataFrame, second: pd.DataFrame) -> dict[str, float]:
    if not (len(first) and len(second)):
        return {}
    horizon = common_horizon(pd.concat([first, second]))
    times = [frame["time"].to_numpy(dtype=float) for frame in (first, second)]
    reached = [~frame["censored"].to_numpy(dtype=bool) for frame in (first, second)]
    means = [restricted_mean(*sample, horizon) for sample in zip(times, reached, strict=True)]
    low, high = restricted_interval(times[0], times[1], horizon)
    test = log_rank(times[0], reached[0], times[1], reached[1])
    return {
        "horizon": horizon,
        "restricted_mean_reference": means[0],
        "restricted_mean_index": means[1],
        "restricted_difference": means[1] - means[0],
        "restricted_difference_low": low,
        "restricted_difference_high": high,
        "p_restricted": permutation_p(*(np.minimum(sample, horizon) for sample in times)),
        "log_rank_z": test.z,
        "p_log_rank_asymptotic": test.p_asymptotic,
        "p_log_rank": test.p,
    }


def bias(runs: pd.DataFrame) -> str:
    """Why these runs of one group cannot be tested yet, and what to type; empty if they can."""
    return next(iter(runs["bias"]), "")


def stopped_before(runs: pd.DataFrame) -> pd.Series:
    """Which runs stopped at a threshold of their own before they met the one that is asked for, (n,) of bool.

    When they would have met it is not known, and that they were not watched any longer has to do with their speed.
    """
    limit = runs["stop_after"].fillna(runs["total_timesteps"])
    return runs["cut"] & runs["censored"] & (runs["state"] == COMPLETE) & (runs["horizon"] < limit)


def common_horizon(runs: pd.DataFrame) -> float:
    """Steps up to which all of these runs were watched, or would have been if they had not reached; n >= 1."""
    watched = runs["watched"].min()
    return float(runs["time"].max() if pd.isna(watched) else watched)


def _notes(name: str, runs: pd.DataFrame, planned: int) -> list[str]:
    notes, n, missed = [], len(runs), int(runs["censored"].sum())
    if n == 0:
        return [f"{name}: no complete run"]
    if bias(runs):
        return [bias(runs)]
    if early := int(stopped_before(runs).sum()):
        notes.append(
            f"{name}: {early} of {n} runs stopped at a threshold of their own before they met this one, and are "
            "censored there, the fast ones soonest: tests take censoring for independent of speed"
        )
    if n < planned:
        notes.append(f"{name}: {n} of {planned} runs")
    if missed == n:
        notes.append(f"{name}: no run reached the threshold, so there is no mean and no t-test")
    elif missed:
        notes.append(f"{name}: {missed} of {n} runs never reached the threshold: mean of the others, no t-test")
    elif n == 1:
        notes.append(f"{name}: n = 1, no t-test")
    return notes


def _doubts(first: pd.DataFrame, second: pd.DataFrame) -> list[str]:
    notes = []
    both = pd.concat([first, second])
    if both["watched"].nunique() > 1:
        notes.append("runs of unequal length: the log-rank p-value is approximate")
    spread = [_reached(frame) for frame in (first, second)]
    if min(map(len, spread)) > 1 and not both["censored"].any() and all(np.ptp(sample) == 0 for sample in spread):
        notes.append("no spread within the cells: t is not defined")
    return notes
