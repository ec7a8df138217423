"""Signals that ask a run to stop, and how a process says that it was stopped."""

from __future__ import annotations

import signal
import time
from contextlib import AbstractContextManager, suppress
from types import FrameType, TracebackType
from typing import Any

#: A second Ctrl-C this many seconds after the first does not wait for the end of the step.
_PATIENCE = 1.0
_CAUGHT = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Stopped(SystemExit):
    """The run was asked to stop and has; the exit code is 143 after SIGTERM, 130 after Ctrl-C, 129 after SIGHUP."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)


class StopSignals(AbstractContextManager["StopSignals"]):
    """Notes SIGTERM, SIGHUP and Ctrl-C instead of dying of them, within a ``with`` block of the main thread.

    Attributes:
        received: The signal that asked to stop, if one did.
        since: When, by ``time.monotonic()``.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self.since = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        for number in _CAUGHT:
            # Who starts a program in the background may have chosen that these do not reach it.
            if number != signal.SIGTERM and signal.getsignal(number) == signal.SIG_IGN:
                continue
            # Elsewhere than in the main thread signals cannot be caught; whoever started the thread does.
            with suppress(ValueError):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def release(self) -> None:
        """Lets signals do what they did before: there is no step any more whose end would heed them."""
        before, self._before = self._before, {}
        for number, handler in before.items():
            signal.signal(number, handler)

    @property
    def name(self) -> str:
        """What the user knows the signal as."""
        return "Ctrl-C" if self.received == signal.SIGINT else signal.Signals(self.received or 0).name

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is None:
            self.received, self.since = number, time.monotonic()
        elif number == signal.SIGINT and time.monotonic() - self.since > _PATIENCE:
            raise KeyboardInterrupt
