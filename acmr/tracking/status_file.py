"""``status.json``: what a run is doing right now, for whoever looks at it from outside.

It is no result and need not survive anything, so it is replaced without waiting for the disk.
"""

from __future__ import annotations

import os
import platform
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from acmr.records import RUNNING, STATUS_FILE
from acmr.storage.json_files import read_json, replace_json

#: Seconds between two writings, and steps between two looks at the clock.
INTERVAL, STRIDE = 2.0, 16


class Heartbeat:
    """Keeps ``status.json`` of a run up to date.

    Args:
        folder: The run's directory.
        total_timesteps: Steps that the run takes at most.
        start_step: Steps that had been taken before.
    """

    def __init__(self, folder: Path, total_timesteps: int, start_step: int = 0) -> None:
        self._path = folder / STATUS_FILE
        self._total, self._step = total_timesteps, start_step
        self._latest: float | None = None
        self._started = time.time()
        self._since = (time.monotonic(), start_step)
        self._write(RUNNING, 0.0)

    def step(self, global_step: int) -> None:
        """Notes one more step."""
        self._step = global_step
        if global_step % STRIDE == 0:
            now, (before, first) = time.monotonic(), self._since
            if now - before >= INTERVAL:
                self._since = (now, global_step)
                self._write(RUNNING, (global_step - first) / (now - before))

    def episode(self, episodic_return: float) -> None:
        """Notes the return of the latest episode."""
        self._latest = episodic_return

    def close(self, state: str) -> None:
        """Says how it ended."""
        self._write(state, 0.0)

    def _write(self, state: str, steps_per_second: float) -> None:
        content = {
            "state": state,
            "global_step": self._step,
            "total_timesteps": self._total,
            "steps_per_second": round(steps_per_second, 1),
            "latest_return": self._latest,
            "process": os.getpid(),
            "host": platform.node(),
            "started": round(self._started, 1),
            "updated": round(time.time(), 1),
        }
        # Where that fails nobody can look at it; that is no reason to stop a training.
        with suppress(OSError):
            replace_json(self._path, content)


def read_status(folder: Path) -> dict[str, Any] | None:
    """What a run said last; None if it never did, or not readably."""
    return read_json(folder / STATUS_FILE)
