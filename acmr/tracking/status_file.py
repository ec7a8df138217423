"""``status.json``: what a run is doing right now, for whoever looks at it from outside.

It is no result and need not survive anything, so it is replaced without waiting for the disk.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from acmr.records import RUNNING, STATUS_FILE, STOPPED, EpisodeRecord
from acmr.storage.hold import LostError
from acmr.storage.json_files import replace_json
from acmr.tracking.observer import Observer

if TYPE_CHECKING:
    # Whoever only reads the file need not load Hydra.
    from acmr.settings.run_spec import RunSpec

#: Seconds between two writings, and steps between two looks at the clock.
INTERVAL, STRIDE = 2.0, 16


class StatusFile(Observer):
    """Keeps ``status.json`` of a run up to date.

    Args:
        spec: The run.
        start_step: Steps that had been taken before.
    """

    title = "status file"

    def __init__(self, spec: RunSpec, start_step: int = 0) -> None:
        self._path = spec.directory / STATUS_FILE
        self._total, self._step = spec.config.most_steps, start_step
        self._latest: float | None = None
        self._started = time.time()
        self._since = (time.monotonic(), start_step)
        self._write(RUNNING, 0.0)

    def on_step(self, step: int) -> None:
        """Notes one more step."""
        self._step = step
        if step % STRIDE == 0:
            now, (before, first) = time.monotonic(), self._since
            if now - before >= INTERVAL:
                self._since = (now, step)
                self._write(RUNNING, (step - first) / (now - before))

    def on_episode(self, record: EpisodeRecord) -> None:
        """Notes the return of the latest episode."""
        self._latest = record.episodic_return

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Says how it ended."""
        self._write(STOPPED if summary is None else str(summary["status"]), 0.0)

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
        # Where that fails nobody can look at it. That is no reason to stop a training; the next durable write is one if
        # the directory is no longer this run's.
        with suppress(OSError, LostError):
            replace_json(self._path, content)
