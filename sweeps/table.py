"""The table of runs, as wide as the terminal that it is printed in, and the lines below it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from itertools import takewhile

from rich.console import Console
from rich.table import Table
from rich.text import Text

from acmr.cells import stops
from acmr.records import COMPLETE, DIVERGED, FAILED, RUNNING, STOPPED
from acmr.text import duration
from sweeps.folder import WAITING
from sweeps.view import BLOCKED, LOST, RunStatus

_COLORS = {COMPLETE: "green", DIVERGED: "magenta", FAILED: "red", RUNNING: "cyan", LOST: "red", BLOCKED: "red"}
#: Names with fewer characters are hard to tell apart; rather than that, the table says less about each run.
_SHORT_NAME = 16
#: As narrow as a name may become; below it the terminal has no room for a table.
_SHORTEST_NAME = 4
#: Columns of a pipe or a file, where nothing has to fit.
_UNLIMITED = 10_000
#: Where a run's name may be parted: before a setting, but not within a number such as 1e-05.
_PARTS, _SEPARATORS = re.compile(r"(?=-[A-Za-z]|  |/)"), "- /"


def make_console() -> Console:
    """Where tables are printed: as wide as the terminal; in a pipe or a file as wide as they are."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _UNLIMITED)


def run_table(views: Sequence[RunStatus], console: Console) -> Table:
    """The runs, one a line; a narrow terminal gets shorter names and no steps, but always state, speed, ETA, return."""
    names = [view.name for view in views]
    columns, gap = _columns(views), 2
    if _room(columns, gap, console) < min(_SHORT_NAME, max(map(len, names), default=0)):
        columns, gap = _few_columns(columns), 1
    mark = "~" if console.options.ascii_only else "…"
    names = shorten(names, max(_room(columns, gap, console), _SHORTEST_NAME), mark)
    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0), header_style="bold")
    for header in ("run", *columns):
        table.add_column(header, justify="left" if header in ("run", "state") else "right", no_wrap=True)
    for view, *cells in zip(views, names, *columns.values(), strict=True):
        # As texts, because a name may hold what looks like rich's markup.
        table.add_row(*map(Text, cells), style=_COLORS.get(view.state))
    return table


def shorten(names: Sequence[str], width: int, mark: str = "…") -> list[str]:
    """Names of at most ``width`` characters, cut in the middle so that they can be told apart, if that is possible."""
    if max(map(len, names), default=0) <= width:
        return list(names)
    short = _fit(list(dict.fromkeys(names)), width, mark)
    return [short[name] for name in names]


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
        lines.append(Text(f"{state}  {who}: {reason}", style=_COLORS.get(state, "")))
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


def _fit(names: Sequence[str], width: int, mark: str) -> dict[str, str]:
    """A short version of each name; they are different names."""
    parts = _what_differs(names, mark)
    # All are cut at the same place: in the middle or, if that makes them all alike, where most can be told apart.
    places = sorted(range(width), key=lambda place: abs(place - width // 2))
    candidates = [{name: _cut(*parts[name], place, width, mark) for name in names} for place in places]
    best = candidates[0]
    if len(set(best.values())) == 1:
        best = max(candidates, key=lambda short: len(set(short.values())))
    alike: dict[str, list[str]] = {}
    for name, short in best.items():
        alike.setdefault(short, []).append(name)
    for group in alike.values():
        # Runs of one kind that differ in one setting begin and end alike; among them other parts matter.
        if 1 < len(group) < len(names):
            best |= _fit(group, width, mark)
    return best


def _what_differs(names: Sequence[str], mark: str) -> dict[str, tuple[str, str]]:
    """For each name how it begins where all do, and the rest, with a mark for the parts that all have."""
    found = {}
    parts = {name: _PARTS.split(name) for name in names}
    common = set.intersection(*map(set, parts.values()))
    for name, own in parts.items():
        start = "".join(takewhile(common.__contains__, own))
        rest = "".join("\0" if part in common else part for part in own).lstrip("\0")
        # A name that the others go on from has nothing of its own.
        found[name] = (start, re.sub("\0+[- /]*", mark, rest)) if rest else ("", name)
    return found


def _cut(start: str, rest: str, place: int, width: int, mark: str) -> str:
    if len(start) + len(rest) <= width:
        return start + rest
    rest = rest.lstrip(_SEPARATORS)
    if len(rest) < width:
        return start[: width - 1 - len(rest)] + mark + rest
    return f"{rest[:place]}{mark}{rest[len(rest) - (width - 1 - place) :]}"
