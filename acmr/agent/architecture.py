"""The structure of the actor and the critics as data: which linear layers there are, and of what shapes.

The only place that states it. Networks are built from it, teacher files are checked against it, and how much disk a run
needs is worked out from it. It imports no torch, so that reading a description costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

ACTOR, CRITICS = "actor", ("critic_1", "critic_2")
#: Layers that translate between a student's dimensions and its teacher's.
ADAPTERS = ("input_adapter", "mean_adapter", "log_std_adapter")
#: How a log standard deviation is brought within its bounds: squashed (CleanRL) or clamped (Stable-Baselines3).
TANH, CLAMP = "tanh", "clamp"
#: The bounds.
LOG_STD_BOUNDS = {TANH: (-5.0, 2.0), CLAMP: (-20.0, 2.0)}
#: Inputs and outputs of a linear layer.
Shape = tuple[int, int]


@dataclass(frozen=True)
class Dimensions:
    """Sizes of an environment's observation and action vectors."""

    observation: int
    action: int

    def __str__(self) -> str:
        return f"{self.observation} sensors and {self.action} actuators"


@dataclass(frozen=True)
class Architecture:
    """All that determines the layers of one actor and two critics.

    Attributes:
        dims: Observation and action sizes of the environment.
        hidden_sizes: Width of each hidden layer.
        action_low: Least value of each action.
        action_high: Greatest value of each action.
        core: Sizes of a teacher's environment where the teacher's layers lie between adapters, else None.
        adapter_activation: ``relu`` or ``none``, between the input adapter and the teacher's first layer.
        log_std: How the policy's log standard deviation is bounded, ``tanh`` or ``clamp``. No linear layer makes one of
            the other, so that it belongs to the heads of a policy, wherever they are copied to.
    """

    dims: Dimensions
    hidden_sizes: tuple[int, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    core: Dimensions | None = None
    adapter_activation: str = "relu"
    log_std: str = TANH

    @classmethod
    def plain(cls, dims: Dimensions, hidden_sizes: Sequence[int], low: np.ndarray, high: np.ndarray) -> Architecture:
        """Networks without adapters, for actions between ``low`` and ``high``, each (action,)."""
        return cls(dims, tuple(hidden_sizes), tuple(low.tolist()), tuple(high.tolist()))

    def part(self, name: str) -> dict[str, Shape]:
        """Shapes of the layers of ``actor`` or of a critic, in the order in which they are applied and drawn.

        The order is part of a run's identity: initial weights come from one generator, layer by layer.
        """
        inner, last = self.core or self.dims, self.hidden_sizes[-1]
        given, taken = (
            (self.dims.observation, inner.observation)
            if name == ACTOR
            # A critic reads the observation and the action side by side.
            else (self.dims.observation + self.dims.action, inner.observation + inner.action)
        )
        shapes: dict[str, Shape] = {"input_adapter": (given, taken)} if self.core else {}
        for index, shape in enumerate(pairwise((taken, *self.hidden_sizes))):
            shapes[f"hidden_{index}" if index else "input"] = shape
        if name != ACTOR:
            return shapes | {"output": (last, 1)}
        shapes |= {"mean": (last, inner.action), "log_std": (last, inner.action)}
        if self.core:
            shapes |= dict.fromkeys(ADAPTERS[1:], (inner.action, self.dims.action))
        return shapes

    @property
    def layers(self) -> dict[str, Shape]:
        """Shape of every linear layer by its name, such as ``actor.hidden_1`` or ``critic_2.output``."""
        return {f"{part}.{name}": shape for part in (ACTOR, *CRITICS) for name, shape in self.part(part).items()}

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Shape of every tensor in a teacher's file: weights (out, in) and biases (out,)."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, (fan_in, fan_out) in self.layers.items():
            shapes |= {f"{name}.weight": (fan_out, fan_in), f"{name}.bias": (fan_out,)}
        return shapes

    @property
    def sizes(self) -> dict[str, int]:
        """How many parameters each layer has, bias included."""
        return {name: (fan_in + 1) * fan_out for name, (fan_in, fan_out) in self.layers.items()}

    @property
    def parameter_count(self) -> int:
        """How many parameters all layers have together."""
        return sum(self.sizes.values())


def is_hidden(layer: str) -> bool:
    """Whether a layer lies between two hidden activations, so that no dimension of an environment touches it."""
    return layer.split(".")[-1].startswith("hidden_")


def is_adapter(layer: str) -> bool:
    """Whether a layer translates between a student's dimensions and its teacher's."""
    return layer.split(".")[-1] in ADAPTERS
