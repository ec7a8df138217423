"""What several figures share: axes, labels, panels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from acmr.cells import CELLS, SOURCE, TARGET
from acmr.names import figure as figure_text
from analysis.figures.data import MOST_OTHERS, POINTS, FigureData, leaving
from analysis.figures.style import COLUMN, Palette, letters

#: Height of a row, inches.
ROW = 0.24


def short_steps(value: float) -> str:
    """Steps as they are written at axes: 0, 500, 12k, −412k, 1M."""
    if value < 0:
        return f"−{short_steps(-value)}"
    if value >= 999_500:
        return f"{value / 1e6:.3g}M"
    if value >= 10_000:
        return f"{value / 1e3:.0f}k"
    return f"{value / 1e3:.3g}k" if value >= 1000 else f"{value:.0f}"


def step_axis(axis: Axis) -> None:
    """Lets an axis count steps."""
    axis.set_major_locator(MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda value, _: short_steps(value)))


def short_name(group: str) -> str:
    """A group's name as figures show it, with its middle left out if it is long."""
    name = figure_text(group, letters())
    return name if len(name) <= 36 else f"{name[:17]}…{name[-18:]}"


def two_lines(label: str, width: int = 18) -> str:
    """A label broken after a hyphen or blank, where it is long."""
    if len(label) <= width:
        return label
    name, bracket, rest = label.partition(" (")
    if bracket and max(len(name), len(rest) + 1) <= width:
        return f"{name}\n({rest}"
    breaks = [at + 1 for at, sign in enumerate(label[:-1]) if sign in "- …"]
    at = min(breaks or [len(label) // 2], key=lambda at: abs(at - len(label) / 2))
    return f"{label[:at].rstrip()}\n{label[at:]}"


def set_title(axes: Axes, text: str, room: int = 21) -> None:
    """Writes a panel's title, in letters so small that its longest line fits ``room`` letters of the usual size."""
    longest = max(map(len, text.split("\n")))
    axes.set_title(text, pad=2, fontsize=max(4.5, 7.0 * min(1.0, room / max(longest, 1))))


def legend_columns(labels: Sequence[str]) -> int:
    """How many columns of a legend fit into a figure."""
    return 2 if max(map(len, labels), default=0) <= 24 else 1


def count_label(data: FigureData, group: str) -> str:
    """Name of a group, with what is missing of it."""
    runs = data.drawn(group)
    name = short_name(group)
    if not runs["counted"].any():
        return f"{name} (unfinished)"
    said = [f"{len(runs)} of {data.planned}"] if len(runs) < data.planned else []
    said += ["biased"] if data.is_biased(group) else []
    return f"{name} ({', '.join(said)})" if said else name


def mark_leaving(axes: Axes, data: FigureData, group: str, quantity: str, color: object) -> None:
    """Draws an open circle on a group's mean curve wherever a seed leaves it and others go on."""
    steps, values = leaving(data.curves, group, quantity)
    axes.plot(steps, values, "o", color=color, markerfacecolor="white", markersize=3, markeredgewidth=0.8, zorder=4)


def marker_style(palette: Palette, group: str, groups: Sequence[str]) -> dict[str, Any]:
    """Markers along a curve, in the palette that has them."""
    if not palette.markers:
        return {}
    return {"marker": palette.marker(group, groups), "markersize": 3.5, "markevery": POINTS // 8}


def panels(groups: list[str]) -> list[list[str]]:
    """The target's cells, the source's, and other groups, as far as they are there: each set is drawn apart."""
    kinds = [
        [group for group in groups if group in CELLS and CELLS[group].role == TARGET],
        [group for group in groups if group in CELLS and CELLS[group].role == SOURCE],
        [group for group in groups if group not in CELLS][:MOST_OTHERS],
    ]
    return [kind for kind in kinds if kind]


def stacked(groups: list[str]) -> tuple[Figure, list[tuple[Axes, list[str]]]]:
    """One panel for each of :func:`panels`."""
    filled = panels(groups)
    figure, grid = plt.subplots(
        max(1, len(filled)),
        1,
        figsize=(COLUMN, 0.4 + 1.7 * max(1, len(filled))),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    return figure, list(zip(grid.flat, filled, strict=False))


def finish(figure: Figure, drawn: list[tuple[Axes, list[str]]], data: FigureData) -> Figure | None:
    """Adds legends and the steps' axis to :func:`stacked` panels; None if there are no panels."""
    if not drawn:
        plt.close(figure)
        return None
    last = drawn[-1][0]
    for axes, groups in drawn:
        longest = max(len(count_label(data, group)) for group in groups)
        if longest <= 8:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.03))
        else:
            below = -0.3 if axes is last else -0.03
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncol=1 if longest > 20 else 2)
    last.set(xlabel="global step", xlim=(0, data.horizon))
    step_axis(last.xaxis)
    return figure


def rows(data: FigureData, groups: list[str]) -> tuple[Figure, Axes]:
    """A panel with a row for each group, the first on top."""
    figure, axes = plt.subplots(figsize=(COLUMN, 0.6 + ROW * len(groups)), layout="constrained")
    axes.set_yticks(range(len(groups)), [two_lines(count_label(data, group)) for group in groups])
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    return figure, axes


def spread(row: int, count: int) -> np.ndarray:
    """Heights at which the points of a row stand, so that equal ones can be seen, (count,)."""
    return row + (np.linspace(-0.22, 0.22, count) if count > 1 else np.zeros(count))


def mean_bar(axes: Axes, row: int, mean: float, interval: tuple[float, float], color: object = "black") -> None:
    """Draws a mean with its interval into a row."""
    low, high = interval
    if np.isfinite(low) and np.isfinite(high):
        axes.plot([low, high], [row, row], color=color, linewidth=1.1, solid_capstyle="butt", zorder=1)
    axes.plot(mean, row, "|" if color == "black" else "D", color=color, markersize=9 if color == "black" else 4.5)
