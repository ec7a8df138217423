"""The actor and the critics of the paper, as named linear layers that a transfer can address one by one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

#: Bounds of the log standard deviation that the policy can express (reference implementation: CleanRL).
LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
_ADAPTERS = ("input_adapter", "mean_adapter", "log_std_adapter")


@dataclass(frozen=True)
class Dimensions:
    """Sizes of an environment's observation and action vectors."""

    observation: int
    action: int

    def __str__(self) -> str:
        return f"{self.observation} sensors and {self.action} actuators"


def linear(in_features: int, out_features: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with PyTorch's default initialization, drawn from a generator of one's own.

    Weights and biases are uniform in +-1/sqrt(in_features), as ``torch.nn.Linear.reset_parameters`` has them.
    """
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, in_features, out_features)
    bound = 1.0 / math.sqrt(in_features)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer


class Trunk(nn.Module):
    """Input layer and hidden layers, each followed by ReLU; before them, if asked for, an input adapter.

    Args:
        inputs: Size of the vectors it is given.
        core_inputs: Size that its first layer takes; another size than ``inputs`` is met by an adapter.
        adapted: Whether there is an input adapter.
        adapter_activation: ``relu`` or ``none``, applied to the adapter's output.
        hidden_sizes: Width of each layer.
        generator: Source of the initial weights.
    """

    def __init__(
        self,
        inputs: int,
        core_inputs: int,
        adapted: bool,
        adapter_activation: str,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.input_adapter = linear(inputs, core_inputs, generator) if adapted else None
        self.adapter_relu = adapter_activation == "relu"
        self.input = linear(core_inputs, hidden_sizes[0], generator)
        self.hidden_names = tuple(f"hidden_{index}" for index in range(1, len(hidden_sizes)))
        for name, fan_in, fan_out in zip(self.hidden_names, hidden_sizes, hidden_sizes[1:], strict=False):
            self.add_module(name, linear(fan_in, fan_out, generator))

    def features(self, inputs: Tensor) -> Tensor:
        """Last hidden activations, (batch, hidden_sizes[-1]), of inputs (batch, inputs)."""
        if self.input_adapter is not None:
            inputs = self.input_adapter(inputs)
            if self.adapter_relu:
                inputs = functional.relu(inputs)
        hidden = functional.relu(self.input(inputs))
        for name in self.hidden_names:
            hidden = functional.relu(self.get_submodule(name)(hidden))
        return hidden

    def layers(self) -> Iterator[tuple[str, nn.Linear]]:
        """Each linear layer with its name."""
        for name, module in self.named_children():
            if isinstance(module, nn.Linear):
                yield name, module


class Actor(Trunk):
    """Tanh-squashed Gaussian policy with a state-dependent standard deviation.

    Args:
        dims: Observation and action sizes of the environment it acts in.
        hidden_sizes: Width of each hidden layer.
        action_low: Least value of each action, (action,).
        action_high: Greatest value of each action, (action,).
        generator: Source of the initial weights.
        core: Sizes of a teacher's environment; given, the actor has the teacher's layers between adapters.
        adapter_activation: ``relu`` or ``none``, between the input adapter and the teacher's first layer.
    """

    action_scale: Tensor
    action_bias: Tensor

    def __init__(
        self,
        dims: Dimensions,
        hidden_sizes: Sequence[int],
        action_low: np.ndarray,
        action_high: np.ndarray,
        generator: torch.Generator,
        core: Dimensions | None = None,
        adapter_activation: str = "relu",
    ) -> None:
        inner = core or dims
        super().__init__(
            dims.observation, inner.observation, core is not None, adapter_activation, hidden_sizes, generator
        )
        self.mean = linear(hidden_sizes[-1], inner.action, generator)
        self.log_std = linear(hidden_sizes[-1], inner.action, generator)
        self.mean_adapter = linear(inner.action, dims.action, generator) if core else None
        self.log_std_adapter = linear(inner.action, dims.action, generator) if core else None
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (action_low, action_high))
        self.register_buffer("action_scale", (high - low) / 2.0, persistent=False)
        self.register_buffer("action_bias", (high + low) / 2.0, persistent=False)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before squashing, each (batch, action)."""
        hidden = self.features(observations)
        mean, raw = self.mean(hidden), self.log_std(hidden)
        if self.mean_adapter is not None and self.log_std_adapter is not None:
            mean, raw = self.mean_adapter(mean), self.log_std_adapter(raw)
        return mean, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(raw) + 1.0)

    def sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions by reparameterization and their log-probabilities.

        Args:
            observations: (batch, observation).
            noise: Standard normal draws, (batch, action).

        Returns:
            Actions within their bounds, (batch, action), and log pi(action | observation), (batch,):
            Gaussian density, less log(scale * (1 - tanh(x)^2) + 1e-6) for the squashing
            (Haarnoja et al. 2018, appendix C; 1e-6 as in CleanRL).
        """
        mean, log_std = self(observations)
        squashed = torch.tanh(mean + log_std.exp() * noise)
        gaussian = -0.5 * noise.square() - log_std - _HALF_LOG_2PI
        log_prob = gaussian - torch.log(self.action_scale * (1.0 - squashed.square()) + 1e-6)
        return squashed * self.action_scale + self.action_bias, log_prob.sum(dim=1)

    def mode(self, observations: Tensor) -> Tensor:
        """The deterministic policy: the squashed mean, (batch, action)."""
        mean, _ = self(observations)
        return torch.tanh(mean) * self.action_scale + self.action_bias


class Critic(Trunk):
    """Soft action-value function; the arguments are those of :class:`Actor`."""

    def __init__(
        self,
        dims: Dimensions,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
        core: Dimensions | None = None,
        adapter_activation: str = "relu",
    ) -> None:
        inner = core or dims
        super().__init__(
            dims.observation + dims.action,
            inner.observation + inner.action,
            core is not None,
            adapter_activation,
            hidden_sizes,
            generator,
        )
        self.output = linear(hidden_sizes[-1], 1, generator)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Q(s, a), (batch,)."""
        output: Tensor = self.output(self.features(torch.cat((observations, actions), dim=1)))
        return output.squeeze(1)


class Networks(nn.Module):
    """All that SAC learns of an environment but its temperature: one actor and two independent critics."""

    def __init__(
        self,
        dims: Dimensions,
        hidden_sizes: Sequence[int],
        action_low: np.ndarray,
        action_high: np.ndarray,
        generator: torch.Generator,
        core: Dimensions | None = None,
        adapter_activation: str = "relu",
    ) -> None:
        super().__init__()
        self.dims, self.core, self.hidden_sizes = dims, core, tuple(hidden_sizes)
        self.action_low, self.action_high = action_low, action_high
        self.adapter_activation = adapter_activation
        self.actor = Actor(dims, hidden_sizes, action_low, action_high, generator, core, adapter_activation)
        self.critic_1 = Critic(dims, hidden_sizes, generator, core, adapter_activation)
        self.critic_2 = Critic(dims, hidden_sizes, generator, core, adapter_activation)

    @property
    def critics(self) -> tuple[Critic, Critic]:
        """Both critics."""
        return self.critic_1, self.critic_2

    def layers(self) -> dict[str, nn.Linear]:
        """Every linear layer by its name, such as ``actor.hidden_1`` or ``critic_2.output``."""
        return {
            f"{part}.{name}": layer
            for part in ("actor", "critic_1", "critic_2")
            for name, layer in getattr(self, part).layers()
        }

    def with_core(self, core: Dimensions | None, adapter_activation: str, generator: torch.Generator) -> Networks:
        """Fresh networks for the same environment around the layers of another one."""
        return Networks(
            self.dims, self.hidden_sizes, self.action_low, self.action_high, generator, core, adapter_activation
        )


def is_hidden(layer: str) -> bool:
    """Whether a layer lies between two hidden activations, so that no dimension of an environment touches it."""
    return layer.split(".")[-1].startswith("hidden_")


def is_adapter(layer: str) -> bool:
    """Whether a layer translates between a student's dimensions and its teacher's."""
    return layer.split(".")[-1] in _ADAPTERS
