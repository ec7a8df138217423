"""What a run starts with, made and checked before anything is written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.learner import Learner, find_learner
from acmr.agent.networks import Networks
from acmr.agent.replay_files import replay_bytes
from acmr.config import ConfigError, ExperimentConfig
from acmr.envs import EnvDescription, describe
from acmr.records import TENSOR_FILE
from acmr.run.random_streams import RandomStreams, random_streams
from acmr.settings.run_spec import RunSpec, teacher_spec
from acmr.storage.checkpoint_store import KEPT
from acmr.storage.run_dir import RunDir
from acmr.text import size
from acmr.tracking.watchers import tracker_class
from acmr.transfer.methods import check_body, transfer
from acmr.transfer.report import TransferReport
from acmr.transfer.teacher import Teacher, load_teacher

#: Logs, settings and whatever is small, in bytes.
_SMALL = 1 << 20


@dataclass(frozen=True)
class Prepared:
    """All that a run needs and that could be wrong, made and checked before anything is written."""

    spec: RunSpec
    about: EnvDescription
    networks: Networks
    report: TransferReport
    learner: Callable[..., Learner]
    log_alpha: float
    streams: RandomStreams


def prepare(spec: RunSpec) -> Prepared:
    """Builds the networks that a run starts with, with everything its teacher gives."""
    config = spec.config
    _check_device(config.device)
    tracker_class(config.tracking)
    learner = find_learner(config.agent)
    about = describe(config.env)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    teacher = find_teacher(config, dims)
    streams = random_streams(config.seed, config.device)
    architecture = Architecture(dims, tuple(config.agent.hidden_sizes), about.action_low, about.action_high)
    fresh = Networks(architecture, streams.networks)
    networks, report = transfer(fresh, teacher, config.transfer, config.freeze, streams.networks)
    copied_alpha = teacher is not None and config.transfer.copy_log_alpha
    log_alpha = teacher.description.log_alpha if teacher is not None and copied_alpha else 0.0
    return Prepared(spec, about, networks, report, learner, log_alpha, streams)


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
    path = source.directory / TENSOR_FILE
    if not RunDir(source.directory).is_complete():
        state = "is not finished" if RunDir(source.directory).stored_settings() else "does not exist"
        raise ConfigError(
            f"transfer={config.transfer.name}: the teacher's run {source.directory} {state}; "
            f"train it with: {source.command} (or give another one: transfer.teacher=PATH)"
        )
    return load_teacher(path)


def _check_device(device: str) -> None:
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise ConfigError(f"device={device}: must be cpu or cuda") from None
    if kind not in ("cpu", "cuda"):
        raise ConfigError(f"device={device}: must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device={device}: no CUDA device is available here; type device=cpu")


def arrays_bytes(networks: Networks) -> int:
    """At most this much do the arrays of one checkpoint take: weights, targets, two moments each, and the rest."""
    return 5 * 4 * networks.architecture.parameter_count + (4 << 20)


def space_needed(config: ExperimentConfig, networks: Networks) -> int:
    """Bytes that a run takes on the disk while it goes on."""
    weights = 4 * networks.architecture.parameter_count
    if config.checkpoint_every == 0:
        return weights + _SMALL
    dims, agent = networks.dims, config.agent
    replay = replay_bytes(agent.buffer_size, config.most_steps, dims.observation, dims.action)
    # One checkpoint more while the oldest is still there; each holds weights, most of their targets, two moments.
    return replay + (KEPT + 1) * 4 * weights + _SMALL


def check_space(config: ExperimentConfig, networks: Networks, run_dir: Path, checkpoint_folder: Path) -> None:
    """Refuses a run that its disk cannot take.

    Raises:
        ConfigError: With what it needs and what there is.
    """
    place = next((folder for folder in (run_dir, *run_dir.absolute().parents) if folder.is_dir()), Path("/"))
    needed = space_needed(config, networks)
    free = shutil.disk_usage(place).free
    if needed > free + _held(checkpoint_folder):
        raise ConfigError(
            f"{run_dir}: takes up to {size(needed)} while it runs, but its disk has {size(free)} free; free some, "
            "type output_dir=FOLDER on another disk, or checkpoint_every=0 (it cannot be resumed then)"
        )


def _held(folder: Path) -> int:
    total = 0
    # Another process may be at work there, and remove what is looked at.
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):
                total += path.lstat().st_size
    return total
