"""A sweep that somebody looks after while it goes on: who adds runs to it, and withdraws others."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from acmr.records import COMPLETE
from acmr.settings.run_spec import RunSpec
from sweeps.folder import all_folders
from sweeps.job import write_job
from sweeps.launchers.base import LauncherAdapter
from sweeps.plan import Plan, entries_of, make_plan
from sweeps.state import FINAL
from sweeps.sweeper import Settings, Sweep, refuse_overlap


class GrowingSweep(Sweep):
    """Trains runs of which more may come; workers that have nothing to do wait for them.

    A launcher whose jobs have their runs from the start (``workers_pick_runs = False``, a cluster) trains what has come
    in rounds; runs can be withdrawn there, too.

    Args:
        plan: What there is to do at first.
        output_dir: The folder of all runs.
        settings: The sweep's own settings.
        adapter: What starts the workers.
        look: Called about twice a second; may add and withdraw runs, and returns whether more may come. What it raises
            ends the sweep in good order, and is raised by :meth:`run`.
    """

    def __init__(
        self,
        plan: Plan,
        output_dir: Path,
        settings: Settings,
        adapter: LauncherAdapter,
        look: Callable[[GrowingSweep], bool],
    ) -> None:
        super().__init__(plan, output_dir, settings, adapter)
        self._look = look
        self._error: Exception | None = None

    def run(self) -> int:
        """Trains until nothing is left to do and nothing more may come; returns the exit code."""
        try:
            code = super().run()
        finally:
            # The process that looks after it may begin another one with the same runs.
            self._folder.release()
        if self._error is not None:
            raise self._error
        return code

    def add(self, spec: RunSpec) -> Plan:
        """Takes a run and the teacher that it implies; what was withdrawn of them is wanted again.

        Returns:
            What there was to do for it.

        Raises:
            ConfigError: As :func:`~sweeps.sweeper.run_sweep`.
        """
        plan = make_plan([spec])
        others = [folder for folder in all_folders(self._output_dir) if folder.path.absolute() != self._folder.path]
        refuse_overlap(plan, self._output_dir, others)
        place = {entry.directory: entry.index for entry in self._entries}
        # Indices within the plan of this run, and here.
        known: dict[int | None, int | None] = {None: None}
        for run, entry in zip(plan.runs, entries_of(plan, self._output_dir), strict=True):
            index = place.get(entry.directory)
            if index is None:
                index = len(self._entries)
                write_job(self._folder.job_file(index), run.spec)
                self._entries.append(replace(entry, index=index, teacher=known[entry.teacher]))
                self._order += [] if run.ended else [index]
            self._folder.readmit(index)
            known[run.index] = index
        self._folder.extend(self._entries, self._order)
        return plan

    def withdraw(self, directory: Path) -> None:
        """Stops a run as at the end of a sweep, with a checkpoint; not one that another run waits for."""
        index = self._index(directory)
        if not any(entry.teacher == index and not self._is_over(entry.index) for entry in self._entries):
            self._folder.withdraw(index)

    def is_over(self, directory: Path) -> bool:
        """Whether a run has come to its end, failed, or cannot start since its teacher did."""
        return self._is_over(self._index(directory))

    def _is_over(self, index: int) -> bool:
        teacher = self._entries[index].teacher
        blocked = teacher is not None and (state := self._state(teacher).state) in FINAL and state != COMPLETE
        return blocked or self._state(index).state in FINAL

    def _index(self, directory: Path) -> int:
        wanted = os.path.relpath(directory, self._output_dir)
        return next(entry.index for entry in self._entries if entry.directory == wanted)

    def _tend(self) -> bool:
        if self._error is None:
            try:
                self._folder.keep_open(self._look(self))
            except Exception as error:
                self._error = error
                self._folder.stop(at_once=False)
        return self._error is None

    def _to_launch(self) -> list[int]:
        runs = super()._to_launch()
        if self._adapter.workers_pick_runs and runs:
            # Workers that choose their runs stay for those to come: as many as there may be.
            runs = (runs * self._adapter.workers)[: max(len(runs), self._adapter.workers)]
        return runs
