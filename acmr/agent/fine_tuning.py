"""How a learner begins that has something to lose: gently. All of it is off in the paper's cells.

A student whose policy and values came from a teacher loses them in its first thousand updates if it learns as one that
begins with nothing: Adam has no memory yet, so that its first steps are as large as the rate allows whatever the
gradient is, and the critics have seen another body. Three remedies, in both learners: rates that rise from zero
(``agent.warmup``), critics that learn before the actor does (``agent.critics_first``), and kickstarting (Schmitt et al.
2018): a penalty on the distance to the transferred policy that fades (``agent.kickstart``). A fourth is freezing for a
time (``thaw``): the layers that are fresh learn first, and the others join them from the output down, as in gradual
unfreezing (Howard and Ruder 2018).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn

from acmr.agent.architecture import ACTOR, CRITICS
from acmr.agent.networks import Networks
from acmr.config import SACConfig

#: When a layer begins to learn that is frozen for good.
NEVER = math.inf


def rate_share(config: SACConfig, updates: int) -> float:
    """Share of its learning rate with which an optimizer makes its next update, 0 to 1.

    Args:
        config: ``warmup`` is the number of updates over which the share rises in equal steps.
        updates: How many it has made.
    """
    return min(1.0, (updates + 1) / config.warmup) if config.warmup else 1.0


def set_biases(
    networks: Networks, targets: Iterable[nn.Module], origin: nn.Module | None, biases: Mapping[str, Tensor]
) -> None:
    """Sets biases of layers wherever a learner that has made no update holds them.

    Args:
        networks: Actor and critics.
        targets: Of both critics, in their order.
        origin: The policy that the actor is held to, if it is.
        biases: By the layer's name, such as ``critic_1.input``.
    """
    twins = {**dict(zip(CRITICS, targets, strict=True)), ACTOR: origin}
    with torch.no_grad():
        for name, bias in biases.items():
            part, _, layer = name.partition(".")
            for owner in (getattr(networks, part), twins[part]):
                if owner is not None:
                    getattr(owner, layer).bias.copy_(bias)


def actor_learns(config: SACConfig, updates: int) -> bool:
    """Whether actor and temperature learn already, or the critics alone, which have made so many updates."""
    return updates > config.critics_first


def kickstart_weight(config: SACConfig, updates: int) -> float:
    """Weight of the penalty on the distance to the transferred policy in the actor's next update.

    Args:
        config: ``kickstart`` is the weight at first; it fades to zero over ``kickstart_updates`` in equal steps.
        updates: How many the actor has made.
    """
    return config.kickstart * max(0.0, 1.0 - updates / config.kickstart_updates) if config.kickstart else 0.0


def thaw_schedule(frozen: Sequence[str], steps: Sequence[int]) -> dict[str, int]:
    """When each frozen layer begins to learn, by its name.

    Args:
        frozen: Names of layers such as ``actor.hidden_1``, within actor and critics in the order of their application.
        steps: Environment steps, ascending. At each the layer next to the output thaws in the actor and in both
            critics (mean and log_std count as one), at the last one all that are left; where there are none, nothing
            ever does.
    """
    schedule: dict[str, int] = {}
    for part in (ACTOR, *CRITICS) if steps else ():
        own = {name: name.replace("log_std", "mean") for name in frozen if name.startswith(f"{part}.")}
        from_the_output = list(dict.fromkeys(reversed(own.values())))
        schedule |= {name: steps[min(from_the_output.index(one), len(steps) - 1)] for name, one in own.items()}
    return schedule


def begin_of(layer: nn.Module, thaws: Mapping[nn.Module, int]) -> float:
    """Environment step at which a layer begins to learn: 0 where it requires gradients, else what is said of it.

    Raises:
        ValueError: If only a part of it requires gradients.
    """
    learns = {parameter.requires_grad for parameter in layer.parameters()}
    if len(learns) > 1:
        raise ValueError("the weight and the bias of a layer must be frozen together")
    return 0 if learns.pop() else thaws.get(layer, NEVER)


def thaw(thaws: Mapping[nn.Module, int], step: int) -> float:
    """Lets those layers learn that begin by an environment step, and no others; returns when the next one begins."""
    for layer, begin in thaws.items():
        layer.requires_grad_(begin <= step)
    return min((begin for begin in thaws.values() if begin > step), default=NEVER)
