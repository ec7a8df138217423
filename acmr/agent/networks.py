"""The actor and the critics of the paper, as named linear layers that a transfer can address one by one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from acmr.agent.architecture import (
    ACTOR,
    ADAPTERS,
    CLAMP,
    CRITICS,
    LOG_STD_BOUNDS,
    Architecture,
    Dimensions,
    Shape,
    is_hidden,
)

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


def linear(in_features: int, out_features: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with PyTorch's default initialization, drawn from a generator of one's own.

    Weights and biases are uniform in +-1/sqrt(in_features), as ``torch.nn.Linear.reset_parameters`` has them.
    """
    # Its own initialization draws from torch's global generator, which is put back. (torch.nn.utils.skip_init would
    # not draw at all, but loads sympy: a quarter of a second for each process.)
    with torch.random.fork_rng(devices=[]):
        layer = nn.Linear(in_features, out_features)
    bound = 1.0 / math.sqrt(in_features)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer


class Trunk(nn.Module):
    """Input layer and hidden layers, each followed by ReLU; before them, if there is one, an input adapter.

    Args:
        shapes: Inputs and outputs of each linear layer, those of the head included (:class:`Architecture`).
        adapter_activation: ``relu`` or ``none``, applied to the input adapter's output.
        generator: Source of the initial weights.
    """

    input_adapter: nn.Linear | None
    input: nn.Linear

    def __init__(self, shapes: Mapping[str, Shape], adapter_activation: str, generator: torch.Generator) -> None:
        super().__init__()
        for name, (fan_in, fan_out) in shapes.items():
            self.add_module(name, linear(fan_in, fan_out, generator))
        # Absent adapters are None rather than missing, so that a pass can ask for them.
        for name in ADAPTERS:
            if name not in shapes:
                self.register_module(name, None)
        self.adapter_relu = adapter_activation == "relu"
        self.hidden_names = tuple(name for name in shapes if is_hidden(name))

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
        architecture: Layers and bounds of the actions.
        generator: Source of the initial weights.
    """

    action_scale: Tensor
    action_bias: Tensor
    mean: nn.Linear
    log_std: nn.Linear
    mean_adapter: nn.Linear | None
    log_std_adapter: nn.Linear | None

    def __init__(self, architecture: Architecture, generator: torch.Generator) -> None:
        super().__init__(architecture.part(ACTOR), architecture.adapter_activation, generator)
        bounds = (architecture.action_low, architecture.action_high)
        low, high = (torch.tensor(bound, dtype=torch.float32) for bound in bounds)
        # Not persistent: a teacher's file holds what was learned, and its description the bounds.
        self.register_buffer("action_scale", (high - low) / 2.0, persistent=False)
        self.register_buffer("action_bias", (high + low) / 2.0, persistent=False)
        self.log_std_rule = architecture.log_std

    def outputs(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """What the heads say: the mean, and the log standard deviation before it is bounded, each (batch, action)."""
        hidden = self.features(observations)
        mean, raw = self.mean(hidden), self.log_std(hidden)
        if self.mean_adapter is not None and self.log_std_adapter is not None:
            mean, raw = self.mean_adapter(mean), self.log_std_adapter(raw)
        return mean, raw

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before squashing, each (batch, action)."""
        mean, raw = self.outputs(observations)
        least, most = LOG_STD_BOUNDS[self.log_std_rule]
        if self.log_std_rule == CLAMP:
            return mean, raw.clamp(least, most)
        return mean, least + 0.5 * (most - least) * (torch.tanh(raw) + 1.0)

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
        # The noise is given, so that the gradient reaches mean and log_std, and two learners can draw the same.
        squashed = torch.tanh(mean + log_std.exp() * noise)
        gaussian = -0.5 * noise.square() - log_std - _HALF_LOG_2PI
        log_prob = gaussian - torch.log(self.action_scale * (1.0 - squashed.square()) + 1e-6)
        return squashed * self.action_scale + self.action_bias, log_prob.sum(dim=1)

    def mode(self, observations: Tensor) -> Tensor:
        """The deterministic policy: the squashed mean, (batch, action)."""
        mean, _ = self(observations)
        return torch.tanh(mean) * self.action_scale + self.action_bias


class Critic(Trunk):
    """Soft action-value function.

    Args:
        architecture: Its layers.
        name: Which of the critics it is.
        generator: Source of the initial weights.
    """

    output: nn.Linear

    def __init__(self, architecture: Architecture, name: str, generator: torch.Generator) -> None:
        super().__init__(architecture.part(name), architecture.adapter_activation, generator)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Q(s, a), (batch,)."""
        output: Tensor = self.output(self.features(torch.cat((observations, actions), dim=1)))
        return output.squeeze(1)


class Networks(nn.Module):
    """All that SAC learns of an environment but its temperature: one actor and two independent critics.

    Args:
        architecture: Which layers they have.
        generator: Source of the initial weights.
    """

    def __init__(self, architecture: Architecture, generator: torch.Generator) -> None:
        super().__init__()
        self.architecture = architecture
        self.actor = Actor(architecture, generator)
        self.critic_1, self.critic_2 = (Critic(architecture, name, generator) for name in CRITICS)

    @property
    def dims(self) -> Dimensions:
        """Observation and action sizes of the environment."""
        return self.architecture.dims

    @property
    def critics(self) -> tuple[Critic, Critic]:
        """Both critics."""
        return self.critic_1, self.critic_2

    def layers(self) -> dict[str, nn.Linear]:
        """Every linear layer by its name, such as ``actor.hidden_1`` or ``critic_2.output``."""
        return {f"{part}.{name}": layer for part in (ACTOR, *CRITICS) for name, layer in getattr(self, part).layers()}

    def with_core(self, core: Dimensions | None, adapter_activation: str, generator: torch.Generator) -> Networks:
        """Fresh networks for the same environment around the layers of another one."""
        return Networks(replace(self.architecture, core=core, adapter_activation=adapter_activation), generator)

    def with_log_std(self, rule: str) -> Networks:
        """The same weights in a policy whose log standard deviation is bounded by another rule."""
        if rule == self.architecture.log_std:
            return self
        # Its weights are drawn only to be overwritten: no run's generator is to notice.
        other = Networks(replace(self.architecture, log_std=rule), torch.Generator().manual_seed(0))
        other.load_state_dict(self.state_dict())
        return other
