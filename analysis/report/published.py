"""The paper's own table 3, and how far ours agrees with it."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from importlib import resources
from typing import Any

import pandas as pd

from analysis.statistics.study.replication import predicted_effect, published_effect, verdict


def published_table3() -> pd.DataFrame:
    """The published rows: ``reference, index, t_score, p_value, source`` (NaN as printed)."""
    file = resources.files("analysis.report") / "data" / "published_table3.csv"
    with file.open(encoding="utf-8") as text:
        return pd.read_csv(text)


_COLUMNS = [
    *("reference", "index", "t_published", "t_ours", "p_published", "p_ours", "sign"),
    *("g_published", "g_published_low", "g_published_high", "g_predicted_low", "g_predicted_high"),
    *("g_ours", "g_ours_low", "g_ours_high", "replicates", "remark"),
]


def side_by_side(table3: pd.DataFrame) -> pd.DataFrame:
    """Sets our table 3 next to the published one, as effects and not by which of them are significant.

    Args:
        table3: Ours (:func:`analysis.statistics.comparisons.compare_cells`).

    Returns:
        One row for each published one: both t and p; ``sign`` (``agrees``, ``differs`` or ``-`` where one of them has
        none); the published effect with its interval, where ours has to be expected by it, and ours; ``replicates``
        (``inside`` or ``outside`` of what had to be expected); and a ``remark``.
    """
    ours = {(row["reference"], row["index"]): row for row in table3.to_dict("records")}
    rows = []
    for printed in published_table3().to_dict("records"):
        key = (printed["reference"], printed["index"])
        if key not in ours:
            continue
        row, t = ours[key], float(printed["t_score"])
        sign, remark = _agreement(t, row)
        tests = {
            "t_published": t,
            "t_ours": row["t_score"],
            "p_published": printed["p_value"],
            "p_ours": row["p_value"],
        }
        names = {"reference": key[0], "index": key[1]}
        rows.append(names | tests | {"sign": sign} | _effects(t, row) | {"remark": remark})
    return pd.DataFrame(rows, columns=_COLUMNS)


def _effects(t: float, ours: Mapping[Hashable, Any]) -> dict[str, Any]:
    published, predicted = published_effect(t), predicted_effect(t, int(ours["n_reference"]), int(ours["n_index"]))
    g = ours["hedges_g"]
    return {
        "g_published": published.g,
        "g_published_low": published.low,
        "g_published_high": published.high,
        # Means of the runs that reached alone are not what was predicted.
        "g_predicted_low": predicted.low if math.isfinite(g) else math.nan,
        "g_predicted_high": predicted.high if math.isfinite(g) else math.nan,
        "g_ours": g,
        "g_ours_low": ours["hedges_g_low"],
        "g_ours_high": ours["hedges_g_high"],
        "replicates": verdict(g, predicted),
    }


def _agreement(t: float, ours: Mapping[Hashable, Any]) -> tuple[str, str]:
    if min(ours["runs_reference"], ours["runs_index"]) == 0:
        return "-", "not run yet"
    if ours["biased_reference"] or ours["biased_index"]:
        return "-", "biased: only its fast runs have ended"
    if pd.isna(t):
        reached, runs = ours["n_index"], ours["runs_index"]
        if not reached:
            return "agrees", f"{ours['index']} never reaches the threshold, in either"
        # Never to reach is to be slower than all that do; what ours lost within its horizon tells the same of us.
        sign = "agrees" if ours["restricted_difference"] > 0 else "differs"
        return sign, f"{ours['index']} never reached the threshold in the paper; here {reached} of {runs} runs did"
    if pd.isna(ours["t_score"]):
        return "-", _without_test(ours)
    return "agrees" if (t < 0) == (ours["t_score"] < 0) else "differs", ""


def _without_test(ours: Mapping[Hashable, Any]) -> str:
    if not (ours["censored_reference"] or ours["censored_index"]):
        return "no t-test with fewer than two runs a cell"
    steps = ours["restricted_difference"]
    return (
        f"no t-test, for not every run reached the threshold; within {ours['horizon']:,.0f} steps the index is "
        f"{abs(steps):,.0f} steps {'faster' if steps < 0 else 'slower'} (log-rank p = {ours['p_log_rank']:.3f})"
    )
