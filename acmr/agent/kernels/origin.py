"""The policy that an actor is held to at first, and the pull towards it (kickstarting)."""

from __future__ import annotations

import copy
from collections.abc import Sequence

from torch import Tensor

from acmr.agent.kernels.arrays import Array, array_of
from acmr.agent.kernels.groups import actor_groups, relus
from acmr.agent.kernels.layers import Stack, columns
from acmr.agent.kernels.parameters import FlatParameters
from acmr.agent.networks import Actor


class Origin:
    """A copy of an actor as it was at first, and its outputs for one batch at a time.

    Args:
        actor: Whom it is a copy of.
        reduced: Whether its products are computed in bfloat16, for each of its groups.

    Attributes:
        actor: The copy.
        parameters: Those of the copy.
    """

    def __init__(self, actor: Actor, reduced: Sequence[bool]) -> None:
        self.actor = copy.deepcopy(actor).requires_grad_(False)
        self.parameters = FlatParameters(actor_groups(self.actor), reduced=reduced)
        self._stack = Stack(self.parameters.blocks, relus(actor))

    def allocate(self, batch_size: int) -> None:
        """Makes room for batches of this size."""
        self._places = self._stack.allocate(batch_size)
        self._mean, self._raw = map(array_of, columns(self._places[-1].output, 2))

    def forward(self, observations: Tensor) -> None:
        """Computes its outputs for observations, (batch, observation)."""
        self._stack.forward(observations, self._places)

    def pull(self, outputs: tuple[Array, Array], gradients: tuple[Array, Array], weight: float) -> Array:
        """Adds the gradient of half the squared distance to these outputs, times a weight.

        Args:
            outputs: Mean and raw log_std of the actor for the observations of :meth:`forward`, each (batch, action).
            gradients: Where theirs are added to.
            weight: That of one transition.

        Returns:
            The distance, times the weight, (1,).
        """
        total: Array = 0.0
        for ours, theirs, gradient in zip(outputs, (self._mean, self._raw), gradients, strict=True):
            apart = ours - theirs
            gradient += apart * weight
            total = total + (apart * apart).sum()
        return total * (0.5 * weight)
