"""Which layers of the networks learn side by side, and where ReLU stands between them."""

from __future__ import annotations

from collections.abc import Sequence

from acmr.agent.kernels.parameters import Group
from acmr.agent.networks import Actor, Critic, Trunk


def actor_groups(actor: Actor) -> list[Group]:
    """Mean and log_std read the same hidden layer: one product. Their adapters read one of them each."""
    layers = dict(actor.layers())
    groups: list[Group] = [[[layer]] for name, layer in layers.items() if not name.startswith(("mean", "log_std"))]
    groups.append([[actor.mean, actor.log_std]])
    if actor.mean_adapter is not None and actor.log_std_adapter is not None:
        groups.append([[actor.mean_adapter], [actor.log_std_adapter]])
    return groups


def critic_groups(critics: Sequence[Critic]) -> list[Group]:
    """Critics of the same shape, layer by layer."""
    return [[[layer] for _, layer in twins] for twins in zip(*(critic.layers() for critic in critics), strict=True)]


def relus(network: Trunk) -> list[bool]:
    """Whether ReLU follows, for each group of layers in the order of their application."""
    adapter = [network.adapter_relu] if network.input_adapter is not None else []
    return adapter + [not head for head in heads(network)[len(adapter) :]]


def heads(network: Trunk) -> list[bool]:
    """Whether it belongs to the head, which has no ReLU, for each group of layers in the order of their application."""
    trunk = (network.input_adapter is not None) + 1 + len(network.hidden_names)
    heads = 2 if isinstance(network, Actor) and network.mean_adapter is not None else 1
    return [False] * trunk + [True] * heads
