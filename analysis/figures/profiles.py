"""Performance profiles: which share of a group's runs ends above each return."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from analysis.figures.data import MOST_OTHERS, FigureData, FigureSpec
from analysis.figures.parts import finish, marker_style, short_name, stacked
from analysis.figures.style import Palette
from analysis.statistics.study.aggregates import LEAST_RUNS, profile
from analysis.statistics.two_samples import ALPHA

#: Points of a profile, and resamples behind its band.
_POINTS, _RESAMPLES = 200, 2000


def _full(data: FigureData) -> list[str]:
    """Groups with runs that took all their steps and so have an asymptotic return."""
    groups = [group for group in data.present(data.groups) if data.drawn(group)["asymptotic_return"].notna().any()]
    others = [group for group in groups if group in data.others]
    return [group for group in groups if group not in others[MOST_OTHERS:]]


def _shows(data: FigureData) -> list[str]:
    sizes = {group: int(data.drawn(group)["asymptotic_return"].notna().sum()) for group in _full(data)}
    return [f"{group} ({count} full run{'s' if count > 1 else ''})" for group, count in sizes.items()]


def return_profiles(data: FigureData, palette: Palette) -> Figure | None:
    """Share of the full runs whose asymptotic return is higher than each return."""
    groups = _full(data)
    if not groups:
        return None
    figure, panels = stacked(groups)
    values = {group: np.sort(data.drawn(group)["asymptotic_return"].dropna().to_numpy(float)) for group in groups}
    ends = np.concatenate(list(values.values()))
    room = 0.08 * (float(np.ptp(ends)) or abs(float(ends[0])) or 1.0)
    limits = np.linspace(float(ends.min()) - room, float(ends.max()) + room, _POINTS)
    for axes, members in panels:
        for group in members:
            color = palette.color(group, data.groups)
            style = marker_style(palette, group, data.groups)
            alone = len(values[group]) < 2
            label = f"{short_name(group)}, n = {len(values[group])}"
            line = {"color": color, "linestyle": ":" if alone else "-", "label": label}
            axes.step(limits, profile(values[group], limits), where="post", **line, **style)
            if len(values[group]) >= LEAST_RUNS:
                axes.fill_between(limits, *_band(values[group], limits), color=color, alpha=0.15, linewidth=0)
        axes.set(ylim=(-0.03, 1.05), ylabel="share of runs above")
    found = finish(figure, panels, data)
    last = panels[-1][0]
    last.set(xlabel="asymptotic return", xlim=(float(limits[0]), float(limits[-1])))
    last.xaxis.set_major_locator(MaxNLocator(4))
    last.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    return found


def _band(values: NDArray[np.float64], limits: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """95% bootstrap interval of each share, by itself."""
    draws = np.random.default_rng(0).choice(values, (_RESAMPLES, len(values)))
    shares = np.stack([profile(draw, limits) for draw in draws])
    low, high = np.quantile(shares, [ALPHA / 2, 1 - ALPHA / 2], axis=0)
    return low, high


FIGURES = (
    FigureSpec(
        "return_profiles",
        "Performance profiles",
        "Share of a group's full runs whose asymptotic return lies above each return (Agarwal et al., 2021); dotted: a "
        f"single run. Bootstrap bands from {LEAST_RUNS} runs on. Runs that stopped at their threshold have no such "
        "return.",
        return_profiles,
        limited=True,
        shows=_shows,
    ),
)
