"""Networks for Stable-Baselines3: the same functions, laid out as its SAC has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from acmr.agent.architecture import TANH
from acmr.agent.networks import Actor, Critic, Trunk
from acmr.transfer.teacher import Teacher

#: A linear layer as its weight (out, in) and its bias (out,), in float64: layers are multiplied with one another.
_Linear = tuple[Tensor, Tensor]


class _Spaces(gym.Env[np.ndarray, np.ndarray]):
    """An environment that has nothing but its spaces; Stable-Baselines3 asks for one."""

    def __init__(self, observation: Box, action: Box) -> None:
        self.observation_space, self.action_space = observation, action


def write_sb3(teacher: Teacher, path: Path) -> None:
    """Writes a model for ``stable_baselines3.SAC.load``: actor, critics, targets and temperature.

    Its deterministic actions and its Q values are those of the networks. Its sampled actions are so where log_std is
    clamped, as it is there; of one that is a tanh it gets the tangent at the middle.
    """
    # Not installed with the program; the caller has seen that it is there.
    from stable_baselines3 import SAC

    networks, about = teacher.build_networks().double(), teacher.description
    low, high = (np.asarray(bound, np.float32) for bound in (about.action_low, about.action_high))
    seen = Box(-np.inf, np.inf, (about.dims.observation,), np.float32)
    trunk, critic_trunk = _trunk(networks.actor), _trunk(networks.critic_1)
    widths = {"pi": [len(bias) for _, bias in trunk], "qf": [len(bias) for _, bias in critic_trunk]}
    model: Any = SAC(
        "MlpPolicy",
        _Spaces(seen, Box(low, high, dtype=np.float32)),
        policy_kwargs={"net_arch": widths, "activation_fn": nn.ReLU},
        # Nobody learns here; who goes on with the model chooses a buffer of their own.
        buffer_size=1,
        device="cpu",
    )
    _fill(model.actor.latent_pi, trunk)
    mean, raw = _heads(networks.actor)
    _fill([model.actor.mu], [mean])
    if about.log_std == TANH:
        # log_std = -5 + 3.5 (tanh(raw) + 1) = -1.5 + 3.5 raw + ... at raw = 0.
        raw = (3.5 * raw[0], 3.5 * raw[1] - 1.5)
    _fill([model.actor.log_std], [raw])
    for critic in (model.critic, model.critic_target):
        for network, ours in zip(critic.q_networks, networks.critics, strict=True):
            _fill(network, _q_layers(ours, networks.actor, about.dims.observation))
    with torch.no_grad():
        model.log_ent_coef.fill_(0.0 if about.log_alpha is None else about.log_alpha)
    model.save(path)


def _fill(modules: Any, layers: list[_Linear]) -> None:
    linear = [module for module in modules if isinstance(module, nn.Linear)]
    with torch.no_grad():
        for module, (weight, bias) in zip(linear, layers, strict=True):
            module.weight.copy_(weight)
            module.bias.copy_(bias)


def _of(layer: nn.Linear) -> _Linear:
    return layer.weight.detach(), layer.bias.detach()


def _after(first: _Linear, second: _Linear) -> _Linear:
    """Two linear layers with nothing between them, as one."""
    return second[0] @ first[0], second[0] @ first[1] + second[1]


def _trunk(network: Trunk) -> list[_Linear]:
    """The layers that a ReLU follows."""
    layers = [_of(network.input), *(_of(getattr(network, name)) for name in network.hidden_names)]
    if network.input_adapter is None:
        return layers
    adapter = _of(network.input_adapter)
    return [adapter, *layers] if network.adapter_relu else [_after(adapter, layers[0]), *layers[1:]]


def _heads(actor: Actor) -> tuple[_Linear, _Linear]:
    """Mean and log standard deviation, each as one layer behind the trunk."""
    mean, raw = _of(actor.mean), _of(actor.log_std)
    if actor.mean_adapter is not None and actor.log_std_adapter is not None:
        return _after(mean, _of(actor.mean_adapter)), _after(raw, _of(actor.log_std_adapter))
    return mean, raw


def _q_layers(critic: Critic, actor: Actor, observations: int) -> list[_Linear]:
    """A critic that is given actions in [-1, 1], as Stable-Baselines3 has them, in place of those within the bounds."""
    layers = [*_trunk(critic), _of(critic.output)]
    weight, bias = layers[0]
    acting = weight[:, observations:]
    moved = torch.cat([weight[:, :observations], acting * actor.action_scale], dim=1)
    return [(moved, bias + acting @ actor.action_bias), *layers[1:]]
