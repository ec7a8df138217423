"""Actor-Critic Model Reuse: what a student takes from its teacher, layer by layer (paper, section 3.2).

A method is one function: it takes the student's fresh networks and the teacher, and returns the networks to learn
with and the names of the layers that came from the teacher. Register it with :func:`method` and add a YAML file of
the same name under ``conf/transfer/`` (docs/howto-transfer.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch

from acmr.agent.networks import Dimensions, Networks, is_hidden
from acmr.config import ConfigError, TransferConfig
from acmr.transfer.teacher import Teacher

Method = Callable[[Networks, Teacher, TransferConfig, torch.Generator], tuple[Networks, list[str]]]
_METHODS: dict[str, Method] = {}
NONE = "none"


@dataclass(frozen=True)
class TransferReport:
    """What became of each layer, and how many parameters that is."""

    method: str
    freeze: bool
    teacher: dict[str, Any] | None
    copied: list[str]
    fresh: list[str]
    frozen: list[str]
    parameters: dict[str, int]

    def lines(self) -> list[str]:
        """The report for a reader, one fact a line."""
        said = [f"transfer: {self.method}" + (", copied layers frozen" if self.freeze else "")]
        if self.teacher is not None:
            said.append(
                f"  teacher: {self.teacher['path']} ({self.teacher['environment']}, seed {self.teacher['seed']}, "
                f"{self.teacher['global_step']:,} steps)"
            )
        for kind in ("copied", "fresh", "frozen"):
            names: list[str] = getattr(self, kind)
            said.append(f"  {kind}: {self.parameters[kind]:,} parameters: {', '.join(names) if names else 'no layer'}")
        said.append(f"  learning: {self.parameters['trainable']:,} of {self.parameters['total']:,} parameters")
        return said


def method(name: str) -> Callable[[Method], Method]:
    """Registers a transfer method under the name of its YAML file."""

    def register(function: Method) -> Method:
        _METHODS[name] = function
        return function

    return register


def method_names() -> tuple[str, ...]:
    """Every transfer there is, ``none`` first."""
    return (NONE, *_METHODS)


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
        teacher: The teacher; None with method ``none``.
        config: Method and its settings.
        freeze: Whether the copied layers stop learning.
        generator: Source of the weights of layers that a method adds.

    Returns:
        The networks to learn with and the report.

    Raises:
        ConfigError: If the teacher does not fit the method.
    """
    copied: list[str] = []
    if config.name not in method_names():
        raise ConfigError(f"transfer.name={config.name}: must be one of {', '.join(method_names())}")
    if config.name != NONE:
        assert teacher is not None, "a method other than none is given a teacher"
        student, copied = _METHODS[config.name](student, teacher, config, generator)
        if not copied:
            raise ConfigError(f"transfer={config.name}: no layer of {teacher.path} could be copied")
    layers = student.layers()
    frozen = [name for name in layers if freeze and name in copied]
    for name in frozen:
        layers[name].requires_grad_(False)
    return student, _report(student, teacher, config, freeze, copied, frozen)


@method("direct")
def direct(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """All layers as they are, between environments of the same dimensions (experiment H1)."""
    if teacher.description.dims != student.dims:
        raise ConfigError(
            f"transfer=direct: the teacher {teacher.path} has {teacher.description.dims}, the student "
            f"{student.dims}; type transfer=hidden or transfer=expand between different bodies"
        )
    _same_widths(student, teacher, "direct")
    core = Dimensions(*teacher.description.core) if teacher.description.core else None
    networks = student.with_core(core, teacher.description.adapter_activation, generator)
    return networks, _copy(networks, teacher, networks.layers())


@method("hidden")
def hidden(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """The layers between two hidden activations: no sensor or actuator touches them (A1, A2)."""
    _same_widths(student, teacher, "hidden")
    return student, _copy(student, teacher, filter(is_hidden, student.layers()))


@method("expand")
def expand(
    student: Networks, teacher: Teacher, config: TransferConfig, generator: torch.Generator
) -> tuple[Networks, list[str]]:
    """All layers in the teacher's dimensions, between adapters to the student's (A3, A4)."""
    if teacher.description.core is not None:
        raise ConfigError(
            f"transfer=expand: the teacher {teacher.path} is itself expanded, and adapters are not stacked; "
            "give the teacher it came from, or type transfer=hidden"
        )
    _same_widths(student, teacher, "expand")
    networks = student.with_core(teacher.description.dims, config.adapter_activation, generator)
    inner = [name for name in networks.layers() if f"{name}.weight" in teacher.tensors]
    return networks, _copy(networks, teacher, inner)


def _same_widths(student: Networks, teacher: Teacher, name: str) -> None:
    theirs = tuple(teacher.description.hidden_sizes)
    if theirs != student.hidden_sizes:
        raise ConfigError(
            f"transfer={name}: the teacher {teacher.path} has hidden layers of {list(theirs)}, the student of "
            f"{list(student.hidden_sizes)}; type agent.hidden_sizes=[{','.join(map(str, theirs))}]"
        )


def _copy(networks: Networks, teacher: Teacher, names: Iterable[str]) -> list[str]:
    layers, copied = networks.layers(), list(names)
    with torch.no_grad():
        for name in copied:
            layers[name].weight.copy_(teacher.tensors[f"{name}.weight"])
            layers[name].bias.copy_(teacher.tensors[f"{name}.bias"])
    return copied


def _report(
    networks: Networks,
    teacher: Teacher | None,
    config: TransferConfig,
    freeze: bool,
    copied: list[str],
    frozen: list[str],
) -> TransferReport:
    layers = networks.layers()
    fresh = [name for name in layers if name not in copied]
    sizes = {name: sum(parameter.numel() for parameter in layer.parameters()) for name, layer in layers.items()}

    def count(names: Iterable[str]) -> int:
        return sum(sizes[name] for name in names)

    origin = None
    if teacher is not None:
        about = teacher.description
        origin = {
            "path": str(teacher.path),
            "environment": about.environment,
            "seed": about.seed,
            "global_step": about.global_step,
            "sha256": about.sha256,
        }
    parameters = {
        "total": count(layers),
        "trainable": count(layers) - count(frozen),
        "copied": count(copied),
        "fresh": count(fresh),
        "frozen": count(frozen),
    }
    return TransferReport(config.name, freeze, origin, copied, fresh, frozen, parameters)
