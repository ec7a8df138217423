"""Comparisons of steps to threshold for other thresholds, counts and smoothed returns than the paper's.

One threshold and one count are two numbers that somebody chose; a difference that turns its sign with them says little
about the cells. Of a run that stopped at its threshold nothing is known about criteria that it had not met by then, and
the fast runs stop first: a group with such runs has no difference at such a criterion. Beside all runs stand the full
ones alone, of which everything is known, and which nobody chose by their speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.loading.load import RunSet
from analysis.loading.missing import planned_seeds, profile_of
from analysis.statistics.comparisons import bias, common_horizon, stopped_before
from analysis.statistics.early_ends import settle
from analysis.statistics.metrics import END_MEASURES, judge
from analysis.statistics.survival import restricted_interval, restricted_mean
from analysis.statistics.two_samples import t_test

#: Which runs a row is of: all that count, or those that took all their steps.
ALL, FULL = "all", "full"
#: What a difference is of: means of steps to threshold, or, where some run never reached it, restricted means.
MEANS, RESTRICTED = "means", "restricted"

COLUMNS = [
    *("reference", "index", "basis", "criterion", "threshold", "runs_reference", "runs_index"),
    *("unknown_reference", "unknown_index", "reached_reference", "reached_index", "measure", "difference"),
    *("low", "high", "p_value", "horizon", "own"),
]


@dataclass(frozen=True)
class Criterion:
    """When a run has reached a threshold.

    Attributes:
        episodes: Episodes that are looked at.
        smoothed: Whether their mean has to meet the threshold; False: each of them.
    """

    episodes: int
    smoothed: bool = False

    def __str__(self) -> str:
        return f"mean of {self.episodes}" if self.smoothed else f"{self.episodes} in a row"


#: The counts, and the smoothed returns; 50 episodes are the paper's rolling average.
CRITERIA = (*map(Criterion, (1, 3, 5, 10)), *(Criterion(episodes, smoothed=True) for episodes in (5, 10, 50)))
#: What has to be known of a run to judge it.
_JUDGED = (
    *("group", "cell", "seed", "state", "reason", "counted", "cut", "apart"),
    *("horizon", "stop_after", "total_timesteps"),
)
#: Steps of the thresholds' grid below and above the one that is asked for: 4500 to 5200 for 4900.
_BELOW, _ABOVE, _WIDTH = 4, 3, 0.02


def thresholds(own: float) -> list[float]:
    """The thresholds that are compared: the one that is asked for, and others around it, about 2% apart."""
    width = abs(own) * _WIDTH or 1.0
    unit = 10.0 ** (math.floor(math.log10(width)))
    width = round(width / unit) * unit
    return [own + place * width for place in range(-_BELOW, _ABOVE + 1)]


def criteria(consecutive: int) -> list[Criterion]:
    """The criteria that are compared, among them the count that is asked for."""
    return sorted({*CRITERIA, Criterion(consecutive)}, key=lambda one: (one.smoothed, one.episodes))


def crossings(
    steps: NDArray[np.int64], returns: NDArray[np.float64], limits: Sequence[float], looked: Sequence[Criterion]
) -> NDArray[np.float64]:
    """Step at which a run first meets each criterion at each threshold.

    Args:
        steps: Step at each episode's end, (episodes,), ascending.
        returns: Raw return of each episode, (episodes,); NaN meets nothing.
        limits: Thresholds, (t,).
        looked: Criteria, (c,).

    Returns:
        (c, t), NaN where it never happened.
    """
    found = np.full((len(looked), len(limits)), np.nan)
    series = pd.Series(returns)
    places = np.arange(len(returns))
    for column, limit in enumerate(limits):
        missed = np.maximum.accumulate(np.where(returns >= limit, -1, places), dtype=np.int64)
        for row, criterion in enumerate(looked):
            if criterion.smoothed:
                met = series.rolling(criterion.episodes).mean().to_numpy() >= limit
            else:
                met = places - missed >= criterion.episodes
            if met.any():
                found[row, column] = steps[int(np.argmax(met))]
    return found


def sensitivity(data: RunSet, pairs: Iterable[tuple[str, str]], threshold: float, consecutive: int) -> pd.DataFrame:
    """Each comparison at every threshold and criterion.

    Args:
        data: The runs.
        pairs: (reference, index) of each comparison.
        threshold: The one that is asked for (``own`` marks it, with ``consecutive``).
        consecutive: The count that is asked for.

    Returns:
        ``COLUMNS``: one row a comparison, basis (``ALL``; ``FULL`` only where some of the runs were cut short),
        criterion and threshold. ``unknown_*`` counts runs that stopped before they met the criterion: then there is no
        ``difference``. It is index - reference in steps, of what ``measure`` says, with its 95% interval; ``p_value``
        is the t-test's, of one setting among many.
    """
    pairs, limits, looked = list(pairs), thresholds(threshold), criteria(consecutive)
    runs = data.runs.loc[data.runs["group"].isin({group for pair in pairs for group in pair}), list(_JUDGED)]
    runs = runs.assign(**dict.fromkeys(END_MEASURES, np.nan))
    found = _all_crossings(data, runs, limits, looked)
    seeds, profile = planned_seeds(data.runs), profile_of(data)
    rows = []
    for at, criterion in enumerate(looked):
        for place, limit in enumerate(limits):
            judged = settle(judge(runs.assign(steps_to_threshold=found[:, at, place])), seeds, profile)
            own = criterion == Criterion(consecutive) and limit == threshold
            setting = {"criterion": str(criterion), "threshold": limit, "own": own}
            groups = _counted(judged)
            rows += [row | setting for pair in pairs for row in _rows(groups, *pair)]
    table = pd.DataFrame(rows, columns=COLUMNS)
    order = {pair: place for place, pair in enumerate(pairs)}
    places = [order[pair] for pair in zip(table["reference"], table["index"], strict=True)]
    # The criteria and thresholds stay in their order.
    return table.assign(place=places).sort_values(["place", "basis"], kind="stable", ignore_index=True)[COLUMNS]


def _all_crossings(
    data: RunSet, runs: pd.DataFrame, limits: Sequence[float], looked: Sequence[Criterion]
) -> NDArray[np.float64]:
    """(runs, criteria, thresholds)."""
    found = np.full((len(runs), len(looked), len(limits)), np.nan)
    place = {name: at for at, name in enumerate(runs.index)}
    for name, own in data.episodes.groupby("run", observed=True, sort=False):
        if name in place:
            steps, returns = own["global_step"].to_numpy(), own["episodic_return"].to_numpy(dtype=float)
            found[place[name]] = crossings(steps, returns, limits, looked)
    return found


def _counted(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The runs that count by their group; ``unknown``: stopped before they met the criterion."""
    columns = ["group", "cut", "censored", "time", "watched", "bias"]
    used = runs.assign(unknown=stopped_before(runs)).loc[runs["counted"], [*columns, "unknown"]]
    return {str(group): own for group, own in used.groupby("group", sort=False)}


def _rows(groups: dict[str, pd.DataFrame], reference: str, index: str) -> list[dict[str, Any]]:
    if reference not in groups or index not in groups:
        return []
    counted = [groups[reference], groups[index]]
    names = {"reference": reference, "index": index}
    rows = [names | {"basis": ALL} | _difference(counted[0], counted[1], not any(map(bias, counted)))]
    if any(bool(frame["cut"].any()) for frame in counted):
        # Which runs were to be full was settled before any of them began, so that even a biased group's may be used.
        full = [frame[~frame["cut"]] for frame in counted]
        if all(map(len, full)):
            rows.append(names | {"basis": FULL} | _difference(full[0], full[1], True))
    return rows


def _difference(first: pd.DataFrame, second: pd.DataFrame, known: bool) -> dict[str, Any]:
    row: dict[str, Any] = {"measure": ""}
    for role, frame in (("reference", first), ("index", second)):
        row |= {f"runs_{role}": len(frame), f"unknown_{role}": int(frame["unknown"].sum())}
        row[f"reached_{role}"] = int((~frame["censored"]).sum())
    if not known or row["unknown_reference"] or row["unknown_index"] or not (len(first) and len(second)):
        return row
    if first["censored"].any() or second["censored"].any():
        return row | _restricted(first, second)
    a, b = (frame["time"].to_numpy(dtype=float) for frame in (first, second))
    test = t_test(a, b)
    numbers = {"low": test.low, "high": test.high, "p_value": test.p}
    return row | {"measure": MEANS, "difference": float(b.mean() - a.mean())} | numbers


def _restricted(first: pd.DataFrame, second: pd.DataFrame) -> dict[str, Any]:
    horizon = common_horizon(pd.concat([first, second]))
    times = [frame["time"].to_numpy(dtype=float) for frame in (first, second)]
    reached = [~frame["censored"].to_numpy(dtype=bool) for frame in (first, second)]
    means = [restricted_mean(*sample, horizon) for sample in zip(times, reached, strict=True)]
    low, high = restricted_interval(times[0], times[1], horizon)
    both = not (reached[0].any() or reached[1].any())
    # Where nobody reached it both means are the horizon, which is no tie but no news.
    difference = float("nan") if both else means[1] - means[0]
    return {"measure": RESTRICTED, "difference": difference, "low": low, "high": high, "horizon": horizon}


def grid(points: pd.DataFrame) -> pd.DataFrame:
    """The differences as they are read: a row for each comparison, basis and criterion, a column for each threshold.

    Args:
        points: :func:`sensitivity`.

    Returns:
        ``index, reference, runs`` (basis, and how many of each in this order), ``criterion``, then the thresholds:
        steps, in brackets if they are of restricted means, empty where they are not known. Criteria of which nothing is
        known are left out.
    """
    rows = []
    keys = ["reference", "index", "basis", "criterion"]
    for (reference, index, basis, criterion), own in points.groupby(keys, sort=False):
        if own["difference"].isna().all():
            continue
        sizes = own[["runs_index", "runs_reference"]].iloc[0]
        row = {"index": index, "reference": reference, "runs": f"{basis}, {sizes.iloc[0]} + {sizes.iloc[1]}"}
        row["criterion"] = criterion
        shown = zip(own["threshold"], own["difference"], own["measure"], strict=True)
        rows.append(row | {f"{limit:g}": _text(value, measure) for limit, value, measure in shown})
    limits = [f"{limit:g}" for limit in points["threshold"].unique()]
    return pd.DataFrame(rows, columns=["index", "reference", "runs", "criterion", *limits])


def _text(value: float, measure: str) -> str:
    if pd.isna(value):
        return ""
    steps = f"{value:,.0f}".replace("-", "−")
    return f"({steps})" if measure == RESTRICTED else steps


def overview(points: pd.DataFrame) -> pd.DataFrame:
    """How far each comparison hangs on threshold and criterion.

    Args:
        points: :func:`sensitivity`.

    Returns:
        ``reference, index, basis, runs_reference, runs_index, settings`` (looked at), ``known`` (with a difference),
        ``faster`` (of these, index ahead), ``lowest``, ``highest`` (difference, steps), ``asked`` (that of the
        threshold and count asked for).
    """
    rows = []
    for (reference, index, basis), own in points.groupby(["reference", "index", "basis"], sort=False):
        known = own["difference"].dropna()
        rows.append(
            {
                "reference": reference,
                "index": index,
                "basis": basis,
                "runs_reference": int(own["runs_reference"].iloc[0]),
                "runs_index": int(own["runs_index"].iloc[0]),
                "settings": len(own),
                "known": len(known),
                "faster": int((known < 0).sum()),
                "lowest": known.min(),
                "asked": own.loc[own["own"], "difference"].iloc[0],
                "highest": known.max(),
            }
        )
    columns = ["reference", "index", "basis", "runs_reference", "runs_index", "settings", "known", "faster"]
    return pd.DataFrame(rows, columns=[*columns, "lowest", "asked", "highest"])
