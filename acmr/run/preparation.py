"""What a run starts with, made and checked before anything is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.learner import Learner, find_learner
from acmr.agent.memory import check_memory
from acmr.agent.networks import Networks
from acmr.agent.precision import MatmulPrecision, choose_products
from acmr.config import INDEPENDENT, ConfigError
from acmr.envs import EnvDescription, check_resume, describe
from acmr.envs.state import ResumeCheck
from acmr.run.random_streams import RandomStreams, random_streams
from acmr.settings.run_spec import RunSpec
from acmr.tracking.watchers import tracker_class
from acmr.transfer.audition import Audition
from acmr.transfer.find import find_teacher
from acmr.transfer.methods import Student, find_method, transfer
from acmr.transfer.report import TransferReport


@dataclass(frozen=True)
class Prepared:
    """All that a run needs and that could be wrong, made and checked before anything is written.

    Attributes:
        spec: The run.
        about: Its environment.
        networks: Those that it starts with.
        report: What the transfer made of them.
        audition: Which of several ways to begin it takes.
        thaws: Environment step from which its frozen layers learn, by their names.
        learner: Makes the learner that ``agent`` chooses.
        log_alpha: Logarithm of the temperature that it starts with.
        streams: Its random numbers.
        products: How matrix products are computed from now on.
        resume_check: When the environment's state can be stored.
        wrapper_states: What wrappers around the environment begin with, where a teacher's have seen something.
    """

    spec: RunSpec
    about: EnvDescription
    networks: Networks
    report: TransferReport
    audition: Audition
    thaws: dict[str, int]
    learner: Callable[..., Learner]
    log_alpha: float
    streams: RandomStreams
    products: MatmulPrecision
    resume_check: ResumeCheck
    wrapper_states: dict[str, Any]


def prepare(spec: RunSpec) -> Prepared:
    """Makes what a run starts with, and refuses what cannot be run; touches no disk.

    Raises:
        ConfigError: With one line that says what to type instead.
    """
    config = spec.config
    _check_device(config.device)
    tracker_class(config.tracking)
    learner = find_learner(config.agent, bool(config.thaw))
    # A name that stands for nothing is no reason to look for a teacher.
    find_method(config.transfer)
    # Before anything else asks for the environment: one of its instances is then tried out for all of them.
    resume_check = check_resume(config.env)
    about = describe(config.env)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    teacher = find_teacher(config, dims)
    apart = spec.kin if config.seeding == INDEPENDENT else None
    streams = random_streams(config.seed, config.device, apart)
    architecture = Architecture(dims, tuple(config.agent.hidden_sizes), about.action_low, about.action_high)
    check_memory(config, architecture)
    fresh = Networks(architecture, streams.networks)
    student = Student(fresh, about.observation_names, about.action_names, config.env.wrappers, about.normalized)
    transferred = transfer(student, teacher, config.transfer, config.freeze, streams.networks, config.thaw)
    log_alpha = teacher.log_alpha() if teacher is not None and config.transfer.copy_log_alpha else 0.0
    return Prepared(
        spec=spec,
        about=about,
        networks=transferred.networks,
        report=transferred.report,
        audition=transferred.audition,
        thaws=transferred.thaws,
        learner=learner,
        log_alpha=log_alpha,
        streams=streams,
        products=choose_products(config.agent, config.device),
        resume_check=resume_check,
        wrapper_states=transferred.wrapper_states,
    )


def _check_device(device: str) -> None:
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise ConfigError(f"device={device}: must be cpu or cuda") from None
    if kind not in ("cpu", "cuda"):
        raise ConfigError(f"device={device}: must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device={device}: no CUDA device is available here; type device=cpu")
