"""The table of runs, as wide as the terminal that it is printed in, and the lines below it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from acmr.cells import stops
from acmr.names import terminal
from acmr.records import COMPLETE, DIVERGED, FAILED, RUNNING, STOPPED
from acmr.text import UNLIMITED, duration, shorten
from sweeps.state import WAITING
from sweeps.view import BLOCKED, LOST, RunStatus

#: Lines on why runs are in their states, and rows of runs, that a table has where the terminal is low.
_MOST_REASONS, _FEWEST_ROWS = 3, 3
_COLORS = {COMPLETE: "green", DIVERGED: "magenta", FAILED: "red", RUNNING: "cyan", LOST: "red", BLOCKED: "red"}
#: Names with fewer characters are hard to tell apart; rather than that, the table says less about each run.
_SHORT_NAME = 16
#: As narrow as a name may become, and what then makes room for it, the least important first; never the state.
_SHORTEST_NAME, _LEAST = 4, ("#", "return", "/s", "ETA")


def make_console() -> Console:
    """Where tables are printed: as wide as the terminal; in a pipe or a file as wide as they are."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else UNLIMITED)


def run_table(views: Sequence[RunStatus], console: Console) -> Table:
    """The runs, one a line; a narrow terminal gets shorter names and no steps, but always state, speed, ETA, return."""
    names = [terminal(view.name) for view in views]
    columns, gap = _columns(views), 2
    if _room(columns, gap, console) < min(_SHORT_NAME, max(map(len, names), default=0)):
        columns, gap = _few_columns(columns), 1
    for header in _LEAST:
        if _room(columns, gap, console) < _SHORTEST_NAME:
            columns.pop(header, None)
    mark = "~" if console.options.ascii_only else "…"
    names = shorten(names, max(_room(columns, gap, console), _SHORTEST_NAME), mark)
    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0), header_style="bold")
    for header in ("run", *columns):
        table.add_column(header, justify="left" if header in ("run", "state") else "right", no_wrap=True)
    for view, *cells in zip(views, names, *columns.values(), strict=True):
        # As texts, because a name may hold what looks like rich's markup.
        table.add_row(*map(Text, cells), style=_COLORS.get(view.state))
    return table


def one_screen(views: Sequence[RunStatus], whole: str, console: Console) -> Group:
    """The table, why runs are in their states, and a line on the whole, as far as the terminal is high."""
    line = Text(whole, style="bold")
    why = reasons(views)[:_MOST_REASONS]
    for text in why:
        text.no_wrap, text.overflow = True, "ellipsis"
    lines_below = len(why) + len(line.wrap(console, console.width))
    # Two more for the header and for the line that the cursor is in.
    height = max(console.height - lines_below - 2, _FEWEST_ROWS)
    if len(views) > height:
        # What runs or went wrong first; the rest is in the line below.
        quiet = (COMPLETE, WAITING)
        views = sorted(views, key=lambda view: (view.state in quiet, view.state))[:height]
    return Group(run_table(views, console), *why, line)


def counts(views: Iterable[RunStatus]) -> str:
    """How many runs are in which state."""
    numbers: dict[str, int] = {}
    for view in views:
        numbers[view.state] = numbers.get(view.state, 0) + 1
    order = (COMPLETE, DIVERGED, RUNNING, WAITING, STOPPED, LOST, BLOCKED, FAILED)
    return ", ".join(f"{numbers[state]} {state}" for state in order if state in numbers) or "no runs"


def reasons(views: Iterable[RunStatus]) -> list[Text]:
    """Why runs are in their states, a line for each reason."""
    found: dict[tuple[str, str], list[RunStatus]] = {}
    for view in views:
        if view.reason:
            found.setdefault((view.state, view.reason), []).append(view)
    lines = []
    for (state, reason), alike in found.items():
        who = f"{alike[0].name} seed {alike[0].seed}" if len(alike) == 1 else f"{len(alike)} runs"
        lines.append(Text(terminal(f"{state}  {who}: {reason}"), style=_COLORS.get(state, "")))
    return lines


def _columns(views: Sequence[RunStatus]) -> dict[str, list[str]]:
    """Cells of all columns but the name's, by their headers."""
    shares = [f" {100 * view.step / view.total:3.0f}%" if view.total else "" for view in views]
    # Where a run may stop before, its time left is that to the last step that it may take.
    most = ["<" if view.seconds_left and stops(view.directory.parts[-2]) else "" for view in views]
    return {
        "seed": [str(view.seed) for view in views],
        "state": [view.state for view in views],
        "step": [f"{view.step:,}{share}" if view.step else "-" for view, share in zip(views, shares, strict=True)],
        "steps/s": [f"{view.speed:,.0f}" if view.speed else "-" for view in views],
        "ETA": [f"{sign}{duration(view.seconds_left)}" for view, sign in zip(views, most, strict=True)],
        "return": [f"{view.latest:,.0f}" if view.latest is not None else "-" for view in views],
    }


def _few_columns(columns: dict[str, list[str]]) -> dict[str, list[str]]:
    shorter = {"seed": "#", "state": "state", "steps/s": "/s", "ETA": "ETA", "return": "return"}
    return {short: columns[header] for header, short in shorter.items()}


def _room(columns: dict[str, list[str]], gap: int, console: Console) -> int:
    """Characters that the other columns leave for the names."""
    return console.width - sum(gap + max(map(len, [header, *cells])) for header, cells in columns.items())
