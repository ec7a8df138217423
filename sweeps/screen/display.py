"""The output of a sweep: its plan, a live table in a terminal, plain lines elsewhere, and at the end what failed."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Group
from rich.live import Live

from acmr.cells import stops
from acmr.command import PROGRAM
from acmr.names import terminal
from acmr.records import COMPLETE, DIVERGED, ENDED, FAILED, RUNNING, STOPPED
from acmr.text import duration, size
from sweeps.estimate import Estimate
from sweeps.folder import OUTPUT_FILE, SweepFolder
from sweeps.plan import Plan, PlannedRun
from sweeps.screen.table import counts, make_console, one_screen
from sweeps.state import FINAL, SweepRun
from sweeps.view import BLOCKED, LOST, RunStatus, steps_ahead, view_entries

#: Seconds between two plain lines on how far everything is.
LINE_INTERVAL = 60.0
#: Seconds after which the average speed since the start says more than the present one.
_SETTLED = 30.0


class Display:
    """Follows the runs of a sweep.

    Args:
        folder: The sweep's folder.
        entries: Its runs.
        output_dir: The folder of all runs, as the user typed it.
    """

    def __init__(self, folder: SweepFolder, entries: Sequence[SweepRun], output_dir: Path) -> None:
        self._folder, self._entries, self._output_dir = folder, entries, output_dir
        self.views: list[RunStatus] = []
        self._told: dict[int, tuple[str, str]] = {}
        self._started = time.monotonic()
        self._said_at = self._looked_at = self._started
        # Reading the files of many runs takes time from the trainings.
        self._interval = 1.0 if len(entries) <= 100 else 5.0
        self._console = make_console()
        live = sys.stdout.isatty() and os.environ.get("TERM") not in (None, "", "dumb")
        self.refresh()
        self._first_steps = self._steps()
        self._live = Live(self._drawing(), console=self._console, auto_refresh=False) if live else None
        if self._live is not None:
            self._live.start(refresh=True)
            # Left hidden, it would stay so after a kill.
            self._console.show_cursor(True)

    def refresh(self) -> None:
        """Looks at all runs that have not ended."""
        self._looked_at = time.monotonic()
        known = {index: view for index, view in enumerate(self.views) if view.state in ENDED}
        if len(known) < len(self._entries):
            states = [self._folder.state(entry.index) for entry in self._entries]
            self.views = view_entries(self._output_dir, self._entries, states, known)

    def tick(self) -> None:
        """Looks, if that is due, and shows what is new."""
        if time.monotonic() - self._looked_at < self._interval:
            return
        self.refresh()
        if self._live is not None:
            self._live.update(self._drawing(), refresh=True)
            return
        for index, view in enumerate(self.views):
            if self._told.get(index) != (view.state, view.reason):
                self._tell(index, view)
        if time.monotonic() - self._said_at >= LINE_INTERVAL:
            self._said_at = time.monotonic()
            self.say(self.line())

    def say(self, text: str) -> None:
        """Prints a line, above the table if there is one."""
        self._console.print(terminal(text), markup=False, soft_wrap=True)
        sys.stdout.flush()

    def close(self) -> None:
        """Shows all a last time."""
        self._interval = 0.0
        self.tick()
        if self._live is not None:
            self._live.stop()

    def line(self) -> str:
        """How far the whole is."""
        speed = self._speed()
        ahead = steps_ahead(self.views)
        eta = f"; {speed:,.0f} steps/s, {duration(ahead / speed)} left" if speed and ahead else ""
        return f"{counts(self.views)}{eta}"

    def tell_failures(self) -> int:
        """Prints what went wrong, why, and where the log is.

        Returns:
            How many runs failed or cannot start.
        """
        for view in self.views:
            if view.state in (FAILED, BLOCKED, DIVERGED, LOST):
                self.say(_sentence(view, view.reason))
                log = view.directory / OUTPUT_FILE
                if log.exists():
                    self.say(f"  log: {log}")
        return sum(view.state in (FAILED, BLOCKED) for view in self.views)

    def _tell(self, index: int, view: RunStatus) -> None:
        before, self._told[index] = self._told.get(index), (view.state, view.reason)
        if before is None and view.state != RUNNING:
            return
        if view.state in (RUNNING, *FINAL, STOPPED, BLOCKED):
            detail = view.reason
            if view.state == COMPLETE and view.latest is not None:
                detail = f"return {view.latest:,.0f}, {view.speed:,.0f} steps/s"
            self.say(_sentence(view, detail))

    def _steps(self) -> int:
        return sum(view.step for view in self.views)

    def _speed(self) -> float:
        now = sum(view.speed for view in self.views if view.state == RUNNING)
        elapsed = time.monotonic() - self._started
        return (self._steps() - self._first_steps) / elapsed if elapsed > _SETTLED else now

    def _drawing(self) -> Group:
        return one_screen(self.views, self.line(), self._console)


def print_plan(plan: Plan, needs: Estimate, workers: int, output_dir: Path) -> None:
    """Prints what would be done."""
    console = make_console()
    stage_of = {run.index: number for number, stage in enumerate(plan.stages, start=1) for run in stage}
    for run in plan.runs:
        cell = f"{run.spec.cell}  " if run.spec.cell else ""
        state = run.ended or f"stage {stage_of[run.index]}"
        console.print(f"{state:<10} {cell}{run.spec.directory}{_remark(run)}", markup=False, soft_wrap=True)
    stages = ", then ".join(str(len(stage)) for stage in plan.stages)
    done = len(plan.runs) - len(plan.missing)
    console.print(
        f"{_number(len(plan.runs))}: {done} done, {len(plan.missing)} missing{f' ({stages})' if stages else ''}"
    )
    if not plan.missing:
        return
    source = f"as fast as {_number(needs.measured_on)} that ended in {output_dir}"
    time_needed = f"about {duration(needs.seconds)}, {source}" if needs.seconds else "not known until a run is complete"
    console.print(f"workers: {workers}")
    console.print(f"time: {time_needed}", soft_wrap=True)
    if needs.stops_like is not None:
        guide = f"as {_number(needs.stops_like)} did" if needs.stops_like else "as late as they may: none has ended yet"
        console.print(f"stop: the time counts on runs that meet their threshold {guide}", soft_wrap=True)
    console.print(f"memory: {_bytes(needs.memory)} at most, once the replay memories are full", soft_wrap=True)
    console.print(f"disk: {_bytes(needs.disk)} at most; {_bytes(needs.kept)} stay", soft_wrap=True)


def command_line() -> str:
    """The command line as it was typed, not as Hydra got it; in a notebook Python's own is that of the kernel."""
    # A subcommand has the name of its module in place of the program's.
    if PROGRAM in (Path(sys.argv[0]).stem, *(Path(word).name for word in sys.orig_argv[1:2])):
        own = next(place for place, word in enumerate(sys.orig_argv) if Path(word).stem == PROGRAM)
        return shlex.join([PROGRAM, *sys.orig_argv[own + 1 :]])
    return shlex.join(["python", *(["run.py", *sys.argv[1:]] if "ipykernel" in sys.modules else sys.orig_argv[1:])])


def _sentence(view: RunStatus, detail: str) -> str:
    return terminal(f"{view.state}  {view.name} seed {view.seed}{f': {detail}' if detail else ''}")


def _remark(run: PlannedRun) -> str:
    if run.stands_for:
        # A run that no other stands for is not full because of this one.
        full = "in full, " if any(stops(name) for name in run.stands_for) else ""
        why = f"{full}and there" if run.ended else f"{full}since it teaches"
        if not all(name.startswith(f"{run.spec.config.env.name}-") for name in run.stands_for):
            why = "the same body"
        return f"  ({why}: stands for {', '.join(run.stands_for)})"
    return "  (added: the teacher of runs below)" if run.implied else ""


def _number(count: int) -> str:
    return f"{count} run{'' if count == 1 else 's'}"


def _bytes(count: float | None) -> str:
    return "an amount not known" if count is None else size(count)
