"""Actor-Critic Model Reuse: what a student takes from its teacher, layer by layer (paper, section 3.2).

A method is one function: it takes the student with its fresh networks and the teacher, and returns the networks to
learn with and which layers came from the teacher. One of your own is a function in a module anywhere and a YAML file in
``conf/transfer`` or a folder of yours, with the rules that teacher and student must keep (docs/howto-transfer.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from acmr.agent.architecture import ACTOR, Dimensions, is_adapter, is_hidden
from acmr.agent.fine_tuning import thaw_schedule
from acmr.agent.networks import Networks
from acmr.config import NAMES, NO_ACTIVATION, NO_CONTROL, SHUFFLED, ConfigError, TransferConfig
from acmr.registry import Registry, named_in
from acmr.stateful import State
from acmr.transfer.audition import Audition, Biases
from acmr.transfer.report import TransferReport, report_transfer
from acmr.transfer.statistics import check_units, handed_over
from acmr.transfer.teacher import Teacher


@dataclass(frozen=True)
class Student:
    """Who is to learn.

    Attributes:
        networks: Fresh ones, in the dimensions of its environment.
        observation_names: One per observation.
        action_names: One per action.
        wrappers: Those that were chosen around its environment.
        normalized: Its sensors that each of them normalizes by running statistics, by the wrapper's name.
    """

    networks: Networks
    observation_names: Sequence[str]
    action_names: Sequence[str]
    wrappers: Sequence[Mapping[str, Any]] = ()
    normalized: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Taken:
    """What a method made of a student.

    Attributes:
        networks: Those to learn with: the student's own, or new ones.
        copied: Names of the layers that hold the teacher's values as they are; ``freeze=true`` freezes them.
        fitted: Names of the layers that hold the teacher's values as far as they fit; they always learn.
        details: What else there is to say in ``transfer.json``.
        lines: The same for a reader, one fact a line.
        choices: Ways to begin, by name, each with the biases it sets; where there is more than one, the student tries
            them (:mod:`acmr.transfer.audition`).
    """

    networks: Networks
    copied: list[str]
    fitted: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    choices: dict[str, Biases] = field(default_factory=dict)


@dataclass(frozen=True)
class Transferred:
    """A student that is ready to learn.

    Attributes:
        networks: What it learns with.
        report: What became of each layer.
        audition: Which of several ways to begin it takes; there may be none to choose from.
        thaws: Environment step from which frozen layers learn, by their names.
        wrapper_states: What the wrappers around its environment begin with; empty: as new ones.
    """

    networks: Networks
    report: TransferReport
    audition: Audition
    thaws: dict[str, int]
    wrapper_states: State = field(default_factory=dict)


#: Student, teacher (None where the method's rules say that it needs none), settings, source of new weights.
Method = Callable[[Student, Any, TransferConfig, torch.Generator], Taken]
METHODS: Registry[Method] = Registry("transfer.name", "acmr.transfer")
#: Registers a transfer method under the name of its YAML file.
method = METHODS.add


def find_method(config: TransferConfig) -> Method:
    """The function that a method is: in a module of the user's, or the one that is registered under its name.

    Raises:
        ConfigError: If there is none.
    """
    if config.method is None:
        return METHODS.find(config.name)
    found: Method = named_in("transfer.method", config.method)
    if not callable(found):
        raise ConfigError(f"transfer.method={config.method}: no function (docs/howto-transfer.md)")
    return found


def transfer(
    student: Student,
    teacher: Teacher | None,
    config: TransferConfig,
    freeze: bool,
    generator: torch.Generator,
    thaw: Sequence[int] = (),
) -> Transferred:
    """Gives a student what its method takes from the teacher, and freezes it where asked to.

    Args:
        student: Fresh networks, and what sensors and actuators they are for.
        teacher: The teacher; None for a method that needs none.
        config: Method, its rules and its settings.
        freeze: Whether the copied layers stop learning.
        generator: Source of the weights of layers that a method adds.
        thaw: Environment steps at which frozen layers begin to learn again, from the output down.

    Raises:
        ConfigError: If the teacher does not fit the method.
    """
    take = find_method(config)
    if teacher is not None:
        check_body(config, f"the teacher {teacher.path}", teacher.description.dims, student.networks.dims)
        _check_widths(config, teacher, student.networks)
    taken = take(student, teacher, config, generator)
    if teacher is not None and not (taken.copied or taken.fitted):
        raise ConfigError(f"transfer={config.name}: no layer of {teacher.path} could be copied")
    if config.adapter_init == NAMES and not any(map(is_adapter, taken.fitted)):
        raise ConfigError(
            f"transfer={config.name} transfer.adapter_init={NAMES}: this method makes no adapters; leave it out"
            f"{config.rules.or_instead}"
        )
    taken = _bound_alike(taken, teacher)
    layers = taken.networks.layers()
    frozen = [name for name in layers if freeze and name in taken.copied]
    for name in frozen:
        # The learner reads this: frozen layers are no part of what its optimizers step, nor of what its targets follow.
        layers[name].requires_grad_(False)
    report = report_transfer(taken.networks, teacher, config, freeze, (taken.copied, taken.fitted, frozen))
    thaws = thaw_schedule(frozen, thaw)
    control = config.control if config.control != NO_CONTROL else None
    more = {"thaws": thaws, "control": control}
    details = taken.details | {key: value for key, value in more.items() if value}
    report = replace(report, details=details, notes=[*taken.lines, *_control_lines(control), *_thaw_lines(thaws)])
    states = _wrapper_states(student, teacher, taken, config)
    return Transferred(taken.networks, report, Audition(taken.choices), thaws, states)


def _control_lines(control: str | None) -> list[str]:
    what = "its names dealt out anew" if control == SHUFFLED else "fresh weights in the place of its own"
    return [f"a control: the teacher with {what}"] if control else []


def _thaw_lines(thaws: Mapping[str, int]) -> list[str]:
    layers = {step: [name for name, begin in thaws.items() if begin == step] for step in sorted(set(thaws.values()))}
    return [f"from step {step:,} on, these learn again: {', '.join(names)}" for step, names in layers.items()]


def _wrapper_states(student: Student, teacher: Teacher | None, taken: Taken, config: TransferConfig) -> State:
    """What the student's wrappers begin with: what the teacher's ended with, where its first layer was taken."""
    first = "input" if taken.networks.architecture.core is None else "input_adapter"
    if teacher is None or f"{ACTOR}.{first}" not in (*taken.copied, *taken.fitted):
        return {}
    check_units(teacher, student.wrappers, config)
    return handed_over(teacher, student.normalized, config)


def _bound_alike(taken: Taken, teacher: Teacher | None) -> Taken:
    """Bounds log_std as the teacher does, where its head was taken: else the same weights say something else."""
    names = (name.split(".")[-1] for name in (*taken.copied, *taken.fitted))
    if teacher is None or "log_std" not in names:
        return taken
    networks = taken.networks.with_log_std(teacher.description.log_std)
    if networks is taken.networks:
        return taken
    details, line = taken.details | {"log_std": networks.architecture.log_std}, "log_std is bounded as in the teacher"
    return replace(taken, networks=networks, details=details, lines=[*taken.lines, f"{line} ({details['log_std']})"])


@method("none")
def none(student: Student, teacher: None, config: TransferConfig, generator: torch.Generator) -> Taken:
    """Nothing: the baselines (H0, A0)."""
    return Taken(student.networks, [])


@method("direct")
def direct(student: Student, teacher: Teacher, config: TransferConfig, generator: torch.Generator) -> Taken:
    """All layers as they are, between environments of the same dimensions (experiment H1)."""
    about = teacher.description.architecture
    # A teacher that was itself expanded hands on its adapters, too.
    networks = student.networks.with_core(about.core, about.adapter_activation, generator)
    return Taken(networks, copy_layers(networks, teacher, networks.layers()))


@method("hidden")
def hidden(student: Student, teacher: Teacher, config: TransferConfig, generator: torch.Generator) -> Taken:
    """The layers between two hidden activations: no sensor or actuator touches them (A1, A2)."""
    networks = student.networks
    return Taken(networks, copy_layers(networks, teacher, filter(is_hidden, networks.layers())))


@method("expand")
def expand(student: Student, teacher: Teacher, config: TransferConfig, generator: torch.Generator) -> Taken:
    """All layers in the teacher's dimensions, between adapters to the student's (A3, A4).

    With ``transfer.adapter_init=names`` the adapters begin as a selection, so that the student begins with the same
    function as one by name; and they learn, whatever is frozen.
    """
    if teacher.description.core is not None:
        raise ConfigError(
            f"transfer=expand: the teacher {teacher.path} is itself expanded, and adapters are not stacked; "
            f"give the teacher it came from{config.rules.or_instead}"
        )
    if config.adapter_init == NAMES:
        # What fits an expanded teacher's adapters by name fits these: they select all there is.
        return find_method(TransferConfig(name="named"))(student, _all_selected(teacher), config, generator)
    networks = student.networks.with_core(teacher.description.dims, config.adapter_activation, generator)
    inner = [name for name in networks.layers() if f"{name}.weight" in teacher.tensors]
    return Taken(networks, copy_layers(networks, teacher, inner))


def _all_selected(teacher: Teacher) -> Teacher:
    """The same function as one that was expanded into its own body: adapters that hand on what they read."""
    about, tensors = teacher.description, dict(teacher.tensors)
    core = replace(about, core=[about.dims.observation, about.dims.action], adapter_activation=NO_ACTIVATION)
    for name, shape in core.architecture.tensors.items():
        if name not in tensors:
            tensors[name] = torch.eye(*shape) if name.endswith("weight") else torch.zeros(shape)
    return replace(teacher, description=core, tensors=tensors)


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
