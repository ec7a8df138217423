"""How far a run is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

from acmr.config import PROGRESS_MODES, ConfigError
from acmr.records import EpisodeRecord
from acmr.text import duration

#: Seconds between two drawings of the bar, and between two lines.
BAR_INTERVAL, LINE_INTERVAL = 0.5, 60.0
#: The speed, and the time left that follows from it, is that of the last this many seconds: learning is slower than
#: the random steps before it.
SPEED_WINDOW = 20.0
#: Columns that the bar itself may take; what it stands beside makes room for it, down to nothing.
_SHORTEST_BAR, _LONGEST_BAR = 6, 40


class RunProgress:
    """Counts a run's steps and says now and then how it goes; this one says nothing.

    The clock is read at every ``_stride`` steps, and the stride follows the speed, so that a step costs almost nothing.
    """

    interval = float("inf")

    def __init__(
        self,
        total_timesteps: int,
        threshold: float,
        consecutive: int,
        start_step: int = 0,
        clock: Callable[[], float] = time.monotonic,
        stops: bool = False,
    ) -> None:
        """Starts the clock; see :func:`make_progress`."""
        self._total = total_timesteps
        self._threshold = threshold
        self._consecutive = consecutive
        self._stops = stops
        self._clock = clock
        self._step = start_step
        self._next_look = start_step + 1
        self._started = self._shown_at = clock()
        self._samples: deque[tuple[float, int]] = deque([(self._started, start_step)])
        self._latest: float | None = None
        self._streak = 0
        self._reached: int | None = None

    def update(self, global_step: int) -> None:
        """Notes that ``global_step`` steps have been taken; to be called after each."""
        self._step = global_step
        if global_step >= self._next_look:
            self._look()

    def episode(self, record: EpisodeRecord) -> None:
        """Notes a finished episode."""
        self._latest = record.episodic_return
        self._streak = self._streak + 1 if record.episodic_return >= self._threshold else 0
        if self._streak >= self._consecutive and self._reached is None:
            self._reached = record.global_step

    def close(self) -> None:
        """Says how it stands at the end."""

    @property
    def steps_per_second(self) -> float:
        """Speed over the last :data:`SPEED_WINDOW` seconds; 0 before there is one."""
        (since, first), (until, last) = self._samples[0], self._samples[-1]
        return (last - first) / (until - since) if until > since else 0.0

    @property
    def seconds_left(self) -> float | None:
        """Time to the end at the present speed; None while that is unknown."""
        speed = self.steps_per_second
        return (self._total - self._step) / speed if speed > 0 else None

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

    def _look(self) -> None:
        now = self._clock()
        self._sample(now)
        # Short enough that a run which slows down twentyfold is not lost sight of.
        pause = min(self.interval / 10, 0.2)
        self._next_look = self._step + max(1, int(self.steps_per_second * pause))
        if now - self._shown_at >= self.interval:
            self._shown_at = now
            self._show()

    def _sample(self, now: float) -> None:
        while len(self._samples) > 1 and now - self._samples[1][0] >= SPEED_WINDOW:
            self._samples.popleft()
        if now > self._samples[-1][0]:
            self._samples.append((now, self._step))

    def _show(self) -> None:
        """Shows the state of things."""


class LineProgress(RunProgress):
    """A plain line now and then, and one at the end."""

    interval = LINE_INTERVAL

    def __init__(
        self,
        total_timesteps: int,
        threshold: float,
        consecutive: int,
        title: str = "",
        start_step: int = 0,
        say: Callable[[str], None] = lambda line: print(line, flush=True),
        clock: Callable[[], float] = time.monotonic,
        stops: bool = False,
    ) -> None:
        """Says where the run starts."""
        super().__init__(total_timesteps, threshold, consecutive, start_step, clock, stops)
        self._say = say
        self._prefix = f"{title}: " if title else ""
        ends = ", where it stops" if stops else ""
        self._say(f"{self._prefix}step {start_step:,} of {total_timesteps:,}, threshold {threshold:,g}{ends}")

    def close(self) -> None:
        """Says the last line."""
        now = self._clock()
        self._sample(now)
        took = f"{duration(now - self._started)} in all"
        self._say(f"{self._prefix}{self._counts()}, {took}, {self.standing()}")

    def _show(self) -> None:
        ahead = f", {self.time_left()} left" if self.seconds_left is not None else ""
        self._say(f"{self._prefix}{self._counts()}{ahead}, {self.standing()}")

    def _counts(self) -> str:
        share = 100 * self._step / self._total
        return f"step {self._step:,} of {self._total:,} ({share:.0f}%), {self.steps_per_second:,.0f} steps/s"


class BarProgress(RunProgress):
    """A bar at the bottom of the terminal; what is printed or logged meanwhile appears above it."""

    interval = BAR_INTERVAL

    def __init__(
        self,
        total_timesteps: int,
        threshold: float,
        consecutive: int,
        title: str = "",
        start_step: int = 0,
        stops: bool = False,
    ) -> None:
        """Draws the bar on standard output."""
        super().__init__(total_timesteps, threshold, consecutive, start_step, stops=stops)
        self._title = title
        # rich puts stand-ins in their place that write above the bar.
        terminals = {stream: name for name in ("stdout", "stderr") if (stream := getattr(sys, name)).isatty()}
        self._live = Live(self._line(), console=Console(), auto_refresh=False)
        self._live.start(refresh=True)
        # Left hidden, it would stay so after a kill.
        self._live.console.show_cursor(True)
        # Log handlers made before now hold the terminal itself and would write into the bar.
        self._moved = [(handler, handler.stream) for handler in _stream_handlers() if handler.stream in terminals]
        for handler, stream in self._moved:
            handler.setStream(getattr(sys, terminals[stream]))

    def close(self) -> None:
        """Draws the bar a last time and leaves it on the screen."""
        self._sample(self._clock())
        self._show()
        self._live.stop()
        for handler, stream in self._moved:
            handler.setStream(stream)
        self._moved = []

    def _show(self) -> None:
        self._live.update(self._line(), refresh=True)

    def _line(self) -> Text:
        return Text(self.line(Console().width - 1), no_wrap=True, overflow="ellipsis")

    def line(self, width: int) -> str:
        """The bar, with as much beside it as ``width`` columns take."""
        share = self._step / self._total
        steps = f"{self._step:,}/{self._total:,}"
        speed = f"{self.steps_per_second:,.0f} steps/s"
        end = f"took {duration(self._clock() - self._started)}" if self.is_over else f"ETA {self.time_left()}"
        percent = f"{100 * share:3.0f}%"
        full = [percent, steps, speed, end, self.standing()]
        for words in ([self._title, None, *full], [None, *full], [None, percent, speed, end, self.standing()]):
            room = width - sum(len(word) + 1 for word in words if word)
            if room >= _SHORTEST_BAR:
                return " ".join(word or _bar(share, min(room, _LONGEST_BAR)) for word in words if word != "")
        spare = [[percent, steps, end, self.standing()], [percent, end, self.standing()], [percent, self.standing()]]
        return next((text for words in spare if len(text := " ".join(words)) <= width), percent)


def make_progress(
    mode: str,
    *,
    total_timesteps: int,
    threshold: float,
    consecutive: int = 5,
    title: str = "",
    start_step: int = 0,
    stops: bool = False,
    say: Callable[[str], None] = lambda line: print(line, flush=True),
) -> RunProgress:
    """Shows how far a run is.

    Args:
        mode: ``bar``, ``lines``, ``off``, or ``auto``: a bar where standard output is a terminal, else lines.
        total_timesteps: Steps that the run takes at most.
        threshold: Return to reach.
        consecutive: Episodes running that must reach it.
        title: Name of the run.
        start_step: Steps that had been taken before.
        stops: Whether the run ends once it has reached its threshold.
        say: Takes a line, in the mode ``lines``.

    Raises:
        ConfigError: If there is no such mode.
    """
    if mode not in PROGRESS_MODES:
        raise ConfigError(f"progress={mode}: must be one of {', '.join(PROGRESS_MODES)}")
    if mode == "auto":
        mode = "bar" if sys.stdout.isatty() and os.environ.get("TERM") not in (None, "", "dumb") else "lines"
    if mode == "bar":
        return BarProgress(total_timesteps, threshold, consecutive, title, start_step, stops)
    if mode == "lines":
        return LineProgress(total_timesteps, threshold, consecutive, title, start_step, say, stops=stops)
    return RunProgress(total_timesteps, threshold, consecutive, start_step, stops=stops)


def _bar(share: float, width: int) -> str:
    done = min(width, int(share * width))
    return "\u2501" * done + "\u2500" * (width - done)


def _stream_handlers() -> Iterator[logging.StreamHandler[TextIO]]:
    """Every log handler that writes to a stream, files apart."""
    named = [logger for logger in logging.root.manager.loggerDict.values() if isinstance(logger, logging.Logger)]
    for logger in (logging.root, *named):
        for handler in logger.handlers:
            if isinstance(handler, logging.StreamHandler) and not isinstance(handler, logging.FileHandler):
                yield handler
