"""Builds what shows a run to people: progress, the status file, and the tracker that ``tracking`` names.

None of it can end a training, and each is told first what the run has recorded so far.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from functools import partial
from heapq import merge
from importlib import import_module
from pathlib import Path

from acmr.config import ConfigError, TrackingConfig
from acmr.records import EPISODES_FILE, METRICS_FILE, EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.text import one_line
from acmr.tracking.observer import Guarded, Observer, Say, Tracker
from acmr.tracking.progress import RunProgress, make_progress
from acmr.tracking.status_file import StatusFile


def make_watchers(spec: RunSpec, start_step: int, say: Say) -> list[Observer]:
    """Builds everything that only shows a run; trackers come last, for some take seconds to close.

    Args:
        spec: The run.
        start_step: Environment steps that have been taken.
        say: Takes a line for each that cannot be made, or stops because of an error.
    """
    watchers = [
        _started(RunProgress.title, partial(make_progress, spec, start_step), say),
        _started(StatusFile.title, partial(StatusFile, spec, start_step), say),
        make_tracker(spec, say),
    ]
    for watcher in watchers:
        replay(watcher, spec.directory)
    return watchers


def make_tracker(spec: RunSpec, say: Say) -> Observer:
    """Starts the tracker of a run.

    Args:
        spec: The run.
        say: Takes one line if the tracker cannot be started, or goes on no more.

    Returns:
        An observer that never raises.
    """
    kind = tracker_class(spec.config.tracking)
    return Observer() if kind is None else _started(kind.title, partial(kind, spec, say), say)


def tracker_class(config: TrackingConfig) -> type[Tracker] | None:
    """The class that ``conf/tracking`` names; None where nothing tracks.

    Raises:
        ConfigError: If there is no such class.
    """
    if config.tracker is None:
        return None
    module, _, name = config.tracker.rpartition(".")
    try:
        kind = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"tracking.tracker={config.tracker}: no such class ({one_line(error)})") from error
    if not (isinstance(kind, type) and issubclass(kind, Tracker)):
        raise ConfigError(f"tracking.tracker={config.tracker}: not a subclass of acmr.tracking.observer.Tracker")
    return kind


def replay(observer: Observer, run_dir: Path) -> None:
    """Tells an observer what a run has recorded so far, in the order in which it happened.

    Args:
        observer: One that has been told nothing yet.
        run_dir: The run's directory.
    """
    rows = [
        ((step, 0, row) for step, row in _rows(run_dir / EPISODES_FILE)),
        ((step, 1, row) for step, row in _rows(run_dir / METRICS_FILE)),
    ]
    # An episode that ends at a step comes before that step's metrics, as in the run itself.
    for step, is_metrics, row in merge(*rows, key=lambda item: item[:2]):
        if is_metrics:
            observer.on_metrics(step, row)
        else:
            observer.on_episode(EpisodeRecord.from_row(step, row))


def _started(title: str, make: Callable[[], Observer], say: Say) -> Observer:
    try:
        return Guarded(make(), say)
    except Exception as error:
        say(f"{title} not started: {one_line(error)}. The run goes on without it.")
        return Observer()


def _rows(file: Path) -> Iterator[tuple[int, dict[str, float]]]:
    """Rows of a CSV file whose every field is a number, by global step; a row that a kill tore is left out."""
    if not file.exists():
        return
    with file.open(newline="") as lines:
        reader = csv.reader(line for line in lines if line.endswith("\n"))
        header = next(reader, [])
        for fields in reader:
            if len(fields) == len(header):
                row = {key: float(text) for key, text in zip(header, fields, strict=True) if text}
                yield int(row.pop("global_step")), row
