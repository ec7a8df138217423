"""Kaplan-Meier curves with their bands and the numbers at risk."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray

from analysis.figures.data import FigureData, FigureSpec
from analysis.figures.parts import count_label, marker_style, panels, step_axis, two_lines
from analysis.figures.style import COLUMN, Palette
from analysis.loading.read_run import UNFINISHED
from analysis.statistics.survival import at_risk, kaplan_meier

#: Height of a panel and of a line below it, inches.
_PANEL, _LINE = 1.5, 0.13


def kaplan_meier_curves(data: FigureData, palette: Palette) -> Figure | None:
    """Share of the runs not yet at the threshold, over the steps; below it how many are still watched."""
    kinds = panels(data.present(data.groups))
    if not kinds:
        return None
    labels = {group: two_lines(count_label(data, group), 12) for kind in kinds for group in kind}
    lines = [sum(1 + labels[group].count("\n") for group in kind) for kind in kinds]
    heights = [height for count in lines for height in (_PANEL, 0.1 + _LINE * count)]
    figure, grid = plt.subplots(
        len(heights),
        1,
        figsize=(COLUMN, 0.5 + sum(heights)),
        sharex=True,
        squeeze=False,
        height_ratios=heights,
        layout="constrained",
    )
    moments = np.asarray(MaxNLocator(5).tick_values(0, data.horizon), dtype=float)
    moments = moments[(moments >= 0) & (moments <= data.horizon)]
    for curves, counts, kind in zip(grid[::2, 0], grid[1::2, 0], kinds, strict=True):
        for group in kind:
            _curve(curves, data, palette, group)
        curves.set(ylim=(0, 1.05), ylabel="not yet at threshold")
        _numbers(counts, data, palette, kind, labels, moments)
    last = grid[-1, 0]
    last.set(xlabel="global step", xlim=(0, data.horizon))
    step_axis(last.xaxis)
    return figure


def _watched(data: FigureData, group: str) -> pd.DataFrame:
    # Unfinished runs are what censoring is made for: they were watched until their latest step.
    own = data.runs[(data.runs["group"] == group) & (data.runs["episodes"] > 0)]
    return own[own["counted"] | (own["state"] == UNFINISHED)]


def _curve(axes: Axes, data: FigureData, palette: Palette, group: str) -> None:
    own, color = _watched(data, group), palette.color(group, data.groups)
    curve = kaplan_meier(own["time"], ~own["censored"].astype(bool))
    end = max(float(own["time"].max()), curve.steps[-1])
    steps, share, low, high = (
        np.append(values, last)
        for values, last in ((curve.steps, end), *((part, part[-1]) for part in (curve.share, curve.low, curve.high)))
    )
    style = {**marker_style(palette, group, data.groups), "markevery": 1} if palette.markers else {}
    axes.step(steps, share, where="post", color=color, clip_on=False, **style)
    if len(own) > 1:
        axes.fill_between(steps, low, high, step="post", color=color, alpha=0.08, linewidth=0)
    at = curve.share[np.searchsorted(curve.steps, curve.censored, side="right") - 1]
    if len(at):
        axes.plot(curve.censored, at, "|", color=color, markersize=7, markeredgewidth=1.2, clip_on=False)


def _numbers(
    axes: Axes,
    data: FigureData,
    palette: Palette,
    groups: list[str],
    labels: dict[str, str],
    moments: NDArray[np.float64],
) -> None:
    """A row for each group, which is the legend, too: how many of its runs are at risk at each of the steps."""
    heights = np.array([1 + labels[group].count("\n") for group in groups])
    rows = np.cumsum(heights) - heights / 2
    axes.set_yticks(rows, [labels[group] for group in groups])
    axes.set_ylim(float(heights.sum()), 0)
    axes.tick_params(axis="y", length=0, pad=18)
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False)
    axes.set_title("runs at risk", loc="left", fontsize=6, pad=1)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for row, group in zip(rows, groups, strict=True):
        color = palette.color(group, data.groups)
        marker: dict[str, Any] = {}
        if palette.markers:
            marker = {"marker": palette.marker(group, data.groups), "markersize": 3.5}
        beside = blended_transform_factory(axes.transAxes, axes.transData)
        axes.plot(
            [-0.08, -0.055, -0.03], [row] * 3, color=color, transform=beside, clip_on=False, markevery=[1], **marker
        )
        counts = at_risk(_watched(data, group)["time"], moments)
        for moment, count in zip(moments, counts, strict=True):
            # At the ends they stay within the panel, beside which the lines of the legend are.
            side = "left" if moment == 0 else "right" if moment == data.horizon else "center"
            axes.text(moment, row, str(count), ha=side, va="center", fontsize=6, color=color)


FIGURES = (
    FigureSpec(
        "kaplan_meier",
        "Not yet at the threshold",
        "Kaplan-Meier estimate of the share of runs that have not reached the threshold, with the 95% interval of each "
        "share (bands; Clopper and Pearson's, with the effective number of runs where some were censored); ticks: runs "
        "that were watched no longer; below: how many runs are still watched and not yet at the threshold.",
        kaplan_meier_curves,
        limited=True,
    ),
)
