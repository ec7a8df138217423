"""Estimates the time, disk and memory of a sweep: from finished runs where there are some, else computed or unknown."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acmr.cells import plain_name
from acmr.config import THRESHOLD, ExperimentConfig
from acmr.envs import describe
from acmr.records import COMPLETE, SUMMARY_FILE, ended_state
from acmr.run_folders import run_folders
from sweeps.plan import Plan, PlannedRun
from sweeps.view import Lengths, read_said

#: Memory of a training beside its replay buffer: Python, torch and MuJoCo (measured, 64-bit Linux, CPU).
_BASE_MEMORY = 450e6
#: Disk of a finished run where none of its kind is there to look at: results, networks and mirror, an upper limit.
_RESULT_DISK = 20e6
#: Profile and name of runs that differ in the seed or in where they stop only: they are equally fast.
_Kind = tuple[str, str]


@dataclass(frozen=True)
class Estimate:
    """What the missing runs need.

    Attributes:
        seconds: Time to the end of the last run; None: no finished run says how fast they are.
        measured_on: How many finished runs the time comes from.
        memory: Most memory at a time, in bytes; None: not known.
        disk: Most disk at a time, in bytes; None: not known.
        kept: Disk that stays, in bytes.
        stops_like: How many finished runs say when those that stop at their threshold do; None: no run stops.
    """

    seconds: float | None
    measured_on: int
    memory: float | None
    disk: float | None
    kept: float
    stops_like: int | None = None


def estimate(plan: Plan, output_dir: Path, workers: int) -> Estimate:
    """Works out what the missing runs of a plan need when ``workers`` are trained at a time."""
    finished = _finished(output_dir)
    speeds, lengths = _speeds(finished), _lengths(finished)
    models = {run.index: _models(run, speeds) for run in plan.missing}
    steps = {run.index: lengths.expect(run.spec.directory, run.spec.config.most_steps) for run in plan.missing}
    seconds = {
        run.index: _seconds(steps[run.index], [speeds[name] for name in models[run.index]]) for run in plan.missing
    }
    stopping = [run for run in plan.missing if run.spec.config.stop == THRESHOLD]
    buffers = sorted((_buffer_bytes(run.spec.config) for run in plan.missing), key=lambda size: -(size or 0))
    largest = buffers[:workers]
    known = [size for size in largest if size is not None]
    complete = len(known) == len(largest)
    kept = sum(_kept_bytes(run) for run in plan.missing)
    return Estimate(
        seconds=_makespan(plan, {index: time for index, time in seconds.items() if time is not None}, workers)
        if all(time is not None for time in seconds.values())
        else None,
        measured_on=sum(len(speeds[name]) for name in set[_Kind]().union(*models.values())),
        memory=sum(known) + _BASE_MEMORY * len(largest) if complete else None,
        disk=sum(known) * 1.1 + kept if complete else None,
        kept=kept,
        stops_like=max(len(lengths.like(run.spec.directory)) for run in stopping) if stopping else None,
    )


def _finished(output_dir: Path) -> dict[Path, dict[str, Any]]:
    """Summaries of complete runs, by directory."""
    found: dict[Path, dict[str, Any]] = {}
    for folder in run_folders(output_dir.absolute()) if output_dir.is_dir() else ():
        summary = read_said(folder.path / SUMMARY_FILE)
        if summary is not None and ended_state(summary) == COMPLETE:
            found[folder.path] = summary
    return found


def _speeds(finished: Mapping[Path, Mapping[str, Any]]) -> dict[_Kind, list[float]]:
    """Steps per second of finished runs, by profile and name."""
    found: dict[_Kind, list[float]] = {}
    for directory, summary in finished.items():
        if speed := summary.get("steps_per_second"):
            kind = (directory.parts[-3], plain_name(directory.parts[-2]))
            found.setdefault(kind, []).append(float(speed))
    return found


def _lengths(finished: Mapping[Path, Mapping[str, Any]]) -> Lengths:
    found = Lengths()
    for directory, summary in finished.items():
        if needed := summary.get("steps_to_threshold") or summary.get("global_step"):
            found.add(directory, int(needed))
    return found


def _models(run: PlannedRun, speeds: dict[_Kind, list[float]]) -> list[_Kind]:
    """Whose speed a run is expected to have: its own with other seeds, else for want of better its whole profile."""
    profile, same = run.spec.config.profile, (run.spec.config.profile, plain_name(run.spec.name))
    return [same] if same in speeds else [kind for kind in speeds if kind[0] == profile]


def _seconds(steps: float, speeds: list[list[float]]) -> float | None:
    values = [speed for of_kind in speeds for speed in of_kind]
    return steps / statistics.fmean(values) if values else None


def _makespan(plan: Plan, seconds: dict[int, float], workers: int) -> float:
    """Time to the end when each worker takes up the first run that can start (list scheduling)."""
    ends = {run.index: 0.0 for run in plan.runs if run.ended}
    free = [0.0] * workers
    waiting = list(plan.order)
    teachers = {run.index: run.teacher for run in plan.runs}
    while waiting:
        now = min(free)
        ready = [index for index in waiting if _end_of(teachers[index], ends) <= now]
        if not ready:
            free[free.index(now)] = min(end for end in [*free, *ends.values()] if end > now)
            continue
        # The order is that in which workers take up runs; see Worker.take_next.
        waiting.remove(ready[0])
        free[free.index(now)] = ends[ready[0]] = now + seconds[ready[0]]
    return max(ends.values(), default=0.0)


def _end_of(teacher: int | None, ends: dict[int, float]) -> float:
    return 0.0 if teacher is None else ends.get(teacher, float("inf"))


def _buffer_bytes(config: ExperimentConfig) -> float | None:
    """Most that the replay buffer can fill, as memory and in the checkpoints on disk."""
    try:
        about = describe(config.env)
    except Exception:
        # The plan is printed all the same; the run itself will say what is wrong with its environment.
        return None
    row = 4 * (len(about.observation_names) + len(about.action_names) + 3)
    return float(row * min(config.agent.buffer_size, config.most_steps))


def _kept_bytes(run: PlannedRun) -> float:
    alike = [path.parent for path in run.spec.directory.parent.glob(f"*/{SUMMARY_FILE}")]
    sizes = [_size(folder.iterdir()) for folder in alike]
    return statistics.fmean(sizes) if sizes else _RESULT_DISK


def _size(files: Iterable[Path]) -> float:
    return float(sum(file.stat().st_size for file in files if file.is_file()))
