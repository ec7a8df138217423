"""Writes the tables, captions and figures of two pages from the published runs: ``python -m docs.results``.

The pages are ``docs/results.md`` and ``docs/method.md``.

Each table and caption stands between two comments with its name; what stands there is replaced.
``tests/test_published.py`` holds the page to what this prints. The figures are those of ``make paper-figures``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acmr.cells import CELLS
from acmr.records import EVALUATION_FILE, VELOCITY_COLUMN
from analysis.analyze import Analysis, analyze
from analysis.figures.paper import FIGURES, save
from analysis.figures.style import PALETTES, apply
from analysis.loading.load import load
from analysis.loading.speed import read_speed
from analysis.report.published import side_by_side
from analysis.report.write import figure_data
from docs import named
from docs.markdown import duration, number, p_value, span, steps, table

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "docs" / "results.md", ROOT / "docs" / "method.md")
PUBLISHED = ROOT / "results" / "paper"
IMAGES = ROOT / "docs" / "images" / "results"
#: Figures on the pages.
PICTURES = ("figure_4", "figure_5", "sensitivity", "kaplan_meier", "training_speed")
#: Steps at which the first part of learning is looked at, and episodes before each that count.
_EARLY, _BEFORE = range(25_000, 250_000, 25_000), 20
#: Width of the parts that a whole run is cut into.
_PART = 100_000


def tables() -> dict[str, str]:
    """Each table in Markdown, by its name on its page."""
    found = analyze(load(PUBLISHED))
    makers: dict[str, Callable[[Analysis], str]] = {
        "runs": _runs,
        "cells": _cells,
        "comparisons": _comparisons,
        "replication": _replication,
        "differences": _sensitivity,
        "overview": _overview,
        "paired": _paired,
        "blocks": _blocks,
        "equivalence": _equivalence,
        "cost": _cost,
        "evaluations": _evaluations,
        "early": _early,
        "parts": _parts,
        "speed": _speed,
    }
    data = figure_data(found)
    captions = {spec.name: spec.said(data) for spec in FIGURES if spec.name in PICTURES}
    return {name: make(found) for name, make in makers.items()} | captions | named.tables(found, PUBLISHED)


def filled() -> dict[Path, str]:
    """The pages with their tables as they are now.

    Raises:
        ValueError: If a table has no place on any of them.
    """
    pages = {path: path.read_text(encoding="utf-8") for path in PAGES}
    for name, text in tables().items():
        place = re.compile(rf"<!-- {name} -->\n.*?<!-- /{name} -->", re.DOTALL)
        path = next((path for path, page in pages.items() if place.search(page)), None)
        if path is None:
            raise ValueError(f"no page has a place for the table {name}")
        between = f"<!-- {name} -->\n{text}\n<!-- /{name} -->"
        pages[path] = place.sub(lambda _, between=between: between, pages[path])
    return pages


def draw() -> None:
    """Draws the figures of the page."""
    apply()
    found = analyze(load(PUBLISHED))
    save(named.picture(found), IMAGES, "named", ("png",))
    data = figure_data(found)
    for spec in FIGURES:
        figure = spec.draw(data, PALETTES[0]) if spec.name in PICTURES else None
        if figure is not None:
            save(figure, IMAGES, spec.name, ("png",))


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
                *(f"{told['steps_per_second']:.0f}", duration(told["wall_seconds"])),
            ]
        )
    heads = ["cell", "seed", "steps to threshold", "first of the five", "episodes", "return, last 10", "ended"]
    return table([*heads, "steps per second", "wall time"], rows)


def _cells(found: Analysis) -> str:
    rows = []
    for row in found.cells.to_dict("records"):
        runs, reached = int(row["runs"]), int(row["reached"])
        if runs:
            rows.append([row["group"], f"{reached} of {runs}", steps(row["mean"]), steps(row["std"])])
    return table(["cell", "reached", "mean steps to threshold", "standard deviation"], rows)


def _comparisons(found: Analysis) -> str:
    ours = {(row["reference"], row["index"]): row for row in found.table3.to_dict("records")}
    rows = []
    for printed in side_by_side(found.table3).to_dict("records"):
        pair = (printed["reference"], printed["index"])
        row = ours[pair]
        rows.append(
            [
                f"{pair[1]} − {pair[0]}",
                *(number(printed["t_published"], 2), p_value(printed["p_published"])),
                f"{row['runs_index']} + {row['runs_reference']}",
                *(number(row["t_score"], 2), p_value(row["p_value"]), p_value(row["p_holm"])),
                span(row["difference"], row["difference_low"], row["difference_high"]),
                *(p_value(row["p_permutation"]), p_value(row["p_log_rank"])),
            ]
        )
    heads = ["index − reference", "t, paper", "p, paper", "runs", "t", "p", "p after Holm", "difference (95%)"]
    return table([*heads, "p, permutations", "p, log-rank"], rows)


def _replication(found: Analysis) -> str:
    rows = []
    for row in side_by_side(found.table3).to_dict("records"):
        if pd.notna(row["g_published"]):
            sides = [_interval(row, f"g_{side}", 2) for side in ("published", "ours")]
            expected = _range(row, "g_predicted", 2)
            rows.append([_pair(row), sides[0], expected, sides[1], row["replicates"].replace("-", "–")])
    heads = ["index − reference", "g, paper (95%)", "to be expected here", "g (95%)", "ours lies"]
    return table(heads, rows)


def _sensitivity(found: Analysis) -> str:
    points = found.study.sensitivity
    limits = [name for name in points.columns if name not in ("index", "reference", "runs", "criterion")]
    rows = [
        [_pair(row), row["runs"], row["criterion"], *(row[limit] or "–" for limit in limits)]
        for row in points.to_dict("records")
    ]
    return table(["index − reference", "runs", "criterion", *limits], rows)


def _overview(found: Analysis) -> str:
    rows = []
    for row in found.study.overview.to_dict("records"):
        runs = f"{row['basis']}, {row['runs_index']} + {row['runs_reference']}"
        ahead = f"{row['faster']} of {row['known']}"
        rows.append([_pair(row), runs, ahead, *(steps(row[end]) for end in ("lowest", "asked", "highest"))])
    return table(["index − reference", "runs", "index faster at", "lowest", "at 4900, 5 in a row", "highest"], rows)


def _paired(found: Analysis) -> str:
    rows = []
    for row in found.study.paired.to_dict("records"):
        counts = [f"{row[name]:.0f}" if pd.notna(row[name]) else "–" for name in ("pairs", "shared_episodes", "faster")]
        tests = [p_value(row[name]) for name in ("p_paired", "p_sign_flip", "p_restricted", "p_value")]
        rows.append([_pair(row), *counts, number(row["correlation"], 2), _difference(row, "difference"), *tests])
    heads = ["index − reference", "seeds", "equal episodes", "index faster on", "correlation", "difference (95%)"]
    return table([*heads, "p, paired t", "p, signs", "p, signs, restricted", "p, not paired"], rows)


def _blocks(found: Analysis) -> str:
    rows = [
        [
            *(row["cells"], row["seeds"], number(row["f_score"], 2), p_value(row["p_value"])),
            *(number(row["friedman"], 2), p_value(row["p_permutation"]), number(row["share_of_seeds"], 2)),
        ]
        for row in found.study.blocks.to_dict("records")
    ]
    return table(["cells", "seeds", "F", "p", "Friedman", "p, exact", "share of the seeds"], rows)


def _equivalence(found: Analysis) -> str:
    rows = []
    for row in found.study.equivalence.to_dict("records"):
        ends = (steps(row[end]) for end in ("margin", "least_margin"))
        alike = row["equivalent"] or "–"
        tests = (p_value(row[name]) for name in ("p_tost", "p_tost_paired"))
        rows.append([_pair(row), *ends, _difference(row, "difference"), *tests, alike])
    heads = ["index − reference", "margin", "least margin", "difference (90%)", "p", "p, paired"]
    return table([*heads, "alike"], rows)


def _cost(found: Analysis) -> str:
    rows = []
    for row in found.study.cost.to_dict("records"):
        names = ("own_steps", "teacher_steps", "total_steps", "saved_steps", "students_to_repay")
        rows.append([row["group"], row["runs"], *(steps(row[name]) for name in names)])
    heads = ["cell", "runs", "own steps", "teacher's", "both", "saved against its baseline", "students to repay"]
    return table(heads, rows)


def _pair(row: dict[Hashable, Any]) -> str:
    return f"{row['index']} − {row['reference']}"


def _difference(row: dict[Hashable, Any], name: str) -> str:
    return span(row[name], row["low"], row["high"])


def _interval(row: dict[Hashable, Any], name: str, digits: int) -> str:
    return f"{number(row[name], digits)} ({_range(row, name, digits)})" if pd.notna(row[name]) else "–"


def _range(row: dict[Hashable, Any], name: str, digits: int) -> str:
    low, high = (number(row[f"{name}_{end}"], digits) for end in ("low", "high"))
    return f"{low} to {high}" if low != "–" else "–"


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
    return table(["cell", "seed", "mean return", "its SD", "lowest", "ended in a fall", "m/s"], rows)


def _early(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found):
        own = found.data.episodes[found.data.episodes["run"] == name]
        values = []
        for step in _EARLY:
            before = own[own["global_step"] <= step]["episodic_return"].tail(_BEFORE)
            values.append(f"{before.mean():,.0f}" if own["global_step"].iloc[-1] >= step else "ended")
        rows.append([run["cell"], int(run["seed"]), *values])
    return table(["cell", "seed", *(f"{step:,}" for step in _EARLY)], rows)


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
    return table(["cell", "seed", "steps", "return", "length", "m/s", "full length"], rows)


def _speed(found: Analysis) -> str:
    rows = []
    for name, run in _ordered(found, full=True):
        speed = read_speed(PUBLISHED / name, float(run["learning_starts"]))
        parts = [speed[(speed["step"] > end - _PART) & (speed["step"] <= end)] for end in (100_000, 500_000, 1_000_000)]
        rows.append([run["cell"], int(run["seed"]), *(f"{part['steps_per_second'].median():.0f}" for part in parts)])
    return table(["cell", "seed", "to 100,000", "to 500,000", "to 1,000,000"], rows)


def main() -> None:
    """Fills the pages and draws their figures."""
    for path, page in filled().items():
        path.write_text(page, encoding="utf-8")
        print(f"written: {path.relative_to(ROOT)}")
    draw()


if __name__ == "__main__":
    main()
