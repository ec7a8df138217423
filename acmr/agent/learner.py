"""What a run asks of a learner, and which learner the settings mean."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from acmr.agent.networks import Networks
from acmr.agent.replay_buffer import Batch
from acmr.config import ConfigError, SACConfig
from acmr.registry import Registry

#: What the learners report: means over the updates since they were last asked.
METRIC_NAMES = ("critic_loss", "actor_loss", "alpha_loss", "q_value_1", "q_value_2", "alpha", "entropy")


class Learner(Protocol):
    """Acts by a policy and learns it from batches of transitions.

    Two of them stand side by side: :class:`acmr.agent.sac.SAC` with hand-written passes, and
    :class:`acmr.agent.sac_plain.PlainSAC`, which is slower and easily changed (docs/howto-loss.md).

    Attributes:
        precisions: Values of ``agent.precision`` that it can compute with.
        networks: Actor and critics; what their layers hold is what has been learned.
        config: Hyperparameters.
        log_alpha: Log of the temperature, (1,).
    """

    precisions: ClassVar[tuple[str, ...]]
    networks: Networks
    config: SACConfig
    log_alpha: Tensor

    def __init__(
        self,
        networks: Networks,
        config: SACConfig,
        acting: torch.Generator,
        learning: torch.Generator,
        log_alpha: float = 0.0,
        device: str = "cpu",
        thaws: Mapping[str, int] | None = None,
    ) -> None: ...

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Samples an action, (action,), for one observation, (observation,)."""

    def update(self, batch: Batch, global_step: int) -> None:
        """Learns from one batch what falls due at this environment step."""

    def set_biases(self, biases: Mapping[str, Tensor]) -> None:
        """Begins with these biases of layers, by the layers' names, in networks and targets; before any update."""

    def metrics(self) -> dict[str, float]:
        """Means over the updates since the last call, by :data:`METRIC_NAMES`; NaN where there were none."""

    def state_dict(self) -> dict[str, Any]:
        """All that the following updates and actions depend on, as copies.

        ``tensors`` and ``generators`` by name, and ``metric_sums`` and ``metric_counts`` by name of the metric.
        """

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on, bit for bit, from where :meth:`state_dict` was taken.

        Raises:
            ValueError: If the state is of another agent.
        """


LEARNERS: Registry[type[Learner]] = Registry("agent.name", "acmr.agent")
#: Registers a learner under the name of its module and of its YAML file in ``conf/agent``.
learner = LEARNERS.add


def find_learner(config: SACConfig, thaws: bool = False) -> Callable[..., Learner]:
    """The class that the settings name.

    Args:
        config: The settings.
        thaws: Whether it is to let frozen layers learn later, which one of the user's own need not be able to.

    Raises:
        ConfigError: If there is none, or if it cannot compute as the settings ask.
    """
    found = LEARNERS.find(config.name)
    if config.precision not in found.precisions:
        raise ConfigError(
            f"agent={config.name} agent.precision={config.precision}: this learner computes in "
            f"{' or '.join(found.precisions)} only; type agent.precision={found.precisions[0]}"
        )
    if thaws and "thaws" not in signature(found).parameters:
        raise ConfigError(
            f"agent={config.name}: this learner has no argument thaws, so that nothing that is frozen can thaw; "
            "type freeze=true or freeze=false"
        )
    return found


class Means:
    """Sums up what updates report, until somebody asks for the means."""

    def __init__(self) -> None:
        self._sums: dict[str, Any] = {}
        self._counts: dict[str, int] = {}
        self._restart()

    def add(self, **values: Any) -> None:
        """Adds one update's values: numbers, NumPy's or tensors without gradients."""
        for name, value in values.items():
            # No float(): on a GPU that would wait for every update to end.
            self._sums[name] = self._sums[name] + value
            self._counts[name] += 1

    def take(self) -> dict[str, float]:
        """The means since the last call; NaN where there were none."""
        means = {
            name: float(total) / self._counts[name] if self._counts[name] else float("nan")
            for name, total in self._sums.items()
        }
        self._restart()
        return means

    def state_dict(self) -> dict[str, Any]:
        """Sums and counts as plain numbers."""
        return {
            "metric_sums": {name: float(total) for name, total in self._sums.items()},
            "metric_counts": dict(self._counts),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from :meth:`state_dict`; other entries are left alone."""
        self._sums, self._counts = dict(state["metric_sums"]), dict(state["metric_counts"])

    def _restart(self) -> None:
        self._sums = dict.fromkeys(METRIC_NAMES, 0.0)
        self._counts = dict.fromkeys(METRIC_NAMES, 0)


def load_tensors(own: dict[str, Tensor], given: dict[str, Tensor]) -> None:
    """Copies tensors into those of the same names.

    Raises:
        ValueError: If names or shapes differ; nothing has been copied then.
    """
    ours, theirs = ({name: tuple(tensor.shape) for name, tensor in some.items()} for some in (own, given))
    if ours != theirs:
        differing = sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name))
        raise ValueError(f"the state is of another agent: {', '.join(differing)} differ")
    with torch.no_grad():
        for name, tensor in own.items():
            tensor.copy_(given[name])
