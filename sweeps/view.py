"""Reads the state of runs from their directories, and estimates the steps they have left; imports nothing heavy."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acmr.cells import plain_name, stops
from acmr.records import (
    COMPLETE,
    DIVERGED,
    FAILED,
    NO_EPISODE,
    RUNNING,
    STATUS_FILE,
    STOPPED,
    SUMMARY_FILE,
    ended_state,
    unended_reason,
)
from acmr.run_folders import changes
from acmr.storage.json_files import read_json
from acmr.storage.processes import is_alive
from sweeps.state import FINAL, WAITING, State, SweepRun

#: A run that says it is running, but whose process is gone or has said nothing for so many seconds.
LOST, SILENCE = "lost", 600.0
BLOCKED = "blocked"
#: What a run says in numbers, and what none of them reaches.
_NUMBERS = (
    *("global_step", "total_timesteps", "steps_per_second", "steps_to_threshold", "final_return", "latest_return"),
    *("updated", "process"),
)
_MOST = 1e15


@dataclass(frozen=True)
class RunStatus:
    """One run as it stands.

    Attributes:
        name: What it is called in tables.
        seed: Its seed.
        directory: Where it lies.
        state: ``waiting``, ``running``, ``complete``, ``diverged``, ``failed``, ``stopped``, ``lost`` or ``blocked``.
        step: Environment steps taken.
        total: Those that it takes at most, 0 if not known; of a complete run those that it took.
        speed: Steps per second: now, or over the whole of a complete run.
        latest: Latest return; of a complete run the mean of its last ones.
        reason: Why it is in this state, if there is something to say.
        met: Steps until a complete run met its threshold, if it did.
    """

    name: str
    seed: int
    directory: Path
    state: str
    step: int = 0
    total: int = 0
    speed: float = 0.0
    latest: float | None = None
    reason: str = ""
    met: int | None = None

    @property
    def seconds_left(self) -> float | None:
        """Time to its end, the latest that it may have, at the present speed."""
        return (self.total - self.step) / self.speed if self.state == RUNNING and self.speed > 0 else None


def read_said(path: Path) -> dict[str, Any] | None:
    """What a run says in a JSON file, without numbers that nobody can compute with; other programs write any.

    Returns:
        None if the file is not there, not readable or no object.
    """
    content = read_json(path)
    return content and {key: value for key, value in content.items() if key not in _NUMBERS or _is_usable(value)}


def _is_usable(value: Any) -> bool:
    # Of the comparisons with NaN none is true.
    return isinstance(value, int | float) and abs(value) < _MOST


def view_run(directory: Path, name: str, seed: int, total: int = 0, state: State | None = None) -> RunStatus:
    """Looks at one run.

    Args:
        directory: Its directory, which need not be there yet.
        name: What it is called.
        seed: Its seed.
        total: Steps that it takes, if that is known.
        state: What the sweep that it belongs to knows of it.
    """
    summary = None if state and state.state == RUNNING else read_said(directory / SUMMARY_FILE)
    ended = None if summary is None else ended_state(summary)
    if summary is not None and ended is not None:
        if changed := changes(directory, read_json(directory / SUMMARY_FILE) or {}):
            what = "; ".join(changed.values())
            reason = f"it ended, but {what}; put back what it wrote, or run it anew with force=true"
            return RunStatus(name, seed, directory, FAILED, total=total, reason=reason)
        step, speed = int(summary.get("global_step") or 0), float(summary.get("steps_per_second") or 0)
        met, latest = summary.get("steps_to_threshold"), summary.get("final_return")
        total = step if ended == COMPLETE else int(summary.get("total_timesteps") or total)
        reason = NO_EPISODE if summary.get("episodes") == 0 else ""
        return RunStatus(name, seed, directory, ended, step, total, speed, latest, reason, met)
    status = read_said(directory / STATUS_FILE) or {}
    alive = status.get("state") == RUNNING and _is_alive(status)
    told, reason = _told(status, state or State(STOPPED), alive)
    if summary is not None and not alive:
        reason = reason or unended_reason(summary)
    return RunStatus(
        name=name,
        seed=seed,
        directory=directory,
        state=told,
        step=int(status.get("global_step") or 0),
        total=int(status.get("total_timesteps") or total),
        speed=float(status.get("steps_per_second") or 0.0) if alive else 0.0,
        latest=status.get("latest_return"),
        reason=reason,
    )


def view_entries(
    output_dir: Path, entries: Sequence[SweepRun], states: Sequence[State], known: Mapping[int, RunStatus] | None = None
) -> list[RunStatus]:
    """Looks at the runs of a sweep; a student whose teacher cannot become complete is ``blocked``.

    Args:
        output_dir: The folder of all runs.
        entries: The runs, teachers before their students.
        states: What the sweep knows of each.
        known: Runs that need no second look, by index.
    """
    views: list[RunStatus] = []
    for entry, told in zip(entries, states, strict=True):
        if known and entry.index in known:
            views.append(known[entry.index])
            continue
        name = f"{entry.cell}  {entry.name}" if entry.cell else entry.name
        state = State(entry.ended) if entry.ended else told
        view = view_run(output_dir / entry.directory, name, entry.seed, entry.total_timesteps, state)
        teacher = views[entry.teacher] if entry.teacher is not None else None
        if teacher is not None and view.state in (WAITING, STOPPED) and teacher.state in (FAILED, DIVERGED, BLOCKED):
            # The sweep's folder says "waiting", since nobody took it up; nobody will.
            reason = f"waits for its teacher {teacher.name} seed {teacher.seed}, which {_verb(teacher.state)}"
            view = RunStatus(view.name, view.seed, view.directory, BLOCKED, total=view.total, reason=reason)
        views.append(view)
    return views


class Lengths:
    """Steps that runs needed to meet their thresholds, those included that came to their end before.

    Full runs tell as much as stopped ones, since a stopped run is the beginning of the full one. Runs are told apart by
    profile and name, both of which are parts of their directories: ``<output_dir>/<profile>/<name>/seed_<n>``.
    """

    def __init__(self) -> None:
        self._needed: dict[tuple[str, str], list[int]] = {}

    def add(self, directory: Path, needed: int) -> None:
        """Notes a complete run, and the steps until it met its threshold or, if it never did, came to its end."""
        self._needed.setdefault(_kind(directory), []).append(needed)

    def like(self, directory: Path) -> list[int]:
        """What runs needed that differ in the seed or in where they stop; for want of them, all of the same profile."""
        profile, name = _kind(directory)
        same = self._needed.get((profile, name))
        return same or [needed for kind, ends in self._needed.items() if kind[0] == profile for needed in ends]

    def expect(self, directory: Path, most: int, step: int = 0) -> float:
        """Steps that a run will have taken at its end.

        Args:
            directory: Where the run lies.
            most: Steps after which it ends at the latest.
            step: Steps that it has taken.
        """
        if not stops(directory.parts[-2]):
            return float(most)
        # Runs that ended sooner are no guide to one that has come further.
        later = [min(needed, most) for needed in self.like(directory) if needed > step]
        return statistics.fmean(later) if later else float(most)


def steps_ahead(views: Sequence[RunStatus]) -> float:
    """Steps that are left to take; a run that stops at its threshold is expected to end where such runs did so far."""
    lengths = Lengths()
    for view in views:
        if view.state == COMPLETE:
            lengths.add(view.directory, view.met or view.step)
    ahead = [view for view in views if view.state not in (*FINAL, BLOCKED)]
    return sum(lengths.expect(view.directory, view.total, view.step) - view.step for view in ahead)


def _kind(directory: Path) -> tuple[str, str]:
    return directory.parts[-3], plain_name(directory.parts[-2])


def _told(status: dict[str, Any], state: State, alive: bool) -> tuple[str, str]:
    if state.state == RUNNING or (state.state == FAILED and not alive):
        return state.state, state.reason
    if alive:
        return RUNNING, ""
    # Where a sweep has more to do with it, what became of an earlier attempt says nothing of how it stands.
    cause = str(status.get("cause") or "")
    if status.get("state") == FAILED and state == State(STOPPED):
        return FAILED, cause
    if status.get("state") == RUNNING:
        return LOST, "its process is gone; the command that started it goes on with it"
    return (STOPPED if status else state.state), state.reason or cause


def _is_alive(status: dict[str, Any]) -> bool:
    recent = time.time() - float(status.get("updated") or 0) < SILENCE
    return recent and is_alive(int(status.get("process") or 0), str(status.get("host")))


def _verb(state: str) -> str:
    return "cannot start" if state == BLOCKED else state
