"""Trains the runs of the trials under way with the workers of a sweep, teachers first, and says what they are worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.app.metric import metric_of
from acmr.app.tune.curve import heights
from acmr.config import STEPS, ConfigError, ExperimentConfig
from acmr.records import EPISODES_FILE, DamagedError
from acmr.settings.run_spec import RunSpec
from acmr.storage.run_dir import RunDir
from analysis.loading.episodes import read_episodes
from sweeps.growing import GrowingSweep
from sweeps.plan import Plan, PlannedRun, expand, make_plan
from sweeps.sweeper import Settings, train_plan


@dataclass(frozen=True)
class Training:
    """A run that a trial needs.

    Attributes:
        asked: The run.
        made: Itself, or the longer one of which it is the beginning and which is made in its place.
        was_there: Whether it had come to its end before it was asked for.
    """

    asked: RunSpec
    made: RunSpec
    was_there: bool

    @property
    def config(self) -> ExperimentConfig:
        """Its settings."""
        return self.asked.config


class Trainings:
    """Trains runs, and says what each is worth.

    Args:
        settings: Those of the sweeps.
        config: Hydra's composed config.
        context: Hydra's own.
        metric: What is asked of the runs.
        log: Takes what the sweeps say.
    """

    def __init__(self, settings: Settings, config: DictConfig, context: HydraContext, metric: str, log: Path) -> None:
        self._settings, self._config, self._context = settings, config, context
        self._metric, self._log = metric, log
        self._sweep: GrowingSweep | None = None
        # Not known to be over; and those of which a sweep that has ended brought to an end what it could.
        self._open: list[Training] = []
        self._past: list[Training] = []
        self._read: dict[Path, tuple[tuple[int, int], pd.DataFrame]] = {}

    def run(self, look: Callable[[], bool]) -> int:
        """Trains what is begun, until nothing more is wanted.

        Args:
            look: Called about twice a second; may begin and cut runs, and returns whether more may come.

        Returns:
            0, or 128 + the signal that ended it.

        Raises:
            ConfigError: If a run cannot be made; those under way are stopped in good order then.
        """
        while look():
            self._open = [training for training in self._open if not self.is_over(training)]
            if self._open:
                code = self._train(look)
                if code >= 128:
                    return code
        return 0

    def _train(self, look: Callable[[], bool]) -> int:
        first, *others = self._open

        def tend(sweep: GrowingSweep) -> bool:
            if self._sweep is None:
                self._sweep = sweep
                for training in others:
                    sweep.add(training.asked)
            return look()

        with open(self._log, "a", encoding="utf-8") as log, redirect_stdout(log):
            place = Path(first.config.output_dir)
            make = partial(GrowingSweep, look=tend)
            code = train_plan(make_plan([first.asked]), place, self._settings, self._config, self._context, make)
        # Where a launcher starts nothing, no run is waited for again.
        self._past += self._open
        self._sweep = None
        return code

    def begin(self, job: Sequence[str]) -> Training:
        """Has a run trained, unless it is there; the same one may be asked for several times.

        Args:
            job: The run's words.

        Raises:
            ConfigError: If it cannot be made.
        """
        spec = expand([job])[0]
        plan = make_plan([spec]) if self._sweep is None else self._sweep.add(spec)
        made = _serving(plan, spec)
        training = Training(spec, made.spec, made.ended is not None)
        self._open.append(training)
        return training

    def cut(self, training: Training) -> None:
        """Stops a run in good order; it can go on from its checkpoint whenever somebody wants it."""
        self._open = [other for other in self._open if other is not training]
        if self._sweep is not None:
            self._sweep.withdraw(training.made.directory)

    def is_over(self, training: Training) -> bool:
        """Whether a run has come to its end, or failed."""
        if training.was_there or training in self._past:
            return True
        return self._sweep is not None and self._sweep.is_over(training.made.directory)

    def heights(self, training: Training) -> dict[int, float]:
        """What a run was worth at the tenths of its length that it has passed (:mod:`acmr.app.tune.curve`)."""
        path = training.made.directory / EPISODES_FILE
        try:
            stat = path.stat()
            mark = (stat.st_size, stat.st_mtime_ns)
            if self._read.get(path, (None,))[0] != mark:
                self._read[path] = (mark, read_episodes(path, own=True)[0])
        except (OSError, DamagedError):
            # Not begun, or just being cut back to what a checkpoint knows of it.
            return {}
        return heights(self._read[path][1], training.config, self._metric, self.is_over(training))

    def worth(self, training: Training) -> float | None:
        """What a run that is over is worth; None: it failed."""
        self._read.pop(training.made.directory / EPISODES_FILE, None)
        try:
            summary: dict[str, Any] | None = RunDir(training.made.directory).summary()
        except ConfigError:
            return None
        if summary is None:
            return None
        value = metric_of(training.made, summary, self._metric)
        # One that stands for another goes on after it would have ended.
        value = min(value, float(training.config.most_steps)) if self._metric == STEPS else value
        return None if value != value else value


def _serving(plan: Plan, spec: RunSpec) -> PlannedRun:
    """The planned run that is the one that was asked for, or stands for it."""
    return next(
        run
        for run in plan.runs
        if run.spec.directory == spec.directory
        or (spec.name in run.stands_for and run.spec.config.seed == spec.config.seed)
    )
