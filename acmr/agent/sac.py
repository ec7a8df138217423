"""Soft Actor-Critic (Haarnoja et al. 2018) as the paper ran it.

The passes through the networks are written out (:mod:`acmr.agent.kernels.layers`) and share what they can without
changing a value; :mod:`acmr.agent.sac_plain` says the same plainly, with autograd: read that first. The tests hold the
two together.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from acmr.agent.fine_tuning import actor_learns, kickstart_weight, rate_share, set_biases, thaw
from acmr.agent.kernels.adam import Adam, StagedAdam
from acmr.agent.kernels.arrays import Array, array_of, math_of, tensor_of
from acmr.agent.kernels.groups import actor_groups, critic_groups, heads, relus
from acmr.agent.kernels.layers import CriticStack, Stack, columns
from acmr.agent.kernels.origin import Origin
from acmr.agent.kernels.parameters import FlatParameters
from acmr.agent.kernels.policy import NumpyPolicy, Sample, SquashedGaussian
from acmr.agent.learner import Means, learner, load_tensors
from acmr.agent.networks import Critic, Networks
from acmr.agent.replay_buffer import Batch, JoinedBatch
from acmr.config import PRECISIONS, SACConfig


@learner("sac")
class SAC:
    """Learns networks from batches of transitions.

    The target critics start equal to the critics as they are given, so transfer and freezing come first.
    Layers whose parameters do not require gradients are not stepped until they thaw, nor do their target twins move.
    The parameters of the networks and targets become views into vectors that are learned as a whole.

    Args:
        networks: Actor and critics.
        config: Hyperparameters.
        acting: Generator of the noise of actions taken in the environment.
        learning: Generator of the noise of actions sampled in the updates.
        log_alpha: Initial log of the temperature.
        device: Where the networks live.
        thaws: Environment step from which layers learn that do not require gradients now, by the layer's name.
    """

    precisions = PRECISIONS

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
        self._generators = {"acting": acting, "learning": learning}
        self.targets = copy.deepcopy(nn.ModuleList(networks.critics)).requires_grad_(False)
        self.target_entropy = -float(networks.dims.action)
        self._math = math_of(networks.actor.action_scale)
        self._thaws: dict[nn.Module, int] = {networks.layers()[name]: step for name, step in (thaws or {}).items()}
        self._build_networks()
        start = log_alpha if config.autotune else math.log(config.alpha)
        self.log_alpha = torch.full((1,), start, device=device)
        # The temperature is read several times for each time it changes, so its exponential is kept beside it.
        self._alpha, self._log_alpha_gradient = self.log_alpha.exp(), torch.zeros(1, device=device)
        self._alpha_array = array_of(self._alpha)
        self._optimizers = {
            "actor": StagedAdam.of(self._actor_parameters, config.policy_lr),
            "critics": StagedAdam.of(self._critic_parameters, config.q_lr),
            "log_alpha": StagedAdam({0: Adam(self.log_alpha, self._log_alpha_gradient, config.q_lr)}),
        }
        self._thaw(0)
        self._means = Means()
        self._batch_size = 0

    def _build_networks(self) -> None:
        actor, critics, dims = self.networks.actor, self.networks.critics, self.networks.dims
        # Twin layers lie side by side in memory and learn as one block (:class:`FlatParameters`); the order is that of
        # their application.
        self._reduced = self.config.precision == "bfloat16"
        low_actor, low_critics = ([self._reduced and not head for head in heads(net)] for net in (actor, critics[0]))
        self._actor_parameters = FlatParameters(actor_groups(actor), None, low_actor, self._thaws)
        self._critic_parameters = FlatParameters(critic_groups(critics), None, low_critics, self._thaws)
        target_groups = critic_groups([target for target in self.targets if isinstance(target, Critic)])
        self._target_parameters = FlatParameters(target_groups, self._critic_parameters, low_critics)
        # Whom the actor is held to at first: the policy as it was transferred.
        held = self.config.kickstart > 0
        self._origin = Origin(actor, low_actor) if held else None
        active = relus(critics[0])
        self._actor = Stack(self._actor_parameters.blocks, relus(actor))
        self._critics = CriticStack(self._critic_parameters.blocks, active, dims.observation)
        self._targets = CriticStack(self._target_parameters.blocks, active, dims.observation)
        bounded = (actor.action_scale, actor.action_bias, actor.log_std_rule)
        self._policy = SquashedGaussian(*bounded)
        acting = Stack(self._actor_parameters.masters, relus(actor)).layers
        self._acting = NumpyPolicy(acting, *bounded) if self._math is np else None

    @torch.no_grad()
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Samples the policy's action, (action,), for one observation, (observation,)."""
        noise = torch.randn((1, self.networks.dims.action), generator=self._generators["acting"])
        if self._acting is not None:
            return self._acting(observation, noise.numpy()[0])
        observations = torch.as_tensor(observation, dtype=torch.float32, device=self.device).unsqueeze(0)
        actions, _ = self.networks.actor.sample(observations, noise.to(self.device))
        return actions[0].cpu().numpy()

    @torch.no_grad()
    def update(self, batch: Batch, global_step: int) -> None:
        """Learns from one batch: what falls due at this environment step.

        The critics learn at every step. Every ``policy_frequency`` steps the actor makes up for its delay
        with as many updates on this batch, each followed by a temperature update.
        """
        # Critics read observation and action side by side. The replay buffer gathers them so: then this joins nothing.
        joined = JoinedBatch.join(batch)
        if self._reduced:
            joined = joined.to(torch.bfloat16)
        if len(joined.rewards) != self._batch_size:
            self._allocate(len(joined.rewards))
        if global_step >= self._next_thaw:
            self._thaw(global_step)
        self._update_critics(joined)
        if global_step % self.config.policy_frequency == 0 and self._actor_learns:
            self._update_actor_and_temperature(joined.observations)
        if global_step % self.config.target_network_frequency == 0:
            # lerp leaves equal values bitwise equal; frozen layers are no part of these vectors.
            self._target_parameters.trainable.lerp_(self._critic_parameters.trainable, self.config.tau)
            self._target_parameters.refresh()

    def set_biases(self, biases: Mapping[str, Tensor]) -> None:
        """Begins with these biases of layers, by the layers' names, in networks and targets; before any update."""
        set_biases(self.networks, self.targets, self._origin.actor if self._origin else None, biases)
        self._refresh()

    def metrics(self) -> dict[str, float]:
        """Means over the updates since the last call; NaN where there were none."""
        return self._means.take()

    def state_dict(self) -> dict[str, Any]:
        """All that the following updates and actions depend on, as copies."""
        return {
            "tensors": {name: tensor.clone() for name, tensor in self._state_tensors().items()},
            "generators": {name: generator.get_state() for name, generator in self._generators.items()},
            **self._means.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on, bit for bit, from where :meth:`state_dict` was taken of an agent with the same settings.

        Raises:
            ValueError: If the state is of another agent: names or sizes differ.
        """
        load_tensors(self._state_tensors(), state["tensors"])
        self._refresh()
        for name, generator in self._generators.items():
            generator.set_state(state["generators"][name])
        self._means.load_state_dict(state)

    def _thaw(self, step: int) -> None:
        # What has thawed follows from the step alone, which a learner that was restored is told with its next update.
        self._next_thaw = thaw(self._thaws, step)
        self._actor.let_learn(self._actor_parameters.learning(step))
        self._critics.let_learn(self._critic_parameters.learning(step))
        for optimizer in self._optimizers.values():
            optimizer.thaw(step)

    def _refresh(self) -> None:
        for parameters in (self._actor_parameters, self._critic_parameters, self._target_parameters):
            parameters.refresh()
        if self._origin is not None:
            self._origin.parameters.refresh()
        self._thaw(0)

    def _state_tensors(self) -> dict[str, Tensor]:
        moments = {
            f"{name}.{key}": tensor
            for name, optimizer in self._optimizers.items()
            for key, tensor in optimizer.tensors().items()
        }
        origin = {"origin": self._origin.parameters.values} if self._origin is not None else {}
        return {
            **origin,
            "actor": self._actor_parameters.values,
            "critics": self._critic_parameters.values,
            "targets": self._target_parameters.values,
            "log_alpha": self.log_alpha,
            "alpha": self._alpha,
            **moments,
        }

    def _allocate(self, batch_size: int) -> None:
        self._batch_size = batch_size
        self._actor_places, self._critic_places = self._actor.allocate(batch_size), self._critics.allocate(batch_size)
        self._noise = torch.zeros((batch_size, self.networks.dims.action), device=self.device)
        # A product with 1 / n is a mean, in one call for both critics.
        self._average = array_of(torch.full((batch_size,), 1.0 / batch_size, device=self.device))
        # What the arithmetic between the networks reads and writes: views that are made once.
        heads, values = self._actor_places[-1], self._critic_places[-1]
        self._mean, self._raw = (array_of(part) for part in columns(heads.output, 2))
        self._of_mean, self._of_raw = (array_of(part) for part in columns(heads.gradient, 2))
        if self._origin is not None:
            self._origin.allocate(batch_size)
        self._values, self._of_values = (array_of(part)[:, :, 0] for part in (values.output, values.gradient))

    def _draw(self) -> Sample:
        """Samples from the actor's last output; good until the next call."""
        noise = self._noise.normal_(generator=self._generators["learning"])
        return self._policy.sample(self._mean, self._raw, array_of(noise))

    def _update_critics(self, batch: JoinedBatch) -> None:
        values, alpha = self._values, self._alpha_array
        self._actor.forward(batch.next_observations, self._actor_places)
        after = self._draw()
        room = batch.next_inputs[:, self.networks.dims.observation :]
        if self._reduced:  # NumPy has no bfloat16
            room.copy_(tensor_of(after.actions))
        else:
            array_of(room)[...] = after.actions
        # Targets and critics take turns in the same memory: their values are used up before the critics' pass.
        self._targets.forward(batch.next_inputs, self._critic_places)
        soft_value = self._math.minimum(values[0], values[1]) - alpha * after.log_prob
        # Truncation is not an end: only a terminated transition has no future (reference, section 2).
        future = self.config.gamma * (1.0 - array_of(batch.terminated)) * soft_value
        expected = array_of(batch.rewards) + future

        self._critics.forward(batch.inputs, self._critic_places)
        errors = values - expected
        # Each critic's loss is the mean of the squared errors.
        self._of_values[...] = errors * (2.0 / self._batch_size)
        self._critics.backward(batch.inputs, self._critic_places)
        self._critic_parameters.collect()
        self._step("critics")
        self._critic_parameters.refresh()
        losses, means = (errors * errors) @ self._average, values @ self._average
        self._means.add(critic_loss=losses[0] + losses[1], q_value_1=means[0], q_value_2=means[1])

    def _update_actor_and_temperature(self, observations: Tensor) -> None:
        updates = self.config.policy_frequency
        # All of the actor's updates read the same observations, and the critics stand still meanwhile.
        self._critics.share(observations)
        self._actor.forward(observations, self._actor_places)
        if self._origin is not None:
            self._origin.forward(observations)
        for remaining in reversed(range(updates)):
            self._update_actor(observations, self._draw())
            if self.config.autotune or remaining:
                # One pass with the new weights serves the temperature and, with noise of its own, the next update.
                self._actor.forward(observations, self._actor_places)
            if self.config.autotune:
                self._update_temperature(self._draw())

    def _update_actor(self, observations: Tensor, sample: Sample) -> None:
        (first, second), share, alpha = self._values, 1.0 / self._batch_size, self._alpha_array
        self._critics.forward_actions(tensor_of(sample.actions), self._critic_places)
        # The loss, mean(alpha log_prob - min(q_1, q_2)), reaches the smaller value; equal ones halve it.
        reached = share * ((first < second) + 0.5 * (first == second))
        self._of_values[0] = -reached
        self._of_values[1] = reached - share
        of_actions = array_of(self._critics.action_gradient(self._critic_places))
        self._policy.backward(sample, of_actions, alpha * share, self._of_mean, self._of_raw)
        penalty = self._hold_on(share)
        self._actor.backward(observations, self._actor_places)
        self._actor_parameters.collect()
        self._step("actor")
        self._actor_parameters.refresh()
        log_prob, value = sample.log_prob @ self._average, self._math.minimum(first, second) @ self._average
        self._means.add(actor_loss=alpha[0] * log_prob - value + penalty, entropy=-log_prob)

    @property
    def _actor_learns(self) -> bool:
        # Optimizers are asked only where something depends on it: on a GPU, that waits for all updates to end.
        return not self.config.critics_first or actor_learns(self.config, self._optimizers["critics"].updates)

    def _hold_on(self, share: float) -> Array:
        """Adds the gradient of the penalty on the distance to the transferred policy; returns the penalty."""
        weight = kickstart_weight(self.config, self._optimizers["actor"].updates) if self._origin is not None else 0.0
        if self._origin is None or weight == 0.0:
            return 0.0
        return self._origin.pull((self._mean, self._raw), (self._of_mean, self._of_raw), weight * share)

    def _step(self, name: str) -> None:
        self._optimizers[name].step(partial(rate_share, self.config) if self.config.warmup else None)

    def _update_temperature(self, sample: Sample) -> None:
        loss = -self._alpha_array[0] * (sample.log_prob @ self._average + self.target_entropy)
        # The loss is linear in alpha, so its derivative by log_alpha is itself.
        array_of(self._log_alpha_gradient)[...] = loss
        self._step("log_alpha")
        torch.exp(self.log_alpha, out=self._alpha)
        self._means.add(alpha_loss=loss, alpha=self._alpha_array[0])
