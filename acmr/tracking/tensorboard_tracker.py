"""Writes TensorBoard event files beside a run: ``tensorboard --logdir runs`` shows them.

They are no result and can always be written anew from the run's own files (:mod:`acmr.tracking.mirror`).
"""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from acmr.records import EVENTS_FOLDER, EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.storage.durable import remove_tree
from acmr.tracking.observer import Say, Tracker


class TensorBoardTracker(Tracker):
    """Writes each row as one event, and every event to the file at once: a kill loses none.

    Args:
        spec: The run; events go into the folder ``tensorboard`` of its directory. What an earlier process wrote there
            is removed: it may hold rows of steps that are now taken again.
        say: Is not used.

    Raises:
        ModuleNotFoundError: If TensorBoard is not installed.
        OSError: If the folder cannot be written.
    """

    title = "TensorBoard"

    def __init__(self, spec: RunSpec, say: Say) -> None:
        try:
            # TensorBoard's own writer of records rather than torch's SummaryWriter, which writes in a thread: a kill
            # loses what waits there, and a full disk prints the thread's traceback.
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.summary.writer.record_writer import RecordWriter
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("it is not installed; type pip install tensorboard") from error
        self._event, self._summary = Event, Summary
        folder = spec.directory / EVENTS_FOLDER
        with suppress(OSError):
            remove_tree(folder)
        folder.mkdir()
        # TensorBoard finds files by the beginning of this name, and orders those of one run by the number in it.
        file = folder / f"events.out.tfevents.{time.time():.0f}.{platform.node()}"
        self._writer = RecordWriter(file.open("wb", buffering=0))
        self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def on_episode(self, record: EpisodeRecord) -> None:
        """Writes the columns of ``episodes.csv``."""
        self._scalars(record.global_step, record.row())

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Writes the columns of ``metrics.csv``."""
        self._scalars(step, values)

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Closes the file."""
        self._writer.close()

    def _scalars(self, step: int, values: Mapping[str, float]) -> None:
        scalars = [self._summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._write(self._event(wall_time=time.time(), step=step, summary=self._summary(value=scalars)))

    def _write(self, event: Any) -> None:
        self._writer.write(event.SerializeToString())
