"""Differences in steps to threshold for other thresholds, counts and smoothed returns."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from analysis.figures.data import FigureData, FigureSpec
from analysis.figures.parts import set_title, short_name, short_steps, two_lines
from analysis.figures.style import COLUMN, Palette
from analysis.statistics.study.sensitivity import ALL, FULL, RESTRICTED

#: Colors of counts and of smoothed returns, light to dark; told apart by their markers, too.
_COUNTS, _MEANS = ("#9ecae1", "#4292c6", "#08519c", "#08306b"), ("#fdae6b", "#e6550d", "#8c2d04")
_MARKERS = "o^sDv<>ph"


def sensitivity(data: FigureData, palette: Palette) -> Figure | None:
    """A row for each comparison, all runs beside the full ones: the difference over the threshold by criterion."""
    points = data.sensitivity.dropna(subset=["difference"]) if len(data.sensitivity) else data.sensitivity
    if points.empty:
        return None
    pairs = list(points.groupby(["reference", "index"], sort=False))
    bases = [basis for basis in (ALL, FULL) if basis in set(points["basis"])]
    styles = _styles(list(dict.fromkeys(data.sensitivity["criterion"])))
    size = (COLUMN, 0.9 + 1.15 * len(pairs))
    figure, grid = plt.subplots(len(pairs), len(bases), figsize=size, sharex=True, squeeze=False, layout="constrained")
    for row, ((reference, index), own) in zip(grid, pairs, strict=True):
        for axes, basis in zip(row, bases, strict=True):
            _panel(axes, own[own["basis"] == basis], styles, data.threshold)
            set_title(axes, _title(data.sensitivity, str(reference), str(index), basis), room=25)
    for axes in grid[-1]:
        axes.set_xlabel("threshold (return)")
    figure.supylabel("difference in steps (below 0: index faster)", fontsize=7)
    handles = [Line2D([], [], label=name, linewidth=1, **style) for name, style in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncol=3, handlelength=2, columnspacing=1.0)
    return figure


def _title(points: pd.DataFrame, reference: str, index: str, basis: str) -> str:
    name = f"{short_name(index)} − {short_name(reference)}"
    name = f"{name}, " if len(name) <= 12 else f"{two_lines(name, 24)}\n"
    own = points[(points["reference"] == reference) & (points["index"] == index) & (points["basis"] == basis)]
    if own.empty:
        return ""  # all of them are full, or none is
    sizes = own[["runs_index", "runs_reference"]].iloc[0]  # in the order of the names
    return f"{name}{basis} runs: {sizes.iloc[0]} + {sizes.iloc[1]}"


def _styles(names: list[str]) -> dict[str, dict[str, Any]]:
    smoothed = [name for name in names if name.startswith("mean")]
    counts = [name for name in names if name not in smoothed]
    shades = {**_shades(counts, _COUNTS), **_shades(smoothed, _MEANS)}
    return {
        name: {"color": shades[name], "marker": _MARKERS[place % len(_MARKERS)], "markersize": 3.2}
        for place, name in enumerate(names)
    }


def _shades(names: list[str], shades: tuple[str, ...]) -> dict[str, str]:
    places = np.linspace(0, len(shades) - 1, len(names)).round().astype(int)
    return {name: shades[place] for name, place in zip(names, places, strict=True)}


def _panel(axes: Axes, own: pd.DataFrame, styles: dict[str, dict[str, Any]], threshold: float) -> None:
    if own.empty:
        axes.set_axis_off()
        return
    for criterion, line in own.groupby("criterion", sort=False):
        style = styles[str(criterion)]
        alone = bool((line[["runs_reference", "runs_index"]].min(axis=1) < 2).any())
        look: dict[str, Any] = {"linestyle": ":" if alone else "-", "linewidth": 0.9, "markeredgewidth": 0.6}
        look["markerfacecolor"] = "white" if alone else style["color"]
        axes.plot(line["threshold"], line["difference"], **style, **look)
        parts = line[line["measure"] == RESTRICTED]
        bar: dict[str, Any] = {"color": "black", "markersize": 5, "markeredgewidth": 0.8, "zorder": 4}
        axes.plot(parts["threshold"], parts["difference"], "_", **bar)
    axes.margins(x=0.08)
    axes.axhline(0, color="black", linewidth=0.7, zorder=1)
    axes.axvline(threshold, color="0.6", linewidth=0.7, linestyle="--", zorder=1)
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short_steps(value)))


def _shows(data: FigureData) -> list[str]:
    known = data.sensitivity.dropna(subset=["difference"])
    return list(dict.fromkeys(f"{row['index']} − {row['reference']}" for row in known.to_dict("records")))


FIGURES = (
    FigureSpec(
        "sensitivity",
        "Sensitivity to threshold and criterion",
        "Index less reference in steps to threshold, for other thresholds (dashed: the one asked for), for 1 to 10 "
        "episodes in a row and for the mean of so many. Left: all runs that count, where none of them stopped before "
        "it met the criterion; right: those alone that took all their steps. Open and dotted: one of the two groups "
        "has a single run; bars: restricted means, for some run never met the criterion. One setting was chosen "
        "before; the others are no tests.",
        sensitivity,
        shows=_shows,
    ),
)
