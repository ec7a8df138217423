"""Tables of runs and of groups: the paper's tables 1 and 2, steps to threshold, transfer metrics."""

from __future__ import annotations

import numpy as np
import pandas as pd

from acmr.cells import CELLS, REFERENCE, SOURCE, TARGET
from analysis.loading.load import RunSet
from analysis.statistics.comparisons import bias, common_horizon
from analysis.statistics.metrics import jumpstart, transfer_ratio
from analysis.statistics.survival import restricted_mean
from analysis.statistics.two_samples import mean_interval


def table1() -> pd.DataFrame:
    """Overview of the paper's configurations (paper, table 1)."""
    label = {(cell.transfer, cell.freeze): cell.configuration for cell in CELLS.values() if cell.published}
    rows = [("Yes" if freeze else "No", label["hidden", freeze], label["expand", freeze]) for freeze in (False, True)]
    return pd.DataFrame(rows, columns=["Freeze", "Hidden Layer Transfer", "Layer Expansion"])


def table2(data: RunSet) -> pd.DataFrame:
    """Overview of the experiments (paper, table 2), with the settings that they stand for and the runs that count."""
    names = dict(zip((SOURCE, TARGET), data.pair, strict=True))
    counted = data.runs[data.runs["counted"]].groupby("group").size()
    table = pd.DataFrame(
        {
            "Experiment": cell.name,
            "Environment": cell.role.capitalize(),
            "Configuration": cell.configuration,
            "environment_name": names[cell.role],
            "transfer": cell.transfer,
            "freeze": cell.freeze,
            "settings": ", ".join(f"{key}={value}" for key, value in cell.changes.items()),
            "runs": int(counted.get(cell.name, 0)),
        }
        for cell in data.cells
    )
    # The paper's cells need no column for it.
    return table if table["settings"].any() else table.drop(columns="settings")


def steps_table(runs: pd.DataFrame) -> pd.DataFrame:
    """One row a run: what it is, its state, its steps to threshold and the other metrics."""
    columns = [
        *("group", "cell", "seed", "state", "reason", "steps_to_threshold", "steps_to_threshold_first", "censored"),
        *("horizon", "episodes", "initial_return", "asymptotic_return", "area_under_curve", "final_length"),
        *("final_velocity", "wall_seconds", "steps_per_second"),
    ]
    return runs.reset_index(names="run")[["run", *columns]]


def cell_table(runs: pd.DataFrame, groups: list[str]) -> pd.DataFrame:
    """One row a group: steps to threshold over its counted runs.

    Args:
        runs: The runs with their metrics.
        groups: Groups in the order of the rows.

    Returns:
        ``group, runs, reached, mean, std, low, high`` (95% t-interval of the mean; mean and the rest only of the runs
        that reached the threshold, the interval only if all did), ``restricted_mean``, ``hours`` (mean wall-clock), and
        ``biased`` (its fast runs ended first and others have not: no interval and no restricted mean).
    """
    rows = []
    for group in groups:
        own = runs[(runs["group"] == group) & runs["counted"]]
        values = own["steps_to_threshold"].dropna().to_numpy(dtype=float)
        usable = len(own) and not bias(own)
        low, high = mean_interval(values) if usable and len(values) == len(own) else (np.nan, np.nan)
        reached = ~own["censored"].astype(bool)
        within = restricted_mean(own["time"], reached, common_horizon(own)) if usable else np.nan
        rows.append(
            {
                "group": group,
                "runs": len(own),
                "reached": len(values),
                "mean": values.mean() if len(values) else np.nan,
                "std": values.std(ddof=1) if len(values) > 1 else np.nan,
                "low": low,
                "high": high,
                "restricted_mean": within,
                "hours": own["wall_seconds"].mean() / 3600,
                "biased": bool(bias(own)),
            }
        )
    columns = ["group", "runs", "reached", "mean", "std", "low", "high", "restricted_mean", "hours", "biased"]
    return pd.DataFrame(rows, columns=columns)


def transfer_table(runs: pd.DataFrame, groups: list[str], reference: str = REFERENCE) -> pd.DataFrame:
    """The metrics of Taylor and Stone (2009) by group: means over its counted runs, and against its baseline.

    Runs that stopped at their threshold have an initial return only; ``full_runs`` counts the others. A biased group
    has no means.

    Args:
        runs: The runs with their metrics.
        groups: Groups in the order of the rows.
        reference: Baseline of the groups that are no cells, and of the cells whose baseline is A0.
    """
    columns = ["initial_return", "asymptotic_return", "area_under_curve"]
    used = runs[runs["counted"] & (runs["bias"] == "")]
    full = used[~used["cut"]].groupby("group").size()
    table = used.groupby("group")[columns].mean()
    values = zip(table.index, table.to_numpy(dtype=float).tolist(), strict=True)
    means = {str(group): dict(zip(columns, row, strict=True)) for group, row in values}
    nothing = dict.fromkeys(columns, float("nan"))
    rows = []
    for group in groups:
        name = _baseline(group, reference)
        own, base = means.get(group, nothing), means.get(name or "", nothing)
        rows.append(
            {
                "group": group,
                "baseline": name or "",
                "full_runs": int(full.get(group, 0)),
                **own,
                "jumpstart": jumpstart(own["initial_return"], base["initial_return"]),
                "asymptotic_gain": own["asymptotic_return"] - base["asymptotic_return"],
                "transfer_ratio": transfer_ratio(own["area_under_curve"], base["area_under_curve"]),
            }
        )
    return pd.DataFrame(rows)


def _baseline(group: str, reference: str) -> str | None:
    """What a group's returns are measured against, as far as it learns in the same environment."""
    against: str | None = reference
    if group in CELLS:
        own = CELLS.get(CELLS[group].baseline or "")
        # H0 is compared with A0 by its steps, but another robot's returns are of another scale.
        alike = own is not None and own.role == CELLS[group].role
        against = None if own is None or not alike else reference if own.name == REFERENCE else own.name
    return against if against != group else None


def scores(runs: pd.DataFrame) -> dict[str, np.ndarray]:
    """Asymptotic returns in rliable's shape: for each group an array (runs x tasks), here one task, seeds ascending.

    Runs that stopped at their threshold have none.
    """
    counted = runs[runs["counted"] & runs["asymptotic_return"].notna()]
    return {
        str(group): own.sort_values("seed")[["asymptotic_return"]].to_numpy(dtype=float)
        for group, own in counted.groupby("group", sort=False)
    }
