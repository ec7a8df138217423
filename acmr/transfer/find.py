"""Finds the teacher of a student."""

from __future__ import annotations

from acmr.agent.architecture import Dimensions
from acmr.config import NAMES, ZERO, ConfigError, ExperimentConfig
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
    stands_in = config.transfer.rules.statistics or config.transfer.adapter_init == NAMES
    return with_statistics(teacher) if stands_in and config.transfer.impute != ZERO else teacher


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
