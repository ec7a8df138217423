"""The directory of a sweep: its plan and settings as they were at its start, and the state of each run.

``<output_dir>/.sweeps/<id>/`` holds ``plan.json``, the runs' settings (``jobs``), a copy of ``conf``, the state of each
run (``states``), which were begun anew in it (``begun``) or are wanted no more (``withdrawn``), ``open`` while more may
come and, once the sweep is to stop, ``stop``. What cannot be read stops nobody: a state counts as waiting, the plan
of a sweep that is over is set aside. Free of Hydra, to start quickly.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acmr.records import STOPPED, DamagedError
from acmr.storage.durable import WriteError, read_regular
from acmr.storage.json_files import write_json
from acmr.storage.processes import is_alive
from sweeps.state import STATES, WAITING, WITHDRAWN, State, SweepRun, read_run

SWEEPS = ".sweeps"
#: What a training printed, in its run's directory.
OUTPUT_FILE = "output.log"
#: Folders of former sweeps that are kept.
_KEPT = 10
_PLAN, _SET_ASIDE = "plan.json", "plan.json.damaged"
#: More than the plan of any sweep takes.
_MOST_BYTES = 64 << 20
#: The fields of a plan that have to be of a type, where they are there.
_KINDS: dict[str, Any] = {
    "command": str, "retries": int, "grace": int | float, "process": int, "host": str, "order": list, "runs": list,
}  # fmt: skip


class SweepFolder:
    """Reads and writes a sweep's folder; every file appears whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.conf = path / "conf"
        self.output_dir = path.parent.parent
        self._held: int | None = None
        self._plan: dict[str, Any] | None = None

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
        for name in ("jobs", "states", "claims", "begun", "withdrawn"):
            (folder.path / name).mkdir(parents=True)
        shutil.copytree(conf, folder.conf)
        folder._hold()
        content = {
            **header,
            "process": os.getpid(),
            "host": platform.node(),
            "order": list(order),
            "runs": [asdict(entry) for entry in entries],
        }
        write_json(folder.path / _PLAN, content)
        for old in all_folders(output_dir)[:-_KEPT]:
            if not old.is_alive():
                shutil.rmtree(old.path, ignore_errors=True)
        return folder

    def header(self) -> dict[str, Any]:
        """The whole plan as it was stored.

        Raises:
            DamagedError: If it cannot be read, or is no plan.
        """
        if self._plan is None:
            path = self.path / _PLAN
            content = _read(path)
            odd = [key for key, kind in _KINDS.items() if key in content and not isinstance(content[key], kind)]
            if odd or "runs" not in content:
                raise DamagedError(f"{path}: no plan of a sweep ({(odd or ['runs'])[0]})")
            self._plan = content
        return self._plan

    def entries(self) -> list[SweepRun]:
        """All runs of the sweep.

        Raises:
            DamagedError: If the plan cannot be read, or has something else in their place.
        """
        return [read_run(self.path / _PLAN, index, run) for index, run in enumerate(self.header()["runs"])]

    def extend(self, entries: Sequence[SweepRun], order: Sequence[int]) -> None:
        """Stores the plan anew, with runs that came after those that it had.

        Args:
            entries: All runs, the former ones first.
            order: Those to train.
        """
        content = {**self.header(), "order": list(order), "runs": [asdict(entry) for entry in entries]}
        write_json(self.path / _PLAN, content)
        self._plan = content

    def reload(self) -> None:
        """Forgets the plan, so that it is read again."""
        self._plan = None

    def is_alive(self) -> bool:
        """Whether its process is still there."""
        try:
            with _locked(self.path / "alive") as free:
                return not free
        except OSError:
            # A file system without locks, or no file: the plan says whose it is.
            with suppress(DamagedError):
                plan = self.header()
                return is_alive(int(plan.get("process", 0)), str(plan.get("host", platform.node())))
            return False

    def set_aside(self, why: str, warn: Callable[[str], None]) -> None:
        """Says that the plan cannot be read, and takes it away if its sweep is over, so that it is said once."""
        if self.is_alive():
            warn(f"warning: {why}; the sweep is still at work, and is passed over here")
            return
        with suppress(OSError):
            os.replace(self.path / _PLAN, self.path / _SET_ASIDE)
            warn(f"warning: {why}; that sweep is over, and its plan is set aside as {_SET_ASIDE}")
            return
        warn(f"warning: {why}; that sweep is over, and is passed over")

    def release(self) -> None:
        """Says that the sweep is over before its process is."""
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _hold(self) -> None:
        # A lock, because a process number may soon belong to somebody else, and because other machines see it too.
        self._held = os.open(self.path / "alive", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        with suppress(OSError):
            fcntl.flock(self._held, fcntl.LOCK_EX)

    def job_file(self, index: int) -> Path:
        """Where the settings of a run are."""
        return self.path / "jobs" / f"{index:05d}.json"

    def state(self, index: int) -> State:
        """What has become of a run; it waits where nothing is said that can be read."""
        found = self._stored_state(index)
        # A worker that has it stops it first, and says so.
        withdrawn = found.state in (WAITING, STOPPED) and self.is_withdrawn(index)
        return State(WITHDRAWN, found.failures, "stopped on purpose") if withdrawn else found

    def _stored_state(self, index: int) -> State:
        with suppress(DamagedError):
            said = _read(self._state_file(index))
            state, failures, reason = said.get("state"), said.get("failures"), said.get("reason")
            if state in STATES and type(failures) is int and 0 <= failures < 1_000_000 and isinstance(reason, str):
                return State(state, failures, reason)
        return State()

    def set_state(self, index: int, state: State) -> None:
        """Notes what has become of a run."""
        write_json(self._state_file(index), asdict(state))

    def _state_file(self, index: int) -> Path:
        return self.path / "states" / f"{index:05d}.json"

    def withdraw(self, index: int) -> None:
        """Says that a run is wanted no more: its worker stops it as at the end of the sweep, and none takes it up."""
        (self.path / "withdrawn" / f"{index:05d}").touch()

    def readmit(self, index: int) -> None:
        """Says that it is wanted again."""
        (self.path / "withdrawn" / f"{index:05d}").unlink(missing_ok=True)

    def is_withdrawn(self, index: int) -> bool:
        """Whether a run is wanted no more."""
        return (self.path / "withdrawn" / f"{index:05d}").exists()

    def keep_open(self, more: bool) -> None:
        """Says whether more runs may come, for which workers wait."""
        (self.path / "open").touch() if more else (self.path / "open").unlink(missing_ok=True)

    @property
    def is_open(self) -> bool:
        """Whether more runs may come."""
        return (self.path / "open").exists()

    @contextmanager
    def claim(self, index: int) -> Iterator[bool]:
        """Takes a run for this process, unless another has it; it is free again when the process ends, however."""
        with ExitStack() as stack:
            try:
                mine = stack.enter_context(_locked(self.path / "claims" / f"{index:05d}"))
            except OSError:
                # Where nothing can be locked, the run's own directory tells a second worker that it is held.
                mine = True
            yield mine

    def note_begun(self, index: int) -> None:
        """Records that a run which is to be made anew has been begun anew in this sweep."""
        # Should it be lost, another attempt begins once more.
        with suppress(WriteError):
            write_json(self.path / "begun" / f"{index:05d}.json", {})

    def has_begun(self, index: int) -> bool:
        """Whether that was recorded."""
        return (self.path / "begun" / f"{index:05d}.json").exists()

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


def all_folders(output_dir: Path, warn: Callable[[str], None] = lambda line: None) -> list[SweepFolder]:
    """The folders of all sweeps that are kept and whose plan can be read, the newest last.

    Args:
        output_dir: The folder of all runs.
        warn: Told of each whose plan cannot be read.
    """
    found = []
    for place in (output_dir / SWEEPS).glob("*"):
        folder, path = SweepFolder(place), place / _PLAN
        try:
            if os.path.lexists(path) and folder.entries() is not None:
                found.append((path.stat().st_mtime_ns, folder))
        except (DamagedError, OSError) as error:
            folder.set_aside(f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error), warn)
    return [folder for _, folder in sorted(found, key=lambda pair: pair[0])]


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_regular(path, _MOST_BYTES))
    except (ValueError, RecursionError):
        raise DamagedError(f"{path}: cannot be read") from None
    if not isinstance(content, dict):
        raise DamagedError(f"{path}: cannot be read")
    return content


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Whether a file's lock could be had; the lock goes with the process that has it, however that ends."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except BlockingIOError:
        yield False
    finally:
        os.close(descriptor)
