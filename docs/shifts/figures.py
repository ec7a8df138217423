"""The figures of ``docs/shifts.md``."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures.parts import step_axis
from analysis.figures.style import COLUMN, PALETTES
from analysis.statistics.study.aggregates import iqm, profile
from docs.shifts.runs import BASELINE, METHODS, Benchmark
from docs.shifts.tables import scores

#: Steps that a point of a curve stands for, and points of a profile.
_BIN, _POINTS = 2_000, 101


def figures(found: Benchmark) -> Iterator[tuple[str, Figure]]:
    """The figures of the page by their names, as far as there are runs for them."""
    if found.pairs:
        yield "curves", curves(found)
    if found.whole:
        yield "profiles", profiles(found)


def curves(found: Benchmark) -> Figure:
    """A panel for each pair: the interquartile mean of each method's runs, and the middle half of them."""
    pairs = found.pairs
    rows = -(-len(pairs) // 2)
    figure, grid = plt.subplots(rows, 2, figsize=(COLUMN * 2, 1.5 * rows + 0.4), layout="constrained", squeeze=False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        for method in METHODS:
            own, color = found.of(pair, method), PALETTES[0].color(method, list(METHODS))
            if len(own):
                ends, runs = binned(found, own)
                axes.plot(ends, iqm(runs, axis=0), color=color)
                axes.fill_between(ends, *np.quantile(runs, [0.25, 0.75], axis=0), color=color, alpha=0.15, linewidth=0)
        axes.axhline(found.of(pair, BASELINE)["threshold"].iloc[0], color="black", linewidth=0.6, linestyle="--")
        axes.set_title(pair.replace("_", " "))
        axes.set(xlim=(0, None), ylabel="return")
        step_axis(axes.xaxis)
    for axes in grid.flat[len(pairs) :]:
        axes.set_visible(False)
    figure.supxlabel("environment steps of the student", fontsize=7)
    return _with_legend(figure)


def binned(found: Benchmark, runs: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean returns of the episodes that end in each 2,000 steps, (bins,) ends and (runs, bins); none: as before."""
    ends = np.arange(_BIN, runs["budget"].iloc[0] + 1, _BIN)
    told = []
    for name in runs["run"]:
        own = found.data.episodes[found.data.episodes["run"] == name]
        means = own["episodic_return"].groupby(np.ceil(own["global_step"] / _BIN)).mean()
        told.append(means.reindex(range(1, len(ends) + 1)).ffill().bfill().to_numpy(float))
    return ends, np.stack(told)


def profiles(found: Benchmark) -> Figure:
    """Performance profiles over all whole pairs: of the steps to threshold, and of the return at a tenth."""
    figure, panels = plt.subplots(1, 2, figsize=(COLUMN * 2, 2.3), layout="constrained")
    _profile(panels[0], found, "steps", np.linspace(0, 1, _POINTS), below=True)
    panels[0].set(xlabel="share of the budget", ylabel="share of runs that met the threshold", xlim=(0, 1))
    values = np.concatenate([each for method in METHODS for each in scores(found, method, "early")])
    _profile(panels[1], found, "early", np.linspace(values.min(), values.max(), _POINTS), below=False)
    panels[1].set(xlabel="return at a tenth (0: untrained, 1: threshold)", ylabel="share of runs above")
    return _with_legend(figure)


def _profile(axes: Axes, found: Benchmark, name: str, limits: NDArray[np.float64], below: bool) -> None:
    for method in METHODS:
        color, own = PALETTES[0].color(method, list(METHODS)), scores(found, method, name)
        # Who is at the threshold by a step is not slower than that; a run that never was has the whole budget.
        own = [np.where(each < 1, -each, -2.0) for each in own] if below else own
        sought = -limits - 1e-9 if below else limits
        axes.step(limits, profile(np.concatenate(own), sought), where="post", color=color)
        rng = np.random.default_rng(0)
        draws = [profile(np.concatenate([rng.choice(each, len(each)) for each in own]), sought) for _ in range(1000)]
        axes.fill_between(limits, *np.quantile(draws, [0.025, 0.975], axis=0), color=color, alpha=0.15, linewidth=0)
    axes.set(ylim=(-0.03, 1.03))


def _with_legend(figure: Figure) -> Figure:
    lines = [plt.Line2D([], [], color=PALETTES[0].color(method, list(METHODS))) for method in METHODS]
    figure.legend(lines, list(METHODS.values()), loc="outside upper center", ncol=len(METHODS))
    return figure
