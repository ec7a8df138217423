"""A worker of a sweep: takes up a run, trains it in a process of its own, and notes what has become of it.

Hydra's launchers call :func:`work`; other ones start ``python -m sweeps.worker FOLDER``.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from acmr.command import command
from acmr.config import ConfigError
from acmr.records import COMPLETE, ENDED, FAILED, RUNNING, STOPPED, DamagedError
from acmr.storage.run_dir import RunDir
from sweeps.folder import OUTPUT_FILE, SweepFolder
from sweeps.job import STOP_SIGNALS, TrainingProcess
from sweeps.state import FINAL, State, SweepRun

#: The run that a job takes up where it may choose.
NEXT = "next"
#: Exit codes of one training that mean something; see the manual of ``run.py``.
REFUSED, NUMBERS_DIVERGED, HELD = 2, 3, 75
#: Seconds to wait for a run's directory that another process holds; a killed one may still write its checkpoint.
PATIENCE = 60.0
_PAUSE = 0.5


def work(cfg: DictConfig) -> None:
    """Hydra's task: trains one run of a sweep, with its repetitions.

    Args:
        cfg: ``sweep``, the sweep's folder; ``run``, the index of the run or ``next``; ``parent``, the process that this
            worker must not outlive, or 0.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    folder = SweepFolder(Path(cfg.sweep))
    worker = Worker(folder, int(cfg.parent))
    if cfg.run == NEXT:
        # There are as many jobs as runs; where more may come, there are as many as workers.
        while worker.take_next() and folder.is_open:
            pass
    else:
        worker.take(int(cfg.run))
    if worker.is_orphan():
        # Its queue may hold more runs, and nobody is left to stop it.
        os._exit(1)


class Worker:
    """Trains runs of a sweep.

    Args:
        folder: The sweep's folder.
        parent: The process whose end is this one's too; 0: none.
    """

    def __init__(self, folder: SweepFolder, parent: int) -> None:
        self._folder, self._parent = folder, parent
        self._read_plan()

    def _read_plan(self) -> None:
        try:
            header, self._entries = self._folder.header(), self._folder.entries()
        except DamagedError as error:
            raise ConfigError(f"{error}; start the sweep's command again") from error
        self._order: list[int] = [index for index in header["order"] if index in range(len(self._entries))]
        self._retries, self._grace = int(header["retries"]), float(header["grace"])

    def take_next(self) -> bool:
        """Takes up the first run that can start; waits while there is none but others may make one ready.

        Returns:
            Whether there was one.
        """
        while not self._is_over():
            # Asked first: a run that comes after this look is found at the next one. A sweep that was killed leaves its
            # mark, and a worker of another machine does not see its process.
            promising = self._folder.is_open and self._folder.is_alive()
            if promising:
                self._folder.reload()
                self._read_plan()
            for index in self._order:
                if self._state(index).state in FINAL:
                    continue
                if not self._is_ready(index):
                    promising = promising or self._may_become_ready(index)
                    continue
                with self._folder.claim(index) as mine:
                    # Another worker may have trained it to its end since the look at its state.
                    if mine and self._folder.state(index).state not in FINAL:
                        self._train(index)
                        return True
            if not promising:
                return False
            # Files are looked at again and again, since workers of other machines can send no signals.
            time.sleep(_PAUSE)
        return False

    def take(self, index: int) -> None:
        """Takes up one run, unless it has ended."""
        if self._state(index).state not in FINAL and not self._is_over():
            self._train(index, bound=True)

    def _state(self, index: int) -> State:
        ended = self._entries[index].ended
        return State(ended) if ended else self._folder.state(index)

    def _is_ready(self, index: int) -> bool:
        teacher = self._entries[index].teacher
        return teacher is None or self._state(teacher).state == COMPLETE

    def _may_become_ready(self, index: int) -> bool:
        teacher = self._entries[index].teacher
        return teacher is not None and self._state(teacher).state not in FINAL

    def _is_over(self, index: int | None = None) -> bool:
        """Whether the sweep is to stop, or one of its runs is."""
        withdrawn = index is not None and self._folder.is_withdrawn(index)
        return withdrawn or self._folder.stopping or self.is_orphan()

    def is_orphan(self) -> bool:
        """Whether the process that it works for has gone."""
        return self._parent not in (0, os.getpid(), os.getppid())

    def _train(self, index: int, bound: bool = False) -> None:
        state, held_since = self._folder.state(index), time.monotonic()
        while state.failures <= self._retries:
            self._folder.set_state(index, replace(state, state=RUNNING))
            code, words, told = self._attempt(self._entries[index])
            outcome = self._outcome(index, code, told)
            if outcome in (*ENDED, STOPPED):
                self._folder.set_state(index, replace(state, state=outcome, reason=""))
                return
            # Held by a training whose worker was killed: it will end by itself, which is no failure of this run.
            if code == HELD and time.monotonic() - held_since < PATIENCE and not self._is_over():
                time.sleep(_PAUSE)
                continue
            state = State(FAILED, state.failures + 1, _reason(code, words))
            # What was refused once will be refused again.
            final = code in (REFUSED, HELD) or state.failures > self._retries
            if not final:
                again = f"attempt {state.failures + 1} of {self._retries + 1} after: {state.reason}"
                state = replace(state, state=STOPPED, reason=again)
            self._folder.set_state(index, state)
            # A cluster's job that somebody ended must not begin the run anew; the sweep launches another one.
            if final or (bound and code in _ENDED_FROM_OUTSIDE):
                return

    def _attempt(self, entry: SweepRun) -> tuple[int, str, bool]:
        """Trains once; returns the exit code, the last words, and whether the training was told to stop."""
        run_dir = self._folder.output_dir / entry.directory
        try:
            training = TrainingProcess(self._folder.job_file(entry.index), run_dir / OUTPUT_FILE, entry.threads)
        except OSError as error:
            return REFUSED, f"{error.filename or run_dir}: {error.strerror or error}", False
        try:
            while (code := training.wait()) is None and not self._is_over(entry.index):
                pass
            told = code is None
        finally:
            # Also when Slurm takes this job's time away, which ends this function by an exception.
            code = training.stop(self._grace, lambda: self._folder.killing)
        return code, training.last_words(), told

    def _outcome(self, index: int, code: int, told: bool) -> str:
        if code == 0 or code == NUMBERS_DIVERGED:
            with suppress(ConfigError):
                summary = RunDir(self._folder.output_dir / self._entries[index].directory).summary()
                status = (summary or {}).get("status")
                return str(status) if status in ENDED else FAILED
            return FAILED
        return STOPPED if told or self._is_over(index) else FAILED


_ENDED_FROM_OUTSIDE = (-signal.SIGTERM, 128 + signal.SIGTERM, 128 + signal.SIGINT)


def _reason(code: int, words: str) -> str:
    if code < 0:
        name = signal.Signals(-code).name
        hint = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"killed by {name}{hint}"
    if code in _ENDED_FROM_OUTSIDE:
        return "ended from outside"
    return words or f"exit code {code}"


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Trains runs of a sweep until none is left that could start; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sweeps.worker", description=main.__doc__)
    parser.add_argument("folder", type=Path, help="the sweep's folder, OUTPUT_DIR/.sweeps/ID")
    parser.add_argument("--parent", type=int, default=0, help="process that this one must not outlive; 0: none (0)")
    options = parser.parse_args(arguments)
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    worker = Worker(SweepFolder(options.folder.absolute()), options.parent)
    while worker.take_next():
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
