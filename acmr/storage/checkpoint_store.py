"""Checkpoints of a running run on disk: which there are, whether they are whole, and how many are kept.

``step_<n>.safetensors`` holds arrays; ``step_<n>.json`` has two lines, the sha256 of the second and what it is about,
and the state itself as JSON, in which the hash of every other file stands. The latter is written last: a checkpoint
exists once it has its name. Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from acmr.foreign import parse_mapping
from acmr.records import DamagedError
from acmr.storage.durable import (
    FileDigest,
    make_folder,
    read_checked,
    read_regular,
    remove,
    remove_leftovers,
    sync_folder,
    write_bytes,
)
from acmr.storage.hold import check_hold
from acmr.text import size

#: Changes with what a checkpoint holds and where; another one is refused.
FORMAT_VERSION = 2
#: Checkpoints that are kept: should the latest be damaged, there is the one before.
KEPT = 2
#: A state larger than this is not one of ours.
_MAX_STATE_BYTES = 64 << 20
#: More than the first line of a state file takes.
_HEAD_BYTES = 1024
_STATE = re.compile(r"step_(\d{1,15})\.json")
_OURS = re.compile(r"(step_\d{1,15}\.(json|safetensors)|segment_\d{1,15}_\d{1,15}\.safetensors)")


class FormatError(DamagedError):
    """A checkpoint of another version of this program. The message says which format it has."""


@dataclass(frozen=True)
class Snapshot:
    """A run at the end of one step.

    Attributes:
        values: The state as far as JSON holds it.
        arrays: The rest of it.
    """

    values: dict[str, Any]
    arrays: dict[str, np.ndarray]


class SnapshotStore:
    """The checkpoint folder of a run; creating the object touches no disk.

    Args:
        folder: The folder.
        limit: Bytes that the arrays of a checkpoint may take.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self._limit = folder, limit

    def steps(self) -> list[int]:
        """Steps with a checkpoint, whole or not, latest first.

        Raises:
            DamagedError: If the folder is no folder.
        """
        if self.folder.is_symlink() or (self.folder.exists() and not self.folder.is_dir()):
            raise DamagedError(f"{self.folder}: no folder of this run")
        matches = [_STATE.fullmatch(path.name) for path in self.folder.iterdir()] if self.folder.exists() else []
        return sorted((int(match[1]) for match in matches if match), reverse=True)

    def prepare(self) -> None:
        """Makes the folder, and removes what killed processes left half written."""
        make_folder(self.folder)
        remove_leftovers(self.folder)

    def write(self, step: int, snapshot: Snapshot) -> None:
        """Adds a checkpoint; other files that its state names must be on the disk.

        Raises:
            ValueError: If it is larger than what would be read again.
            WriteError: If the disk does not take it.
        """
        data = save_arrays(snapshot.arrays)
        _check_size("arrays", data, self._limit)
        write_bytes(self._arrays_file(step), data)
        content = {"values": snapshot.values, "arrays": FileDigest.of(data).to_json()}
        body = (json.dumps(content) + "\n").encode()
        _check_size("values", body, _MAX_STATE_BYTES - _HEAD_BYTES)
        # Last: a checkpoint exists once this file does, and all that it needs is there by then.
        write_bytes(self.state_file(step), _head(body) + b"\n" + body)

    def read(self, step: int) -> Snapshot:
        """Reads a checkpoint; other files that its state names are left to whoever knows what they hold.

        Raises:
            FormatError: If another version of this program wrote it.
            DamagedError: If it is not as it was written, saying which file.
        """
        path = self.state_file(step)
        head, _, body = read_regular(path, _MAX_STATE_BYTES).partition(b"\n")
        # Before anything is read as JSON: a checksum of our own finds what a parser takes for another value.
        if head != _head(body):
            raise _not_as_written(path, head)
        try:
            content = parse_mapping(path.name, body)
            digest = FileDigest.from_json(content["arrays"])
            values = dict(content["values"])
        except (ValueError, KeyError, TypeError, AttributeError, DamagedError) as error:
            raise DamagedError(f"{path}: not a checkpoint of this program") from error
        if digest.size > self._limit:
            raise DamagedError(f"{path}: not a checkpoint of this run")
        try:
            arrays = load_arrays(read_checked(self._arrays_file(step), digest, whole=True))
        except (SafetensorError, KeyError, ValueError, TypeError) as error:
            raise DamagedError(f"{self._arrays_file(step)}: not a safetensors file") from error
        return Snapshot(values, arrays)

    def discard(self, step: int) -> None:
        """Removes a checkpoint, so that at every moment it is whole or not there."""
        remove(self.state_file(step))
        sync_folder(self.folder)
        remove(self._arrays_file(step))

    def prune(self, files: Mapping[int, Collection[str]]) -> None:
        """Removes all but the latest checkpoints, and whatever belongs to none.

        Args:
            files: Names of the other files of the checkpoints that are to be kept, by step.
        """
        for step in self.steps():
            if step not in files:
                self.discard(step)
        kept = {name for names in files.values() for name in names}
        kept |= {path.name for step in files for path in (self.state_file(step), self._arrays_file(step))}
        try:
            there = sorted(self.folder.iterdir())
        except FileNotFoundError:
            check_hold(self.folder)  # which says so where the run's whole directory is gone
            raise
        for path in there:
            if _OURS.fullmatch(path.name) and path.name not in kept:
                remove(path)

    def clear(self) -> None:
        """Removes every checkpoint and, unless something foreign lies in it, the folder."""
        if not self.folder.is_dir() or self.folder.is_symlink():
            return
        for step in self.steps():
            self.discard(step)
        remove_leftovers(self.folder)
        for path in self.folder.iterdir():
            if _OURS.fullmatch(path.name):
                remove(path)
        with suppress(OSError):
            self.folder.rmdir()

    def state_file(self, step: int) -> Path:
        """Where the checkpoint of a step begins."""
        return self.folder / f"step_{step}.json"

    def _arrays_file(self, step: int) -> Path:
        return self.folder / f"step_{step}.safetensors"


def _head(body: bytes) -> bytes:
    return json.dumps({"format_version": FORMAT_VERSION, "sha256": hashlib.sha256(body).hexdigest()}).encode()


def _check_size(what: str, data: bytes, limit: int) -> None:
    # Now rather than when it is to be read: until then the run would take it for a good one.
    if len(data) > limit:
        raise ValueError(f"a checkpoint with {what} of {size(len(data))}; at most {size(limit)} would be read again")


def _not_as_written(path: Path, head: bytes) -> DamagedError:
    with suppress(ValueError, AttributeError, RecursionError):
        version = json.loads(head).get("format_version")
        if isinstance(version, int) and version != FORMAT_VERSION:
            return FormatError(f"{path}: format {version} (this version reads {FORMAT_VERSION})")
    return DamagedError(f"{path}: does not hold what was written to it")
