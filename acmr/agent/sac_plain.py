"""Soft Actor-Critic (Haarnoja et al. 2018) as the paper ran it, written plainly with autograd.

It learns what :mod:`acmr.agent.sac` learns, up to rounding, and ``tests/test_sac_reference.py`` holds the two together.
It is slower, and made to be changed: its losses are functions of tensors that a subclass replaces (docs/howto-loss.md).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from acmr.agent.fine_tuning import NEVER, actor_learns, begin_of, kickstart_weight, rate_share, set_biases, thaw
from acmr.agent.learner import Means, learner, load_tensors
from acmr.agent.networks import Networks, Trunk
from acmr.agent.replay_buffer import Batch
from acmr.config import SACConfig


@learner("sac_plain")
class PlainSAC:
    """Learns networks from batches of transitions; the same promises as :class:`acmr.agent.sac.SAC`.

    Args:
        networks: Actor and critics, transferred and frozen already.
        config: Hyperparameters.
        acting: Generator of the noise of actions taken in the environment.
        learning: Generator of the noise of actions sampled in the updates.
        log_alpha: Initial log of the temperature.
        device: Where the networks live.
        thaws: Environment step from which layers learn that do not require gradients now, by the layer's name.
    """

    # Autograd through bfloat16 would need scaled losses and copies of the weights.
    precisions = ("float32",)

    def __init__(
        self,
        networks: Networks,
        config: SACConfig,
        acting: torch.Generator,
        learning: torch.Generator,
        log_alpha: float = 0.0,
        device: str = "cpu",
        thaws: Mapping[str, int] | None = None,
    ) -> None:
        self.networks, self.config, self.device = networks.to(device), config, device
        self._thaws: dict[nn.Module, int] = {networks.layers()[name]: step for name, step in (thaws or {}).items()}
        self._generators = {"acting": acting, "learning": learning}
        self.targets = copy.deepcopy(nn.ModuleList(networks.critics)).requires_grad_(False)
        # Whom the actor is held to at first: the policy as it was transferred.
        self.origin = copy.deepcopy(networks.actor).requires_grad_(False) if config.kickstart else None
        # One nat less for each action (Haarnoja et al. 2018b, appendix D).
        self.target_entropy = -float(networks.dims.action)
        start = log_alpha if config.autotune else math.log(config.alpha)
        self.log_alpha = torch.full((1,), start, device=device, requires_grad=config.autotune)
        self._optimizers = {
            "actor": _adam(self._learning([networks.actor]), config.policy_lr),
            "critics": _adam(self._learning(networks.critics), config.q_lr),
        }
        if config.autotune:
            self._optimizers["log_alpha"] = _adam([[self.log_alpha]], config.q_lr)
        self._means = Means()

    @staticmethod
    def expected_value(
        rewards: Tensor, terminated: Tensor, next_values: Tensor, log_prob: Tensor, alpha: Tensor, config: SACConfig
    ) -> Tensor:
        """What the critics are to say of a transition, (batch,).

        Args:
            rewards: (batch,).
            terminated: (batch,), 1 where the transition has no future. Truncation is not an end.
            next_values: Of both targets, for an action of the policy in the next state, (2, batch).
            log_prob: Of that action, (batch,).
            alpha: Temperature, (1,).
            config: Hyperparameters.
        """
        # The smaller of two independent estimates: a single one is overestimated (Fujimoto et al. 2018).
        soft_value = next_values.amin(dim=0) - alpha * log_prob
        return rewards + config.gamma * (1.0 - terminated) * soft_value

    @staticmethod
    def critic_loss(values: Tensor, expected: Tensor, config: SACConfig) -> Tensor:
        """Mean squared error of each critic, summed, from values (2, batch) and what is expected, (batch,)."""
        return (values - expected).square().mean(dim=1).sum()

    @staticmethod
    def actor_loss(values: Tensor, log_prob: Tensor, alpha: Tensor, config: SACConfig) -> Tensor:
        """What the policy minimizes, from both critics' values of its actions, (2, batch), and log_prob, (batch,)."""
        return (alpha * log_prob - torch.minimum(*values)).mean()

    @staticmethod
    def distance(outputs: tuple[Tensor, Tensor], origin: tuple[Tensor, Tensor]) -> Tensor:
        """Half the squared distance of two policies' outputs (mean and raw log_std, each (batch, action)), averaged."""
        return 0.5 * (torch.cat(outputs, dim=1) - torch.cat(origin, dim=1)).square().sum(dim=1).mean()

    @staticmethod
    def temperature_loss(log_alpha: Tensor, log_prob: Tensor, target_entropy: float, config: SACConfig) -> Tensor:
        """Raises the temperature while the policy's entropy, -mean(log_prob), is under its target."""
        return (-log_alpha.exp() * (log_prob + target_entropy)).mean()

    @torch.no_grad()
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Samples the policy's action, (action,), for one observation, (observation,)."""
        noise = torch.randn((1, self.networks.dims.action), generator=self._generators["acting"]).to(self.device)
        observations = torch.as_tensor(observation, dtype=torch.float32, device=self.device).unsqueeze(0)
        actions, _ = self.networks.actor.sample(observations, noise)
        return actions[0].cpu().numpy()

    def update(self, batch: Batch, global_step: int) -> None:
        """Learns from one batch: what falls due at this environment step.

        The critics learn at every step. Every ``policy_frequency`` steps the actor makes up for its delay
        with as many updates on this batch, each followed by a temperature update.
        """
        # What has thawed follows from the step alone, so that no state has to hold it.
        thaw(self._thaws, global_step)
        self._update_critics(batch)
        if global_step % self.config.policy_frequency == 0 and self._actor_learns:
            for _ in range(self.config.policy_frequency):
                self._update_actor(batch.observations)
                if self.config.autotune:
                    self._update_temperature(batch.observations)
        if global_step % self.config.target_network_frequency == 0:
            self._update_targets()

    def set_biases(self, biases: Mapping[str, Tensor]) -> None:
        """Begins with these biases of layers, by the layers' names, in networks and targets; before any update."""
        set_biases(self.networks, self.targets, self.origin, biases)

    def metrics(self) -> dict[str, float]:
        """Means over the updates since the last call; NaN where there were none."""
        return self._means.take()

    def state_dict(self) -> dict[str, Any]:
        """All that the following updates and actions depend on, as copies."""
        return {
            "tensors": {name: tensor.detach().clone() for name, tensor in self._state_tensors().items()},
            "generators": {name: generator.get_state() for name, generator in self._generators.items()},
            **self._means.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on, bit for bit, from where :meth:`state_dict` was taken of an agent with the same settings.

        Raises:
            ValueError: If the state is of another agent: names or sizes differ.
        """
        load_tensors(self._state_tensors(), state["tensors"])
        for name, generator in self._generators.items():
            generator.set_state(state["generators"][name])
        self._means.load_state_dict(state)

    def _state_tensors(self) -> dict[str, Tensor]:
        tensors = {f"networks.{name}": tensor for name, tensor in self.networks.state_dict().items()}
        tensors |= {f"targets.{name}": tensor for name, tensor in self.targets.state_dict().items()}
        for name, optimizer in self._optimizers.items():
            for index, moments in enumerate(optimizer.state.values()):
                tensors |= {f"{name}.{index}.{key}": tensor for key, tensor in moments.items()}
        if self.origin is not None:
            tensors |= {f"origin.{name}": tensor for name, tensor in self.origin.state_dict().items()}
        return {**tensors, "log_alpha": self.log_alpha}

    def _sample(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        shape = (len(observations), self.networks.dims.action)
        noise = torch.randn(shape, generator=self._generators["learning"], device=self.device)
        return self.networks.actor.sample(observations, noise)

    def _update_critics(self, batch: Batch) -> None:
        with torch.no_grad():
            actions, log_prob = self._sample(batch.next_observations)
            next_values = torch.stack([target(batch.next_observations, actions) for target in self.targets])
            expected = self.expected_value(
                batch.rewards, batch.terminated, next_values, log_prob, self.log_alpha.exp(), self.config
            )
        values = torch.stack([critic(batch.observations, batch.actions) for critic in self.networks.critics])
        loss = self.critic_loss(values, expected, self.config)
        self._step("critics", loss)
        first, second = values.detach().mean(dim=1)
        self._means.add(critic_loss=loss.detach(), q_value_1=first, q_value_2=second)

    def _update_actor(self, observations: Tensor) -> None:
        actions, log_prob = self._sample(observations)
        values = torch.stack([critic(observations, actions) for critic in self.networks.critics])
        loss = self.actor_loss(values, log_prob, self.log_alpha.exp().detach(), self.config)
        if self.origin is not None:
            weight = kickstart_weight(self.config, _updates(self._optimizers["actor"]))
            outputs = self.networks.actor.outputs(observations), self.origin.outputs(observations)
            loss = loss + weight * self.distance(*outputs)
        self._step("actor", loss)
        self._means.add(actor_loss=loss.detach(), entropy=-log_prob.detach().mean())

    def _update_temperature(self, observations: Tensor) -> None:
        with torch.no_grad():
            _, log_prob = self._sample(observations)
        loss = self.temperature_loss(self.log_alpha, log_prob, self.target_entropy, self.config)
        self._step("log_alpha", loss)
        self._means.add(alpha_loss=loss.detach(), alpha=self.log_alpha.detach().exp()[0])

    @property
    def _actor_learns(self) -> bool:
        return not self.config.critics_first or actor_learns(self.config, _updates(self._optimizers["critics"]))

    def _step(self, name: str, loss: Tensor) -> None:
        optimizer, learning = self._optimizers[name], []
        optimizer.zero_grad()
        for group in optimizer.param_groups:
            if self.config.warmup:
                lr = self.config.policy_lr if name == "actor" else self.config.q_lr
                group["lr"] = lr * rate_share(self.config, _updates(optimizer, group))
            learning += [parameter for parameter in group["params"] if parameter.requires_grad]
        # Gradients of these parameters only: the actor's loss must not leave any in the critics. Adam passes over those
        # that have none, which are those still frozen.
        for parameter, gradient in zip(learning, torch.autograd.grad(loss, learning), strict=True):
            parameter.grad = gradient
        optimizer.step()

    def _learning(self, networks: Iterable[Trunk]) -> list[list[Tensor]]:
        """Parameters that learn, now or later: those that begin at the same step together, the first ones first."""
        stages: dict[float, list[Tensor]] = {}
        for network in networks:
            for _, layer in network.layers():
                stages.setdefault(begin_of(layer, self._thaws), []).extend(layer.parameters())
        return [stages[begin] for begin in sorted(stages.keys() - {NEVER})]

    @torch.no_grad()
    def _update_targets(self) -> None:
        for target, critic in zip(self.targets, self.networks.critics, strict=True):
            # lerp leaves equal values bitwise equal, so the twins of frozen layers stand still.
            torch._foreach_lerp_(list(target.parameters()), list(critic.parameters()), self.config.tau)


def _adam(stages: Iterable[list[Tensor]], lr: float) -> torch.optim.Adam:
    """Adam for the parameters that learn, in groups that begin together."""
    optimizer = torch.optim.Adam([{"params": parameters} for parameters in stages], lr=lr, foreach=True)
    for parameter in (each for group in optimizer.param_groups for each in group["params"]):
        # As its first step would begin; made here, so that a state can be loaded before there was one.
        moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
        optimizer.state[parameter] = {"step": torch.zeros(()), **moments}
    return optimizer


def _updates(optimizer: torch.optim.Adam, group: Mapping[str, Any] | None = None) -> int:
    """Steps that it has taken with one group of parameters; None: with those that began first."""
    group = group or optimizer.param_groups[0]
    return int(optimizer.state[group["params"][0]]["step"])
