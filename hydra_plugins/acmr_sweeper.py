"""The classes that Hydra finds, for which they have to be defined under ``hydra_plugins``.

See :mod:`sweeps.sweeper` and :mod:`acmr.app.tune.search`.
"""

from __future__ import annotations

from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class StagedSweeper(BasicSweeper):
    """Hydra's own sweeper, with teachers before students and only what is missing.

    Args:
        max_batch_size: Not used; all runs are planned at once.
        params: What is swept where the command line does not say so.
        plan: Whether to print the plan and start nothing.
        retries: How often a run that failed is tried again.
        grace: Seconds that a training has to write its checkpoint when the sweep is stopped.
        workers: How many runs to train at a time; None: as the launcher's file says.
    """

    def __init__(
        self,
        max_batch_size: int | None,
        params: dict[str, str] | None = None,
        plan: bool = False,
        retries: int = 2,
        grace: float = 20.0,
        workers: int | None = None,
    ) -> None:
        super().__init__(max_batch_size, params)
        self.settings = {"plan_only": plan, "retries": retries, "grace": grace, "workers": workers}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keeps what the launcher will be made of, once the plan is there."""
        self.hydra_context, self.config = hydra_context, config

    def sweep(self, arguments: list[str]) -> Any:
        """Expands the command line into runs and trains what is missing of them.

        Raises:
            SystemExit: Always, with the sweep's exit code.
            ConfigError: If the sweep cannot be made; nothing has been started then.
        """
        # Here, because Hydra imports this file at the start of every single run.
        from acmr.settings.swept import check_counts, check_swept
        from sweeps.sweeper import Settings, run_sweep

        assert self.hydra_context is not None
        assert self.config is not None
        check_swept(self.params, self.config)
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = parser.parse_overrides([*self._parse_config(), *arguments])
        check_counts(overrides)
        jobs = self.split_arguments(overrides, None)[0]
        raise SystemExit(run_sweep(jobs, Settings(**self.settings), self.config, self.hydra_context))


class TuningSweeper(Sweeper):
    """Searches for settings with Optuna, with teachers before students and only what is missing.

    Args:
        trials: How many the search has at its end.
        study: Its name; None: one that follows from what it searches.
        prune: Whether trials that begin badly are cut short.
        retries: How often a run that failed is tried again.
        grace: Seconds that a training has to write its checkpoint when the search is stopped.
        workers: How many runs to train at a time; None: as the launcher's file says.
    """

    def __init__(
        self,
        trials: int,
        study: str | None = None,
        prune: bool = True,
        retries: int = 0,
        grace: float = 20.0,
        workers: int | None = None,
    ) -> None:
        self._wanted = {"trials": trials, "study": study, "prune": prune}
        self._sweeps = {"plan_only": False, "retries": retries, "grace": grace, "workers": workers}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keeps what the launcher will be made of, once the plan is there."""
        self.hydra_context, self.config = hydra_context, config

    def sweep(self, arguments: list[str]) -> Any:
        """Searches.

        Raises:
            SystemExit: Always, with the search's exit code.
            ConfigError: If the search cannot be made; nothing has been started then.
        """
        from acmr.app.tune.search import Wanted, run_search
        from sweeps.sweeper import Settings

        assert self.hydra_context is not None
        assert self.config is not None
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        wanted = Wanted(**self._wanted, sweeps=Settings(**self._sweeps))
        raise SystemExit(run_search(parser.parse_overrides(arguments), wanted, self.config, self.hydra_context))
