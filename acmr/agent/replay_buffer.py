"""Experience replay: a ring of transitions that holds each observation once, sampled uniformly."""

from __future__ import annotations

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

    Layout, so that a copy can follow by appending: transition ``n`` (counted from 0 by ``added``) lies in row
    ``n % (capacity + 1)`` of ``rows`` (observation, then action), ``rewards``, ``terminated`` and ``endings``. Its
    next observation begins the next row, unless the transition ended an episode: then ``endings[row]`` is the row
    of ``last_observations`` that holds it (else -1). Episode ``m`` (counted by ``ended``) has row ``m % capacity``
    there. After transitions X to Y - 1 were added, only the rows of X to Y of the former and the rows of the
    episodes that ended meanwhile of the latter differ. Memory is touched as it fills, not when it is made.

    Args:
        capacity: Transitions it keeps.
        observation_dim: Size of an observation.
        action_dim: Size of an action.
        device: Where batches go.
    """

    def __init__(self, capacity: int, observation_dim: int, action_dim: int, device: str = "cpu") -> None:
        self.capacity, self.device, self.observation_dim = capacity, device, observation_dim
        self.added, self.ended = 0, 0
        self._row_count = capacity + 1  # one more than transitions: the newest one's next observation
        self.rows = np.zeros((self._row_count, observation_dim + action_dim), np.float32)
        self.rewards = np.zeros(self._row_count, np.float32)
        self.terminated = np.zeros(self._row_count, np.float32)
        self.endings = np.full(self._row_count, -1, np.int32)
        self.last_observations = np.zeros((capacity, observation_dim), np.float32)
        self._batches: dict[int, _BatchMemory] = {}

    def __len__(self) -> int:
        return min(self.added, self.capacity)

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
            last = self.ended % self.capacity
            self.last_observations[last] = next_observation
            self.endings[row] = last
            self.ended += 1
        else:
            self.rows[(row + 1) % self._row_count, :width] = next_observation
            self.endings[row] = -1
        self.added += 1

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
        memory.gather(self, drawn + max(0, self.added - self.capacity) % self._row_count)
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
