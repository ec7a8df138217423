"""What is printed at the end: steps to threshold by cell, and where the results lie."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from acmr.names import terminal
from acmr.text import UNLIMITED, shorten
from analysis.loading.missing import Missing
from analysis.loading.read_run import UNFINISHED
from analysis.report.tables import footnote, is_censored

#: Missing runs named one by one; more are only counted.
MOST_NAMED = 6
#: Columns of the summary beside the group and how many of its runs reached the threshold.
_NUMBERS = ("mean", "SD", "restricted", "against", "t", "p", "log-rank p")
#: Those that make room for names in a narrow terminal, the least important first, and the least room for names.
_LEAST, _SHORT_NAME, _SHORTEST_NAME = ("t", "SD", "against", "log-rank p", "p", "restricted"), 16, 4
#: Behind the name of a group of which only the fast runs have ended.
_BIASED = " (biased)"
#: Characters between two columns.
_GAP = 2


def print_summary(cells: pd.DataFrame, comparisons: pd.DataFrame, title: str, console: Console | None = None) -> None:
    """Prints one row a group: runs, mean and standard deviation of the steps, and the paper's test.

    Where some run never reached the threshold, the mean of those that did is marked, and the restricted mean of all
    stands beside it.

    Args:
        cells: :func:`analysis.statistics.summaries.cell_table`.
        comparisons: Rows of table 3.
        title: Heading.
        console: Where to; None: the terminal.
    """
    console = console or Console(highlight=False, width=None if sys.stdout.isatty() else UNLIMITED)
    rows = _rows(cells, comparisons)
    shown = _NUMBERS if is_censored(cells) else [header for header in _NUMBERS if header != "restricted"]
    columns = {header: [row[header] for row in rows] for header in ("reached", *shown)}
    names = [row["cell"] for row in rows]
    for header in _LEAST:
        if _room(columns, console) < min(_SHORT_NAME, max(map(len, names), default=0)):
            columns.pop(header, None)
    marks = [_BIASED if biased else "" for biased in cells["biased"]]
    room = max(_room(columns, console) - max(map(len, marks), default=0), _SHORTEST_NAME)
    names = shorten(names, room, "~" if console.options.ascii_only else "…")
    table = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
    table.add_column("cell", no_wrap=True)
    for header in columns:
        table.add_column(header, justify="right", no_wrap=True)
    for name, mark, *values in zip(names, marks, *columns.values(), strict=True):
        # As texts, because a name may hold what looks like rich's markup.
        table.add_row(*map(Text, (name + mark, *values)))
    console.print(Text(terminal(title), style="bold"), soft_wrap=True)
    console.print(table)
    if note := footnote(cells):
        console.print(Text(note), soft_wrap=True)


def _rows(cells: pd.DataFrame, comparisons: pd.DataFrame) -> list[dict[str, str]]:
    tests = {row["index"]: row for row in comparisons.to_dict("records")}
    rows = []
    for row in cells.to_dict("records"):
        numbers = dict.fromkeys(_NUMBERS, "")
        star = "*" if row["reached"] < row["runs"] else ""
        numbers |= {"mean": _steps(row["mean"], star), "SD": _steps(row["std"], star)}
        numbers["restricted"] = _steps(row["restricted_mean"])
        test = tests.get(row["group"])
        if test and test["runs_reference"] and test["runs_index"]:
            numbers |= {
                "against": terminal(test["reference"]),
                "t": _decimal(test["t_score"]),
                "p": _decimal(test["p_value"]),
            }
            numbers["log-rank p"] = _decimal(test["p_log_rank"])
        rows.append({"cell": terminal(row["group"]), "reached": f"{row['reached']} of {row['runs']}", **numbers})
    return rows


def _room(columns: dict[str, list[str]], console: Console) -> int:
    """Characters that the other columns leave for the names."""
    return console.width - sum(_GAP + max(map(len, [header, *cells])) for header, cells in columns.items())


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


def _steps(value: float, mark: str = "") -> str:
    return "–" if pd.isna(value) else f"{value:,.0f}{mark}"


def _decimal(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"
