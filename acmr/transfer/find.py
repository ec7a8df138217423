"""Finds the teacher of a student, or makes of it what a control has in its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from acmr.agent.architecture import Dimensions
from acmr.agent.networks import Networks
from acmr.config import NAMES, SHUFFLED, UNTRAINED, ZERO, ConfigError, ExperimentConfig
from acmr.envs import describe
from acmr.settings.run_spec import specify, teacher_spec
from acmr.storage.run_dir import RunDir
from acmr.transfer.methods import check_body
from acmr.transfer.statistics import with_statistics
from acmr.transfer.teacher import Teacher, load_teacher


def find_teacher(config: ExperimentConfig, dims: Dimensions) -> Teacher | None:
    """Loads the teacher that the settings name or imply, with its statistics where its method asks for them.

    Args:
        config: The student's settings.
        dims: Sizes of the student's environment.

    Raises:
        ConfigError: If there is none, with the command that trains it.
    """
    if not config.transfer.rules.needs_teacher:
        return None
    teacher = load_teacher(config.transfer.teacher) if config.transfer.teacher is not None else _implied(config, dims)
    if config.transfer.control == UNTRAINED:
        teacher = untrained(teacher, config.seed)
    stands_in = config.transfer.rules.statistics or config.transfer.adapter_init == NAMES
    if stands_in and config.transfer.impute != ZERO:
        teacher = with_statistics(teacher)
    return shuffled(teacher, config.seed) if config.transfer.control == SHUFFLED else teacher


def untrained(teacher: Teacher, seed: int) -> Teacher:
    """The teacher as it might have begun: other fresh weights, no temperature learned, nothing seen yet."""
    architecture = teacher.description.architecture
    fresh = Networks(architecture, torch.Generator().manual_seed(seed)).state_dict()
    return replace(teacher, description=replace(teacher.description, log_alpha=0.0, statistics=None), tensors=fresh)


def shuffled(teacher: Teacher, seed: int) -> Teacher:
    """The teacher with the names of its sensors, and those of its actuators, dealt out anew: none is where it was."""
    about, rng = teacher.description, np.random.default_rng(seed)

    def deal(names: list[str]) -> list[str]:
        # Each gets the next one's name on a random way around: a cycle, so that nobody keeps their own.
        way = rng.permutation(len(names))
        dealt = dict(zip(way, np.roll(way, 1), strict=True))
        return [names[dealt[row]] for row in range(len(names))]

    sensors, actuators = deal(about.observation_names), deal(about.action_names)
    return replace(teacher, description=replace(about, observation_names=sensors, action_names=actuators))


def _implied(config: ExperimentConfig, dims: Dimensions) -> Teacher:
    """The run of the source environment."""
    source = teacher_spec(config)
    if config.transfer.rules.same_body:
        # Before anybody trains a teacher for days that will be of no use.
        about = describe(source.config.env)
        theirs = Dimensions(len(about.observation_names), len(about.action_names))
        check_body(config.transfer, f"the source environment {source.config.env.name}", theirs, dims)
    run_dir = RunDir(source.directory)
    if not run_dir.is_complete():
        run_dir.check_unchanged()
        state = "is not finished" if run_dir.stored_settings() else "does not exist"
        raise ConfigError(
            f"transfer={config.transfer.name}: the teacher's run {source.directory} {state}; "
            f"train it with: {source.command} (or both, one after the other: {specify(config).sweep_command}; "
            "or give another one: transfer.teacher=PATH)"
        )
    return load_teacher(source.directory)
