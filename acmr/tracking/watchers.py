"""Builds what shows a run to people: progress, the status file, and the tracker that ``tracking`` names.

None of it can end a training, and each is told first what the run has recorded so far.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from heapq import merge
from importlib import import_module
from pathlib import Path

from acmr.config import ConfigError, TrackingConfig
from acmr.foreign import is_there, read_bytes
from acmr.records import EPISODE_COLUMNS, EPISODES_FILE, METRICS_FILE, DamagedError, EpisodeRecord
from acmr.settings.run_spec import RunSpec
from acmr.text import message, one_line
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
    try:
        events = recorded(spec.directory)
    except DamagedError as error:
        say(f"warning: what was recorded so far is not shown ({error})")
        events = []
    for watcher in watchers:
        replay(watcher, events)
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


STEP, LENGTH = EPISODE_COLUMNS[0], EPISODE_COLUMNS[2]
#: What a run has recorded at a step: an episode, or metrics.
Event = tuple[int, EpisodeRecord | dict[str, float]]


def recorded(run_dir: Path) -> list[Event]:
    """What a run has recorded so far, in the order in which it happened.

    Args:
        run_dir: The run's directory.

    Raises:
        DamagedError: If one of its tables holds anything but numbers; a row that a kill tore is left out.
    """
    rows = [
        ((step, 0, row) for step, row in _rows(run_dir / EPISODES_FILE, (STEP, LENGTH))),
        ((step, 1, row) for step, row in _rows(run_dir / METRICS_FILE, (STEP,))),
    ]
    # An episode that ends at a step comes before that step's metrics, as in the run itself.
    ordered = merge(*rows, key=lambda item: item[:2])
    try:
        return [(step, row if kind else EpisodeRecord.from_row(step, row)) for step, kind, row in ordered]
    except KeyError as error:
        raise DamagedError(f"{EPISODES_FILE}: a row without {message(error)}") from None


def replay(observer: Observer, events: Iterable[Event]) -> None:
    """Tells an observer what :func:`recorded` found.

    Args:
        observer: One that has been told nothing yet.
        events: What to tell.
    """
    for step, what in events:
        if isinstance(what, EpisodeRecord):
            observer.on_episode(what)
        else:
            observer.on_metrics(step, what)


def _started(title: str, make: Callable[[], Observer], say: Say) -> Observer:
    try:
        return Guarded(make(), say)
    except Exception as error:
        say(f"{title} not started: {one_line(error)}. The run goes on without it.")
        return Observer()


def _rows(file: Path, needed: Sequence[str]) -> list[tuple[int, dict[str, float]]]:
    """Rows of a CSV file by the first of the columns that count steps; a value that is not there is left out."""
    if not is_there(file):
        return []
    text = read_bytes(file, title=file.name).decode("utf-8", errors="replace")
    reader = csv.reader(line for line in io.StringIO(text, newline="") if line.endswith("\n"))
    found = []
    try:
        header = next(reader, [])
        for fields in reader:
            if len(fields) == len(header):
                row = {key: float(text) for key, text in zip(header, fields, strict=True) if text}
                # What cannot be a whole number of steps, or is not there, raises.
                steps = [int(row[name]) for name in needed]
                found.append((steps[0], {key: value for key, value in row.items() if key != needed[0]}))
    except (ValueError, OverflowError, KeyError, csv.Error) as error:
        raise DamagedError(f"{file.name}: line {reader.line_num} is no row of numbers ({message(error)})") from None
    return found
