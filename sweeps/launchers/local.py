"""Workers on this machine, started by joblib."""

from __future__ import annotations

import os
from multiprocessing import resource_tracker

from joblib import cpu_count
from joblib.externals.loky.backend import resource_tracker as loky_tracker

from sweeps.folder import SweepFolder
from sweeps.launchers.hydra_launcher import HydraLauncherAdapter
from sweeps.worker import NEXT


class LocalAdapter(HydraLauncherAdapter):
    """Runs as many jobs at a time as there are workers; each takes up the next run that can start."""

    launcher = "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"
    workers_key = "n_jobs"

    @property
    def workers(self) -> int:
        """How many runs are trained at a time; -1 is as many as fit on the cores."""
        return max(1, cpu_count() // self.threads) if self.wanted == -1 else super().workers

    def shield(self) -> None:
        """Blocks the signals that end a sweep, and keeps joblib's helpers from undoing it."""
        # They tell of what a sweep that was ended left to them; that they clear it away is enough.
        words = [*os.environ.get("PYTHONWARNINGS", "").split(","), "ignore:resource_tracker:UserWarning"]
        os.environ["PYTHONWARNINGS"] = ",".join(filter(None, dict.fromkeys(words)))
        # These helpers of the workers would unblock the signals again if they were started later.
        resource_tracker.ensure_running()
        loky_tracker.ensure_running()
        super().shield()

    def prepare(self, folder: SweepFolder, number: int) -> None:
        """Tells joblib how many cores -1 means where a training has several threads."""
        self.settings.n_jobs = self.workers

    def words(self, folder: SweepFolder, run: int) -> list[str]:
        """The job trains the first run that can start when it is its turn; there are as many jobs as runs."""
        return [f"sweep={folder.path}", f"run={NEXT}", f"parent={os.getpid()}"]
