"""An observer in a thread of its own: what it does, and whether it ever comes back, costs the run nothing."""

from __future__ import annotations

import atexit
import queue
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from acmr.records import EpisodeRecord
from acmr.tracking.observer import Observer

#: Rows that may wait for the thread; a run has a few a second.
MOST_ROWS = 10_000
#: Seconds that the thread may take over one row, or the run may wait for room in the queue.
PATIENCE = 30.0
#: Seconds that the observer may take to start and to close before it is given up.
START_WAIT, CLOSE_WAIT = 120.0, 45.0
#: Seconds that the thread has to end once what it waits for has been ended, and for rows that wait where nobody closes.
_LAST_WAIT = 3.0


class Threaded(Observer):
    """Makes an observer in a thread, tells it everything there in the same order, and waits for it only so long.

    What the observer raises is raised here at the next call. It is given up where it takes longer than that over a row:
    then whatever it waits for is ended.

    Args:
        make: Makes the observer.
        end: Ends what the observer may be waiting for; called once, from another thread, and only if it hangs.
        patience: Seconds over a row after which it hangs.
        close_wait: The same of its close.

    Raises:
        Exception: What ``make`` raises.
        TimeoutError: If that takes too long.
    """

    def __init__(
        self,
        make: Callable[[], Observer],
        end: Callable[[], None],
        patience: float = PATIENCE,
        close_wait: float = CLOSE_WAIT,
    ) -> None:
        self._make, self._end, self._patience, self._close_wait = make, end, patience, close_wait
        self._waiting: queue.Queue[tuple[Callable[[Observer], None], bool]] = queue.Queue(MOST_ROWS)
        self._error: BaseException | None = None
        self._busy_since: float | None = None
        self._hangs = False
        self._started = threading.Event()
        # A daemon: a thread that never comes back must not keep the process.
        self._thread = threading.Thread(target=self._work, name="tracker", daemon=True)
        self._thread.start()
        if not self._started.wait(START_WAIT):
            self._give_up()
            raise TimeoutError(f"it has not started within {START_WAIT:g} s")
        self._raise()
        # A program that ends without a close still hands over its rows, before W&B's own last words (registered later,
        # called earlier).
        atexit.register(_hand_over, weakref.ref(self))

    def on_episode(self, record: EpisodeRecord) -> None:
        """Passes it on."""
        self._tell(lambda observer: observer.on_episode(record))

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Passes it on."""
        kept = dict(values)
        self._tell(lambda observer: observer.on_metrics(step, kept))

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Passes it on once all rows are through, and ends what does not answer in time."""
        deadline = time.monotonic() + (0.0 if self._hangs else self._close_wait)
        if not self._hangs:
            with suppress(queue.Full):
                self._waiting.put((lambda observer: observer.close(summary), True), timeout=self._close_wait)
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._thread.is_alive():
            told = self._hangs
            self._give_up()
            if not told:
                raise TimeoutError(f"it did not end within {self._close_wait:g} s, and was ended")
            return
        self._raise()

    def hand_over(self) -> None:
        """Waits a moment for what was told to be through, unless it was given up; nothing is raised."""
        if self._hangs:
            return
        through = threading.Event()
        with suppress(queue.Full):
            self._waiting.put_nowait((lambda observer: through.set(), False))
        deadline = time.monotonic() + _LAST_WAIT
        while self._thread.is_alive() and not through.is_set() and time.monotonic() < deadline:
            through.wait(0.02)

    def _tell(self, what: Callable[[Observer], None]) -> None:
        self._raise()
        since = self._busy_since
        if since is not None and time.monotonic() - since > self._patience:
            self._hangs = True
            raise TimeoutError(f"it has not answered for {self._patience:g} s")
        try:
            self._waiting.put((what, False), timeout=self._patience)
        except queue.Full:
            self._hangs = True
            raise TimeoutError(f"{MOST_ROWS:,} rows wait for it, and none was taken for {self._patience:g} s") from None

    def _give_up(self) -> None:
        self._hangs = True
        with suppress(Exception):
            self._end()
        with suppress(queue.Full):
            self._waiting.put_nowait((lambda observer: None, True))
        self._thread.join(_LAST_WAIT)

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _work(self) -> None:
        try:
            observer = self._make()
        except BaseException as error:
            self._error = error
            return
        finally:
            self._started.set()
        failed = is_last = False
        # Once it was given up, nothing more is asked of it.
        while not (is_last or self._hangs):
            what, is_last = self._waiting.get()
            if failed and not is_last:
                continue
            self._busy_since = time.monotonic()
            try:
                what(observer)
            except BaseException as error:
                self._error, failed = error, True
            self._busy_since = None


def _hand_over(reference: weakref.ref[Threaded]) -> None:
    threaded = reference()
    if threaded is not None:
        threaded.hand_over()
