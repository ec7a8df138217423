"""One launch of jobs, in a thread of its own: Hydra's launchers return only when all jobs have ended."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from sweeps.folder import SweepFolder
from sweeps.launchers.base import LauncherAdapter

#: Seconds between two questions to a cluster's queue, and how often in a row it has to say that nothing is left.
_QUEUE_INTERVAL, _QUEUE_ANSWERS = 5.0, 2


class Launch:
    """Starts jobs.

    Args:
        adapter: What starts them.
        folder: The sweep's folder.
        runs: Indices of the runs.
        number: Count of launches before.

    Attributes:
        error: What the launcher raised, if it did.
    """

    def __init__(self, adapter: LauncherAdapter, folder: SweepFolder, runs: Sequence[int], number: int) -> None:
        self.error: BaseException | None = None
        self._adapter = adapter
        self._interval, self._asked, self._seen, self._empty = _QUEUE_INTERVAL, time.monotonic(), False, 0
        self._thread = threading.Thread(target=self._call, args=(folder, runs, number), daemon=True)
        self._thread.start()

    @property
    def is_waiting(self) -> bool:
        """Whether the launcher has not come back."""
        return self._thread.is_alive()

    def is_over(self, seconds: float) -> bool:
        """Whether no job is left, after waiting for so many seconds at most."""
        self._thread.join(seconds)
        if not self._adapter.has_queue or (self.error is None and not self.is_waiting):
            return not self.is_waiting
        # The launcher may have given up jobs that still run, or wait for jobs that have gone.
        if time.monotonic() - self._asked >= self._interval:
            self._asked = time.monotonic()
            busy = self._adapter.is_busy()
            self._seen = self._seen or busy or not self.is_waiting
            self._empty = 0 if busy or not self._seen else self._empty + 1
        return self._empty >= _QUEUE_ANSWERS

    def cancel(self) -> None:
        """Ends the jobs."""
        # A job that comes into the queue later sees that the sweep is over, and ends at once.
        self._interval, self._seen = 1.0, True
        self._adapter.cancel()

    def _call(self, folder: SweepFolder, runs: Sequence[int], number: int) -> None:
        try:
            self._adapter.shield()
            self._adapter.launch(folder, runs, number)
        except BaseException as error:
            self.error = error
