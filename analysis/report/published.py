"""The paper's own table 3, and how far ours agrees with it."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from importlib import resources
from typing import Any

import pandas as pd

from analysis.statistics.two_samples import ALPHA


def published_table3() -> pd.DataFrame:
    """The published rows: ``reference, index, t_score, p_value, source`` (NaN as printed)."""
    file = resources.files("analysis.report") / "data" / "published_table3.csv"
    with file.open(encoding="utf-8") as text:
        return pd.read_csv(text)


def side_by_side(table3: pd.DataFrame) -> pd.DataFrame:
    """Sets our table 3 next to the published one.

    Args:
        table3: Ours (:func:`analysis.statistics.comparisons.compare_cells`).

    Returns:
        One row for each published one: both t and p, ``sign`` and ``significance`` (``agrees``, ``differs`` or ``-``
        where one of them has none), and a ``remark``.
    """
    ours = {(row["reference"], row["index"]): row for row in table3.to_dict("records")}
    rows = []
    for printed in published_table3().to_dict("records"):
        key = (printed["reference"], printed["index"])
        if key not in ours:
            continue
        row = ours[key]
        sign, significance, remark = _agreement(printed["t_score"], printed["p_value"], row)
        rows.append(
            {
                "reference": key[0],
                "index": key[1],
                "t_published": printed["t_score"],
                "t_ours": row["t_score"],
                "p_published": printed["p_value"],
                "p_ours": row["p_value"],
                "sign": sign,
                "significance": significance,
                "remark": remark,
            }
        )
    columns = ["reference", "index", "t_published", "t_ours", "p_published", "p_ours", "sign", "significance", "remark"]
    return pd.DataFrame(rows, columns=columns)


def _agreement(t: float, p: float, ours: Mapping[Hashable, Any]) -> tuple[str, str, str]:
    if min(ours["runs_reference"], ours["runs_index"]) == 0:
        return "-", "-", "not run yet"
    if ours["biased_reference"] or ours["biased_index"]:
        return "-", "-", "biased: only its fast runs have ended"
    if pd.isna(t):
        reached, runs = ours["n_index"], ours["runs_index"]
        if not reached:
            return "agrees", "agrees", f"{ours['index']} never reaches the threshold, in either"
        # Never to reach is to be slower than all that do; what ours lost within its horizon tells the same of us.
        sign = "agrees" if ours["restricted_difference"] > 0 else "differs"
        return sign, "-", f"{ours['index']} never reached the threshold in the paper; here {reached} of {runs} runs did"
    if pd.isna(ours["t_score"]):
        return "-", "-", _without_test(ours)
    verdicts = ["agrees" if same else "differs" for same in ((t < 0) == (ours["t_score"] < 0), _same_level(p, ours))]
    return verdicts[0], verdicts[1], ""


def _same_level(p: float, ours: Mapping[Hashable, Any]) -> bool:
    return bool((p < ALPHA) == (ours["p_value"] < ALPHA))


def _without_test(ours: Mapping[Hashable, Any]) -> str:
    if not (ours["censored_reference"] or ours["censored_index"]):
        return "no t-test with fewer than two runs a cell"
    steps = ours["restricted_difference"]
    return (
        f"no t-test, for not every run reached the threshold; within {ours['horizon']:,.0f} steps the index is "
        f"{abs(steps):,.0f} steps {'faster' if steps < 0 else 'slower'} (log-rank p = {ours['p_log_rank']:.3f})"
    )
