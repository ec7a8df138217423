"""Writes the tables of ``docs/results.md`` from the published runs: ``python -m docs.results``.

Each table stands between two comments with its name; what stands there is replaced. ``tests/test_published.py`` holds
the page to what this prints.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acmr.cells import CELLS
from acmr.records import EVALUATION_FILE, VELOCITY_COLUMN
from analysis.analyze import Analysis, analyze
from analysis.loading.load import load
from analysis.loading.speed import read_speed
from analysis.report.published import side_by_side

ROOT = Path(__file__).resolve().parent.parent
PAGE, PUBLISHED = ROOT / "docs" / "results.md", ROOT / "results" / "paper"
#: Steps at which the first part of learning is looked at, and episodes before each that count.
_EARLY, _BEFORE = range(25_000, 250_000, 25_000), 20
#: Width of the parts that a whole run is cut into.
_PART = 100_000


def tables() -> dict[str, str]:
    """Each table in Markdown, by its name on the page."""
    found = analyze(load(PUBLISHED))
    makers: dict[str, Callable[[Analysis], str]] = {
        "runs": _runs,
        "cells": _cells,
        "comparisons": _comparisons,
        "evaluations": _evaluations,
        "early": _early,
        "parts": _parts,
        "speed": _speed,
    }
    return {name: make(found) for name, make in makers.items()}


def filled(page: str) -> str:
    """The page with its tables as they are now.

    Raises:
        ValueError: If a table has no place on it.
    """
    for name, table in tables().items():
        place = re.compile(rf"<!-- {name} -->\n.*?<!-- /{name} -->", re.DOTALL)
        if not place.search(page):
            raise ValueError(f"{PAGE.name} has no place for the table {name}")
        page = place.sub(lambda _, name=name, table=table: f"<!-- {name} -->\n{table}\n<!-- /{name} -->", page)
    return page


def _ordered(found: Analysis, full: bool = False) -> Iterable[tuple[str, pd.Series]]:
    """The runs that count, cell by cell and seed by seed."""
    runs = found.measured[found.measured["counted"]].copy()
    runs["place"] = runs["cell"].map(list(CELLS).index)
    for name, run in runs.sort_values(["place", "seed"]).iterrows():
        if not (full and run["cut"]):
            yield str(name), run


def _runs(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found):
        told = found.data.summaries[name]
        met, first = told["steps_to_threshold"], told["steps_to_threshold_first"]
        end = "at its threshold" if run["cut"] and met else f"after {told['global_step']:,} steps"
        rows.append(
            [
                *(run["cell"], int(run["seed"])),
                *(f"{met:,}" if met else "not reached", f"{first:,}" if first else "–"),
                *(f"{told['episodes']:,}", f"{told['final_return']:,.0f}", end),
                *(f"{told['steps_per_second']:.0f}", _duration(told["wall_seconds"])),
            ]
        )
    heads = ["cell", "seed", "steps to threshold", "first of the five", "episodes", "return, last 10", "ended"]
    return _table([*heads, "steps per second", "wall time"], rows)


def _cells(found: Analysis) -> str:
    rows = []
    for row in found.cells.to_dict("records"):
        runs, reached = int(row["runs"]), int(row["reached"])
        if runs:
            rows.append([row["group"], f"{reached} of {runs}", _steps(row["mean"]), _steps(row["std"])])
    return _table(["cell", "reached", "mean steps to threshold", "standard deviation"], rows)


def _comparisons(found: Analysis) -> str:
    ours = {(row["reference"], row["index"]): row for row in found.table3.to_dict("records")}
    rows = []
    for printed in side_by_side(found.table3).to_dict("records"):
        pair = (printed["reference"], printed["index"])
        row = ours[pair]
        low, high = _steps(row["difference_low"]), _steps(row["difference_high"])
        rows.append(
            [
                f"{pair[1]} − {pair[0]}",
                *(_number(printed["t_published"], 2), _p(printed["p_published"])),
                f"{row['runs_reference']} + {row['runs_index']}",
                *(_number(row["t_score"], 2), _p(row["p_value"]), _p(row["p_holm"])),
                f"{_steps(row['difference'])} ({low} to {high})" if low != "–" else "–",
                *(_p(row["p_permutation"]), _p(row["p_log_rank"])),
            ]
        )
    heads = ["index − reference", "t, paper", "p, paper", "runs", "t", "p", "p after Holm", "difference (95%)"]
    return _table([*heads, "p, permutations", "p, log-rank"], rows)


def _evaluations(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found):
        file = PUBLISHED / name / EVALUATION_FILE
        if not file.is_file():
            continue
        told: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        falls = sum(episode["terminated"] for episode in told["each"])
        numbers = [f"{told[key]:,.0f}" for key in ("mean_return", "std_return", "min_return")]
        speed = f"{told['mean_forward_velocity']:.2f}"
        rows.append([run["cell"], int(run["seed"]), *numbers, f"{falls} of {told['episodes']}", speed])
    return _table(["cell", "seed", "mean return", "its SD", "lowest", "ended in a fall", "m/s"], rows)


def _early(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found):
        own = found.data.episodes[found.data.episodes["run"] == name]
        values = []
        for step in _EARLY:
            before = own[own["global_step"] <= step]["episodic_return"].tail(_BEFORE)
            values.append(f"{before.mean():,.0f}" if own["global_step"].iloc[-1] >= step else "ended")
        rows.append([run["cell"], int(run["seed"]), *values])
    return _table(["cell", "seed", *(f"{step:,}" for step in _EARLY)], rows)


def _parts(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found, full=True):
        own = found.data.episodes[found.data.episodes["run"] == name]
        limit = own["episode_length"].max()
        for end in range(2 * _PART, 1_000_001, 2 * _PART):
            part = own[(own["global_step"] > end - 2 * _PART) & (own["global_step"] <= end)]
            returns, lengths = part["episodic_return"].mean(), part["episode_length"].mean()
            whole = float(np.mean(part["episode_length"] == limit))
            speed = part[VELOCITY_COLUMN].mean()
            numbers = [f"{returns:,.0f}", f"{lengths:,.0f}", f"{speed:.2f}", f"{whole:.0%}"]
            rows.append([run["cell"], int(run["seed"]), f"to {end:,}", *numbers])
    return _table(["cell", "seed", "steps", "return", "length", "m/s", "full length"], rows)


def _speed(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found, full=True):
        speed = read_speed(PUBLISHED / name, float(run["learning_starts"]))
        parts = [speed[(speed["step"] > end - _PART) & (speed["step"] <= end)] for end in (100_000, 500_000, 1_000_000)]
        rows.append([run["cell"], int(run["seed"]), *(f"{part['steps_per_second'].median():.0f}" for part in parts)])
    return _table(["cell", "seed", "to 100,000", "to 500,000", "to 1,000,000"], rows)


def _table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def _duration(seconds: float) -> str:
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _steps(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:,.0f}".replace("-", "−")


def _number(value: float, digits: int) -> str:
    return "–" if pd.isna(value) else f"{value:.{digits}f}".replace("-", "−")


def _p(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"


def main() -> None:
    """Fills the page."""
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"written: {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
