"""What a run starts with, made and checked before anything is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.learner import Learner, find_learner
from acmr.agent.memory import check_memory
from acmr.agent.networks import Networks
from acmr.agent.precision import MatmulPrecision, choose_products
from acmr.config import ConfigError, ExperimentConfig
from acmr.envs import EnvDescription, check_resume, describe
from acmr.envs.state import ResumeCheck
from acmr.run.random_streams import RandomStreams, random_streams
from acmr.settings.run_spec import RunSpec, teacher_spec
from acmr.storage.run_dir import RunDir
from acmr.tracking.watchers import tracker_class
from acmr.transfer.methods import check_body, transfer
from acmr.transfer.report import TransferReport
from acmr.transfer.teacher import Teacher, load_teacher


@dataclass(frozen=True)
class Prepared:
    """All that a run needs and that could be wrong, made and checked before anything is written.

    Attributes:
        spec: The run.
        about: Its environment.
        networks: Those that it starts with.
        report: What the transfer made of them.
        learner: Makes the learner that ``agent`` chooses.
        log_alpha: Logarithm of the temperature that it starts with.
        streams: Its random numbers.
        products: How matrix products are computed from now on.
        resume_check: When the environment's state can be stored.
    """

    spec: RunSpec
    about: EnvDescription
    networks: Networks
    report: TransferReport
    learner: Callable[..., Learner]
    log_alpha: float
    streams: RandomStreams
    products: MatmulPrecision
    resume_check: ResumeCheck


def prepare(spec: RunSpec) -> Prepared:
    """Makes what a run starts with, and refuses what cannot be run; touches no disk.

    Raises:
        ConfigError: With one line that says what to type instead.
    """
    config = spec.config
    _check_device(config.device)
    tracker_class(config.tracking)
    learner = find_learner(config.agent)
    # Before anything else asks for the environment: one of its instances is then tried out for all of them.
    resume_check = check_resume(config.env)
    about = describe(config.env)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    teacher = find_teacher(config, dims)
    streams = random_streams(config.seed, config.device)
    architecture = Architecture(dims, tuple(config.agent.hidden_sizes), about.action_low, about.action_high)
    check_memory(config, architecture)
    fresh = Networks(architecture, streams.networks)
    networks, report = transfer(fresh, teacher, config.transfer, config.freeze, streams.networks)
    copied_alpha = teacher is not None and config.transfer.copy_log_alpha
    log_alpha = teacher.description.log_alpha if teacher is not None and copied_alpha else 0.0
    return Prepared(
        spec=spec,
        about=about,
        networks=networks,
        report=report,
        learner=learner,
        log_alpha=log_alpha,
        streams=streams,
        products=choose_products(config.agent, config.device),
        resume_check=resume_check,
    )


def find_teacher(config: ExperimentConfig, dims: Dimensions) -> Teacher | None:
    """Loads the teacher that the settings name or imply.

    Raises:
        ConfigError: If there is none, with the command that trains it.
    """
    if not config.transfer.rules.needs_teacher:
        return None
    if config.transfer.teacher is not None:
        return load_teacher(config.transfer.teacher)
    source = teacher_spec(config)
    if config.transfer.rules.same_body:
        # Before anybody trains a teacher for days that will be of no use.
        about = describe(source.config.env)
        theirs = Dimensions(len(about.observation_names), len(about.action_names))
        check_body(config.transfer, f"the source environment {source.config.env.name}", theirs, dims)
    if not RunDir(source.directory).is_complete():
        state = "is not finished" if RunDir(source.directory).stored_settings() else "does not exist"
        raise ConfigError(
            f"transfer={config.transfer.name}: the teacher's run {source.directory} {state}; "
            f"train it with: {source.command} (or give another one: transfer.teacher=PATH)"
        )
    return load_teacher(source.directory)


def _check_device(device: str) -> None:
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise ConfigError(f"device={device}: must be cpu or cuda") from None
    if kind not in ("cpu", "cuda"):
        raise ConfigError(f"device={device}: must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device={device}: no CUDA device is available here; type device=cpu")
