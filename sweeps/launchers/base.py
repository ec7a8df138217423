"""The interface between a sweep and its launcher, and the choice of one by ``hydra/launcher=NAME``."""

from __future__ import annotations

import copy
import os
import signal
import sys
from collections.abc import Sequence
from pkgutil import resolve_name
from typing import ClassVar

from hydra.types import HydraContext
from omegaconf import DictConfig

from acmr.config import ConfigError
from acmr.settings.compose import launchers
from sweeps.folder import SweepFolder
from sweeps.job import CHECKOUT, STOP_SIGNALS


class LauncherAdapter:
    """Starts the workers of a sweep and waits for them.

    ``conf/hydra/launcher/NAME.yaml`` names a subclass as its ``_target_``; docs/howto-launcher.md makes one.

    Args:
        config: Hydra's composed config; ``hydra.launcher`` in it is what that file says.
        context: Hydra's own.
        threads: The most threads that a run uses.
        workers: How many runs to train at a time, as typed (``workers=N``); None: as the file says.

    Attributes:
        settings: What the launcher's file says.
        threads: The most threads that a run uses.
        wanted: How many runs to train at a time, as typed or from the file, not yet checked.
    """

    #: Whether a worker chooses its run itself, so that none idles at the border of two stages. If not, the runs of a
    #: launch are fixed: first the teachers, and once these are complete, in a second launch, their students.
    workers_pick_runs: ClassVar[bool] = True
    #: Whether :meth:`is_busy` knows better than :meth:`launch` when all jobs have ended.
    has_queue: ClassVar[bool] = False
    #: Which of the settings says how many runs are trained at a time.
    workers_key: ClassVar[str] = "workers"

    def __init__(self, config: DictConfig, context: HydraContext, threads: int, workers: int | None) -> None:
        self.config, self.context, self.threads = copy.deepcopy(config), context, threads
        self.settings: DictConfig = self.config.hydra.launcher
        self.wanted: object = self.settings.get(self.workers_key, 1) if workers is None else workers
        # A job of a cluster begins in the folder where the sweep was started, which need not be this one.
        if CHECKOUT is not None:
            paths = [str(CHECKOUT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
            os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))

    @property
    def workers(self) -> int:
        """How many runs are trained at a time.

        Raises:
            ConfigError: If what was typed is no such number.
        """
        if type(self.wanted) is not int or self.wanted < 1:
            raise ConfigError(f"workers={self.wanted}: an integer of at least 1 is needed")
        return self.wanted

    def launch(self, folder: SweepFolder, runs: Sequence[int], number: int) -> None:
        """Trains runs; returns when all jobs have ended. What it raises is told, and what is missing launched again.

        Args:
            folder: The sweep's folder.
            runs: Indices of the runs.
            number: Count of launches before.
        """
        raise NotImplementedError

    def worker_command(self, folder: SweepFolder) -> list[str]:
        """The command of a worker that trains one run after the other, until none is left or this process is gone."""
        return [sys.executable, "-m", "sweeps.worker", str(folder.path), "--parent", str(os.getpid())]

    def shield(self) -> None:
        """Blocks the signals that end a sweep in this thread, and so in the workers that it will start.

        A worker has to outlive Ctrl-C, which a terminal sends to all of them, to end its training in good order.
        """
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)

    def is_busy(self) -> bool:
        """Whether jobs of the last launch may still be there; asked only where there is a queue."""
        return True

    def clear(self, folders: Sequence[SweepFolder]) -> None:
        """Ends what sweeps left whose own process has gone; workers of this machine notice that themselves."""

    def cancel(self) -> None:
        """Ends the jobs of the last launch; workers see in the sweep's folder that it is to stop."""


def make_adapter(config: DictConfig, context: HydraContext, threads: int, workers: int | None) -> LauncherAdapter:
    """The adapter of the launcher that was chosen.

    Raises:
        ConfigError: If it has none. Hydra's own launchers know nothing of teachers, claims and stopping in good order:
            used as they are, they would start every run at once, or train in the process that should look on.
    """
    name, target = config.hydra.runtime.choices["hydra/launcher"], config.hydra.launcher.get("_target_")
    try:
        kind = resolve_name(str(target))
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"hydra/launcher={name}: its _target_={target} cannot be imported ({error})") from error
    if not (isinstance(kind, type) and issubclass(kind, LauncherAdapter)):
        known = " or ".join(f"hydra/launcher={each}" for each in launchers() if each != name)
        raise ConfigError(
            f"hydra/launcher={name}: sweeps have no adapter for it; type {known}, "
            "or write an adapter (docs/howto-launcher.md)"
        )
    return kind(config, context, threads, workers)
