"""The tables of ``docs/shifts.md``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from acmr.settings.compose import compose_config
from analysis.statistics.study.aggregates import improvement, iqm, stratified_interval
from analysis.statistics.two_samples import holm, permutation_p
from docs.markdown import number, p_value, span, table
from docs.shifts.pilots import SEEDS, pilots
from docs.shifts.runs import BASELINE, METHODS, PLANNED, ROOT, Benchmark

PAGE = ROOT / "docs" / "shifts.md"


def tables(found: Benchmark) -> dict[str, str]:
    """Each table in Markdown, by its name on the page."""
    return {
        "shifts overall": _overall(found),
        "shifts pairs": _pairs(found),
        "shifts pilots": _pilots(),
        "shifts missing": _missing(found),
    }


def filled(found: Benchmark) -> str:
    """The page with its tables as they are now."""
    page = PAGE.read_text(encoding="utf-8")
    for name, text in tables(found).items():
        between = f"<!-- {name} -->\n{text}\n<!-- /{name} -->"
        place = rf"<!-- {name} -->\n.*?<!-- /{name} -->"
        page = re.sub(place, lambda _, between=between: between, page, flags=re.DOTALL)
    return page


def compared(found: Benchmark) -> pd.DataFrame:
    """Each method of each pair beside the baseline: ``pair, method, p`` (permutations), ``p_holm``, ``faster``."""
    rows = []
    for pair in found.pairs:
        base = found.of(pair, BASELINE)["steps"]
        for method in METHODS:
            own = found.of(pair, method)["steps"]
            if method != BASELINE and len(own) and len(base):
                rows.append([pair, method, permutation_p(base, own), *_interval([-base, -own], improvement)])
    told = pd.DataFrame(rows, columns=["pair", "method", "p", "faster", "faster_low", "faster_high"])
    return told.assign(p_holm=holm(told["p"]))


def scores(found: Benchmark, method: str, name: str) -> list[NDArray[np.float64]]:
    """A measure of a method's runs in each whole pair, on one scale.

    Args:
        found: The runs.
        method: Whose.
        name: ``steps``: as a share of the budget; ``early`` or ``zero_shot``: 0 is what an untrained policy returns, 1
            the threshold.
    """
    told = []
    for pair in found.whole:
        own = found.of(pair, method)
        if name == "steps":
            told.append((own["steps"] / own["budget"]).to_numpy(float))
        else:
            low = found.of(pair, BASELINE)["zero_shot"].mean()
            told.append(((own[name] - low) / (own["threshold"] - low)).to_numpy(float))
    return told


def _overall(found: Benchmark) -> str:
    """Interquartile means and chances of improvement over all pairs of which every method has its runs."""
    if not found.whole:
        return "No pair has ten runs of every method yet."
    rows = []
    for method, called in METHODS.items():
        row: list[object] = [called, f"{sum(map(len, scores(found, method, 'steps')))}"]
        for name in ("steps", "zero_shot", "early"):
            row.append(_told(_interval(scores(found, method, name), iqm), 2))
        for name, sign in (("steps", -1), ("early", 1)):
            both = [[sign * each for each in scores(found, cell, name)] for cell in (BASELINE, method)]
            chance = _interval([*both[0], *both[1]], _mean_improvement)
            row.append("–" if method == BASELINE else _told(chance, 2))
        rows.append(row)
    heads = ["method", "runs", "share of the budget to threshold", "return before learning", "at a tenth"]
    text = table([*heads, "chance of being faster", "of returning more at a tenth"], rows)
    count = f"{len(found.whole)} pair{'s' if len(found.whole) > 1 else ''}"
    return f"{count}: {', '.join(found.whole)}.\n\n{text}"


def _pairs(found: Benchmark) -> str:
    """Every method of every pair."""
    if not found.pairs:
        return "There are no runs yet."
    beside = compared(found).set_index(["pair", "method"])
    rows = []
    for pair in found.pairs:
        for method, called in METHODS.items():
            own = found.of(pair, method)
            if not len(own):
                continue
            row: list[object] = [pair, called, f"{int(own['reached'].sum())} of {len(own)}"]
            row.append(span(*_interval([own["steps"]], iqm)))
            row += [number(float(iqm(own[name])), 0) for name in ("zero_shot", "early", "final")]
            if method == BASELINE:
                row += ["–", "–"]
            else:
                told = beside.loc[(pair, method)]
                row += [_told(tuple(told[["faster", "faster_low", "faster_high"]]), 2), p_value(told["p_holm"])]
            rows.append(row)
    heads = ["pair", "method", "reached", "steps to threshold (95%)", "before learning", "at a tenth", "at the end"]
    return table([*heads, "chance of being faster (95%)", "p, after Holm"], rows)


def _pilots() -> str:
    """The pilots of each body, and the threshold that follows."""
    rows = []
    for body, levels in pilots().items():
        given = compose_config(["profile=shifts", f"env={body}"]).threshold if len(levels) == len(SEEDS) else None
        told = "–" if given is None else f"{given:g}"
        rows.append([body, ", ".join(f"{value:.0f}" for value in levels), told])
    return table(["body", f"level of the pilots {', '.join(map(str, SEEDS))}", "threshold"], rows)


def _missing(found: Benchmark) -> str:
    lines = []
    for pair in found.pairs:
        for method in METHODS:
            if lacking := [seed for seed in PLANNED if seed not in set(found.of(pair, method)["seed"])]:
                lines.append(f"- `{pair}`, {METHODS[method]}: seeds {', '.join(map(str, lacking))}")
    return "\n".join(lines) or "Of the pairs above nothing is missing."


def _mean_improvement(*samples: Any, axis: int = -1) -> Any:
    """Chance of improvement in each pair, and their mean; the first half of the samples is the reference's."""
    half = len(samples) // 2
    return np.mean([improvement(*pair, axis=axis) for pair in zip(samples[:half], samples[half:], strict=True)], axis=0)


def _interval(samples: Sequence[Any], measure: Callable[..., Any]) -> tuple[float, float, float]:
    values = [np.asarray(sample, dtype=float) for sample in samples]
    return float(measure(*values)), *stratified_interval(values, measure)


def _told(value: Sequence[float], digits: int) -> str:
    """A number with its interval, as far as there is one."""
    # A little below nothing is nothing, and no -0.00.
    middle, low, high = (number(round(float(each), digits) + 0.0, digits) for each in value)
    return middle if low == "–" else f"{middle} ({low} to {high})"
