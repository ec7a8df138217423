"""The training process of one run: its settings as a file, its start, its stop in good order."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from acmr.config import ConfigError, ExperimentConfig
from acmr.foreign import opened
from acmr.records import DamagedError
from acmr.settings.compose import look_in
from acmr.settings.run_spec import RunSpec
from acmr.settings.sources import stored_sources
from acmr.storage.durable import open_to_append, read_regular
from acmr.storage.json_files import write_json
from acmr.text import one_line
from sweeps.folder import SweepFolder

_SCRIPT = Path(__file__).resolve().parent.parent / "run.py"
#: The checkout that this is; None: the program is installed, and found from anywhere.
CHECKOUT = _SCRIPT.parent if _SCRIPT.is_file() else None
#: A checkout's own file, whatever else is installed; else a module, and not the folder's own before it (-P).
_STARTER = [str(_SCRIPT)] if CHECKOUT else ["-P", "-m", "acmr.app.training"]
#: Environment variable with the process that a training must not outlive.
PARENT = "ACMR_SWEEP_WORKER"
#: Signals that end a sweep in good order; its processes inherit that they are blocked.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds that a training has for its checkpoint when its worker has gone.
ORPHAN_GRACE = 20.0
_POLL = 0.25
#: More than the settings of any run take.
_MOST_BYTES = 16 << 20
_SET_DEATH_SIGNAL = 1


def write_job(path: Path, spec: RunSpec) -> None:
    """Stores a run with everything that follows from its settings, so that it needs no settings file any more."""
    named = {"name": spec.name, "cell": spec.cell, "kin": spec.kin}
    content = {"config": asdict(spec.config), "changes": spec.changes, **named}
    write_json(path, content)


def read_job(path: Path) -> RunSpec:
    """Reads what :func:`write_job` stored."""
    content = json.loads(read_regular(path, _MOST_BYTES))
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(ExperimentConfig), content["config"]))
    assert isinstance(config, ExperimentConfig)
    return RunSpec(config, content["changes"], content["name"], content["cell"], content["kin"])


def adopt(path: Path) -> tuple[RunSpec, Callable[[], None]]:
    """Makes this process the training of a job: with the settings of the sweep's start, and no longer than its worker.

    Args:
        path: A file of :func:`write_job`, within a sweep's folder.

    Returns:
        The run, and what to call once it has been begun from its first step.

    Raises:
        ConfigError: If the file cannot be read.
    """
    _die_with_parent(int(os.environ.pop(PARENT, os.getppid())))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    # The student's teacher follows from these files, which nobody edits.
    folder = path.parent.parent
    try:
        look_in(stored_sources(folder, folder / "conf"))
        spec = read_job(path)
    except (DamagedError, OSError, ValueError, LookupError, TypeError, RecursionError, OmegaConfBaseException) as error:
        raise ConfigError(f"{path}: damaged ({one_line(error)}); start the sweep's command again") from error
    sweep, index = SweepFolder(folder), int(path.stem)
    if sweep.has_begun(index):
        # This sweep has begun it anew already; to be asked for once is to be done once.
        spec = replace(spec, config=replace(spec.config, force=False))
    return spec, lambda: sweep.note_begun(index)


class TrainingProcess:
    """A run's own process.

    Args:
        job_file: The run's settings.
        log_file: Takes what the process prints, at its end.
        threads: Threads that it may use.

    Raises:
        OSError: If it cannot be started, or its output cannot be kept.
    """

    def __init__(self, job_file: Path, log_file: Path, threads: int) -> None:
        log_file.parent.mkdir(parents=True, exist_ok=True)
        variables = {f"{library}_NUM_THREADS": str(threads) for library in ("OMP", "MKL", "OPENBLAS")}
        with open(open_to_append(log_file), "ab") as log:
            self._log_file, self._start = log_file, log.tell()
            self._process = _start([sys.executable, *_STARTER, f"@{job_file}"], variables, log)

    def wait(self, seconds: float = _POLL) -> int | None:
        """The exit code, negative for a signal; None if it still runs after ``seconds``."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def stop(self, grace: float, hurry: Callable[[], bool] = lambda: False) -> int:
        """Ends it: in good order, and by force if it has not ended after ``grace`` seconds, or once ``hurry()``."""
        deadline = time.monotonic() + grace
        self._process.terminate()
        while (code := self.wait()) is None:
            if time.monotonic() > deadline or hurry():
                self._process.kill()
        return code

    def last_words(self) -> str:
        """The line that says why it ended, if it printed one."""
        try:
            with opened(self._log_file, links=False) as (stream, size):
                stream.seek(max(self._start, size - 20_000))
                said = stream.read().decode(errors="replace")
        except DamagedError:
            # Whoever took it away meanwhile has what stood in it.
            return ""
        lines = [line for line in said.splitlines() if line.strip()]
        return _error_line(lines)


def _start(command: list[str], variables: dict[str, str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    # Slurm announces the end of a job's time to all of its processes; only the worker is to act on it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1, signal.SIGUSR2})
    try:
        return subprocess.Popen(
            command,
            env={**os.environ, **variables, PARENT: str(os.getpid())},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            # Ctrl-C reaches the sweep alone; it ends its trainings one by one.
            start_new_session=True,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _error_line(lines: list[str]) -> str:
    # What is said last says most, also after the traceback of an environment.
    if lines and lines[-1].startswith("error: "):
        return lines[-1].removeprefix("error: ")
    traces = [number for number, line in enumerate(lines) if line.startswith("Traceback (most recent call last)")]
    if traces:
        return next((line for line in lines[traces[-1] + 1 :] if not line.startswith(" ")), lines[-1])
    return next((line.removeprefix("error: ") for line in reversed(lines) if line.startswith("error: ")), "")


def _die_with_parent(parent: int) -> None:
    """Ends this process soon after ``parent`` has, in good order if it can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(128 + signal.SIGTERM)
    threading.Thread(target=_watch, args=(parent,), name="parent-watch", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(ORPHAN_GRACE)
    os.kill(os.getpid(), signal.SIGKILL)
