"""The replay buffer on disk: what was added since the last checkpoint goes to one more file that never changes.

A buffer of 1.6 GB cannot be written anew at each checkpoint. Nor can it be one file that is overwritten as the ring in
memory is: once that has wrapped, the latest rows lie where older ones did that the checkpoint before still needs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from acmr.agent.replay_buffer import ReplayBuffer
from acmr.records import DamagedError
from acmr.stateful import State
from acmr.storage.durable import FileDigest, read_checked, write_bytes

# Digits are limited so that a name from somebody else's checkpoint is never a number that fills the memory.
_NAME = re.compile(r"segment_(\d{1,15})_(\d{1,15})\.safetensors")
#: Bytes that a segment takes beside its numbers.
_HEADER_BYTES = 4096


@dataclass(frozen=True)
class Segment:
    """A file that holds the transitions ``first`` to ``end - 1``, counted from 0 since the run began."""

    first: int
    end: int
    digest: FileDigest

    @property
    def name(self) -> str:
        """The file's name."""
        return f"segment_{self.first}_{self.end}.safetensors"

    @staticmethod
    def named(name: str, digest: FileDigest) -> Segment:
        """The segment that a file is by its name.

        Raises:
            DamagedError: If it is none.
        """
        match = _NAME.fullmatch(name)
        # The name becomes a path, so nothing but such a name may get any further.
        if not match or int(match[1]) >= int(match[2]):
            raise DamagedError(f"{name}: not a part of a replay buffer")
        return Segment(int(match[1]), int(match[2]), digest)


class ReplayFiles:
    """Keeps files beside a replay buffer from which it can be filled again.

    Args:
        folder: Where they lie.
        buffer: The buffer.
    """

    def __init__(self, folder: Path, buffer: ReplayBuffer) -> None:
        self._folder, self._buffer = folder, buffer
        self._segments: list[Segment] = []

    @property
    def names(self) -> set[str]:
        """Names of the files that the latest state needs."""
        return {segment.name for segment in self._segments}

    def state_dict(self) -> State:
        """Writes what the buffer was given since the last call, and names the files that hold all that is in it now.

        Raises:
            WriteError: If the disk does not take it.
        """
        buffer = self._buffer
        # What the ring has overwritten since then needs no file any more.
        first = max(self._segments[-1].end if self._segments else 0, buffer.oldest)
        if first < buffer.added:
            data = save_arrays(buffer.transitions(first, buffer.added))
            segment = Segment(first, buffer.added, FileDigest.of(data))
            # On the disk before the checkpoint that names it: a checkpoint must never point at what is not there.
            write_bytes(self._folder / segment.name, data)
            self._segments.append(segment)
        self._segments = [segment for segment in self._segments if segment.end > buffer.oldest]
        segments = {segment.name: segment.digest.to_json() for segment in self._segments}
        return {"added": buffer.added, "segments": segments}

    def load_state_dict(self, state: State) -> None:
        """Fills the buffer from the files.

        Raises:
            DamagedError: If a file is not as it was written, or if they do not hold all that the buffer had.
        """
        digests = {name: FileDigest.from_json(entry) for name, entry in state["segments"].items()}
        segments = [Segment.named(name, digest) for name, digest in digests.items()]
        # All names are looked at before the first file is read: it may be gigabytes until one that does not fit.
        followed_by = [*(segment.first for segment in segments[1:]), state["added"]]
        for segment, expected in zip(segments, followed_by, strict=False):
            if segment.end != expected:
                raise DamagedError(f"{self._folder / segment.name}: not a part of this run's replay buffer")
        try:
            self._buffer.replace(segments[0].first if segments else state["added"], self._read(segments))
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise DamagedError(f"{self._folder}: not this run's replay buffer ({error})") from error
        self._segments = segments

    def _read(self, segments: list[Segment]) -> Iterator[dict[str, np.ndarray]]:
        # One at a time, so that at most one segment is in memory beside the buffer itself.
        for segment in segments:
            path, count = self._folder / segment.name, segment.end - segment.first
            # Refused by its size alone, before a byte of it is read.
            most = (count + 1) * self._buffer.bytes_per_transition + _HEADER_BYTES
            if count > self._buffer.capacity or segment.digest.size > most:
                raise DamagedError(f"{path}: larger than this run's replay buffer")
            try:
                arrays = load_arrays(read_checked(path, segment.digest, whole=True))
            except SafetensorError as error:
                raise DamagedError(f"{path}: not a safetensors file") from error
            if len(arrays["ended"]) != count:
                raise DamagedError(f"{path}: not the transitions of its name")
            yield arrays


def replay_bytes(capacity: int, steps: int, observation_dim: int, action_dim: int) -> int:
    """Bytes on disk of the replay buffer of a run of so many steps, with episodes of 20 steps and more."""
    transition = 4 * (observation_dim + action_dim + 2) + 1
    return int(min(capacity, steps) * (transition + 4 * observation_dim / 20))
