"""``episodes.csv`` and ``metrics.csv``: the run's own record, which everything that shows or analyzes it is made of."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from acmr.agent.learner import METRIC_NAMES
from acmr.envs import EnvDescription
from acmr.records import (
    EPISODE_COLUMNS,
    METRIC_COLUMNS,
    VELOCITY_COLUMN,
    DamagedError,
    EpisodeRecord,
    meets_threshold,
)
from acmr.stateful import State
from acmr.storage.csv_log import CsvLog
from acmr.storage.durable import FileDigest, read_checked
from acmr.storage.run_dir import RunDir
from acmr.tracking.observer import Observer

_METRIC_COLUMNS = (*METRIC_COLUMNS, *METRIC_NAMES)


class RunLogs(Observer):
    """``episodes.csv`` and ``metrics.csv``; creating the object touches no disk.

    Args:
        run_dir: Where they lie.
        about: What the environment reports.

    Attributes:
        history: Every episode in ``episodes.csv``.
    """

    def __init__(self, run_dir: RunDir, about: EnvDescription) -> None:
        self._run_dir = run_dir
        velocity = [VELOCITY_COLUMN] if about.has_forward_velocity else []
        self._columns = [*EPISODE_COLUMNS, *velocity, *about.reward_terms]
        self._logs: dict[str, CsvLog] = {}
        self.history: list[EpisodeRecord] = []

    def begin(self) -> None:
        """Begins both files anew."""
        self._open({})

    def state_dict(self) -> State:
        """The size and hash of each file, all of whose rows are on the disk then."""
        return {name: digest.to_json() for name, digest in self.sync().items()}

    def load_state_dict(self, state: State) -> None:
        """Cuts both files back to what they held, and reads the episodes.

        Raises:
            DamagedError: If one does not begin with that; neither has been changed then.
        """
        digests = {name: FileDigest.from_json(state[name]) for name in self._files()}
        # Looked at before either is cut back: a checkpoint that is refused must leave both as they are.
        for name, (path, _) in self._files().items():
            read_checked(path, digests[name])
        self._open(digests)
        self.history = self._read_episodes(self._run_dir.episodes_file)

    def on_episode(self, record: EpisodeRecord) -> None:
        """Appends a row to ``episodes.csv``."""
        self.history.append(record)
        row = record.row()
        self._logs["episodes"].row([record.global_step, *(row[name] for name in self._columns[1:])])

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Appends a row to ``metrics.csv``."""
        self._logs["metrics"].row([step, *(values[name] for name in _METRIC_COLUMNS[1:])])

    def meet(self, threshold: float, consecutive: int) -> bool:
        """Whether the latest ``consecutive`` episodes have all returned at least ``threshold``."""
        latest = [record.episodic_return for record in self.history[-consecutive:]]
        return meets_threshold(latest, threshold, consecutive)

    def sync(self) -> dict[str, FileDigest]:
        """Waits until every row is on the disk, and says what each file holds."""
        return {name: log.sync() for name, log in self._logs.items()}

    def digests(self) -> dict[str, FileDigest]:
        """The same by the files' names, as ``summary.json`` keeps it."""
        paths = {name: path for name, (path, _) in self._files().items()}
        return {paths[name].name: digest for name, digest in self.sync().items()}

    def close(self, summary: Mapping[str, Any] | None = None) -> None:
        """Closes both files; where they are closed already, does nothing."""
        logs, self._logs = self._logs, {}
        for log in logs.values():
            log.close()

    def _files(self) -> dict[str, tuple[Path, Sequence[str]]]:
        return {
            "episodes": (self._run_dir.episodes_file, self._columns),
            "metrics": (self._run_dir.metrics_file, _METRIC_COLUMNS),
        }

    def _open(self, digests: Mapping[str, FileDigest]) -> None:
        self.close()
        for name, (path, columns) in self._files().items():
            self._logs[name] = CsvLog(path, columns, digests.get(name))

    def _read_episodes(self, path: Path) -> list[EpisodeRecord]:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = csv.DictReader(stream)
            if rows.fieldnames != self._columns:
                raise DamagedError(f"{path}: not the columns of this run")
            return [_record(row) for row in rows]


def _record(row: dict[str, str]) -> EpisodeRecord:
    return EpisodeRecord.from_row(int(row.pop("global_step")), {name: float(text) for name, text in row.items()})
