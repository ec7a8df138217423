"""Figures with a row for each group: steps to threshold, differences, transfer, cost."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from acmr.cells import CELLS
from analysis.figures.data import MOST_OTHERS, FigureData, FigureSpec
from analysis.figures.parts import (
    ROW,
    count_label,
    mean_bar,
    rows,
    short_name,
    short_steps,
    spread,
    step_axis,
    two_lines,
)
from analysis.figures.style import COLUMN, Palette
from analysis.statistics.two_samples import mean_interval

_TRANSFER = (
    "Dots: seeds; bars and lines: means and their 95% t-intervals, cut at the axis. Initial: the first 10 episodes "
    "after the random actions; mean: area under the learning curve by its steps; asymptotic: the last tenth of the "
    "run (Taylor and Stone, 2009). Runs that stopped at their threshold have an initial return only."
)


def steps_per_seed(data: FigureData, palette: Palette) -> Figure | None:
    """Steps to threshold of each seed, the mean and its 95% t-interval."""
    groups = data.present(data.groups)
    if not groups:
        return None
    figure, axes = rows(data, groups)
    for row, group in enumerate(groups):
        own, color = data.drawn(group), palette.color(group, data.groups)
        values = own["steps_to_threshold"].dropna().to_numpy(dtype=float)
        missed = own.loc[own["censored"], "time"].to_numpy(dtype=float)
        axes.plot(values, spread(row, len(values)), "o", color=color, markersize=4, alpha=0.85, markeredgecolor="white")
        if len(missed):
            style = {"color": color, "markersize": 4.5, "fillstyle": "none", "clip_on": False}
            axes.plot(missed, spread(row, len(missed)), ">", **style)
        if len(values) and not len(missed) and not data.is_biased(group):
            mean_bar(axes, row, float(values.mean()), mean_interval(values))
    axes.set(xlabel="steps to threshold", xlim=(0, data.horizon))
    step_axis(axes.xaxis)
    return figure


def differences(data: FigureData, palette: Palette) -> Figure | None:
    """Difference of each comparison with its 95% t-interval; of the restricted means where runs are censored."""
    table = data.comparisons.dropna(subset=["restricted_difference"])
    if table.empty:
        return None
    figure, axes = plt.subplots(figsize=(COLUMN, 0.6 + ROW * len(table)), layout="constrained")
    entries = table.to_dict("records")
    for row, entry in enumerate(entries):
        color = palette.color(entry["index"], data.groups)
        if np.isfinite(entry["difference"]) and not np.isfinite(entry["difference_low"]):
            # Of a single run nothing is known about how much runs differ: a difference, and no test.
            axes.plot(entry["difference"], row, "o", markersize=4, markerfacecolor="white", markeredgecolor=color)
        elif np.isfinite(entry["difference"]):
            interval = (entry["difference_low"], entry["difference_high"])
            mean_bar(axes, row, entry["difference"], interval, color=color)
        else:
            ends = [entry[f"restricted_difference_{end}"] for end in ("low", "high")]
            axes.plot(ends, [row, row], color="0.55", linewidth=1.1, linestyle=(0, (2, 1)), zorder=1)
            middle = entry["restricted_difference"]
            axes.plot(middle, row, "D", markersize=4.5, markerfacecolor="white", markeredgecolor="0.4")
    axes.axvline(0, color="black", linewidth=0.8)
    labels = [two_lines(f"{short_name(entry['index'])} − {short_name(entry['reference'])}") for entry in entries]
    axes.set_yticks(range(len(table)), labels)
    axes.set_ylim(len(table) - 0.5, -0.5)
    reach = 1.15 * float(np.nanmax(np.abs(table[["difference", "restricted_difference"]].to_numpy()))) or 1.0
    ends = ["difference_low", "difference_high", "restricted_difference_low", "restricted_difference_high"]
    widest = np.nanmax(np.abs(table[[*ends, "restricted_difference"]].to_numpy()))
    reach = max(reach, 1.05 * float(min(widest, data.horizon)))
    axes.set_xlim(-reach, reach)
    axes.set_xlabel("difference in steps\n(← index faster, slower →)")
    step_axis(axes.xaxis)
    axes.grid(axis="y", visible=False)
    return figure


def transfer_metrics(data: FigureData, palette: Palette) -> Figure | None:
    """Initial, asymptotic and mean return of each seed."""
    groups = data.present([*CELLS]) + data.others[:MOST_OTHERS]
    if not groups:
        return None
    names = {"initial_return": "initial", "area_under_curve": "mean", "asymptotic_return": "asymptotic"}
    figure, grid = plt.subplots(1, 3, figsize=(COLUMN, 0.75 + ROW * len(groups)), sharey=True, layout="constrained")
    for axes, (column, title) in zip(grid, names.items(), strict=True):
        seen: list[float] = []
        for row, group in enumerate(groups):
            values = data.drawn(group)[column].dropna().to_numpy(dtype=float)
            color = palette.color(group, data.groups)
            axes.plot(values, spread(row, len(values)), "o", color=color, markersize=3.5, markeredgecolor="white")
            if len(values) and not data.is_biased(group):
                mean_bar(axes, row, float(values.mean()), mean_interval(values))
            seen += values.tolist()
        axes.set_title(title, pad=3)
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_steps(value)))
        axes.set_xlim(*_from_zero(seen))
    grid[0].set_yticks(range(len(groups)), [two_lines(count_label(data, group)) for group in groups])
    grid[0].set_ylim(len(groups) - 0.5, -0.5)
    figure.supxlabel("episodic return", fontsize=7)
    return figure


def _from_zero(values: list[float]) -> tuple[float, float]:
    """Limits of an axis that holds zero, for a length from elsewhere makes small differences look large."""
    low, high = min([0.0, *values]), max([0.0, *values])
    room = 0.08 * (high - low) or 1.0
    return (low - room if low < 0 else 0.0), (high + room if high > 0 else 0.0)


def wall_clock(data: FigureData, palette: Palette) -> Figure | None:
    """Wall-clock time of each run; a mean only of runs that all took, or all did not take, all their steps."""
    groups = [group for group in data.present(data.groups) if data.drawn(group)["wall_seconds"].notna().any()]
    if not groups:
        return None
    figure, axes = rows(data, groups)
    hours = data.runs["wall_seconds"].max() >= 2 * 3600
    for row, group in enumerate(groups):
        own = data.drawn(group).dropna(subset=["wall_seconds"])
        values = own["wall_seconds"].to_numpy(dtype=float) / (3600 if hours else 60)
        color, cut, places = palette.color(group, data.groups), own["cut"].to_numpy(bool), spread(row, len(own))
        if cut.all() or not cut.any():
            axes.barh(row, values.mean(), height=0.6, color=color, alpha=0.35)
        for some, face in ((~cut, color), (cut, "white")):
            look = {"color": color, "markersize": 3.5, "markerfacecolor": face, "markeredgewidth": 0.8}
            axes.plot(values[some], places[some], "o", **look)
    axes.set(xlabel=f"wall-clock time of a run ({'hours' if hours else 'minutes'})", xlim=(0, None))
    return figure


def _pairs(data: FigureData) -> list[str]:
    rows = data.comparisons.dropna(subset=["restricted_difference"]).to_dict("records")
    return [
        f"{row['index']} − {row['reference']}, {row['runs_index']} and {row['runs_reference']} runs" for row in rows
    ]


FIGURES = (
    FigureSpec(
        "steps_per_seed",
        "Steps to threshold of each seed",
        "Dots: seeds; open triangles: runs that ended without reaching it; bar and line: mean and its 95% t-interval, "
        "where every seed reached it.",
        steps_per_seed,
    ),
    FigureSpec(
        "differences",
        "Difference to the reference",
        "Index less reference with the 95% t-interval of the difference (diamonds); open circles: one of the two has a "
        "single run, and nothing is tested; open gray diamonds: difference of the restricted means, where a run never "
        "reached the threshold, with its 95% interval (dashed).",
        differences,
        shows=_pairs,
    ),
    FigureSpec("transfer_metrics", "Initial, mean and asymptotic return", _TRANSFER, transfer_metrics, limited=True),
    FigureSpec(
        "wall_clock",
        "Cost",
        "Wall-clock time of each run: dots, open where it stopped at its threshold; bars: means, where all runs of a "
        "group stopped or none did.",
        wall_clock,
    ),
)
