"""The replay buffer on disk: what was added since the last checkpoint goes to one more file that never changes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from acmr.agent.replay_buffer import ReplayBuffer
from acmr.records import DamagedError
from acmr.storage.durable import FileDigest, read_marked, write_bytes

_NAME = re.compile(r"segment_(\d{1,15})_(\d{1,15})\.safetensors")
#: Bytes that a segment takes beside its numbers.
_HEADER_BYTES = 4096


@dataclass(frozen=True)
class Segment:
    """A file that holds the transitions ``first`` to ``end - 1``, counted from 0 since the run began."""

    first: int
    end: int
    mark: FileDigest

    @property
    def name(self) -> str:
        """The file's name."""
        return f"segment_{self.first}_{self.end}.safetensors"


class BufferFiles:
    """Keeps files beside a replay buffer from which it can be filled again.

    Args:
        folder: Where they lie.
        buffer: The buffer.
    """

    def __init__(self, folder: Path, buffer: ReplayBuffer) -> None:
        self._folder, self._buffer = folder, buffer
        self._segments: list[Segment] = []

    def extend(self) -> dict[str, FileDigest]:
        """Writes what the buffer was given since the last call.

        Returns:
            The files that hold all that is in the buffer now, in order.
        """
        buffer = self._buffer
        oldest = buffer.added - len(buffer)
        first = max(self._segments[-1].end if self._segments else 0, oldest)
        if first < buffer.added:
            data = save_arrays(_transitions(buffer, first, buffer.added))
            segment = Segment(first, buffer.added, FileDigest.of(data))
            write_bytes(self._folder / segment.name, data)
            self._segments.append(segment)
        self._segments = [segment for segment in self._segments if segment.end > oldest]
        return {segment.name: segment.mark for segment in self._segments}

    def load(self, files: Mapping[str, FileDigest], added: int, ended: int, newest: np.ndarray | None) -> None:
        """Fills the buffer.

        Args:
            files: As :meth:`extend` gave them.
            added: Transitions that had been added to the buffer.
            ended: Episodes that had ended in it.
            newest: The observation that the next transition begins with, unless it begins an episode.

        Raises:
            DamagedError: If a file is not as it was written, or if they do not hold all that the buffer had.
        """
        buffer = self._buffer
        segments = [_segment(name, mark) for name, mark in files.items()]
        expected = added
        for segment in reversed(segments):
            if segment.end != expected or segment.first >= segment.end:
                raise DamagedError(f"{self._folder / segment.name}: not a part of this run's replay buffer")
            expected = segment.first
        if expected > max(0, added - buffer.capacity):
            raise DamagedError(f"{self._folder}: a part of the replay buffer is missing")
        buffer.added, buffer.ended = added, ended
        for segment in reversed(segments):
            ended = self._read(segment, added, ended)
        if not 0 <= ended <= expected:
            raise DamagedError(f"{self._folder}: the replay buffer has other episodes than were counted")
        if newest is not None:
            buffer.rows[added % len(buffer.rows), : buffer.observation_dim] = newest
        self._segments = segments

    def _read(self, segment: Segment, added: int, ended: int) -> int:
        """Puts a segment, after which ``ended`` episodes had ended, into the buffer; returns how many had before."""
        path, buffer = self._folder / segment.name, self._buffer
        count = segment.end - segment.first
        if count > buffer.capacity or segment.mark.size > count * _bytes_per_transition(buffer) + _HEADER_BYTES:
            raise DamagedError(f"{path}: larger than this run's replay buffer")
        try:
            arrays = load_arrays(read_marked(path, segment.mark, whole=True))
            endings = arrays["ended"].astype(bool)
            before = ended - int(endings.sum())
            kept = np.arange(segment.first, segment.end) >= added - buffer.capacity
            rows = np.arange(segment.first, segment.end)[kept] % len(buffer.rows)
            for name in ("rows", "rewards", "terminated"):
                getattr(buffer, name)[rows] = arrays[name][kept]
            episodes = np.where(endings, before + np.cumsum(endings) - 1, -1)
            buffer.endings[rows] = np.where(endings, episodes % buffer.capacity, -1)[kept]
            last = episodes[endings & kept] % buffer.capacity
            buffer.last_observations[last] = arrays["last_observations"][kept[endings]]
        except (SafetensorError, KeyError, ValueError, IndexError, TypeError) as error:
            raise DamagedError(f"{path}: not a part of this run's replay buffer") from error
        return before


def replay_bytes(capacity: int, steps: int, observation_dim: int, action_dim: int) -> int:
    """Bytes on disk of the replay buffer of a run of so many steps, with episodes of 20 steps and more."""
    transition = 4 * (observation_dim + action_dim + 2) + 1
    return int(min(capacity, steps) * (transition + 4 * observation_dim / 20))


def _bytes_per_transition(buffer: ReplayBuffer) -> int:
    # At most each transition ends an episode.
    return 4 * (buffer.rows.shape[1] + buffer.observation_dim + 2) + 1


def _transitions(buffer: ReplayBuffer, first: int, end: int) -> dict[str, np.ndarray]:
    rows = np.arange(first, end) % len(buffer.rows)
    # A slice is not copied; only where the ring begins anew must the rows be gathered.
    where = slice(rows[0], rows[-1] + 1) if rows[0] <= rows[-1] else rows
    endings = buffer.endings[where]
    return {
        "rows": buffer.rows[where],
        "rewards": buffer.rewards[where],
        "terminated": buffer.terminated[where],
        "ended": (endings >= 0).astype(np.uint8),
        "last_observations": buffer.last_observations[endings[endings >= 0]],
    }


def _segment(name: str, mark: FileDigest) -> Segment:
    match = _NAME.fullmatch(name)
    if not match:
        raise DamagedError(f"{name}: not a part of a replay buffer")
    return Segment(int(match[1]), int(match[2]), mark)
