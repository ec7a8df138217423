"""Hydra's own launchers, joblib's and submitit's, made to train the runs of a sweep."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict

from sweeps.folder import SweepFolder
from sweeps.launchers.base import LauncherAdapter
from sweeps.worker import work


class FixedConfigs(ConfigLoader):
    """Gives a launcher its jobs' configs without reading ``conf/`` again: whoever edits it changes no job."""

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """The config of one job: Hydra's own part, and the job's words as they are."""
        config = copy.deepcopy(master_config)
        with open_dict(config):
            for key in [str(key) for key in config if key != "hydra"]:
                del config[key]
            config.hydra.overrides.task = list(sweep_overrides)
            for word in sweep_overrides:
                key, _, value = word.partition("=")
                config[key] = value
        return config

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Not offered: no job composes anything."""
        raise NotImplementedError

    def get_search_path(self) -> Any:
        """Not offered."""
        raise NotImplementedError

    def get_sources(self) -> list[Any]:
        """There is nothing that configs come from."""
        return []

    def list_groups(self, parent_name: str) -> list[str]:
        """There are no groups."""
        return []

    def get_group_options(self, group_name: str, *args: Any, **kwargs: Any) -> list[str]:
        """There are no groups."""
        return []

    def compute_defaults_list(self, config_name: str | None, overrides: list[str], run_mode: RunMode) -> Any:
        """Not offered."""
        raise NotImplementedError


class HydraLauncherAdapter(LauncherAdapter):
    """Hands a launcher of Hydra one job for each run: :func:`sweeps.worker.work` with three words."""

    #: The class of Hydra's launcher.
    launcher: ClassVar[str]

    def launch(self, folder: SweepFolder, runs: Sequence[int], number: int) -> None:
        """Trains runs; returns when all jobs have ended, and raises what the launcher raises."""
        with open_dict(self.config):
            # The file names this adapter; Hydra makes its launcher of the same settings.
            self.settings._target_ = self.launcher
            self.prepare(folder, number)
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(FixedConfigs(), self.context.callbacks),
            task_function=work,
            config=self.config,
        )
        for result in launcher.launch([self.words(folder, run) for run in runs], initial_job_idx=0):
            _ = result.return_value

    def prepare(self, folder: SweepFolder, number: int) -> None:
        """Completes the launcher's settings before its launch of this number."""
        raise NotImplementedError

    def words(self, folder: SweepFolder, run: int) -> list[str]:
        """What the job of a run is told; see :func:`sweeps.worker.work`."""
        raise NotImplementedError
