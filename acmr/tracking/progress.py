"""How far a run is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, RenderableColumn
from rich.text import Text

from acmr.config import THRESHOLD
from acmr.records import EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.text import UNLIMITED, duration
from acmr.tracking.observer import Observer, Say

#: Seconds between two drawings of the bar, and between two lines.
BAR_INTERVAL, LINE_INTERVAL = 0.5, 60.0
#: The speed, and the time left that follows from it, is that of the last this many seconds: learning is slower than
#: the random steps before it.
SPEED_WINDOW = 20.0
#: Columns that the bar itself may take; what it stands beside makes room for it.
_SHORTEST_BAR, _LONGEST_BAR = 6, 40
#: What stands in the line, from the widest terminal to the narrowest.
_LAYOUTS = (
    ("name", "bar", "share", "steps", "speed", "end", "standing"),
    ("bar", "share", "steps", "speed", "end", "standing"),
    ("bar", "share", "speed", "end", "standing"),
    ("share", "steps", "end", "standing"),
    ("share", "end", "standing"),
    ("share", "standing"),
    ("share",),
)


class RunProgress(Observer):
    """Counts a run's steps, and shows now and then how it goes; this one shows nothing.

    The clock is read at every so many steps only, and how many that are follows the speed: a step costs almost nothing.

    Args:
        spec: The run.
        start_step: Steps that had been taken before.
        clock: Tells the time in seconds.
        console: Where rich is to draw; None: nowhere, and it measures the speed only.
    """

    title = "progress"
    interval = float("inf")

    def __init__(
        self,
        spec: RunSpec,
        start_step: int = 0,
        clock: Callable[[], float] = time.monotonic,
        console: Console | None = None,
    ) -> None:
        config = spec.config
        self._name = " ".join([*([spec.cell] if spec.cell else []), spec.name, f"seed {config.seed}"])
        self._total, self._threshold, self._consecutive = config.most_steps, config.threshold, config.consecutive
        self._stops = config.stop == THRESHOLD
        self._step, self._next_look = start_step, start_step + 1
        self._clock, self._shown_at = clock, clock()
        self._latest: float | None = None
        self._streak = 0
        self._reached: int | None = None
        self._progress = Progress(
            console=console,
            disable=console is None,
            # No thread of rich's that would draw while the run computes.
            auto_refresh=False,
            speed_estimate_period=SPEED_WINDOW,
            get_time=clock,
        )
        self._progress.add_task("", total=self._total, completed=start_step)
        self._task = self._progress.tasks[0]

    def on_step(self, step: int) -> None:
        """Notes one more step."""
        self._step = step
        if step >= self._next_look:
            self._look()

    def on_episode(self, record: EpisodeRecord) -> None:
        """Notes a finished episode."""
        self._latest = record.episodic_return
        self._streak = self._streak + 1 if record.episodic_return >= self._threshold else 0
        if self._streak >= self._consecutive and self._reached is None:
            self._reached = record.global_step

    @property
    def steps_per_second(self) -> float:
        """Speed over the last :data:`SPEED_WINDOW` seconds; 0 before there is one."""
        return self._task.speed or 0.0

    @property
    def seconds_left(self) -> float | None:
        """Time to the last step at the present speed; None while that is unknown."""
        return self._task.time_remaining

    @property
    def is_over(self) -> bool:
        """Whether the last step has been taken."""
        return self._step >= self._total or (self._stops and self._reached is not None)

    def time_left(self) -> str:
        """The time to the end in words; a run that stops at its threshold may need less."""
        left = self.seconds_left
        return "-" if left is None else f"{'at most ' if self._stops else ''}{duration(left)}"

    def standing(self) -> str:
        """The latest return and how far it is from the threshold."""
        if self._latest is None:
            return "no episode yet"
        latest = f"return {self._latest:,.0f}"
        if self._reached is not None:
            return f"{latest}, {self._threshold:,g} reached at {self._reached:,}"
        if self._streak:
            return f"{latest}, {self._streak}/{self._consecutive} above {self._threshold:,g}"
        return f"{latest}, {self._threshold - self._latest:,.0f} below {self._threshold:,g}"

    def took(self) -> str:
        """How long this process has been at it."""
        return duration(self._task.elapsed)

    def _look(self) -> None:
        self._measure()
        # Short enough that a run which slows down twentyfold is not lost sight of.
        pause = min(self.interval / 10, 0.2)
        self._next_look = self._step + max(1, int(self.steps_per_second * pause))
        now = self._clock()
        if now - self._shown_at >= self.interval:
            self._shown_at = now
            self._show()

    def _measure(self) -> None:
        self._progress.update(self._task.id, completed=self._step)

    def _show(self) -> None:
        """Shows the state of things."""


class LineProgress(RunProgress):
    """A plain line now and then, and one at the end.

    Args:
        spec: The run.
        start_step: Steps that had been taken before.
        clock: Tells the time in seconds.
        say: Takes each line.
    """

    interval = LINE_INTERVAL

    def __init__(
        self,
        spec: RunSpec,
        start_step: int = 0,
        clock: Callable[[], float] = time.monotonic,
        say: Say = lambda line: print(line, flush=True),
    ) -> None:
        super().__init__(spec, start_step, clock)
        self._say = say
        ends = ", where it stops" if self._stops else ""
        self._say(f"{self._name}: step {start_step:,} of {self._total:,}, threshold {self._threshold:,g}{ends}")

    def close(self, summary: object) -> None:
        """Says the last line."""
        self._measure()
        self._say(f"{self._name}: {self._counts()}, {self.took()} in all, {self.standing()}")

    def _show(self) -> None:
        ahead = f", {self.time_left()} left" if self.seconds_left is not None else ""
        self._say(f"{self._name}: {self._counts()}{ahead}, {self.standing()}")

    def _counts(self) -> str:
        share = 100 * self._step / self._total
        return f"step {self._step:,} of {self._total:,} ({share:.0f}%), {self.steps_per_second:,.0f} steps/s"


class BarProgress(RunProgress):
    """A bar at the bottom of the terminal; what is printed or logged meanwhile appears above it.

    Args:
        spec: The run.
        start_step: Steps that had been taken before.
        console: The terminal; None: standard output.
    """

    interval = BAR_INTERVAL

    def __init__(self, spec: RunSpec, start_step: int = 0, console: Console | None = None) -> None:
        # Where it is no terminal but a bar was asked for, nothing has to fit.
        console = console or Console(width=None if sys.stdout.isatty() else UNLIMITED)
        super().__init__(spec, start_step, console=console)
        terminals = {stream: name for name in ("stdout", "stderr") if (stream := getattr(sys, name)).isatty()}
        self._progress.start()
        # Left hidden, it would stay so after a kill.
        self._progress.console.show_cursor(True)
        self._show()
        # rich has put stand-ins in the place of both streams that write above the bar, but log handlers made before now
        # hold the terminal itself.
        self._moved: list[tuple[logging.StreamHandler[TextIO], TextIO]] = []
        for handler in logging.root.handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream in terminals:
                self._moved.append((handler, handler.stream))
                handler.setStream(getattr(sys, terminals[handler.stream]))

    def close(self, summary: object) -> None:
        """Draws the bar a last time and leaves it on the screen."""
        self._measure()
        self._show()
        self._progress.stop()
        for handler, stream in self._moved:
            handler.setStream(stream)

    def _show(self) -> None:
        # Chosen anew each time: a terminal may be made wider or narrower.
        self._progress.columns = self._columns(self._progress.console.width - 1)
        self._progress.refresh()

    def _columns(self, width: int) -> tuple[ProgressColumn, ...]:
        """The bar, with as much beside it as ``width`` columns take."""
        words = {
            "name": self._name,
            "share": f"{100 * self._step / self._total:3.0f}%",
            "steps": f"{self._step:,}/{self._total:,}",
            "speed": f"{self.steps_per_second:,.0f} steps/s",
            "end": f"took {self.took()}" if self.is_over else f"ETA {self.time_left()}",
            "standing": self.standing(),
        }
        for layout in _LAYOUTS:
            room = width - sum(len(words[part]) + 1 for part in layout if part != "bar")
            if room >= (_SHORTEST_BAR if "bar" in layout else -1):
                break
        bar = BarColumn(bar_width=min(room, _LONGEST_BAR))
        return tuple(bar if part == "bar" else RenderableColumn(Text(words[part])) for part in layout)


def make_progress(spec: RunSpec, start_step: int = 0) -> Observer:
    """Shows how far a run is, as its setting ``progress`` says.

    ``bar``, ``lines``, ``off``, or ``auto``: a bar where standard output is a terminal, else lines.
    """
    mode = spec.config.progress
    if mode == "auto":
        mode = "bar" if sys.stdout.isatty() and os.environ.get("TERM") not in (None, "", "dumb") else "lines"
    if mode == "bar":
        return BarProgress(spec, start_step)
    return LineProgress(spec, start_step) if mode == "lines" else Observer()
