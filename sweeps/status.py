"""Prints the state of all runs: ``python -m sweeps.status [OUTPUT_DIR]``. Exit code 1 if one has failed."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.live import Live

from acmr.command import command, typed
from acmr.foreign import is_file
from acmr.names import terminal
from acmr.records import CONFIG_FILE, FAILED, RUNNING, SEED_FOLDER, STATUS_FILE
from acmr.run_folders import RunFolder, run_folders
from acmr.text import duration
from sweeps.folder import SweepFolder, all_folders
from sweeps.screen.table import counts, make_console, one_screen, reasons, run_table
from sweeps.state import WAITING, State, SweepRun
from sweeps.view import BLOCKED, LOST, RunStatus, steps_ahead, view_entries, view_run

#: States for which somebody has to do something.
_BAD = (FAILED, LOST, BLOCKED)
#: Seconds between two looks, at most.
_LONGEST = 86_400


def all_runs(output_dir: Path, folders: Iterable[RunFolder]) -> list[RunStatus]:
    """Every run below a folder, and those that its latest sweep has not begun yet.

    Args:
        output_dir: The folder, as an absolute path: what a run is called follows from where it lies.
        folders: What :func:`~acmr.run_folders.run_folders` finds there.
    """
    views = {view.directory: view for view in _planned(output_dir)}
    for folder in folders:
        if _is_ours(folder) and not views.keys() & {folder.path, *folder.others}:
            views[folder.path] = view_run(folder.path, _name(output_dir, folder.path), _seed(folder.path))
    return sorted(views.values(), key=lambda view: (view.directory.parts[:-1], view.seed))


def _planned(output_dir: Path) -> list[RunStatus]:
    folders = all_folders(output_dir, lambda line: print(terminal(line), file=sys.stderr))
    known: dict[Path, RunStatus] = {}
    for folder in folders:
        entries = folder.entries()
        alive = folder.is_alive()
        for view in view_entries(output_dir, entries, [_state(folder, entry, alive) for entry in entries]):
            # What an older sweep never began is forgotten, what it saw fail is not.
            if folder is folders[-1] or alive or view.state != WAITING:
                known[view.directory] = replace(view, name=_name(output_dir, view.directory))
    return list(known.values())


def _state(folder: SweepFolder, entry: SweepRun, alive: bool) -> State:
    state = folder.state(entry.index)
    if state.state == RUNNING and not alive:
        return State()
    return state


def _is_ours(folder: RunFolder) -> bool:
    """Whether a folder was written by a run: episodes alone may come from anywhere."""
    return any(is_file(folder.path / name) for name in (CONFIG_FILE, STATUS_FILE))


def _name(output_dir: Path, directory: Path) -> str:
    """Where a run lies, without its seed: ``paper/humanoid-none``."""
    return directory.relative_to(output_dir).parent.as_posix()


def _seed(directory: Path) -> int:
    match = SEED_FOLDER.fullmatch(directory.name)
    return int(match[1]) if match else 0


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog=typed("status"), description=__doc__)
    parser.add_argument("output_dir", nargs="?", type=Path, default=Path("runs"), help="folder of all runs (runs)")
    watching = "in a terminal: look again every SECONDS (2), until no run is under way or Ctrl-C"
    parser.add_argument("--watch", nargs="?", type=_interval, const=2.0, metavar="SECONDS", help=watching)
    given = parser.parse_args(arguments)
    if not given.output_dir.is_dir():
        print(f"{given.output_dir}: no runs there yet; {typed()} trains one")
        return 0
    output_dir, console = given.output_dir.absolute(), make_console()
    if given.watch is not None:
        if not console.is_terminal:
            parser.error("--watch: needs a terminal; leave it out")
        _watch(output_dir, given.watch, console)
    folders = run_folders(output_dir)
    views = all_runs(output_dir, folders)
    console.print(run_table(views, console))
    for line in reasons(views):
        console.print(line, soft_wrap=True)
    for folder in folders:
        if folder.problem:
            console.print(terminal(f"{folder.path}: {folder.problem}"), markup=False, soft_wrap=True)
    console.print(_whole(views), style="bold", markup=False, soft_wrap=True)
    return 1 if any(view.state in _BAD for view in views) else 0


def _watch(output_dir: Path, interval: float, console: Console) -> None:
    """Shows one screen of all runs, again and again."""
    with suppress(KeyboardInterrupt), Live(console=console, auto_refresh=False, transient=True) as live:
        console.show_cursor(True)  # left hidden, it would stay so after a kill
        while True:
            views = all_runs(output_dir, run_folders(output_dir))
            live.update(one_screen(views, _whole(views), console), refresh=True)
            if not any(view.state in (RUNNING, WAITING) for view in views):
                break
            time.sleep(interval)


def _whole(views: Sequence[RunStatus]) -> str:
    speed = sum(view.speed for view in views if view.state == RUNNING)
    eta = f"; {speed:,.0f} steps/s, {duration(steps_ahead(views) / speed)} left" if speed else ""
    return f"{len(views)} runs: {counts(views)}{eta}"


def _interval(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.1 <= seconds <= _LONGEST:
        raise argparse.ArgumentTypeError(f"{text}: seconds from 0.1 to {_LONGEST:,} are needed, as in --watch 2")
    return seconds


if __name__ == "__main__":
    sys.exit(main())
