"""Mirrors a run to Weights & Biases: offline files by default, or a server of your own.

The run directory is the durable result; W&B only shows it, and a mirror can always be written anew from the run's own
files (:mod:`acmr.tracking.mirror`). W&B is imported only when a run is mirrored.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acmr.config import INDEPENDENT, THRESHOLD, ExperimentConfig, TransferConfig
from acmr.records import EpisodeRecord, portable_settings
from acmr.settings.run_spec import RunSpec
from acmr.text import one_line
from acmr.tracking import wandb_backend
from acmr.tracking.observer import Observer, Say, Tracker
from acmr.tracking.threaded import Threaded
from acmr.tracking.wandb_backend import LONGEST

if TYPE_CHECKING:
    from wandb import Run

#: How often it is checked that rows reach the file, and how old a row may grow before it counts as lost, in seconds.
ARRIVAL_CHECK = 15.0
#: Seconds that W&B may take over a row, and to take the rest at the end, before its service is ended.
PATIENCE, CLOSE_WAIT = 30.0, 45.0
#: Tag of runs that end at their threshold.
STOPPED = "stopped"


class WandbTracker(Tracker, Threaded):
    """Mirrors a run to W&B; an earlier mirror of the same run in the same folder is replaced.

    All of W&B is in a thread of its own, for it waits for its service process without any limit.

    Args:
        spec: The run.
        say: Takes a line, if the server cannot be used and the run is mirrored offline.

    Raises:
        Exception: Whatever W&B raises, if it cannot be started.
    """

    title = "W&B mirror"

    def __init__(self, spec: RunSpec, say: Say) -> None:
        Threaded.__init__(self, lambda: _Mirror(spec, say), wandb_backend.kill_service, PATIENCE, CLOSE_WAIT)


class _Mirror(Observer):
    """The same, in whatever thread it is used."""

    def __init__(self, spec: RunSpec, say: Say) -> None:
        self._run = _start(spec, say)
        self._file = Path(self._run.settings.sync_file)
        self._size = -1
        self._checked = time.monotonic()
        self._waiting_since: float | None = None

    def on_episode(self, record: EpisodeRecord) -> None:
        """Logs one row on the axis ``global_step``."""
        self._log(record.global_step, record.row())

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Logs one row on the axis ``global_step``."""
        self._log(step, values)

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Adds the summary, waits for what is under way (bounded) and ends W&B's service process."""
        exit_code = 1 if summary is None else 0
        try:
            if summary is not None:
                self._run.summary.update(dict(summary))
            self._size = self._file.stat().st_size
            self._run.finish(exit_code=exit_code)
        except TimeoutError as error:
            wait = wandb_backend.SERVER_WAIT
            raise TimeoutError(
                f"the server did not take everything within {wait:g} s; `make sync` sends the rest"
            ) from error
        finally:
            wandb_backend.end_service(exit_code)
        # The last record always lengthens the file.
        self._waiting_since = -math.inf
        self._check_arrival()
        if self._run.settings.mode != "offline":
            # As `wandb sync` marks what a server has.
            self._file.with_suffix(".wandb.synced").touch()

    def _log(self, step: int, values: Mapping[str, float]) -> None:
        now = time.monotonic()
        if now - self._checked > ARRIVAL_CHECK:
            self._checked = now
            self._check_arrival()
        self._run.log({"global_step": step, **values})
        if self._waiting_since is None:
            self._waiting_since = now

    def _check_arrival(self) -> None:
        """Raises OSError when rows no longer reach the file; W&B itself says nothing on a full disk."""
        size = self._file.stat().st_size
        if size > self._size:
            self._size, self._waiting_since = size, None
        elif self._waiting_since is not None and time.monotonic() - self._waiting_since > ARRIVAL_CHECK / 2:
            free = shutil.disk_usage(self._file.parent).free / 1e6
            raise OSError(f"rows no longer reach {self._file} ({free:.0f} MB free on that disk)")


def _start(spec: RunSpec, say: Say) -> Run:
    """Starts W&B on the server that is named, and offline if there is none or it cannot be used."""
    address = spec.config.tracking.base_url
    if address is not None:
        problem = wandb_backend.server_problem(address)
        if problem is None:
            try:
                return _mirror(spec, address)
            except Exception as error:
                problem = f"{address} cannot be used: {one_line(error)}"
        say(f"W&B: {problem}. This run is mirrored offline; `make sync` sends it later.")
    return _mirror(spec, None)


def _mirror(spec: RunSpec, server: str | None) -> Run:
    config, words = spec.config.tracking, labels(spec)
    folder, name = wandb_backend.mirror_folder(spec), wandb_backend.run_id(spec)
    wandb_backend.make_writable(folder)
    wandb_backend.remove_mirrors(folder, name)
    arguments: dict[str, Any] = {
        "id": name,
        "name": name,
        "project": config.project,
        "entity": config.entity,
        "group": words["group"][: LONGEST["group"]],
        "job_type": words["job_type"],
        "tags": sorted({tag[: LONGEST["tag"]] for tag in words["tags"] if tag}),
        # Viewers search the config, not group and job_type.
        "config": {"run": spec.name, **words, **portable_settings(spec.settings)},
    }
    run = wandb_backend.start(arguments, folder, server)
    with contextlib.suppress(OSError):
        # A file system without links costs the short names, not the mirror.
        wandb_backend.link_by_name(folder, Path(run.settings.sync_dir), short_name(spec))
    return run


def short_name(spec: RunSpec) -> str:
    """What tells a run apart in a few characters: ``A2-s3-paper``, or where it is no cell ``s3-ant-hidden-paper``."""
    profile, seed = spec.config.profile, spec.config.seed
    ending = "".join(f"-{kind}" for kind in _kinds(spec.config))
    return f"{spec.cell}-s{seed}-{profile}{ending}" if spec.cell else f"s{seed}-{spec.name}-{profile}"


def labels(spec: RunSpec) -> dict[str, Any]:
    """Words to find a run by: ``group`` (what its seeds share), ``job_type`` (teacher or student) and ``tags``."""
    config, kinds = spec.config, _kinds(spec.config)
    # The schema's default: nothing is transferred. Stored settings do not hold the rules of the method.
    teaches = config.transfer.name == TransferConfig().name and config.env.name == config.env.source
    tags = [
        config.profile,
        config.env.name,
        config.transfer.name,
        "frozen" if config.freeze else "unfrozen",
        f"seed{config.seed}",
    ]
    return {
        # Runs of different lengths, or of one seed, are not averaged with each other.
        "group": f"{config.profile}/{spec.cell if spec.cell and not kinds else spec.name}",
        "job_type": "teacher" if teaches else "student",
        "tags": [*tags, *([spec.cell] if spec.cell else []), *kinds],
    }


def _kinds(config: ExperimentConfig) -> list[str]:
    """What tells a run from others of its cell and seed, in a word each."""
    found = {STOPPED: config.stop == THRESHOLD, INDEPENDENT: config.seeding == INDEPENDENT}
    return [kind for kind, holds in found.items() if holds]
