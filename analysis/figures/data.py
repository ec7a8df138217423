"""What the figures draw: runs, and their learning curves on common steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from acmr.cells import CELLS
from acmr.records import COMPLETE, METRICS_FILE, VELOCITY_COLUMN
from analysis.figures.style import Palette
from analysis.loading.read_run import FOREIGN, UNFINISHED
from analysis.loading.speed import read_speed
from analysis.statistics.metrics import asymptotic_return, rolling_mean

#: The paper's rolling average (figures 4 to 6), in episodes.
PAPER_WINDOW = 50
#: Points of a curve.
POINTS = 250
#: Groups that are no cells shown as curves; more could not be told apart.
MOST_OTHERS = 8
#: Columns of the episodes that are drawn over the steps.
QUANTITIES = ("episodic_return", "episode_length", VELOCITY_COLUMN)


@dataclass(frozen=True)
class FigureData:
    """Everything the figures need.

    Attributes:
        runs: The runs with their metrics (:func:`analysis.statistics.metrics.measure`).
        episodes: All episodes.
        groups: Groups in the order they are shown.
        comparisons: Rows of table 3, of the cells and the other groups.
        threshold: Return to reach.
        window: Episodes of the rolling average.
        planned: Seeds that a group is planned to have.
        curves: One row for each run and point: ``group, seed, step`` and the rolling averages of ``QUANTITIES``.
        speeds: One row for each run and point: ``group, run, step, steps_per_second``.
        sensitivity: The comparisons at other thresholds (:func:`analysis.statistics.study.sensitivity.sensitivity`).
    """

    runs: pd.DataFrame
    episodes: pd.DataFrame
    groups: list[str]
    comparisons: pd.DataFrame
    threshold: float
    window: int
    planned: int
    curves: pd.DataFrame = field(default_factory=pd.DataFrame)
    speeds: pd.DataFrame = field(default_factory=pd.DataFrame)
    sensitivity: pd.DataFrame = field(default_factory=pd.DataFrame)

    def drawn(self, group: str) -> pd.DataFrame:
        """The runs of a group that are drawn: those that count, or, while there are none, the unfinished ones."""
        return drawn_runs(self.runs, group)

    def present(self, names: tuple[str, ...] | list[str]) -> list[str]:
        """Those of the groups that have something to draw."""
        return [name for name in names if name in self.groups and len(self.drawn(name))]

    def is_biased(self, group: str) -> bool:
        """Whether of a group the fast runs have ended and others have not (:mod:`analysis.statistics.early_ends`)."""
        return bool(self.runs.loc[self.runs["group"] == group, "bias"].any())

    @property
    def others(self) -> list[str]:
        """Groups that are no cells and have something to draw."""
        return self.present([group for group in self.groups if group not in CELLS])

    @property
    def horizon(self) -> float:
        """Last step of the longest run."""
        return float(self.runs["horizon"].max()) if len(self.runs) else 1.0

    def size(self, group: str) -> str:
        """A group and how many of its runs are drawn, for captions."""
        runs = self.drawn(group)
        said = [f"{len(runs)} run{'' if len(runs) == 1 else 's'}"]
        if len(runs) and not runs["counted"].any():
            said.append("unfinished")
        elif cut := int(runs["cut"].sum()):
            said.append(f"{cut} stopped at {'its' if cut == 1 else 'their'} threshold")
        said += ["biased"] if self.is_biased(group) else []
        return f"{group} ({', '.join(said)})"


Draw = Callable[[FigureData, Palette], Figure | None]


@dataclass(frozen=True)
class FigureSpec:
    """A figure: its file name, its title and caption, and what draws it (None: there is nothing to draw).

    ``{window}`` in a caption stands for the episodes of the rolling average.
    """

    name: str
    title: str
    caption: str
    draw: Draw
    #: Whether it leaves out groups that are no cells where there are more than ``MOST_OTHERS``.
    limited: bool = False
    #: What it draws of these data, for its caption; None: every group with something to draw.
    shows: Callable[[FigureData], list[str]] | None = None

    def said(self, data: FigureData) -> str:
        """Its caption: what it shows, and of what."""
        text, left_out = self.caption.format(window=data.window), data.others[MOST_OTHERS:] if self.limited else []
        if left_out:
            text += f" Of the {len(data.others)} groups that are no cells the first {MOST_OTHERS} are drawn."
        groups = [group for group in data.present(data.groups) if group not in left_out]
        shown = self.shows(data) if self.shows else [data.size(group) for group in groups]
        return f"{text} Drawn: {', '.join(shown)}." if shown else text


def drawn_runs(runs: pd.DataFrame, group: str) -> pd.DataFrame:
    """See :meth:`FigureData.drawn`."""
    own = runs[(runs["group"] == group) & (runs["episodes"] > 0)]
    counted = own[own["counted"]]
    return counted if len(counted) else own[own["state"] == UNFINISHED]


def default_window(runs: pd.DataFrame, episodes: pd.DataFrame) -> int:
    """The paper's 50 episodes; fewer, down to 5, where those would span more than a twentieth of a run at its end.

    The paper's own runs end in episodes of 1,000 steps: 50 of them are a twentieth of a million.
    """
    lengths = {
        name: asymptotic_return(own["global_step"], own["episode_length"])
        for name, own in episodes.groupby("run", observed=True, sort=False)
    }
    share = (runs["watched"] / pd.Series(lengths, dtype=float).reindex(runs.index)).median() / 20
    return PAPER_WINDOW if np.isnan(share) else int(np.clip(round(share), 5, PAPER_WINDOW))


def learning_curves(runs: pd.DataFrame, episodes: pd.DataFrame, groups: list[str], window: int) -> pd.DataFrame:
    """The rolling average over each run's episodes, at the same steps for all runs.

    Seeds end their episodes at different steps, so that they can only be averaged after that.

    Args:
        runs: The runs with their metrics.
        episodes: All episodes.
        groups: Groups to take.
        window: Episodes to average.

    Returns:
        One row for each drawn run and point; NaN before the first episode's end, and after the last one's unless the
        run is complete (then its last value stands to the end).
    """
    horizon = float(runs["horizon"].max()) if len(runs) else 1.0
    grid = np.linspace(0, horizon, POINTS + 1)[1:]
    parts = []
    by_run = {str(name): own for name, own in episodes.groupby("run", observed=True, sort=False)}
    for group in groups:
        for name, run in drawn_runs(runs, group).iterrows():
            own = by_run[str(name)]
            steps = own["global_step"].to_numpy(dtype=float)
            end = run["horizon"] if run["state"] in (COMPLETE, FOREIGN) else run["last_step"]
            table = {key: _resample(steps, rolling_mean(own[key], window), grid, end) for key in QUANTITIES}
            parts.append(pd.DataFrame({"group": group, "seed": int(run["seed"]), "step": grid, **table}))
    columns = ["group", "seed", "step", *QUANTITIES]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def mean_curve(curves: pd.DataFrame, group: str, quantity: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over a group's seeds at each step: (steps, means), both (POINTS,).

    A run that ends early (diverged, unfinished, stopped at its threshold) leaves the mean where it ends.
    """
    own = curves[curves["group"] == group].groupby("step")[quantity].mean()
    return own.index.to_numpy(dtype=float), own.to_numpy(dtype=float)


def leaving(curves: pd.DataFrame, group: str, quantity: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of :func:`mean_curve` that are the last before fewer seeds, but still some, are averaged."""
    steps, values = mean_curve(curves, group, quantity)
    seeds = curves[curves["group"] == group].groupby("step")[quantity].count().to_numpy()
    last = np.flatnonzero((np.diff(seeds) < 0) & (seeds[1:] > 0))
    return steps[last], values[last]


def _resample(
    steps: NDArray[np.float64], values: NDArray[np.float64], grid: NDArray[np.float64], end: float
) -> NDArray[np.float64]:
    line = np.interp(grid, steps, values, left=np.nan)
    line[grid > max(end, steps[-1])] = np.nan
    return line


def training_speeds(root: Path, runs: pd.DataFrame, groups: list[str]) -> pd.DataFrame:
    """The speed of every run that is drawn.

    Args:
        root: The runs folder.
        runs: The runs with their metrics (:func:`analysis.statistics.metrics.measure`).
        groups: Groups to take.

    Returns:
        :func:`read_speed` of each, with ``group`` and ``run``; empty if no run recorded it.
    """
    parts = []
    for group in groups:
        for name, run in drawn_runs(runs, group).iterrows():
            if METRICS_FILE in run["doubts"]:
                continue
            starts = run["learning_starts"]
            own = read_speed(root / run["directory"], 0.0 if pd.isna(starts) else float(starts))
            parts.append(own.assign(group=group, run=str(name)))
    filled = [part for part in parts if len(part)]
    columns = ["step", "steps_per_second", "group", "run"]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=columns)
