"""What is printed at the end: steps to threshold by cell, and where the results lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from analysis.loading.missing import Missing
from analysis.loading.read_run import UNFINISHED

#: Missing runs named one by one; more are only counted.
MOST_NAMED = 6


def print_summary(cells: pd.DataFrame, comparisons: pd.DataFrame, title: str, console: Console | None = None) -> None:
    """Prints one row a group: runs, mean and standard deviation of the steps, and the paper's test.

    Args:
        cells: :func:`analysis.statistics.summaries.cell_table`.
        comparisons: Rows of table 3.
        title: Heading.
        console: Where to; None: the terminal.
    """
    console = console or Console(highlight=False)
    table = Table(box=None, pad_edge=False)
    table.add_column("cell")
    for name in ("reached", "mean", "SD", "against", "t", "p", "log-rank p"):
        table.add_column(name, justify="right")
    tests = {row["index"]: row for row in comparisons.to_dict("records")}
    for row in cells.to_dict("records"):
        numbers = [""] * 4
        test = tests.get(row["group"])
        if test and test["runs_reference"] and test["runs_index"]:
            values = (_decimal(test[name]) for name in ("t_score", "p_value", "p_log_rank"))
            numbers = [test["reference"], *values]
        reached = f"{row['reached']} of {row['runs']}"
        name = f"{row['group']} (biased)" if row["biased"] else row["group"]
        table.add_row(escape(name), reached, _steps(row["mean"]), _steps(row["std"]), *numbers)
    console.print(f"[bold]{escape(title)}[/bold]")
    console.print(table)


def missing_lines(missing: Sequence[Missing], planned: int, command: str) -> list[str]:
    """What is missing, in a few lines: which runs, and the commands that make them."""
    if not missing:
        return []
    lines = [f"missing: {len(missing)} of the {planned} runs of the matrix; all of them: {command}"]
    if len(missing) <= MOST_NAMED:
        return lines + [f"  {run.cell} seed {run.seed} ({run.state}): {run.command}" for run in missing]
    by_cell: dict[str, list[str]] = {}
    for run in missing:
        by_cell.setdefault(run.cell, []).append(str(run.seed) + ("" if run.state == "missing" else f" ({run.state})"))
    cells_of: dict[str, list[str]] = {}
    for cell, seeds in by_cell.items():
        cells_of.setdefault(", ".join(seeds), []).append(cell)
    lines += [f"  {' '.join(cells)}: seed {seeds}" for seeds, cells in cells_of.items()]
    return [*lines, f"  each of them as in: {missing[0].command}"]


def left_out_lines(runs: pd.DataFrame) -> list[str]:
    """Runs that were found but do not count, with the reason; unfinished ones of a cell are among the missing."""
    odd = runs[~runs["counted"] & ((runs["state"] != UNFINISHED) | runs["cell"].isna())]
    return [f"not used: {name} ({run['state']}): {run['reason']}" for name, run in odd.iterrows()]


def result_lines(out: Path, tables: int, figures: int) -> list[str]:
    """Where the results lie."""
    return [f"results: {out}/ ({tables} tables, {figures} figures)", f"report:  {out / 'report.html'}"]


def _steps(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:,.0f}"


def _decimal(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"
