"""Figures over the global steps, beside the paper's."""

from __future__ import annotations

import matplotlib.pyplot as plt
import seaborn as sns
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from acmr.cells import CELLS
from acmr.records import VELOCITY_COLUMN
from analysis.figures.data import MOST_OTHERS, FigureData, FigureSpec, mean_curve
from analysis.figures.parts import (
    count_label,
    finish,
    mark_leaving,
    marker_style,
    set_title,
    stacked,
    step_axis,
    two_lines,
)
from analysis.figures.style import COLUMN, Palette


def learning_bands(data: FigureData, palette: Palette) -> Figure | None:
    """Learning curves of each group: mean, and the range over the seeds."""
    groups = data.present([*CELLS]) + data.others[:MOST_OTHERS]
    if not groups:
        return None
    rows = -(-len(groups) // 2)
    figure, grid = plt.subplots(
        rows, 2, figsize=(COLUMN, 0.5 + 1.05 * rows), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for axes, group in zip(grid.flat, groups, strict=False):
        own = data.curves[data.curves["group"] == group]
        color = palette.color(group, data.groups)
        sns.lineplot(own, x="step", y="episodic_return", color=color, errorbar=("pi", 100), ax=axes, legend=False)
        mark_leaving(axes, data, group, "episodic_return", color)
        axes.axhline(data.threshold, color="black", linewidth=0.7)
        set_title(axes, two_lines(count_label(data, group), 24))
        axes.set(xlabel="", ylabel="", xlim=(0, data.horizon))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        step_axis(axes.xaxis)
        axes.xaxis.set_major_locator(MaxNLocator(3))
    for axes in list(grid.flat)[len(groups) :]:
        axes.set_visible(False)
    figure.supxlabel("global step", fontsize=7)
    figure.supylabel("episodic return", fontsize=7)
    return figure


def episode_length(data: FigureData, palette: Palette) -> Figure | None:
    """Episode length over the steps."""
    return _over_steps(data, palette, "episode_length", "episode length (steps)")


def forward_velocity(data: FigureData, palette: Palette) -> Figure | None:
    """Mean forward velocity over the steps, where it was recorded."""
    return _over_steps(data, palette, VELOCITY_COLUMN, "forward velocity (m/s)")


def training_speed(data: FigureData, palette: Palette) -> Figure | None:
    """Environment steps per second of each run over its steps, where they were recorded."""
    recorded = set(data.speeds["group"])
    figure, panels = stacked([group for group in data.groups if group in recorded])
    for axes, groups in panels:
        for group in groups:
            own = data.speeds[data.speeds["group"] == group]
            style = {"color": palette.color(group, data.groups), **marker_style(palette, group, data.groups)}
            for number, (_, run) in enumerate(own.groupby("run", sort=False)):
                label = None if number else count_label(data, group)
                axes.plot(run["step"], run["steps_per_second"], linewidth=0.9, label=label, **style)
        axes.set(ylabel="steps per second", ylim=(0, 1.1 * float(data.speeds["steps_per_second"].quantile(0.99))))
    return finish(figure, panels, data)


def _over_steps(data: FigureData, palette: Palette, quantity: str, label: str) -> Figure | None:
    recorded = set(data.curves.loc[data.curves[quantity].notna(), "group"])
    figure, panels = stacked([group for group in data.groups if group in recorded])
    for axes, groups in panels:
        for group in groups:
            mark_leaving(axes, data, group, quantity, palette.color(group, data.groups))
            steps, values = mean_curve(data.curves, group, quantity)
            axes.plot(
                steps,
                values,
                color=palette.color(group, data.groups),
                label=count_label(data, group),
                **marker_style(palette, group, data.groups),
            )
        axes.set_ylabel(label)
    return finish(figure, panels, data)


_LEAVING = "open circles: where a seed's run ends and leaves the average"

FIGURES = (
    FigureSpec(
        "learning_curves",
        "Learning curves with bands",
        "Rolling averages over {window} episodes: mean over the seeds, and from the lowest to the highest seed; "
        f"{_LEAVING}.",
        learning_bands,
        limited=True,
    ),
    FigureSpec(
        "episode_length",
        "Episode length",
        "Rolling averages over {window} episodes. Surviving an episode is most of what the threshold asks for. "
        f"{_LEAVING.capitalize()}.",
        episode_length,
        limited=True,
    ),
    FigureSpec(
        "forward_velocity",
        "Forward velocity",
        "Rolling averages over {window} episodes. An agent that stands still has a velocity of zero. "
        f"{_LEAVING.capitalize()}.",
        forward_velocity,
        limited=True,
    ),
    FigureSpec(
        "training_speed",
        "Speed",
        "Environment steps per second of each run once it learns; what else the machine did at the time shows, too.",
        training_speed,
        limited=True,
    ),
)
