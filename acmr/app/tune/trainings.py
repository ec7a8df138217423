"""Trains the runs of some trials at a time, with the workers of a sweep; teachers first."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.app.metric import metric_of
from acmr.config import STEPS, ConfigError
from acmr.settings.run_spec import RunSpec
from acmr.storage.run_dir import RunDir
from sweeps.plan import Plan, PlannedRun, expand, make_plan
from sweeps.sweeper import Settings, train_plan


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

    def train(self, jobs: Sequence[Sequence[str]]) -> tuple[list[float | None], int]:
        """Trains what is missing of these runs.

        Args:
            jobs: Each run's words; the same run may be among them several times.

        Returns:
            What each is worth, None where it failed; and the exit code of the sweep.

        Raises:
            ConfigError: If a run cannot be made; nothing has been started then.
        """
        specs = [expand([job])[0] for job in jobs]
        plan = make_plan(list({spec.directory: spec for spec in specs}.values()))
        code = 0
        if plan.missing:
            with open(self._log, "a", encoding="utf-8") as log, redirect_stdout(log):
                output_dir = Path(specs[0].config.output_dir)
                code = train_plan(plan, output_dir, self._settings, self._config, self._context)
        return [self._value(spec, plan) for spec in specs], code

    def _value(self, spec: RunSpec, plan: Plan) -> float | None:
        made = next((run.spec for run in plan.runs if _serves(run, spec)), spec)
        try:
            summary: dict[str, Any] | None = RunDir(made.directory).summary()
        except ConfigError:
            return None
        if summary is None:
            return None
        value = metric_of(made, summary, self._metric)
        # One that stands for another goes on after it would have ended.
        value = min(value, float(spec.config.most_steps)) if self._metric == STEPS else value
        return None if value != value else value


def _serves(run: PlannedRun, spec: RunSpec) -> bool:
    """Whether a planned run is the one that was asked for, or stands for it."""
    stands_in = spec.name in run.stands_for and run.spec.config.seed == spec.config.seed
    return stands_in or run.spec.directory == spec.directory
