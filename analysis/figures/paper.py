"""The paper's figures 4 to 6, the list of all figures, and how they are written."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from acmr.cells import CELLS, SOURCE, TARGET
from analysis.figures import profiles, rows, sensitivity, steps, survival
from analysis.figures.data import Draw, FigureData, FigureSpec, mean_curve
from analysis.figures.parts import count_label, legend_columns, mark_leaving, marker_style, short_steps, step_axis
from analysis.figures.style import COLUMN, PALETTES, Palette


def _paper_figure(cells: tuple[str, ...]) -> Draw:
    """One of figures 4 to 6: the learning curves of these cells."""

    def draw(data: FigureData, palette: Palette) -> Figure | None:
        present = data.present(cells)
        if not present:
            return None
        figure, axes = plt.subplots(figsize=(COLUMN, 2.6), layout="constrained")
        handles: list[Line2D] = []
        colors = {cell: palette.color(cell, data.groups) for cell in present}
        for cell in present:
            _raw_background(axes, data, cell, colors[cell])
        for cell in present:
            handles.append(_curve(axes, data, palette, cell, colors[cell]))
        handles.append(
            axes.axhline(data.threshold, color="black", linewidth=0.9, label=f"threshold {data.threshold:g}")
        )
        axes.set(xlabel="global step", ylabel="episodic return", xlim=(0, data.horizon))
        step_axis(axes.xaxis)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        columns = legend_columns([str(handle.get_label()) for handle in handles])
        figure.set_figheight(2.2 + 0.14 * -(-len(handles) // columns))
        figure.legend(handles=handles, loc="outside lower center", ncol=columns, handlelength=1.8, columnspacing=1.2)
        return figure

    return draw


def _raw_background(axes: Axes, data: FigureData, cell: str, color: object) -> None:
    runs = data.drawn(cell)
    first = runs.sort_values("seed").index[0]
    raw = data.episodes[data.episodes["run"] == first]
    width = float(np.clip(300 / len(raw), 0.4, 0.8))
    # Thousands of episodes: as pixels they keep PDF and SVG small.
    style: dict[str, Any] = {"color": color, "alpha": 0.3, "linewidth": width, "rasterized": True, "zorder": 1}
    axes.plot(raw["global_step"], raw["episodic_return"], **style)


def _curve(axes: Axes, data: FigureData, palette: Palette, cell: str, color: object) -> Line2D:
    steps, values = mean_curve(data.curves, cell, "episodic_return")
    style = marker_style(palette, cell, data.groups)
    runs = data.drawn(cell)
    label = count_label(data, cell)
    mark_leaving(axes, data, cell, "episodic_return", color)
    if len(runs) and not runs["censored"].any() and not data.is_biased(cell):
        mean = float(runs["steps_to_threshold"].mean())
        axes.axvline(mean, color=color, linestyle="--", linewidth=0.9, zorder=2)
        label += f", StT {short_steps(mean)}"
    else:
        reached = int((~runs["censored"]).sum())
        yet = "" if runs["counted"].any() else " yet"
        label += f", StT reached by {reached} of {len(runs)}" if reached else f", StT not reached{yet}"
    return axes.plot(steps, values, color=color, label=label, zorder=3, **style)[0]


_HOW = (
    "Rolling averages over {window} episodes, averaged over the seeds; behind them the raw returns of the first seed "
    "(seed 1 unless it is missing); black: threshold; dashed: mean steps to threshold from the raw returns (StT; where "
    "a seed never reached it, how many did); open circles: where a seed's run ends and leaves the average."
)

#: What the paper's cells are compared with, and the cells of each environment.
_BASELINES = tuple(dict.fromkeys(cell.baseline for cell in CELLS.values() if cell.published and cell.baseline))
_SOURCE, _TARGET = (tuple(cell.name for cell in CELLS.values() if cell.role == role) for role in (SOURCE, TARGET))


def _of(cells: tuple[str, ...]) -> Callable[[FigureData], list[str]]:
    return lambda data: [data.size(cell) for cell in data.present(cells)]


FIGURES = (
    FigureSpec(
        "figure_4",
        "Figure 4",
        f"Baselines in both environments. {_HOW}",
        _paper_figure(_BASELINES),
        shows=_of(_BASELINES),
    ),
    FigureSpec(
        "figure_5",
        "Figure 5",
        f"Cells of the target environment. {_HOW}",
        _paper_figure(_TARGET),
        shows=_of(_TARGET),
    ),
    FigureSpec(
        "figure_6",
        "Figure 6",
        f"Proof of concept: cells of the source environment. {_HOW}",
        _paper_figure(_SOURCE),
        shows=_of(_SOURCE),
    ),
    *survival.FIGURES,
    *sensitivity.FIGURES,
    *steps.FIGURES,
    *rows.FIGURES,
    *profiles.FIGURES,
)


def draw_all(data: FigureData) -> Iterator[tuple[FigureSpec, Palette, Figure]]:
    """Draws every figure in both palettes; a figure is closed when the next is asked for."""
    for spec in FIGURES:
        for palette in PALETTES:
            figure = spec.draw(data, palette)
            if figure is not None:
                yield spec, palette, figure
                plt.close(figure)


def save(figure: Figure, out: Path, name: str, formats: tuple[str, ...]) -> bytes:
    """Writes a figure in each format.

    Args:
        figure: The figure.
        out: Folder, which must exist.
        name: File name without its ending.
        formats: Of ``pdf``, ``png``, ``svg``.

    Returns:
        The SVG, whether it was asked for or not: the report needs it.
    """
    # The layout takes longer than the drawing: once is enough for all formats.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for kind in formats:
        if kind != "svg":
            (out / f"{name}.{kind}").write_bytes(_render(figure, kind))
    svg = _render(figure, "svg")
    if "svg" in formats:
        (out / f"{name}.svg").write_bytes(svg)
    return svg


def _render(figure: Figure, kind: str) -> bytes:
    # No date: the same runs give the same bytes.
    dates = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=dates[kind])
    return buffer.getvalue()


def picture(image: np.ndarray) -> Figure:
    """A rendered picture as a figure of one column's width."""
    height, width = image.shape[:2]
    figure = plt.figure(figsize=(COLUMN, COLUMN * height / width))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image)
    axes.axis("off")
    return figure
