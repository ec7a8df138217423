"""The page of a search: the best command, the course of it, and what mattered."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import optuna
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from acmr.app.tune.space import Space
from acmr.config import STEPS
from acmr.storage.durable import write_bytes
from analysis.figures.style import COLUMN, apply

PAGE_FILE = "search.md"
#: What a trial keeps: the values of its runs by seed; and at which seed, step, and of how many steps it was cut short.
VALUES, CUT = "values", "cut"
#: Trials in the table, and how many it takes before something can be said of what mattered.
_SHOWN, _FEWEST = 10, 10
#: Ratio of the ends of an axis from which there is no room for numbers between powers of ten.
_WIDE = 50.0
_SERIES, _BEST, _PRUNED = "tab:blue", "tab:orange", "0.6"
_SAID = {
    STEPS: "steps to threshold",
    "final_return": "final return",
    "area": "mean height of the learning curve",
    "evaluation": "mean return of the final policy",
}


def write_page(folder: Path, study: optuna.Study, space: Space, metric: str) -> Path:
    """Writes ``search.md`` and its pictures; returns its path.

    Args:
        folder: Where it goes.
        study: With one complete trial at least.
        space: What was chosen.
        metric: What it was after.
    """
    apply()
    trials = study.get_trials(deepcopy=False)
    importance = _importance(study)
    pictures = {
        "history.png": _history(trials, metric),
        "importance.png": _bars(importance) if importance else None,
        "choices.png": _slices(trials, space, metric),
    }
    for name, figure in pictures.items():
        if figure is not None:
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=200, bbox_inches="tight")
            plt.close(figure)
            write_bytes(folder / name, buffer.getvalue())
    content = _text(folder.name, study, space, metric, importance)
    write_bytes(folder / PAGE_FILE, content.encode())
    return folder / PAGE_FILE


def _text(name: str, study: optuna.Study, space: Space, metric: str, importance: dict[str, float]) -> str:
    trials, best = study.get_trials(deepcopy=False), study.best_trial
    counts = {state: sum(trial.state == state for trial in trials) for state in TrialState}
    better = "less is better" if metric == STEPS else "more is better"
    others = [max(space.seeds) + 1 + index for index in range(max(3, len(space.seeds)))]
    again = space.command(best.params).rpartition(" ")[0]
    worth = f"{_SAID[metric]} {best.value:,.6g}"
    lines = [
        f"# Search {name}",
        "",
        f"The best of {len(trials)} trials is trial {best.number}: {worth}, {space.of_seeds} ({better}).",
        "",
        "```",
        space.command(best.params),
        "```",
        "",
        f"{counts[TrialState.COMPLETE]} trials are complete, {counts[TrialState.PRUNED]} were cut short because they "
        f"were worse than the median of the others at the same point, {counts[TrialState.FAIL]} failed.",
        "",
        "The best of many is lucky, too: what it is worth says a training with seeds that took no part, as in",
        "",
        "```",
        f"{again} seed={','.join(map(str, others))}",
        "```",
        "",
        "## Course",
        "",
        "![Value of each trial, and the best so far](history.png)",
        "",
        f"| trial | {' | '.join(space.choices)} | {' | '.join(f'seed {seed}' for seed in space.seeds)} | mean |",
        f"|---|{'---|' * (len(space.choices) + len(space.seeds) + 1)}",
        *(_row(trial, space) for trial in _sorted(trials, metric)[:_SHOWN]),
        "",
        *_cut_short(trials, space),
        "## What was chosen from",
        "",
        *(f"- {line}" for line in space.lines()),
        "",
        "![Value by what was chosen](choices.png)",
        "",
    ]
    if metric == STEPS:
        lines += ["A run that never met its threshold counts as the most steps that it could have taken.", ""]
    lines += ["## What mattered", ""]
    if not importance:
        return "\n".join([*lines, f"Nothing can be said of that with fewer than {_FEWEST} complete trials.", ""])
    said = ", ".join(f"{key} {share:.0%}" for key, share in importance.items())
    lines += [
        f"Share in what tells the better trials from the others (PED-ANOVA): {said}.",
        "",
        "![Importance of each setting](importance.png)",
        "",
    ]
    return "\n".join(lines)


def _sorted(trials: Sequence[FrozenTrial], metric: str) -> list[FrozenTrial]:
    sign = 1 if metric == STEPS else -1
    return sorted(_complete(trials), key=lambda trial: (sign * _value(trial), trial.number))


def _complete(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    return [trial for trial in trials if trial.state == TrialState.COMPLETE]


def _value(trial: FrozenTrial) -> float:
    """Its mean over the seeds; of one that was cut short that of what it had come to."""
    worth = trial.user_attrs[CUT]["worth"] if CUT in trial.user_attrs else trial.value
    return float("nan") if worth is None else float(worth)


def _row(trial: FrozenTrial, space: Space) -> str:
    chosen = [word.partition("=")[2] for word in space.words(trial.params)]
    values = trial.user_attrs[VALUES]
    cells = [
        str(trial.number),
        *chosen,
        *(f"{values[str(seed)]:,.6g}" for seed in space.seeds),
        f"{_value(trial):,.6g}",
    ]
    return f"| {' | '.join(cells)} |"


def _cut_short(trials: Sequence[FrozenTrial], space: Space) -> list[str]:
    cut = [trial for trial in trials if CUT in trial.user_attrs]
    if not cut:
        return []
    return [
        "## Cut short",
        "",
        f"| trial | {' | '.join(space.choices)} | seed | at step | of | worth there |",
        f"|---|{'---|' * (len(space.choices) + 4)}",
        *(_cut_row(trial, space) for trial in cut),
        "",
        "Their runs can go on from their checkpoints: the command of one, typed by hand, does that.",
        "",
    ]


def _cut_row(trial: FrozenTrial, space: Space) -> str:
    where = trial.user_attrs[CUT]
    chosen = [word.partition("=")[2] for word in space.words(trial.params)]
    numbers = [f"{where[key]:,}" for key in ("step", "of")]
    return f"| {' | '.join([str(trial.number), *chosen, str(where['seed']), *numbers, f'{_value(trial):,.6g}'])} |"


def _importance(study: optuna.Study) -> dict[str, float]:
    if len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))) < _FEWEST:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return optuna.importance.get_param_importances(study)
        except (ValueError, RuntimeError):
            # Of values that are all alike there is none.
            return {}


def _history(trials: Sequence[FrozenTrial], metric: str) -> Figure:
    figure, axes = plt.subplots(figsize=(2 * COLUMN, 2.2))
    complete = _complete(trials)
    cut = [trial for trial in trials if CUT in trial.user_attrs]
    numbers, values = [trial.number for trial in complete], [_value(trial) for trial in complete]
    best = (np.minimum if metric == STEPS else np.maximum).accumulate(values)
    axes.plot(numbers, best, drawstyle="steps-post", color=_BEST, label="best so far")
    axes.plot(numbers, values, "o", markersize=3, color=_SERIES, label="trial")
    if cut:
        axes.plot([t.number for t in cut], [_value(t) for t in cut], "x", ms=3, color=_PRUNED, label="cut short")
    axes.set(xlabel="trial", ylabel=_SAID[metric])
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="best")
    return figure


def _bars(importance: dict[str, float]) -> Figure:
    figure, axes = plt.subplots(figsize=(2 * COLUMN, 0.6 + 0.22 * len(importance)))
    names = list(importance)[::-1]
    axes.barh(names, [importance[name] for name in names], color=_SERIES, height=0.6)
    axes.set(xlabel="share in what tells the better trials from the others", xlim=(0, 1))
    axes.grid(visible=False, axis="y")
    return figure


def _slices(trials: Sequence[FrozenTrial], space: Space, metric: str) -> Figure:
    columns = min(3, len(space.choices))
    rows = -(-len(space.choices) // columns)
    size = (2 * COLUMN, 0.3 + 1.7 * rows)
    figure, grid = plt.subplots(rows, columns, figsize=size, sharey=True, squeeze=False, layout="constrained")
    complete = _complete(trials)
    for axes, (key, choice) in zip(grid.flat, space.choices.items(), strict=False):
        values = [_value(trial) for trial in complete]
        assert isinstance(choice, CategoricalDistribution | FloatDistribution | IntDistribution)
        if isinstance(choice, CategoricalDistribution):
            axes.plot([choice.choices.index(trial.params[key]) for trial in complete], values, "o", ms=3, color=_SERIES)
            axes.set_xticks(range(len(choice.choices)), [str(value) for value in choice.choices])
            axes.set_xlim(-0.5, len(choice.choices) - 0.5)
        else:
            axes.plot([trial.params[key] for trial in complete], values, "o", ms=3, color=_SERIES)
            if choice.log:
                axes.set_xscale("log")
                # The figures' style has no formulas, such as powers of ten are; and there is room for a few numbers.
                few = (1.0,) if choice.high / choice.low > _WIDE else (1.0, 2.0, 5.0)
                axes.xaxis.set_major_locator(LogLocator(subs=few, numticks=8))
                axes.xaxis.set_major_formatter(lambda value, place: f"{value:g}")
                axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(key)
    for axes in grid[:, 0]:
        axes.set_ylabel(_SAID[metric])
    for axes in grid.flat[len(space.choices) :]:
        axes.set_visible(False)
    return figure
