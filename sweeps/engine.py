"""Hydra's stock launchers as engines: joblib on this machine, submitit on a Slurm cluster."""

from __future__ import annotations

import copy
import logging
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from joblib import cpu_count
from joblib.externals.loky.backend import resource_tracker as loky_tracker
from omegaconf import DictConfig, OmegaConf, open_dict

from acmr.config import ConfigError
from sweeps.folder import SweepFolder
from sweeps.job import REPOSITORY, STOP_SIGNALS
from sweeps.worker import NEXT, work

#: Seconds that jobs of a sweep that has gone have to write their checkpoints.
_CLEARANCE = 60


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


class LauncherAdapter:
    """Runs jobs on this machine, as many at a time as there are workers; each takes up the next run that can start.

    Args:
        config: Hydra's composed config.
        context: Hydra's own.
        threads: The most threads that a run uses.
    """

    #: Whether a job may choose its run, so that no worker idles at the border of two stages.
    workers_pick_runs = True

    def __init__(self, config: DictConfig, context: HydraContext, threads: int) -> None:
        self._config, self._context = copy.deepcopy(config), context
        self._threads = threads
        # A job of a cluster begins in the folder where the sweep was started, which need not be this one.
        paths = [str(REPOSITORY), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
        os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))

    @property
    def workers(self) -> int:
        """How many runs are trained at a time."""
        jobs = int(self._config.hydra.launcher.get("n_jobs", 1))
        if jobs != -1 and jobs < 1:
            raise ConfigError(f"workers={jobs}: an integer of at least 1 is needed, or -1 for one on each core")
        return max(1, cpu_count() // self._threads) if jobs == -1 else jobs

    def shield(self) -> None:
        """Blocks the signals that end a sweep in this thread, and so in the workers that it will start.

        A worker has to outlive Ctrl-C, which a terminal sends to all of them, to end its training in good order.
        """
        # They tell of what a sweep that was ended left to them; that they clear it away is enough.
        words = [*os.environ.get("PYTHONWARNINGS", "").split(","), "ignore:resource_tracker:UserWarning"]
        os.environ["PYTHONWARNINGS"] = ",".join(filter(None, dict.fromkeys(words)))
        # These helpers of the workers would unblock the signals again if they were started later.
        resource_tracker.ensure_running()
        loky_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)

    def launch(self, folder: SweepFolder, runs: Sequence[int], number: int) -> None:
        """Trains runs; returns when all jobs have ended, and raises what the launcher raises.

        Args:
            folder: The sweep's folder.
            runs: The runs' indices.
            number: Count of launches before.
        """
        with open_dict(self._config):
            self._prepare(self._config.hydra.launcher, folder, number)
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(FixedConfigs(), self._context.callbacks),
            task_function=work,
            config=self._config,
        )
        for result in launcher.launch([self._words(folder, run) for run in runs], initial_job_idx=0):
            _ = result.return_value

    def _words(self, folder: SweepFolder, run: int) -> list[str]:
        return [f"sweep={folder.path}", f"run={NEXT}", f"parent={os.getpid()}"]

    def _prepare(self, launcher: DictConfig, folder: SweepFolder, number: int) -> None:
        if "n_jobs" in launcher:
            launcher.n_jobs = self.workers

    def busy(self) -> bool:
        """Whether jobs of the last launch may still be there, asked outside of it."""
        return True

    def clear(self, folders: Sequence[SweepFolder]) -> None:
        """Ends what sweeps left whose own process has gone; here nothing outlives it."""

    def cancel(self) -> None:
        """Ends the jobs of the last launch; here the workers do that themselves."""


class SlurmAdapter(LauncherAdapter):
    """Runs jobs on a cluster, one for each run; a job is not spent on waiting, so stages follow one another."""

    workers_pick_runs = False

    def __init__(self, config: DictConfig, context: HydraContext, threads: int) -> None:
        super().__init__(config, context, threads)
        if shutil.which("sbatch") is None:
            raise ConfigError(
                "hydra/launcher=slurm: there is no sbatch here; start this on a node that submits jobs, "
                "or type hydra/launcher=local"
            )
        self._name = ""
        # Where a cluster keeps no accounts, it would say so again and again; its own import sets the level first.
        import_module("submitit")
        logging.getLogger("submitit").setLevel(logging.ERROR)

    @property
    def workers(self) -> int:
        """How many runs are trained at a time."""
        return int(self._config.hydra.launcher.array_parallelism)

    def _words(self, folder: SweepFolder, run: int) -> list[str]:
        return [f"sweep={folder.path}", f"run={run}", "parent=0"]

    def _prepare(self, launcher: DictConfig, folder: SweepFolder, number: int) -> None:
        self._name = f"acmr-{folder.path.name}-{number}"
        launcher.name = self._name
        launcher.submitit_folder = str(folder.path / "slurm" / "%j")
        launcher.cpus_per_task = max(self._threads, launcher.cpus_per_task or 1)

    def busy(self) -> bool:
        """Whether the queue still holds jobs of the last launch; submitit itself asks only every ten minutes."""
        command = ["squeue", "--noheader", "--format=%i", f"--name={self._name}"]
        answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        # A controller that does not answer is no reason to give up its jobs.
        return answer.returncode != 0 or bool(answer.stdout.strip())

    def clear(self, folders: Sequence[SweepFolder]) -> None:
        """Ends the jobs of sweeps whose own process has gone: the jobs of this one go on with what they trained."""
        gone = [f"acmr-{folder.path.name}-" for folder in folders if not folder.is_alive()]
        command = ["squeue", "--noheader", "--me", "--format=%A %j"]
        for _ in range(_CLEARANCE):
            answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
            pairs = [line.split(maxsplit=1) for line in answer.stdout.splitlines()]
            left = [job for job, name in pairs if name.startswith(tuple(gone))]
            if not left:
                return
            subprocess.run(["scancel", *left], capture_output=True, check=False, timeout=60)
            time.sleep(1.0)

    def cancel(self) -> None:
        """Takes the jobs of the last launch out of the queue; running ones get the signal to write a checkpoint."""
        subprocess.run(["scancel", f"--name={self._name}"], capture_output=True, check=False, timeout=60)


def make_engine(config: DictConfig, context: HydraContext, threads: int) -> LauncherAdapter:
    """The engine for the launcher that was chosen."""
    target = str(OmegaConf.select(config, "hydra.launcher._target_"))
    kind = SlurmAdapter if target.endswith("SlurmLauncher") else LauncherAdapter
    return kind(config, context, threads)
