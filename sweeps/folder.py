"""The directory of a sweep: its plan and settings as they were at its start, and the state of each run.

``<output_dir>/.sweeps/<id>/`` holds ``plan.json``, the runs' settings (``jobs``), a copy of ``conf``, the state of each
run (``states``) and, once the sweep is to stop, ``stop``. Free of Hydra, so that ``make status`` starts quickly.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acmr.records import ENDED, FAILED
from acmr.storage.json_files import replace_json

SWEEPS = ".sweeps"
#: What a training printed, in its run's directory.
OUTPUT_FILE = "output.log"
#: State of a run of a sweep, beside those that it says itself.
WAITING = "waiting"
#: States that a run does not leave within its sweep.
FINAL = (*ENDED, FAILED)
#: Folders of former sweeps that are kept.
_KEPT = 10


@dataclass(frozen=True)
class SweepRun:
    """One run, as the sweep's folder knows it.

    Attributes:
        index: Its place in the plan.
        name: The run's name.
        cell: The paper's name of the experiment, if it has one.
        seed: Its seed.
        directory: Where it lies, from the folder of all runs.
        total_timesteps: Steps that it takes at most.
        threads: Threads that it uses.
        teacher: Index of the run that has to be complete before it starts.
        ended: ``complete`` or ``diverged``, if it was there before the sweep.
    """

    index: int
    name: str
    cell: str | None
    seed: int
    directory: str
    total_timesteps: int
    threads: int
    teacher: int | None
    ended: str | None


@dataclass(frozen=True)
class State:
    """What has become of a run within its sweep.

    Attributes:
        state: ``waiting``, ``running``, ``complete``, ``diverged``, ``failed`` or ``stopped``.
        failures: How often it failed.
        reason: Why it failed or waits, in one line.
    """

    state: str = WAITING
    failures: int = 0
    reason: str = ""


class SweepFolder:
    """Reads and writes a sweep's folder; every file appears whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.conf = path / "conf"
        self.output_dir = path.parent.parent
        self._held: int | None = None

    @classmethod
    def create(
        cls, output_dir: Path, header: Mapping[str, Any], entries: Sequence[SweepRun], order: Sequence[int], conf: Path
    ) -> SweepFolder:
        """Makes the folder of a new sweep, and clears away those of sweeps long gone.

        Args:
            output_dir: Where the runs lie.
            header: The sweep's own settings.
            entries: All runs.
            order: Those to train, in the order in which they are best taken up.
            conf: The folder of settings, which is copied.
        """
        identity = f"{time.strftime('%Y%m%d-%H%M%S')}-{time.time_ns() // 1000 % 1_000_000:06}"
        folder = cls((output_dir / SWEEPS / identity).absolute())
        for name in ("jobs", "states", "claims"):
            (folder.path / name).mkdir(parents=True)
        shutil.copytree(conf, folder.conf)
        folder._hold()
        content = {
            **header,
            "process": os.getpid(),
            "order": list(order),
            "runs": [asdict(entry) for entry in entries],
        }
        replace_json(folder.path / "plan.json", content)
        for old in all_folders(output_dir)[:-_KEPT]:
            if not old.is_alive():
                shutil.rmtree(old.path, ignore_errors=True)
        return folder

    def header(self) -> dict[str, Any]:
        """The whole plan as it was stored."""
        content = json.loads((self.path / "plan.json").read_text(encoding="utf-8"))
        assert isinstance(content, dict)
        return content

    def entries(self) -> list[SweepRun]:
        """All runs of the sweep."""
        return [SweepRun(**run) for run in self.header()["runs"]]

    def is_alive(self) -> bool:
        """Whether its process is still there."""
        with _locked(self.path / "alive") as free:
            return not free

    def release(self) -> None:
        """Says that the sweep is over before its process is."""
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _hold(self) -> None:
        # A lock, because a process number may soon belong to somebody else, and because other machines see it too.
        self._held = os.open(self.path / "alive", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        fcntl.flock(self._held, fcntl.LOCK_EX)

    def job_file(self, index: int) -> Path:
        """Where the settings of a run are."""
        return self.path / "jobs" / f"{index:05d}.json"

    def state(self, index: int) -> State:
        """What has become of a run."""
        try:
            return State(**json.loads(self._state_file(index).read_text(encoding="utf-8")))
        except FileNotFoundError:
            return State()

    def set_state(self, index: int, state: State) -> None:
        """Notes what has become of a run."""
        replace_json(self._state_file(index), asdict(state))

    def _state_file(self, index: int) -> Path:
        return self.path / "states" / f"{index:05d}.json"

    @contextmanager
    def claim(self, index: int) -> Iterator[bool]:
        """Takes a run for this process, unless another has it; it is free again when the process ends, however."""
        with _locked(self.path / "claims" / f"{index:05d}") as mine:
            yield mine

    def stop(self, at_once: bool) -> None:
        """Tells every worker to end its training: after a checkpoint, or at once."""
        # A file reaches the workers wherever they are, and those that start later, too.
        (self.path / ("kill" if at_once else "stop")).touch()

    @property
    def stopping(self) -> bool:
        """Whether the sweep is to stop."""
        return (self.path / "stop").exists() or self.killing

    @property
    def killing(self) -> bool:
        """Whether it is to stop without a checkpoint."""
        return (self.path / "kill").exists()


def all_folders(output_dir: Path) -> list[SweepFolder]:
    """The folders of all sweeps that are kept, the newest last."""
    found = sorted((output_dir / SWEEPS).glob("*/plan.json"), key=lambda path: path.stat().st_mtime_ns)
    return [SweepFolder(path.parent) for path in found]


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Whether a file's lock could be had; the lock goes with the process that has it, however that ends."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except BlockingIOError:
        yield False
    finally:
        os.close(descriptor)
