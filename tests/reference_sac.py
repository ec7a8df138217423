"""Soft Actor-Critic as the paper ran it, written plainly with autograd: the reference for the fast learner."""

from __future__ import annotations

import copy
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from acmr.agent.networks import Networks
from acmr.agent.replay_buffer import Batch
from acmr.config import SACConfig

#: What :meth:`SAC.metrics` reports: means over the updates since it was last asked.
METRIC_NAMES = ("critic_loss", "actor_loss", "alpha_loss", "q_value_1", "q_value_2", "alpha", "entropy")


class ReferenceSAC:
    """Learns networks from batches of transitions.

    The target critics start equal to the critics as they are given, so transfer and freezing come first.
    Layers whose parameters do not require gradients are never stepped, and their target twins never move.

    Args:
        networks: Actor and critics.
        config: Hyperparameters.
        acting: Generator of the noise of actions taken in the environment.
        learning: Generator of the noise of actions sampled in the updates.
        log_alpha: Initial log of the temperature.
        device: Where the networks live.
    """

    def __init__(
        self,
        networks: Networks,
        config: SACConfig,
        acting: torch.Generator,
        learning: torch.Generator,
        log_alpha: float = 0.0,
        device: str = "cpu",
    ) -> None:
        self.networks, self.config, self.device = networks.to(device), config, device
        self._acting, self._learning = acting, learning
        self.targets = copy.deepcopy(nn.ModuleList(networks.critics)).requires_grad_(False)
        self.target_entropy = -float(networks.dims.action)
        start = log_alpha if config.autotune else float(np.log(config.alpha))
        self.log_alpha = torch.full((1,), start, device=device, requires_grad=config.autotune)
        self._critic_parameters = _trainable(networks.critics)
        self._actor_parameters = _trainable([networks.actor])
        self._critic_optimizer = torch.optim.Adam(self._critic_parameters, lr=config.q_lr, foreach=True)
        self._actor_optimizer = torch.optim.Adam(self._actor_parameters, lr=config.policy_lr, foreach=True)
        self._alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=config.q_lr) if config.autotune else None
        self._sums = {name: torch.zeros((), device=device) for name in METRIC_NAMES}
        self._counts = dict.fromkeys(METRIC_NAMES, 0)

    @torch.no_grad()
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Samples the policy's action, (action,), for one observation, (observation,)."""
        noise = torch.randn((1, self.networks.dims.action), generator=self._acting).to(self.device)
        observations = torch.as_tensor(observation, dtype=torch.float32, device=self.device).unsqueeze(0)
        actions, _ = self.networks.actor.sample(observations, noise)
        return actions[0].cpu().numpy()

    def update(self, batch: Batch, global_step: int) -> None:
        """Learns from one batch: what falls due at this environment step.

        The critics learn at every step. Every ``policy_frequency`` steps the actor makes up for its delay
        with as many updates on this batch, each followed by a temperature update.
        """
        self._update_critics(batch)
        if global_step % self.config.policy_frequency == 0:
            for _ in range(self.config.policy_frequency):
                self._update_actor(batch.observations)
                if self._alpha_optimizer is not None:
                    self._update_temperature(batch.observations, self._alpha_optimizer)
        if global_step % self.config.target_network_frequency == 0:
            self._update_targets()

    def metrics(self) -> dict[str, float]:
        """Means over the updates since the last call; NaN where there were none."""
        means = {
            name: float(total) / self._counts[name] if self._counts[name] else float("nan")
            for name, total in self._sums.items()
        }
        for name, total in self._sums.items():
            total.zero_()
            self._counts[name] = 0
        return means

    def _noise(self, batch_size: int) -> Tensor:
        shape = (batch_size, self.networks.dims.action)
        return torch.randn(shape, generator=self._learning, device=self.device)

    def _update_critics(self, batch: Batch) -> None:
        with torch.no_grad():
            actions, log_prob = self.networks.actor.sample(batch.next_observations, self._noise(len(batch.rewards)))
            values = [target(batch.next_observations, actions) for target in self.targets]
            soft_value = torch.minimum(*values) - self.log_alpha.exp() * log_prob
            # Truncation is not an end: only a terminated transition has no future (reference, section 2).
            expected = batch.rewards + self.config.gamma * (1.0 - batch.terminated) * soft_value
        q_values = [critic(batch.observations, batch.actions) for critic in self.networks.critics]
        loss = sum((functional.mse_loss(value, expected) for value in q_values), torch.zeros((), device=self.device))
        _step(self._critic_optimizer, loss, self._critic_parameters)
        self._record(critic_loss=loss, q_value_1=q_values[0].mean(), q_value_2=q_values[1].mean())

    def _update_actor(self, observations: Tensor) -> None:
        actions, log_prob = self.networks.actor.sample(observations, self._noise(len(observations)))
        q_value = torch.minimum(*(critic(observations, actions) for critic in self.networks.critics))
        loss = (self.log_alpha.exp().detach() * log_prob - q_value).mean()
        _step(self._actor_optimizer, loss, self._actor_parameters)
        self._record(actor_loss=loss, entropy=-log_prob.mean())

    def _update_temperature(self, observations: Tensor, optimizer: torch.optim.Optimizer) -> None:
        with torch.no_grad():
            _, log_prob = self.networks.actor.sample(observations, self._noise(len(observations)))
        loss = (-self.log_alpha.exp() * (log_prob + self.target_entropy)).mean()
        _step(optimizer, loss, [self.log_alpha])
        self._record(alpha_loss=loss, alpha=self.log_alpha.exp()[0])

    @torch.no_grad()
    def _update_targets(self) -> None:
        for target, critic in zip(self.targets, self.networks.critics, strict=True):
            # lerp leaves equal values bitwise equal, so the twins of frozen layers stand still.
            torch._foreach_lerp_(list(target.parameters()), list(critic.parameters()), self.config.tau)

    def _record(self, **values: Tensor) -> None:
        for name, value in values.items():
            self._sums[name] += value.detach()
            self._counts[name] += 1


def _trainable(modules: Iterable[nn.Module]) -> list[nn.Parameter]:
    return [parameter for module in modules for parameter in module.parameters() if parameter.requires_grad]


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter] | list[Tensor]) -> None:
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    optimizer.step()
