"""The directory of one run: its files, who may write them, and whether it is finished."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from acmr.config import (
    TEACHER_CHOICE,
    ConfigError,
    ExperimentConfig,
    is_neutral,
    plain_settings,
    schema_defaults,
)
from acmr.foreign import SETTINGS, is_there, read_mapping
from acmr.names import terminal
from acmr.records import (
    COMPLETE,
    CONFIG_FILE,
    DESCRIPTION_FILE,
    EPISODES_FILE,
    EVALUATION_FILE,
    EVENTS_FOLDER,
    FAILED,
    LOG_FILE,
    METRICS_FILE,
    STATUS_FILE,
    STOPPED,
    SUMMARY_FILE,
    TENSOR_FILE,
    TRANSFER_FILE,
    DamagedError,
    ended_state,
)
from acmr.run_folders import changes, sealed
from acmr.storage.durable import (
    FileDigest,
    StorageError,
    open_to_append,
    read_regular,
    remove,
    remove_leftovers,
    remove_tree,
    sync_folder,
    write_bytes,
)
from acmr.storage.hold import LOCK_FILE, LostError, hold
from acmr.storage.json_files import read_json, replace_json, write_json
from acmr.text import flatten, message, one_line

#: Files that a run writes anew when it starts from the beginning; what would make it look finished goes first.
_RESULTS = (
    SUMMARY_FILE,
    EPISODES_FILE,
    METRICS_FILE,
    TRANSFER_FILE,
    TENSOR_FILE,
    DESCRIPTION_FILE,
    EVALUATION_FILE,
)


class RunDir:
    """Paths and state of a run directory; creating the object touches no disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / CONFIG_FILE
        self.episodes_file = path / EPISODES_FILE
        self.metrics_file = path / METRICS_FILE
        self.transfer_file = path / TRANSFER_FILE
        self.summary_file = path / SUMMARY_FILE
        self.log_file = path / LOG_FILE
        self.lock_file = path / LOCK_FILE
        self.checkpoint_folder = path / "checkpoint"

    def __str__(self) -> str:
        return str(self.path)

    def summary(self) -> dict[str, Any] | None:
        """What the finished run says of itself; None if it is not finished."""
        return self.read_json(self.summary_file)

    def is_complete(self) -> bool:
        """Whether the run came to its end, and what it recorded is what it left."""
        summary = self.summary()
        return summary is not None and ended_state(summary) == COMPLETE and not changes(self.path, summary)

    def check_unchanged(self) -> None:
        """Sees that a finished run is what it was when it ended; an unfinished one has nothing to be judged by.

        Raises:
            ConfigError: If it is not, or its summary cannot be read.
        """
        if changed := changes(self.path, self.summary() or {}):
            raise ConfigError(
                f"{self.path}: a finished run, but {'; '.join(changed.values())}; put back what the run wrote, or type "
                "force=true to run it anew"
            )

    def settings_digest(self) -> FileDigest:
        """What ``config.yaml`` holds.

        Raises:
            ConfigError: If it cannot be read.
        """
        try:
            return FileDigest.of(read_regular(self.config_file, SETTINGS))
        except DamagedError as error:
            raise ConfigError(f"{error}; type force=true to run it anew") from error

    def stored_settings(self) -> dict[str, Any] | None:
        """The settings it was started with; None if there are none yet."""
        if not is_there(self.config_file):
            return None
        try:
            return read_mapping(self.config_file)
        except DamagedError as error:
            raise ConfigError(f"{self.config_file}: not readable; type force=true to run it anew") from error

    def start(self, settings: Mapping[str, Any]) -> None:
        """Clears what an unfinished or repeated run left, and stores the settings."""
        for name in _RESULTS:
            remove(self.path / name)
        # Whether or not this run is shown there, the old one must not be.
        with suppress(OSError):
            remove_tree(self.path / EVENTS_FOLDER)
        # Nothing of the old run may come back once the new one has begun.
        sync_folder(self.path)
        write_bytes(self.config_file, yaml.safe_dump(dict(settings), sort_keys=False).encode())

    def read_json(self, path: Path) -> dict[str, Any] | None:
        """Reads one of the run's JSON files; None if there is none.

        Raises:
            ConfigError: If it cannot be read.
        """
        if not is_there(path):
            return None
        try:
            return read_mapping(path, path.name)
        except DamagedError as error:
            raise ConfigError(f"{path}: damaged ({error}); type force=true to run it anew") from error

    def write_json(self, path: Path, content: Mapping[str, Any]) -> None:
        """Writes a JSON file whole or not at all."""
        write_json(path, content)

    def finish(self, summary: Mapping[str, Any], files: Mapping[str, FileDigest]) -> dict[str, Any]:
        """Stores what the run says of itself, by which it is finished.

        Args:
            summary: The content of ``summary.json``.
            files: What this process has written of each of ``SEALED_FILES``: whatever lies there by their names.

        Returns:
            The summary with what tells whether anything is changed from now on.
        """
        whole = sealed(summary, {name: asdict(digest) for name, digest in files.items()})
        self.write_json(self.summary_file, whole)
        return whole

    @contextmanager
    def log(self, say: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
        """Says lines to the user, and keeps each in ``run.log`` with its time.

        A disk that does not take it, or a terminal that is gone, ends no run. An error that leaves the block is kept
        there as well, and in ``status.json`` if this process had begun to train.
        """

        def note(line: str) -> None:
            with suppress(OSError):
                # A path may hold bytes that are no text.
                os.write(descriptor, f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n".encode(errors="replace"))

        def both(line: str) -> None:
            line = terminal(line)
            note(line)
            with suppress(OSError, ValueError):
                say(line)

        try:
            descriptor = open_to_append(self.log_file)
        except OSError as error:
            raise self._refused(error) from error
        try:
            yield both
        except Exception as error:
            # What is not meant for the user has a message that says little without its type.
            cause = message(error) if isinstance(error, ConfigError) else one_line(error)
            note(f"error: {cause}")
            # Where the disk was full nothing is wrong with the run, which waits for space.
            state = STOPPED if isinstance(error, StorageError) else FAILED
            self._note_end(state, cause.removeprefix(f"{self.path}: "))
            raise
        finally:
            os.close(descriptor)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Holds the directory for this process, and frees it however the process ends.

        Raises:
            ConfigError: If another process holds it (:class:`~acmr.storage.hold.RunHeldError`), or it cannot be made.
        """
        with ExitStack() as stack:
            try:
                stack.enter_context(hold(self.path))
                remove_leftovers(self.path)
            except OSError as error:
                raise self._refused(error) from error
            yield

    def _note_end(self, state: str, cause: str) -> None:
        path = self.path / STATUS_FILE
        status = read_json(path)
        # What another process said of the run stays true where this one has refused to go on with it.
        if status is not None and status.get("process") == os.getpid():
            with suppress(OSError, LostError):
                replace_json(path, status | {"state": state, "cause": cause})

    def _refused(self, error: OSError) -> ConfigError:
        place = error.filename or self.path
        return ConfigError(
            f"{place}: cannot be written ({error.strerror}); free or unlock it, or type output_dir=FOLDER"
        )


def holds_run(run_dir: RunDir, config: ExperimentConfig) -> bool:
    """Whether the run that the settings mean has been begun in a directory, and is not to be replaced.

    Raises:
        ConfigError: If the directory holds a run with other settings, or a finished one that was changed since.
    """
    if config.force:
        return False
    run_dir.check_unchanged()
    stored = run_dir.stored_settings()
    if stored is None:
        return False
    differing = differing_keys(stored, config)
    if differing:
        raise ConfigError(
            f"{run_dir}: holds a run with other settings ({', '.join(differing)}); "
            "type output_dir=FOLDER for another place, or force=true to replace it"
        )
    return True


def differing_keys(stored: Mapping[str, Any], config: ExperimentConfig) -> list[str]:
    """Settings, of those that change the result, in which a stored run differs from this one.

    A setting that the stored run knew nothing of has the schema's default: one that is added to the schema must default
    to what was done before, and then orphans no run. One that only the stored run knows did something that cannot be
    done any more, so it counts as a difference, unless it was null: not set.
    """
    before, now = schema_defaults() | flatten(stored), flatten(plain_settings(config))
    return [
        key
        for key in sorted(set(before) | set(now))
        # One teacher may be reached in several ways; the run's name identifies it by its content.
        if not is_neutral(key) and key not in TEACHER_CHOICE and before.get(key) != now.get(key)
    ]
