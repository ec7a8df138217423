"""Jobs on a Slurm cluster, submitted by submitit."""

from __future__ import annotations

import logging
import shutil
import subprocess
import time
from collections.abc import Sequence
from importlib import import_module

from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.config import ConfigError
from sweeps.folder import SweepFolder
from sweeps.launchers.hydra_launcher import HydraLauncherAdapter

#: Seconds that jobs of a sweep that has gone have to write their checkpoints.
_CLEARANCE = 60


class SlurmAdapter(HydraLauncherAdapter):
    """Submits a job for each run; a job is not spent on waiting, so stages follow one another."""

    launcher = "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher"
    workers_pick_runs = False
    has_queue = True
    workers_key = "array_parallelism"

    def __init__(self, config: DictConfig, context: HydraContext, threads: int, workers: int | None) -> None:
        super().__init__(config, context, threads, workers)
        if shutil.which("sbatch") is None:
            raise ConfigError(
                "hydra/launcher=slurm: there is no sbatch here; start this on a node that submits jobs, "
                "or type hydra/launcher=local"
            )
        self._name = ""
        # Where a cluster keeps no accounts, it would say so again and again; its own import sets the level first.
        import_module("submitit")
        logging.getLogger("submitit").setLevel(logging.ERROR)

    def prepare(self, folder: SweepFolder, number: int) -> None:
        """Gives the jobs of this launch a name to find them by, a folder, and cores for all of their threads."""
        self._name = f"acmr-{folder.path.name}-{number}"
        self.settings.name = self._name
        self.settings.submitit_folder = str(folder.path / "slurm" / "%j")
        self.settings.cpus_per_task = max(self.threads, self.settings.cpus_per_task or 1)
        self.settings.array_parallelism = self.workers

    def words(self, folder: SweepFolder, run: int) -> list[str]:
        """The job trains this run; its parent is Slurm's daemon, whatever becomes of the sweep."""
        return [f"sweep={folder.path}", f"run={run}", "parent=0"]

    def is_busy(self) -> bool:
        """Whether the queue still holds jobs of the last launch.

        submitit gives up all jobs at the first that fails, and takes ten minutes to notice one that was killed, or for
        ever where the cluster keeps no accounts.
        """
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
