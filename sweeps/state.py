"""A run as its sweep knows it, and what has become of it. Free of Hydra, to start quickly."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acmr.records import ENDED, FAILED, RUNNING, STOPPED, DamagedError

#: States of a run of a sweep, beside those that it says itself: nobody has taken it up; it is wanted no more.
WAITING, WITHDRAWN = "waiting", "withdrawn"
#: What is stored; that a run is withdrawn follows from a file of its own, which a worker does not write over.
STATES = (WAITING, RUNNING, STOPPED, *ENDED, FAILED)
#: States that a run does not leave within its sweep, unless it is wanted again.
FINAL = (*ENDED, FAILED, WITHDRAWN)
#: Fields of a run that are words, all others are numbers.
_TEXTS = ("name", "cell", "directory", "ended")


@dataclass(frozen=True)
class SweepRun:
    """One run, as the sweep's folder knows it.

    Attributes:
        index: Its place in the plan.
        name: The run's name.
        cell: The paper's name of the experiment, if it has one.
        seed: Its seed.
        directory: Where it lies, from the folder of all runs.
        total_timesteps: Steps that it takes at most.
        threads: Threads that it uses.
        teacher: Index of the run that has to be complete before it starts.
        ended: ``complete`` or ``diverged``, if it was there before the sweep.
    """

    index: int
    name: str
    cell: str | None
    seed: int
    directory: str
    total_timesteps: int
    threads: int
    teacher: int | None
    ended: str | None


@dataclass(frozen=True)
class State:
    """What has become of a run within its sweep.

    Attributes:
        state: ``waiting``, ``running``, ``complete``, ``diverged``, ``failed``, ``stopped`` or ``withdrawn``.
        failures: How often it failed.
        reason: Why it failed or waits, in one line.
    """

    state: str = WAITING
    failures: int = 0
    reason: str = ""


def read_run(path: Path, index: int, run: Any) -> SweepRun:
    """A run of a plan, every field of its type; runs lie within the folder of all runs.

    Args:
        path: The plan's file.
        index: The run's place in it.
        run: What stands there.

    Raises:
        DamagedError: If it is no run.
    """
    with suppress(TypeError, ValueError):
        entry = SweepRun(**run)
        values = {**asdict(entry), "teacher": entry.teacher or 0, "cell": entry.cell or "", "ended": entry.ended or ""}
        typed = all(type(value) is (str if key in _TEXTS else int) for key, value in values.items())
        if typed and min(entry.index, entry.seed, entry.threads, values["teacher"]) >= 0:
            place = Path(entry.directory)
            inside = len(place.parts) > 1 and not place.is_absolute() and not {"..", "\0"} & {*place.parts, *str(place)}
            if inside and (entry.teacher is None or entry.teacher < index):
                return entry
    raise DamagedError(f"{path}: no plan of a sweep (run {index})")
