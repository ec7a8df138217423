"""Experience replay: a ring of transitions that holds each observation once, sampled uniformly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """Transitions: (batch, observation), (batch, action), (batch,), (batch, observation), (batch,)."""

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor


@dataclass(frozen=True)
class JoinedBatch(Batch):
    """A batch whose observations lie beside the actions, as the critics take them.

    Attributes:
        inputs: Observations and actions, (batch, observation + action); those two are views of it.
        next_inputs: Next observations and, beside them, room for the actions that a learner samples there.
    """

    inputs: Tensor
    next_inputs: Tensor

    @staticmethod
    def of(
        observation_dim: int, inputs: Tensor, next_inputs: Tensor, rewards: Tensor, terminated: Tensor
    ) -> JoinedBatch:
        """Takes the rows apart behind their observations."""
        seen, chosen = inputs[:, :observation_dim], inputs[:, observation_dim:]
        after = next_inputs[:, :observation_dim]
        return JoinedBatch(seen, chosen, rewards, after, terminated, inputs, next_inputs)

    @staticmethod
    def join(batch: Batch) -> JoinedBatch:
        """The same transitions side by side; copies unless they are so already."""
        if isinstance(batch, JoinedBatch):
            return batch
        inputs = torch.cat((batch.observations, batch.actions), dim=1)
        next_inputs = torch.cat((batch.next_observations, torch.zeros_like(batch.actions)), dim=1)
        return JoinedBatch.of(batch.observations.shape[1], inputs, next_inputs, batch.rewards, batch.terminated)

    def to(self, dtype: torch.dtype) -> JoinedBatch:
        """The same with its observations and actions in another precision."""
        inputs, next_inputs = self.inputs.to(dtype), self.next_inputs.to(dtype)
        return JoinedBatch.of(self.observations.shape[1], inputs, next_inputs, self.rewards, self.terminated)


class ReplayBuffer:
    """Keeps the last ``capacity`` transitions in float32: 1.6 GB for a million of the Humanoid's.

    Transitions are numbered from 0 in the order in which they are added. Number ``n`` lies in row
    ``n % (capacity + 1)`` of ``rows`` (observation, then action), ``rewards``, ``terminated`` and ``endings``. Its
    next observation begins the next row, unless the transition ended an episode: then ``endings[row]`` is the row
    of ``last_observations`` that holds it (else -1). Memory is touched as it fills, not when it is made.

    Args:
        capacity: Transitions it keeps.
        observation_dim: Size of an observation.
        action_dim: Size of an action.
        device: Where batches go.

    Attributes:
        added: Transitions that were added since the run began, those that are overwritten included.
    """

    def __init__(self, capacity: int, observation_dim: int, action_dim: int, device: str = "cpu") -> None:
        self.capacity, self.device, self.observation_dim = capacity, device, observation_dim
        self.added = 0
        self._ended = 0  # episodes whose last observation was stored; it only says which row is next
        self._row_count = capacity + 1  # one more than transitions: the newest one's next observation
        self.rows = np.zeros((self._row_count, observation_dim + action_dim), np.float32)
        self.rewards = np.zeros(self._row_count, np.float32)
        self.terminated = np.zeros(self._row_count, np.float32)
        self.endings = np.full(self._row_count, -1, np.int32)
        self.last_observations = np.zeros((capacity, observation_dim), np.float32)
        self._batches: dict[int, _BatchMemory] = {}

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    @property
    def oldest(self) -> int:
        """Number of the oldest transition that is still kept."""
        return self.added - len(self)

    @property
    def bytes_per_transition(self) -> int:
        """At most so many bytes does a transition take in :meth:`transitions`: one that ends an episode."""
        return 4 * (self.rows.shape[1] + self.observation_dim + 2) + 1

    def add(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
        ended: bool,
    ) -> None:
        """Stores one transition.

        Args:
            observation: (observation,); the ``next_observation`` of the last call, unless that ended an episode.
            action: (action,).
            reward: Reward of the step.
            next_observation: (observation,), at the end of an episode its true last one.
            terminated: Whether it has no future to bootstrap from.
            ended: Whether the next transition begins another episode.
        """
        row, width = self.added % self._row_count, self.observation_dim
        self.rows[row, :width] = observation
        self.rows[row, width:] = action
        self.rewards[row] = reward
        self.terminated[row] = terminated
        if ended:
            last = self._ended % self.capacity
            self.last_observations[last] = next_observation
            self.endings[row] = last
            self._ended += 1
        else:
            self.rows[(row + 1) % self._row_count, :width] = next_observation
            self.endings[row] = -1
        self.added += 1

    def transitions(self, first: int, end: int) -> dict[str, np.ndarray]:
        """The transitions ``first`` to ``end - 1`` as :meth:`replace` takes them; they may share the buffer's memory.

        Returns:
            ``rows``, ``rewards``, ``terminated`` and ``ended`` with a row for each of them, ``last_observations`` with
            one for each that ended an episode, and ``next_observation``, which follows the last of them unless that
            ended an episode, too.
        """
        rows = np.arange(first, end) % self._row_count
        # A slice is not copied; only where the ring begins anew must the rows be gathered.
        where = slice(rows[0], rows[-1] + 1) if rows[0] <= rows[-1] else rows
        endings = self.endings[where]
        following = self.rows[end % self._row_count, : self.observation_dim]
        return {
            "rows": self.rows[where],
            "rewards": self.rewards[where],
            "terminated": self.terminated[where],
            "ended": (endings >= 0).astype(np.uint8),
            "last_observations": self.last_observations[endings[endings >= 0]],
            # After the end of an episode that row holds what was there before, and nothing reads it.
            "next_observation": following if endings[-1] < 0 else np.zeros_like(following),
        }

    def replace(self, first: int, chunks: Iterable[Mapping[str, np.ndarray]]) -> None:
        """Takes transitions instead of all that it holds.

        Args:
            first: Number of the first of them; those before it are taken to have been overwritten.
            chunks: As :meth:`transitions` gave them, oldest first, each of at most ``capacity`` transitions.

        Raises:
            KeyError: If a chunk lacks an array.
            ValueError: If an array does not fit, or if there are fewer transitions than the buffer would have kept.
        """
        self.added = first
        for chunk in chunks:
            self._extend(chunk)
        if not 0 <= first <= max(0, self.added - self.capacity):
            raise ValueError("a part of the replay buffer is missing")

    def _extend(self, chunk: Mapping[str, np.ndarray]) -> None:
        ended = chunk["ended"].astype(bool)
        count, episodes, width = len(ended), int(ended.sum()), self.observation_dim
        if count > self.capacity:
            raise ValueError("more transitions than the replay buffer keeps")
        rows = np.arange(self.added, self.added + count) % self._row_count
        for name, array in (("rows", self.rows), ("rewards", self.rewards), ("terminated", self.terminated)):
            array[rows] = _shaped(chunk[name], (count, *array.shape[1:]))
        # Where in its ring an episode's last observation lies decides nothing, so the numbers go on from any.
        last = np.arange(self._ended, self._ended + episodes) % self.capacity
        self.last_observations[last] = _shaped(chunk["last_observations"], (episodes, width))
        self.endings[rows] = -1
        self.endings[rows[ended]] = last
        self.added, self._ended = self.added + count, self._ended + episodes
        # The next chunk begins with it; after the last one it is what the newest transition led to.
        self.rows[self.added % self._row_count, :width] = _shaped(chunk["next_observation"], (width,))

    def sample(self, batch_size: int, rng: np.random.Generator) -> JoinedBatch:
        """Draws transitions uniformly, with replacement.

        The tensors are the same memory at each call: a batch is good until the next one is drawn.

        Args:
            batch_size: Transitions to draw.
            rng: Source of the draws.
        """
        memory = self._batches.get(batch_size)
        if memory is None:
            memory = self._batches[batch_size] = _BatchMemory(batch_size, self.rows.shape[1], self.observation_dim)
        drawn = rng.integers(len(self), size=batch_size)
        # Counted from the oldest transition, round the ring.
        memory.gather(self, drawn + self.oldest % self._row_count)
        return memory.on(self.device)


class _BatchMemory:
    """Arrays that batches of one size are gathered into, and the tensors that share their memory."""

    def __init__(self, batch_size: int, width: int, observation_dim: int) -> None:
        self.inputs = np.zeros((batch_size, width), np.float32)
        self.next_inputs = np.zeros((batch_size, width), np.float32)
        self.rewards, self.terminated = np.zeros(batch_size, np.float32), np.zeros(batch_size, np.float32)
        self._arrays = (self.inputs, self.next_inputs, self.rewards, self.terminated)
        self._observation_dim = observation_dim
        self._batch = JoinedBatch.of(observation_dim, *map(torch.from_numpy, self._arrays))

    def gather(self, buffer: ReplayBuffer, rows: np.ndarray) -> None:
        # mode="wrap" goes round the ring, and writes to `out` without a copy between.
        buffer.rows.take(rows, 0, out=self.inputs, mode="wrap")
        buffer.rows.take(rows + 1, 0, out=self.next_inputs, mode="wrap")
        buffer.rewards.take(rows, out=self.rewards, mode="wrap")
        buffer.terminated.take(rows, out=self.terminated, mode="wrap")
        endings = buffer.endings.take(rows, mode="wrap")
        last = np.flatnonzero(endings >= 0)
        self.next_inputs[last, : self._observation_dim] = buffer.last_observations[endings[last]]

    def on(self, device: str) -> JoinedBatch:
        if device == "cpu":
            return self._batch
        return JoinedBatch.of(self._observation_dim, *(torch.from_numpy(array).to(device) for array in self._arrays))


def _shaped(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    # An assignment would stretch one row over many without a word.
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape}, {shape} expected")
    return array
