"""What another program trained, in this program's terms, and how it becomes a teacher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from acmr.agent.architecture import ACTOR, CRITICS, Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import ConfigError, EnvConfig
from acmr.envs import EnvDescription
from acmr.transfer.description import FORMAT_VERSION, TeacherDescription

#: What an imported teacher has in place of a profile.
PROFILE = "imported"


@dataclass(frozen=True)
class Imported:
    """Networks as they stand in a file, with our names.

    Attributes:
        program: What trained them, with its version where it is known.
        tensors: float32, by our names (``actor.input.weight``).
        hidden_sizes: Widths of the hidden layers.
        log_std: How log_std is bounded, ``tanh`` or ``clamp``.
        scaled_actions: Whether the critics see actions in [-1, 1], whatever the environment's bounds are.
        log_alpha: Log of the temperature; None where it is not stored.
        bounds: Least and greatest value of each action, as far as they are stored.
        global_step: Steps it was trained for; 0 where that is not stored.
        seed: Of its training; 0 where that is not stored.
        remarks: What a user should know, in lines.
    """

    program: str
    tensors: dict[str, Tensor]
    hidden_sizes: tuple[int, ...]
    log_std: str
    scaled_actions: bool
    log_alpha: float | None = None
    bounds: tuple[Sequence[float], Sequence[float]] | None = None
    global_step: int = 0
    seed: int = 0
    remarks: list[str] = field(default_factory=list)

    @property
    def dims(self) -> Dimensions:
        """Sizes of the environment it learned in."""
        return Dimensions(self.tensors["actor.input.weight"].shape[1], self.tensors["actor.mean.weight"].shape[0])


@dataclass(frozen=True)
class Normalization:
    """Running statistics by which observations were normalized: (x - mean) / sqrt(var + epsilon).

    Attributes:
        mean: (observation,).
        var: (observation,).
        epsilon: As the program that normalized has it.
    """

    mean: np.ndarray
    var: np.ndarray
    epsilon: float = 1e-8


def make_teacher(
    found: Imported, env: EnvConfig, about: EnvDescription, normalization: Normalization | None = None
) -> tuple[Networks, TeacherDescription]:
    """Networks that compute what the file's do, for the observations and actions of an environment as they are.

    Args:
        found: What the file holds.
        env: The environment that it learned in.
        about: The same, described.
        normalization: Of the observations that the networks saw, if they were normalized.

    Raises:
        ConfigError: If they are of another environment, by its sizes or its bounds.
    """
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    if found.dims != dims:
        raise ConfigError(
            f"--env {env.name}: has {dims}, but the networks are for {found.dims}; name the environment they learned in"
        )
    if about.normalized:
        raise ConfigError(
            f"--env {env.name}: normalizes observations by running statistics, of which the file says nothing; name an "
            "environment without, and give the statistics with --normalization FILE.npz (docs/exchange.md)"
        )
    low, high = (np.asarray(bound, np.float32) for bound in (about.action_low, about.action_high))
    _check_bounds(found, env, low, high)
    architecture = replace(Architecture.plain(dims, found.hidden_sizes, low, high), log_std=found.log_std)
    shapes = {name: tuple(tensor.shape) for name, tensor in found.tensors.items()}
    # Before anything is multiplied, or made as large as a width says.
    for name, shape in architecture.tensors.items():
        if shapes.get(name) != shape:
            raise ConfigError(f"{name}: the file has it in the shape {shapes.get(name)}; {shape} is needed")
    tensors = _for_plain_actions(found.tensors, low, high) if found.scaled_actions else found.tensors
    tensors = tensors if normalization is None else for_plain_observations(tensors, normalization, dims)
    networks = Networks(architecture, torch.Generator().manual_seed(0))
    networks.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    return networks, TeacherDescription(
        format_version=FORMAT_VERSION,
        environment=env.name,
        environment_id=env.id,
        model_hash=about.model_hash,
        observation_names=list(about.observation_names),
        action_names=list(about.action_names),
        action_low=list(architecture.action_low),
        action_high=list(architecture.action_high),
        hidden_sizes=list(found.hidden_sizes),
        core=None,
        adapter_activation=architecture.adapter_activation,
        # Of actions in [-1, 1], too: a scale adds a constant to their entropy, which the temperature multiplies, and so
        # the policy that is best at this temperature stays the same one.
        log_alpha=found.log_alpha,
        seed=found.seed,
        profile=PROFILE,
        global_step=found.global_step,
        final_return=None,
        config={"env": asdict(env)},
        log_std=found.log_std,
        imported=found.program,
    )


def _check_bounds(found: Imported, env: EnvConfig, low: np.ndarray, high: np.ndarray) -> None:
    if found.bounds is None:
        return
    for kind, theirs, ours in zip(("least", "greatest"), found.bounds, (low, high), strict=True):
        # They may have been printed and read again.
        if len(theirs) != len(ours) or not np.allclose(theirs, ours, rtol=1e-5, atol=1e-6):
            raise ConfigError(
                f"--env {env.name}: the {kind} values of its actions are {ours.tolist()}, of the networks' "
                f"{list(theirs)}; name the environment they learned in"
            )


def _for_plain_actions(tensors: Mapping[str, Tensor], low: np.ndarray, high: np.ndarray) -> dict[str, Tensor]:
    """Critics for actions within their bounds, not in [-1, 1]: a' = (a - bias) / scale goes into the first layer."""
    scale, bias = ((torch.from_numpy(high).double() + sign * torch.from_numpy(low).double()) / 2 for sign in (-1, 1))
    made = {name: tensor.double() for name, tensor in tensors.items()}
    for critic in CRITICS:
        weight = made[f"{critic}.input.weight"].clone()
        weight[:, -len(scale) :] /= scale
        made[f"{critic}.input.weight"] = weight
        made[f"{critic}.input.bias"] = made[f"{critic}.input.bias"] - weight[:, -len(scale) :] @ bias
    return made


def for_plain_observations(
    tensors: Mapping[str, Tensor], normalization: Normalization, dims: Dimensions
) -> dict[str, Tensor]:
    """Networks for observations as they are in place of normalized ones: that goes into the first layers, too.

    Args:
        tensors: By the names of our layers.
        normalization: What the observations went through.
        dims: Sizes of the environment.
    """
    mean, var = normalization.mean, normalization.var
    if mean.shape != (dims.observation,) or var.shape != mean.shape:
        raise ConfigError(
            f"--normalization: mean {mean.shape} and var {var.shape}; a number each for {dims.observation} sensors"
        )
    made = {name: tensor.double() for name, tensor in tensors.items()}
    center, spread = torch.from_numpy(mean), torch.from_numpy(np.sqrt(var + normalization.epsilon))
    first = "input_adapter" if f"{ACTOR}.input_adapter.weight" in made else "input"
    for name in (f"{part}.{first}" for part in (ACTOR, *CRITICS)):
        weight = made[f"{name}.weight"].clone()
        weight[:, : dims.observation] /= spread
        made[f"{name}.weight"] = weight
        made[f"{name}.bias"] = made[f"{name}.bias"] - weight[:, : dims.observation] @ center
    return made
