"""Plans a sweep: from settings to runs, teachers before students. Nothing is started or written here."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from acmr.config import HORIZON, INDEPENDENT, PAIRED, THRESHOLD, ConfigError, ExperimentConfig
from acmr.records import COMPLETE, ended_state
from acmr.settings.compose import compose_config, parse
from acmr.settings.errors import check_booleans
from acmr.settings.run_spec import RunSpec, specify, teacher_spec
from acmr.storage.run_dir import RunDir, holds_run
from sweeps.state import SweepRun

#: Settings that a teacher takes over from its student because they change nothing in its result.
_SHARED_KEYS = ("device", "threads", "progress", "log_every", "tracking", "checkpoint_every", "resume")
#: Of the run that another is the beginning of.
_FULL: dict[str, Any] = {"stop": HORIZON, "stop_after": None}


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Attributes:
        index: Its place in the plan.
        spec: The run.
        ended: ``complete`` or ``diverged``, if it is there already.
        teacher: Index of the run that has to be complete before this one starts.
        implied: Whether it was not asked for, but is the teacher of a run that was.
        stands_for: Names of runs that were asked for and need not be made where it is.
    """

    index: int
    spec: RunSpec
    ended: str | None
    teacher: int | None = None
    implied: bool = False
    stands_for: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """All runs of a sweep, teachers before their students."""

    runs: tuple[PlannedRun, ...]

    @property
    def missing(self) -> list[PlannedRun]:
        """The runs that are not there yet."""
        return [run for run in self.runs if run.ended is None]

    @property
    def stages(self) -> list[list[PlannedRun]]:
        """The missing runs: those that can start at once, and those that wait for one of them."""
        waits = {run.index for run in self.missing}
        first = [run for run in self.missing if run.teacher not in waits]
        second = [run for run in self.missing if run.teacher in waits]
        return [stage for stage in (first, second) if stage]

    @property
    def order(self) -> list[int]:
        """The missing runs as they are best taken up: those that others wait for first, then the longest."""
        # A long run that is begun last keeps one core busy while the others have nothing left to do.
        students = {run.index: 0 for run in self.runs}
        for run in self.missing:
            if run.teacher is not None:
                students[run.teacher] += 1
        return [
            run.index for run in sorted(self.missing, key=lambda run: (-students[run.index], -effort(run), run.index))
        ]


def effort(run: PlannedRun) -> float:
    """About how much work a run is, to compare runs: multiplications in the hidden layers."""
    config = run.spec.config
    sizes = config.agent.hidden_sizes
    products = sum(a * b for a, b in pairwise(sizes)) + sizes[0]
    return float(config.most_steps) * config.agent.batch_size * products


def expand(jobs: Iterable[Sequence[str]]) -> list[RunSpec]:
    """Makes a run of each job's overrides.

    Raises:
        ConfigError: If one of them cannot be run, or if two are the same run.
    """
    specs: dict[Path, tuple[RunSpec, Sequence[str]]] = {}
    for overrides in jobs:
        check_booleans(overrides)
        spec = specify(parse(compose_config(overrides)))
        if spec.directory in specs:
            first, second = _difference(specs[spec.directory][1], overrides)
            if first == second:
                raise ConfigError(f"{first}: the same run twice; give every value once")
            raise ConfigError(f"{first} and {second} are one run, {spec.directory}; sweep what tells them apart")
        specs[spec.directory] = (spec, overrides)
    return [spec for spec, _ in specs.values()]


def make_plan(specs: Sequence[RunSpec]) -> Plan:
    """Adds the teachers that students imply, and finds out what is there already.

    A run that stops at its threshold is not made where the full one, whose beginning it is, teaches another of them or
    is there already; nor one with ``seeding=independent`` where it would be trained beside the teacher of the others;
    nor one that takes nothing, in a body that its teacher's teacher has, too.

    Args:
        specs: Runs in different directories.

    Raises:
        ConfigError: If a directory holds a run with other settings, or if a teacher that is named is not there.
    """
    stand_ins = _stand_ins(specs)
    stands_for: dict[Path, tuple[str, ...]] = {}
    for spec in specs:
        if (other := stand_ins.get(spec.directory)) is not None:
            stands_for[other.directory] = (*stands_for.get(other.directory, ()), spec.name)
    specs = [stand_ins.get(spec.directory, spec) for spec in specs]
    listed = {spec.directory: spec for spec in specs}
    ended = {directory: _ended(spec) for directory, spec in listed.items()}
    # A student that is there needs no teacher any more, even where that was deleted.
    students = [spec for spec in specs if ended[spec.directory] is None]
    teacher_of = {spec.directory: teacher for spec in students if (teacher := _teacher(spec.config)) is not None}
    added = {teacher.directory: teacher for teacher in teacher_of.values() if teacher.directory not in listed}
    ended |= {directory: _ended(spec) for directory, spec in added.items()}
    needed = {path: spec for path, spec in added.items() if ended[path] != COMPLETE}
    teaching = {teacher.directory for teacher in teacher_of.values()}
    all_runs = needed | {path: listed[path] for path in sorted(listed, key=lambda path: path not in teaching)}
    index = {path: number for number, path in enumerate(all_runs)}
    runs = []
    for path, spec in all_runs.items():
        teacher = teacher_of.get(path)
        runs.append(
            PlannedRun(
                index=index[path],
                spec=spec,
                ended=ended[path],
                teacher=index.get(teacher.directory) if teacher else None,
                implied=path in needed,
                stands_for=stands_for.get(path, ()),
            )
        )
    return Plan(tuple(runs))


def entries_of(plan: Plan, output_dir: Path) -> list[SweepRun]:
    """The runs of a plan as its sweep's folder keeps them."""
    return [
        SweepRun(
            index=run.index,
            name=run.spec.name,
            cell=run.spec.cell,
            seed=run.spec.config.seed,
            directory=os.path.relpath(run.spec.directory, output_dir),
            total_timesteps=run.spec.config.most_steps,
            threads=run.spec.config.threads,
            teacher=run.teacher,
            ended=run.ended,
        )
        for run in plan.runs
    ]


def _stand_ins(specs: Sequence[RunSpec]) -> dict[Path, RunSpec]:
    """For the directory of a run that need not be made: the run that stands for it.

    That is the full one of a run that stops, if it teaches a run of the sweep or is complete; and of a run with
    ``seeding=independent`` the one that teaches others of them: it draws from the seed alone, as none of these do.
    Students that are complete count, too: the same command means the same runs when it is typed again.
    """
    full = {spec.directory: specify(replace(spec.config, **_FULL)) for spec in specs if spec.config.stop == THRESHOLD}
    apart = [spec for spec in specs if spec.config.seeding == INDEPENDENT]
    paired = {spec.directory: specify(replace(spec.config, **_FULL, seeding=PAIRED)) for spec in apart}
    students = [spec for spec in specs if (full or paired) and spec.config.transfer.rules.needs_teacher]
    teaching = {teacher_spec(spec.config).directory for spec in students if spec.config.transfer.teacher is None}
    found = {place: spec for place, spec in full.items() if spec.directory in teaching or _is_there(spec)}
    found |= {spec.directory: twin for spec in specs if (twin := _twin(spec)) is not None}
    return found | {place: spec for place, spec in paired.items() if spec.directory in teaching}


def _twin(spec: RunSpec) -> RunSpec | None:
    """The same run under another name, if there is one: the baseline of a body that gets back what its teacher lost.

    To such a body its teacher's teacher is another name, and a run that takes nothing does not depend on its teacher.
    """
    env = spec.config.env
    if spec.config.transfer.rules.needs_teacher or env.source == env.name:
        return None
    try:
        twin = teacher_spec(teacher_spec(spec.config).config)
    except ConfigError:
        # There is no such environment, and nobody who takes nothing needs it.
        return None
    named = replace(env, name=twin.config.env.name, source=twin.config.env.source)
    known = {key: getattr(spec.config, key) for key in (*_SHARED_KEYS, "force", "metric")}
    twin = replace(twin, config=replace(twin.config, **known))
    return twin if twin.config == replace(spec.config, env=named) else None


def _is_there(spec: RunSpec) -> bool:
    """Whether a run is complete, and not to be made anew."""
    try:
        return _ended(spec) == COMPLETE
    except ConfigError:
        # Its directory holds a run with other settings: none that could stand for this one.
        return False


def _teacher(config: ExperimentConfig) -> RunSpec | None:
    if not config.transfer.rules.needs_teacher:
        return None
    if config.transfer.teacher is not None:
        if not Path(config.transfer.teacher).exists():
            raise ConfigError(
                f"transfer.teacher={config.transfer.teacher}: there is no such file or run; train it first, "
                "or leave transfer.teacher out and the sweep trains the teacher that belongs to each student"
            )
        return None
    spec = teacher_spec(config)
    return replace(spec, config=replace(spec.config, **{key: getattr(config, key) for key in _SHARED_KEYS}))


def _ended(spec: RunSpec) -> str | None:
    run_dir = RunDir(spec.directory)
    if not holds_run(run_dir, spec.config):
        return None
    summary = run_dir.summary()
    return None if summary is None else ended_state(summary)


def _difference(ours: Sequence[str], theirs: Sequence[str]) -> tuple[str, str]:
    only_ours = [entry for entry in ours if entry not in theirs] or list(ours)
    only_theirs = [entry for entry in theirs if entry not in ours] or list(theirs)
    return " ".join(only_ours), " ".join(only_theirs)
