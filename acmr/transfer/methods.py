"""Actor-Critic Model Reuse: what a student takes from its teacher, layer by layer (paper, section 3.2).

A method is one function: it takes the student's fresh networks and the teacher, and returns the networks to learn
with and the names of the layers that came from the teacher. One of your own is a module of its name in this package
and a YAML file in ``conf/transfer``, with the rules that teacher and student must keep (docs/howto-transfer.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch

from acmr.agent.architecture import Dimensions, is_hidden
from acmr.agent.networks import Networks
from acmr.config import ConfigError, TransferConfig
from acmr.registry import Registry
from acmr.transfer.report import TransferReport, report_transfer
from acmr.transfer.teacher import Teacher

#: Student, teacher (None where the method's rules say that it needs none), settings, source of new weights; returns
#: the networks to learn with and the names of the layers that hold the teacher's values.
Method = Callable[[Networks, Any, TransferConfig, torch.Generator], tuple[Networks, list[str]]]
METHODS: Registry[Method] = Registry("transfer.name", "acmr.transfer")
#: Registers a transfer method under the name of its YAML file.
method = METHODS.add


def transfer(
    student: Networks,
    teacher: Teacher | None,
    config: TransferConfig,
    freeze: bool,
    generator: torch.Generator,
) -> tuple[Networks, TransferReport]:
    """Gives a student what its method takes from the teacher, and freezes it where asked to.

    Args:
        student: Fresh networks for the student's environment.
        teacher: The teacher; None for a method that needs none.
        config: Method, its rules and its settings.
        freeze: Whether the copied layers stop learning.
        generator: Source of the weights of layers that a method adds.

    Returns:
        The networks to learn with and the report.

    Raises:
        ConfigError: If the teacher does not fit the method.
    """
    take = METHODS.find(config.name)
    if teacher is not None:
        check_body(config, f"the teacher {teacher.path}", teacher.description.dims, student.dims)
        _check_widths(config, teacher, student)
    networks, copied = take(student, teacher, config, generator)
    if teacher is not None and not copied:
        raise ConfigError(f"transfer={config.name}: no layer of {teacher.path} could be copied")
    layers = networks.layers()
    frozen = [name for name in layers if freeze and name in copied]
    for name in frozen:
        # The learner reads this: frozen layers are no part of what its optimizers step, nor of what its targets follow.
        layers[name].requires_grad_(False)
    return networks, report_transfer(networks, teacher, config, freeze, copied, frozen)


@method("none")
def none(
    student: Networks, teacher: None, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """Nothing: the baselines (H0, A0)."""
    return student, []


@method("direct")
def direct(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """All layers as they are, between environments of the same dimensions (experiment H1)."""
    about = teacher.description.architecture
    # A teacher that was itself expanded hands on its adapters, too.
    networks = student.with_core(about.core, about.adapter_activation, generator)
    return networks, copy_layers(networks, teacher, networks.layers())


@method("hidden")
def hidden(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """The layers between two hidden activations: no sensor or actuator touches them (A1, A2)."""
    return student, copy_layers(student, teacher, filter(is_hidden, student.layers()))


@method("expand")
def expand(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """All layers in the teacher's dimensions, between adapters to the student's (A3, A4)."""
    if teacher.description.core is not None:
        raise ConfigError(
            f"transfer=expand: the teacher {teacher.path} is itself expanded, and adapters are not stacked; "
            f"give the teacher it came from{config.rules.or_instead}"
        )
    networks = student.with_core(teacher.description.dims, config.adapter_activation, generator)
    inner = [name for name in networks.layers() if f"{name}.weight" in teacher.tensors]
    return networks, copy_layers(networks, teacher, inner)


def check_body(config: TransferConfig, owner: str, theirs: Dimensions, ours: Dimensions) -> None:
    """Refuses another body than the student's where the method needs the same.

    Args:
        config: The method and its rules.
        owner: Whose body it is, for the message.
        theirs: Its dimensions.
        ours: Those of the student.

    Raises:
        ConfigError: If they differ and must not.
    """
    if config.rules.same_body and theirs != ours:
        raise ConfigError(
            f"transfer={config.name}: {owner} has {theirs}, the student {ours}; "
            f"give a teacher of the same body{config.rules.or_instead}"
        )


def _check_widths(config: TransferConfig, teacher: Teacher, student: Networks) -> None:
    theirs, ours = (list(each.architecture.hidden_sizes) for each in (teacher.description, student))
    if config.rules.same_widths and theirs != ours:
        raise ConfigError(
            f"transfer={config.name}: the teacher {teacher.path} has hidden layers of {theirs}, the student of "
            f"{ours}; type agent.hidden_sizes=[{','.join(map(str, theirs))}]"
        )


def copy_layers(networks: Networks, teacher: Teacher, names: Iterable[str]) -> list[str]:
    """Copies layers of the same name and shape; returns their names."""
    layers, copied = networks.layers(), list(names)
    with torch.no_grad():
        for name in copied:
            layers[name].weight.copy_(teacher.tensors[f"{name}.weight"])
            layers[name].bias.copy_(teacher.tensors[f"{name}.bias"])
    return copied
