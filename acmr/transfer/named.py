"""Takes all that still fits, sensor by sensor and actuator by actuator, by their names.

What a body has lost, its teacher's layers still ask for. In its stead they are given one number each, such as its mean
under the teacher's policy, which changes nothing but their bias (``transfer.impute``). What a body has gained has no
weights at first, so that the policy of the first step is the teacher's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from acmr.agent.architecture import ACTOR, CLAMP, CRITICS, LOG_STD_BOUNDS, TANH
from acmr.agent.networks import Networks
from acmr.config import AUTO, INITIAL, MEAN, ZERO, ConfigError, TransferConfig, share_of_mean
from acmr.transfer.audition import Biases
from acmr.transfer.methods import Student, Taken, copy_layers, method
from acmr.transfer.name_map import NameMap, PartMap, map_bodies, parse_renames
from acmr.transfer.teacher import Teacher

#: Share of its usual size with which the head of an added actuator begins: it hardly moves at first.
SMALL = 0.01
#: What ``transfer.impute=auto`` tries, in this order.
TRIED = ("0.25", "0.75", MEAN, ZERO)


@method("named")
def named(student: Student, teacher: Teacher, config: TransferConfig, generator: torch.Generator) -> Taken:
    """All layers; the first and the last ones column by column and row by row."""
    about = teacher.description
    theirs, ours = ((each.observation_names, each.action_names) for each in (about, student))
    names = map_bodies(theirs, ours, parse_renames(config.rename), config.rules.or_instead)
    networks = student.networks
    if about.core is not None:
        # The adapters of a teacher that was itself expanded are what its sensors and actuators touch.
        networks = networks.with_core(about.architecture.core, about.adapter_activation, generator)
    rules = [config.impute] if config.impute != AUTO else list(TRIED) if names.is_less else [ZERO]
    choices: dict[str, Biases] = {}
    for rule in reversed(rules):
        # The first comes last, and its biases stay.
        inputs = fit_inputs(networks, teacher, names, imputed(teacher, rule))
        choices[rule] = {name: networks.layers()[name].bias.detach().clone() for name in inputs}
    outer = [*inputs, *fit_heads(networks, teacher, names.actuators)]
    inner = copy_layers(networks, teacher, (name for name in networks.layers() if name not in outer))
    details = {
        "sensors": _named_parts(names.sensors, *(each[0] for each in (theirs, ours))),
        "actuators": _named_parts(names.actuators, *(each[1] for each in (theirs, ours))),
        "impute": config.impute,
    }
    lines = [*names.lines(), *([f"what is gone counts as {_said(config.impute)}"] if names.is_less else [])]
    return Taken(networks, inner, outer, details, lines, choices={rule: choices[rule] for rule in rules})


def _said(rule: str) -> str:
    if rule == AUTO:
        return f"what does best in the first episodes: {', '.join(map(_said, TRIED))}"
    said = {MEAN: "its mean under the teacher's policy", INITIAL: "its mean at the start of an episode", ZERO: "zero"}
    return said.get(rule) or f"{rule} of its mean under the teacher's policy"


def imputed(teacher: Teacher, rule: str) -> tuple[np.ndarray, np.ndarray]:
    """What each of the teacher's observations, (observation,), and actions, (action,), counts as where it is gone.

    Raises:
        ConfigError: If the teacher does not say what the rule asks for.
    """
    dims, known = teacher.description.dims, teacher.description.statistics
    share = share_of_mean(rule)
    if share == 0.0:
        return np.zeros(dims.observation), np.zeros(dims.action)
    if known is None:
        raise ConfigError(
            f"transfer.impute={rule}: {teacher.path} does not say what its teacher saw; type transfer.impute=zero"
        )
    if share is None:
        # An episode begins with a state, not with an action: there the mean serves either way.
        return np.array(known.observation_initial), np.array(known.action_mean)
    return share * np.array(known.observation_mean), share * np.array(known.action_mean)


def fit_inputs(networks: Networks, teacher: Teacher, names: NameMap, gone: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Fills the first layer of the actor and of each critic; returns their names.

    Args:
        networks: Those of the student.
        teacher: Whose weights they get.
        names: Which columns are whose.
        gone: Values of the teacher's observations and actions, of which those that are gone are used.
    """
    first = "input_adapter" if networks.architecture.core is not None else "input"
    sensors, dims = names.sensors, teacher.description.dims
    fitted = []
    for part in (ACTOR, *CRITICS):
        name = f"{part}.{first}"
        weight, bias = (teacher.tensors[f"{name}.{kind}"].double() for kind in ("weight", "bias"))
        ours, theirs, missing, values = list(sensors.ours), list(sensors.theirs), list(sensors.gone), gone[0]
        if part != ACTOR:
            # A critic reads the actions behind the observation.
            ours += [networks.dims.observation + row for row in names.actuators.ours]
            theirs += [dims.observation + row for row in names.actuators.theirs]
            missing += [dims.observation + row for row in names.actuators.gone]
            values = np.concatenate(gone)
            weight, bias = _in_our_units(weight, bias, networks, teacher, names.actuators)
        if missing:
            bias = bias + weight[:, missing] @ torch.as_tensor(values[missing], dtype=torch.float64)
        filled = torch.zeros_like(networks.layers()[name].weight, dtype=torch.float64)
        filled[:, ours] = weight[:, theirs]
        _put(networks.layers()[name], filled, bias)
        fitted.append(name)
    return fitted


def fit_heads(networks: Networks, teacher: Teacher, actuators: PartMap) -> list[str]:
    """Fills the layers whose outputs are the actuators'; returns their names."""
    suffix = "_adapter" if networks.architecture.core is not None else ""
    fitted = [f"{ACTOR}.{kind}{suffix}" for kind in ("mean", "log_std")]
    for name in fitted:
        layer = networks.layers()[name]
        weight, bias = SMALL * layer.weight.detach(), torch.zeros_like(layer.bias)
        if name.endswith(("log_std", "log_std_adapter")) and teacher.description.log_std == CLAMP:
            # Where the middle of the other rule lies, at which an added actuator begins.
            bias += sum(LOG_STD_BOUNDS[TANH]) / 2
        for ours, kind in ((weight, "weight"), (bias, "bias")):
            ours[list(actuators.ours)] = teacher.tensors[f"{name}.{kind}"][list(actuators.theirs)].to(ours.dtype)
        _put(layer, weight, bias)
    return fitted


def _in_our_units(
    weight: Tensor, bias: Tensor, networks: Networks, teacher: Teacher, actuators: PartMap
) -> tuple[Tensor, Tensor]:
    """A critic's first layer for actions in the student's bounds.

    The policy's output is relative to the bounds. Where an actuator's have changed, the critics go on to see the same
    share of them.
    """
    about, here = teacher.description, networks.architecture
    columns = [about.dims.observation + row for row in actuators.theirs]
    middle, half = (_of_bounds(about.action_low, about.action_high, actuators.theirs, sign) for sign in (1, -1))
    our_middle, our_half = (_of_bounds(here.action_low, here.action_high, actuators.ours, sign) for sign in (1, -1))
    if torch.equal(middle, our_middle) and torch.equal(half, our_half):
        return weight, bias
    ratio, scaled = half / our_half, weight.clone()
    scaled[:, columns] = weight[:, columns] * ratio
    return scaled, bias + weight[:, columns] @ (middle - our_middle * ratio)


def _of_bounds(low: Sequence[float], high: Sequence[float], rows: Sequence[int], sign: int) -> Tensor:
    """Half the sum (``sign`` 1) or half the difference (-1) of bounds."""
    lows, highs = (torch.tensor([bound[row] for row in rows], dtype=torch.float64) for bound in (low, high))
    return (highs + sign * lows) / 2


@torch.no_grad()
def _put(layer: nn.Linear, weight: Tensor, bias: Tensor) -> None:
    layer.weight.copy_(weight)
    layer.bias.copy_(bias)


def _named_parts(part: PartMap, theirs: Sequence[str], ours: Sequence[str]) -> dict[str, object]:
    return {
        "kept": len(part.ours),
        "gone": [theirs[row] for row in part.gone],
        "added": [ours[row] for row in part.added],
    }
