"""What a run starts with, made and checked before anything is written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.spaces import Box

from acmr.checkpoint import Teacher, load_teacher
from acmr.config import ConfigError, EnvConfig, ExperimentConfig
from acmr.envs import EnvDescription, describe, make_env
from acmr.identity import RunSpec, teacher_spec
from acmr.networks import Dimensions, Networks
from acmr.run_dir import TENSOR_FILE, RunDir
from acmr.seeding import RandomStreams, random_streams
from acmr.transfer import NONE, TransferReport, transfer


@dataclass(frozen=True)
class Prepared:
    """All that a run needs and that could be wrong, made and checked before anything is written."""

    spec: RunSpec
    about: EnvDescription
    networks: Networks
    report: TransferReport
    log_alpha: float
    streams: RandomStreams


def prepare(spec: RunSpec) -> Prepared:
    """Builds the networks that a run starts with, with everything its teacher gives."""
    config = spec.config
    _check_device(config.device)
    about = describe(config.env)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    teacher = find_teacher(config, dims)
    streams = random_streams(config.seed, config.device)
    low, high = _action_bounds(config.env)
    fresh = Networks(dims, config.agent.hidden_sizes, low, high, streams.networks)
    networks, report = transfer(fresh, teacher, config.transfer, config.freeze, streams.networks)
    copied_alpha = teacher is not None and config.transfer.copy_log_alpha
    log_alpha = teacher.description.log_alpha if teacher is not None and copied_alpha else 0.0
    return Prepared(spec, about, networks, report, log_alpha, streams)


def _action_bounds(config: EnvConfig) -> tuple[np.ndarray, np.ndarray]:
    env = make_env(config)
    env.close()
    assert isinstance(env.action_space, Box)
    return env.action_space.low, env.action_space.high


def find_teacher(config: ExperimentConfig, dims: Dimensions) -> Teacher | None:
    """Loads the teacher that the settings name or imply.

    Raises:
        ConfigError: If there is none, with the command that trains it.
    """
    if config.transfer.name == NONE:
        return None
    if config.transfer.teacher is not None:
        return load_teacher(config.transfer.teacher)
    source = teacher_spec(config)
    if config.transfer.name == "direct":
        _check_same_body(source.config, dims)
    path = source.directory / TENSOR_FILE
    if not RunDir(source.directory).is_complete():
        state = "is not finished" if RunDir(source.directory).stored_settings() else "does not exist"
        raise ConfigError(
            f"transfer={config.transfer.name}: the teacher's run {source.directory} {state}; "
            f"train it with: {source.command} (or give another one: transfer.teacher=PATH)"
        )
    return load_teacher(path)


def _check_same_body(source: ExperimentConfig, dims: Dimensions) -> None:
    about = describe(source.env)
    theirs = Dimensions(len(about.observation_names), len(about.action_names))
    if theirs != dims:
        raise ConfigError(
            f"transfer=direct: the source environment {source.env.name} has {theirs}, this one {dims}; "
            "type transfer=hidden or transfer=expand between different bodies"
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
