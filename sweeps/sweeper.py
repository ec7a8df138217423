"""Runs a sweep from its command line to its last run: plans, launches what is missing, shows progress, reports."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.config import ConfigError
from acmr.records import COMPLETE, FAILED, NO_EPISODE, RUNNING, STOPPED
from acmr.settings.compose import CONFIG_FOLDER, look_in, sources
from acmr.settings.sources import sources_of
from acmr.storage.durable import WriteError
from acmr.text import one_line
from sweeps.estimate import estimate
from sweeps.folder import SweepFolder, all_folders
from sweeps.job import STOP_SIGNALS, write_job
from sweeps.launchers.base import LauncherAdapter, make_adapter
from sweeps.launchers.launch import Launch
from sweeps.plan import Plan, entries_of, expand, make_plan
from sweeps.screen.display import Display, command_line, print_plan
from sweeps.state import FINAL, State

#: Seconds between two looks at the jobs; seconds that workers have to end after the trainings had theirs.
_GLANCE, _MARGIN = 0.5, 10.0
LOST_REASON = "its worker or its cluster job was killed"


@dataclass(frozen=True)
class Settings:
    """The sweep's own settings, which are no run's.

    Attributes:
        plan_only: Whether to print the plan and start nothing.
        retries: How often a run that failed is tried again.
        grace: Seconds that a training has to write its checkpoint when the sweep is stopped.
        workers: How many runs to train at a time; None: as the launcher's file says.
    """

    plan_only: bool
    retries: int
    grace: float
    workers: int | None


def run_sweep(jobs: Sequence[Sequence[str]], settings: Settings, config: DictConfig, context: HydraContext) -> int:
    """Plans and trains.

    Args:
        jobs: Each run's overrides.
        settings: The sweep's own settings.
        config: Hydra's composed config.
        context: Hydra's own.

    Returns:
        The exit code: 0 if every run has come to its end, 1 if not, 128 + the signal that stopped the sweep.

    Raises:
        ConfigError: If the sweep cannot be made; nothing has been started then.
    """
    _check(settings)
    look_in(sources_of(config.hydra, CONFIG_FOLDER))
    specs = expand(jobs)
    return train_plan(make_plan(specs), Path(specs[0].config.output_dir), settings, config, context)


def train_plan(
    plan: Plan,
    output_dir: Path,
    settings: Settings,
    config: DictConfig,
    context: HydraContext,
    make: Callable[[Plan, Path, Settings, LauncherAdapter], Sweep] | None = None,
) -> int:
    """Trains what is missing of a plan whose runs lie in a folder, by the sweep that ``make`` makes.

    The rest as :func:`run_sweep`.
    """
    threads = max(run.spec.config.threads for run in plan.runs)
    adapter = make_adapter(config, context, threads, settings.workers)
    workers = max(1, min(adapter.workers, len(plan.missing)))
    if settings.plan_only:
        print_plan(plan, estimate(plan, output_dir, workers), workers, output_dir)
        return 0
    if not plan.missing:
        print(f"{len(plan.runs)} of {len(plan.runs)} runs complete: {_places(plan)}")
        return 0
    folders = all_folders(output_dir, lambda line: print(line, file=sys.stderr))
    refuse_overlap(plan, output_dir, folders)
    adapter.clear(folders)
    return (make or Sweep)(plan, output_dir, settings, adapter).run()


class Sweep:
    """The missing runs of a plan on their way.

    Args:
        plan: What there is to do.
        output_dir: The folder of all runs.
        settings: The sweep's own settings.
        adapter: What starts the workers.
    """

    def __init__(self, plan: Plan, output_dir: Path, settings: Settings, adapter: LauncherAdapter) -> None:
        self._plan, self._settings, self._adapter = plan, settings, adapter
        # Kept here, too: what becomes of the sweep's folder is no reason to forget it.
        self._typed = command_line()
        header = {
            "command": self._typed,
            "retries": settings.retries,
            "grace": settings.grace,
        }
        self._entries, self._order = entries_of(plan, output_dir), plan.order
        try:
            main = sources().main or CONFIG_FOLDER
            self._folder = SweepFolder.create(output_dir, header, self._entries, self._order, main)
            sources().store(self._folder.path, self._folder.conf)
            for run in plan.missing:
                write_job(self._folder.job_file(run.index), run.spec)
        except (OSError, WriteError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(f"output_dir={output_dir}: cannot be written ({why}); type output_dir=FOLDER") from error
        self._output_dir = output_dir
        self._signal: int | None = None
        self._abandoned = False

    def run(self) -> int:
        """Trains until nothing is left to do; returns the exit code."""
        done = len(self._plan.runs) - len(self._plan.missing)
        print(f"{len(self._plan.runs)} runs, {done} done, {len(self._plan.missing)} to train; {self._folder.path}")
        # Who started this in the background may have chosen that some do not reach it.
        wanted = [each for each in STOP_SIGNALS if signal.getsignal(each) is not signal.SIG_IGN]
        before = {each: signal.signal(each, self._note) for each in wanted}
        display = Display(self._folder, self._entries, self._output_dir)
        try:
            self._launch_all(display)
        finally:
            display.close()
            for each, handler in before.items():
                signal.signal(each, handler)
        code = self._report(display)
        if self._abandoned:
            # A launcher that still waits for jobs holds nothing any more, and would not let this process end.
            sys.stdout.flush()
            os._exit(code)
        return code

    def _note(self, number: int, frame: FrameType | None) -> None:
        again, self._signal = self._signal is not None, number
        # On a full disk the workers learn of it when this process has gone.
        with suppress(OSError):
            self._folder.stop(at_once=again)

    def _launch_all(self, display: Display) -> None:
        number = fruitless = 0
        while self._tend() and self._signal is None and (runs := self._to_launch()):
            before = [self._state(index) for index in runs]
            launch = Launch(self._adapter, self._folder, runs, number)
            self._await(launch, display)
            if self._signal is not None:
                return
            if launch.error is not None:
                display.say(f"jobs were lost ({one_line(launch.error)}); what they were training is taken up again")
            self._settle()
            number += 1
            # A launcher that never starts anything would otherwise be called for ever.
            fruitless = fruitless + 1 if before == [self._state(index) for index in runs] else 0
            if fruitless > self._settings.retries:
                why = f" ({one_line(launch.error)})" if launch.error else ""
                display.say(f"error: the launcher starts no jobs{why}")
                return

    def _tend(self) -> bool:
        """Called again and again while runs are trained; whether to go on launching. See :mod:`sweeps.growing`."""
        return True

    def _await(self, launch: Launch, display: Display) -> None:
        deadline, quiet = float("inf"), 0
        while not launch.is_over(_GLANCE):
            display.tick()
            if self._signal is None:
                self._tend()
                continue
            if deadline == float("inf"):
                deadline = time.monotonic() + self._settings.grace + _MARGIN
                display.say("stopping: the trainings write their checkpoints (once more to end them at once)")
                launch.cancel()
            # Hundreds of runs may still wait in the workers' queue; handing them out to nobody takes long.
            quiet = quiet + 1 if self._adapter.workers_pick_runs and not self._is_training() else 0
            if quiet > 2 or time.monotonic() > deadline:
                break
        self._abandoned = self._abandoned or launch.is_waiting

    def _is_training(self) -> bool:
        return any(self._folder.state(index).state == RUNNING for index in self._order)

    def _state(self, index: int) -> State:
        ended = self._entries[index].ended
        return State(ended) if ended else self._folder.state(index)

    def _to_launch(self) -> list[int]:
        """The runs that a launch may train, in order; without the students of teachers that failed."""
        found = []
        for index in self._order:
            teacher = self._entries[index].teacher
            taught = COMPLETE if teacher is None else self._state(teacher).state
            possible = taught == COMPLETE or (self._adapter.workers_pick_runs and taught not in FINAL)
            if self._state(index).state not in FINAL and possible:
                found.append(index)
        return found

    def _settle(self) -> None:
        """After a launch nothing runs: a run that still says so was lost with its worker or its cluster job."""
        for index in self._order:
            state = self._folder.state(index)
            if state.state == RUNNING:
                # On this machine one lost worker takes its siblings along, so that it is no fault of the run.
                failures = state.failures + (0 if self._adapter.workers_pick_runs else 1)
                lost = FAILED if failures > self._settings.retries else STOPPED
                self._folder.set_state(index, State(lost, failures, LOST_REASON))

    def _report(self, display: Display) -> int:
        failed = display.tell_failures()
        complete = sum(view.state == COMPLETE for view in display.views)
        empty = sum(view.reason == NO_EPISODE for view in display.views)
        remark = f" ({empty} of them: {NO_EPISODE})" if empty else ""
        print(f"{complete} of {len(display.views)} runs complete{remark}: {_places(self._plan)}")
        if self._signal is not None:
            print(f"stopped by {signal.Signals(self._signal).name}; to go on: {self._command()}", flush=True)
            return 128 + self._signal
        if failed:
            print(f"to try again what failed: {self._command()}", flush=True)
        return 1 if failed or any(view.state not in FINAL for view in display.views) else 0

    def _command(self) -> str:
        return self._typed


def _check(settings: Settings) -> None:
    # These come from a file and a command line that nobody has typed yet.
    if not isinstance(settings.plan_only, bool):
        raise ConfigError(f"plan={settings.plan_only}: must be true or false")
    if type(settings.retries) is not int or settings.retries < 0:
        raise ConfigError(f"retries={settings.retries}: an integer of at least 0 is needed")
    if type(settings.grace) not in (int, float) or not 0 <= settings.grace < float("inf"):
        raise ConfigError(f"hydra.sweeper.grace={settings.grace}: a number of seconds is needed")


def refuse_overlap(plan: Plan, output_dir: Path, folders: Sequence[SweepFolder]) -> None:
    """Refuses runs that are on their way in another sweep: the two would only wait for one another.

    Raises:
        ConfigError: If there is such a one.
    """
    wanted = {entry.directory for entry in entries_of(plan, output_dir) if entry.ended is None}
    for folder in folders:
        common = [entry for entry in folder.entries() if entry.directory in wanted and entry.ended is None]
        if common and folder.is_alive():
            process = folder.header().get("process")
            raise ConfigError(
                f"{output_dir / common[0].directory}: process {process} has it in its sweep; "
                f"wait for that, or end it: kill {process}"
            )


def _places(plan: Plan) -> str:
    places = {str(run.spec.directory.parent.parent): None for run in plan.runs}
    return " ".join(places)
