"""A policy in a body that it did not learn in, before any learning: what fits of it by name."""

from __future__ import annotations

import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Actor, Networks
from acmr.config import ZERO, EnvConfig, TransferConfig
from acmr.stateful import State
from acmr.transfer.methods import Student
from acmr.transfer.named import named
from acmr.transfer.teacher import Teacher


def policy_in(teacher: Teacher, config: EnvConfig, impute: str, trust: bool = False) -> tuple[Actor, State, list[str]]:
    """The policy with which a student of ``transfer=named`` would begin.

    Args:
        teacher: Whose policy it is.
        config: The body.
        impute: What is gone counts as, one of ``acmr.config.IMPUTATIONS``.
        trust: Whether the teacher's files may choose code to run.

    Returns:
        The policy, what the wrappers around the body are to remember, and what is kept, gone and added.

    Raises:
        ConfigError: If nothing fits by name, or an environment cannot be made.
    """
    from acmr.envs import describe
    from acmr.transfer.statistics import check_units, handed_over, with_statistics

    about, learned = describe(config), teacher.description
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    sizes = tuple(learned.hidden_sizes)
    generator = torch.Generator().manual_seed(0)
    fresh = Networks(Architecture(dims, sizes, about.action_low, about.action_high), generator)
    student = Student(fresh, about.observation_names, about.action_names)
    transfer = TransferConfig(name="named", impute=impute)
    check_units(teacher, config.wrappers, transfer)
    told = teacher if impute == ZERO else with_statistics(teacher, "type --trust, or --impute zero", trust)
    taken = named(student, told, transfer, generator)
    actor = taken.networks.with_log_std(learned.log_std).actor.eval()
    return actor, handed_over(teacher, about.normalized, transfer), taken.lines
