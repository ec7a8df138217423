"""Mirrors a run to Weights & Biases: offline files by default, a server of your own, or nothing.

The run directory is the durable result; W&B only shows it. So a tracker may fail at any time (no server, no disk, no
permission) and costs the run one warning, and a mirror can always be written anew from the run's own files
(:mod:`acmr.tracking.mirror`). W&B is imported only when a run is mirrored.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from acmr.cells import CELLS
from acmr.config import THRESHOLD, TrackingConfig, TransferConfig
from acmr.records import VELOCITY_COLUMN, EpisodeRecord
from acmr.text import one_line
from acmr.tracking import wandb_backend
from acmr.tracking.wandb_backend import LONGEST, SERVER_WAIT

if TYPE_CHECKING:
    from wandb import Run

#: How often it is checked that rows reach the file, and how old a row may grow before it counts as lost, in seconds.
ARRIVAL_CHECK = 15.0
#: Tag of runs that end at their threshold.
STOPPED = "stopped"


class Tracker(Protocol):
    """Takes a run's numbers as they appear. No method raises."""

    def episode(self, record: EpisodeRecord) -> None:
        """Mirrors a finished episode."""

    def metrics(self, global_step: int, values: Mapping[str, float]) -> None:
        """Mirrors a row of ``metrics.csv``."""

    def finish(self, summary: Mapping[str, object] | None, exit_code: int = 0) -> None:
        """Closes the mirror; to be called exactly once, however the run ended."""


class NullTracker:
    """Mirrors nothing."""

    def episode(self, record: EpisodeRecord) -> None:
        """Does nothing."""

    def metrics(self, global_step: int, values: Mapping[str, float]) -> None:
        """Does nothing."""

    def finish(self, summary: Mapping[str, object] | None, exit_code: int = 0) -> None:
        """Does nothing."""


class WandbTracker:
    """Mirrors a run to W&B; after the first failure it warns once and falls silent."""

    def __init__(self, run: Run, warn: Callable[[str], None]) -> None:
        """Takes over a started W&B run."""
        self._run = run
        self._warn = warn
        self._failed = False
        self._file = Path(run.settings.sync_file)
        self._size = -1
        self._checked = time.monotonic()
        self._waiting_since: float | None = None

    def episode(self, record: EpisodeRecord) -> None:
        """Logs one row on the axis ``global_step``."""
        self._log(episode_row(record))

    def metrics(self, global_step: int, values: Mapping[str, float]) -> None:
        """Logs one row on the axis ``global_step``."""
        self._log({"global_step": global_step, **values})

    def finish(self, summary: Mapping[str, object] | None, exit_code: int = 0) -> None:
        """Adds the summary, waits for what is under way (bounded) and ends W&B's service process."""
        try:
            if not self._failed:
                if summary is not None:
                    self._run.summary.update(dict(summary))
                self._size = self._file.stat().st_size
                self._run.finish(exit_code=exit_code)
        except TimeoutError:
            self._fail(f"the server did not take everything within {SERVER_WAIT:g} s; `make sync` sends the rest")
        except Exception as error:
            self._fail(one_line(error))
        finally:
            wandb_backend.end_service(exit_code)
        if not self._failed:
            self._check_end()

    def _log(self, row: Mapping[str, float]) -> None:
        if self._failed:
            return
        try:
            now = time.monotonic()
            if now - self._checked > ARRIVAL_CHECK:
                self._checked = now
                self._check_arrival()
            self._run.log(dict(row))
            if self._waiting_since is None:
                self._waiting_since = now
        except Exception as error:
            self._fail(one_line(error))

    def _check_end(self) -> None:
        """The last record always lengthens the file; a server that took it leaves the marker of ``wandb sync``."""
        try:
            self._waiting_since = -math.inf
            self._check_arrival()
            if self._run.settings.mode != "offline":
                self._file.with_suffix(".wandb.synced").touch()
        except Exception as error:
            self._fail(one_line(error))

    def _check_arrival(self) -> None:
        """Raises OSError when rows no longer reach the file; W&B itself says nothing on a full disk."""
        size = self._file.stat().st_size
        if size > self._size:
            self._size, self._waiting_since = size, None
        elif self._waiting_since is not None and time.monotonic() - self._waiting_since > ARRIVAL_CHECK / 2:
            free = shutil.disk_usage(self._file.parent).free / 1e6
            raise OSError(f"rows no longer reach {self._file} ({free:.0f} MB free on that disk)")

    def _fail(self, reason: str) -> None:
        self._failed = True
        self._warn(f"W&B mirror stopped: {reason}. The run goes on; its own files are complete.")


def make_tracker(
    config: TrackingConfig,
    *,
    output_dir: Path,
    run_name: str,
    profile: str,
    seed: int,
    group: str,
    job_type: str,
    tags: Sequence[str],
    settings: Mapping[str, object],
    warn: Callable[[str], None],
) -> Tracker:
    """Starts the mirror of a run; an earlier mirror of the same run in the same folder is replaced.

    Args:
        config: Where to mirror to.
        output_dir: Root of all runs; its ``wandb`` folder holds all mirrors unless ``config.dir`` names another.
        run_name: Name of the run's directory, as in ``armless_humanoid-hidden-frozen``.
        profile: Name of the profile; with the name and the seed it makes the run's id.
        seed: The run's seed.
        group: What runs of different seeds share.
        job_type: Kind of the run, for example its cell.
        tags: Words to find the run by.
        settings: The resolved settings, as plain values.
        warn: Called with one line, at most once per failure, when the mirror cannot be started or goes on no more.

    Returns:
        A tracker that never raises; one that does nothing where W&B cannot be used.
    """
    if config.mode == "off":
        return NullTracker()
    folder = wandb_backend.mirror_folder(config, output_dir)
    name = wandb_backend.run_id(config, output_dir, profile, run_name, seed)
    labels = {"profile": profile, "run": run_name, "group": group, "job_type": job_type, "tags": list(tags)}
    arguments: dict[str, Any] = {
        "id": name,
        "name": name,
        "project": config.project,
        "entity": config.entity,
        "group": group[: LONGEST["group"]],
        "job_type": job_type[: LONGEST["tag"]],
        "tags": sorted({tag[: LONGEST["tag"]] for tag in tags if tag}),
        # Viewers search the config, not group and job_type.
        "config": {**labels, **settings},
    }
    address = config.base_url if config.mode == "self_hosted" else None
    if address and (problem := wandb_backend.server_problem(address)):
        warn(f"W&B: {problem}. This run is mirrored offline; `make sync` sends it later.")
        address = None
    attempts = [address, None] if address else [None]
    for server in attempts:
        try:
            wandb_backend.make_writable(folder)
            wandb_backend.remove_mirrors(folder, name)
            run = wandb_backend.start(arguments, folder, server)
            with contextlib.suppress(OSError):
                # A file system without links costs the short names, not the mirror.
                wandb_backend.link_by_name(folder, Path(run.settings.sync_dir), _label(profile, run_name, seed, tags))
            return WandbTracker(run, warn)
        except (Exception, SystemExit) as error:
            wandb_backend.end_service(1)
            then = "is mirrored offline; `make sync` sends it later" if server else "goes on without a mirror"
            warn(f"W&B mirror not started{f' on {server}' if server else ''}: {one_line(error)}. The run {then}.")
    return NullTracker()


def _label(profile: str, run_name: str, seed: int, tags: Sequence[str]) -> str:
    """What tells a run apart in a few characters: ``A2-s3-paper``, or where it is no cell ``s3-ant-hidden-paper``."""
    cell = next((tag for tag in tags if tag in CELLS), None)
    ending = f"-{STOPPED}" if STOPPED in tags else ""
    return f"{cell}-s{seed}-{profile}{ending}" if cell else f"s{seed}-{run_name}-{profile}"


def labels(settings: Mapping[str, Any], run_name: str, cell: str | None) -> dict[str, Any]:
    """The arguments ``group``, ``job_type`` and ``tags`` of :func:`make_tracker` that follow from a run's settings.

    Args:
        settings: The resolved settings, keys as in :class:`acmr.config.ExperimentConfig`.
        run_name: Name of the run's directory.
        cell: The paper's name of the run, if it has one.
    """
    env, transfer, profile = settings["env"], str(settings["transfer"]["name"]), str(settings["profile"])
    # Settings that were stored before there was a choice have none.
    stops = settings.get("stop") == THRESHOLD
    # The schema's default: nothing is transferred. Stored settings do not hold the rules of the method.
    teaches = transfer == TransferConfig().name and env["name"] == env["source"]
    tags = [
        profile,
        str(env["name"]),
        transfer,
        "frozen" if settings["freeze"] else "unfrozen",
        f"seed{settings['seed']}",
    ]
    return {
        "group": f"{profile}/{cell if cell and not stops else run_name}",
        "job_type": "teacher" if teaches else "student",
        "tags": [*tags, *([cell] if cell else []), *([STOPPED] if stops else [])],
    }


def episode_row(record: EpisodeRecord) -> dict[str, float]:
    """An episode as W&B shows it: the columns of ``episodes.csv``."""
    row: dict[str, float] = {
        "global_step": record.global_step,
        "episodic_return": record.episodic_return,
        "episode_length": record.episode_length,
    }
    if record.mean_forward_velocity is not None:
        row[VELOCITY_COLUMN] = record.mean_forward_velocity
    return {**row, **record.reward_terms}
