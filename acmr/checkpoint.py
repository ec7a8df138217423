"""The teacher file: a run's final networks as data, never as code.

``teacher.safetensors`` holds the tensors, ``teacher.json`` says what they are. Nothing is unpickled, so a file from
somebody else can be wrong but cannot run anything.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from acmr.config import ConfigError
from acmr.durable import write_bytes
from acmr.networks import Dimensions, Networks
from acmr.run_dir import DESCRIPTION_FILE, TENSOR_FILE

FORMAT_VERSION = 1
#: A description larger than this is not one of ours.
_MAX_DESCRIPTION_BYTES = 4 << 20


@dataclass(frozen=True)
class TeacherDescription:
    """What ``teacher.json`` says.

    Attributes:
        format_version: Version of this format.
        environment: Name of the environment it learned in.
        environment_id: Its Gymnasium id.
        model_hash: sha256 of the compiled model it was trained on.
        observation_names: A name for each observation; their number is the observation dimension.
        action_names: A name for each action.
        action_low: Least value of each action.
        action_high: Greatest value of each action.
        hidden_sizes: Widths of the hidden layers.
        core: Observation and action dimension of its inner layers where adapters surround them, else None.
        adapter_activation: Activation behind the input adapter.
        log_alpha: Log of the final temperature.
        seed: Seed of the run.
        profile: Profile of the run.
        global_step: Environment steps it was trained for.
        final_return: Mean return of its last episodes; None if it finished none.
        config: All settings of the run.
        sha256: Of the tensor file.
    """

    format_version: int
    environment: str
    environment_id: str
    model_hash: str
    observation_names: list[str]
    action_names: list[str]
    action_low: list[float]
    action_high: list[float]
    hidden_sizes: list[int]
    core: list[int] | None
    adapter_activation: str
    log_alpha: float
    seed: int
    profile: str
    global_step: int
    final_return: float | None
    config: dict[str, Any]
    sha256: str = ""

    @property
    def dims(self) -> Dimensions:
        """Sizes of the environment it learned in."""
        return Dimensions(len(self.observation_names), len(self.action_names))


@dataclass(frozen=True)
class Teacher:
    """A loaded teacher: its file, its description and the tensors by ``<layer>.weight`` and ``<layer>.bias``."""

    path: Path
    description: TeacherDescription
    tensors: dict[str, Tensor]

    def build_networks(self) -> Networks:
        """The teacher's own networks, as they were when its training ended."""
        about = self.description
        networks = Networks(
            about.dims,
            about.hidden_sizes,
            np.asarray(about.action_low, np.float32),
            np.asarray(about.action_high, np.float32),
            torch.Generator().manual_seed(0),
            Dimensions(*about.core) if about.core else None,
            about.adapter_activation,
        )
        try:
            networks.load_state_dict(self.tensors)
        except RuntimeError as error:
            raise ConfigError(
                f"{self.path}: the tensors do not fit the layers that {DESCRIPTION_FILE} describes; "
                "the two files are not of one run"
            ) from error
        return networks


def save_teacher(folder: Path, networks: Networks, description: TeacherDescription) -> None:
    """Writes both files of a teacher, each whole or not at all."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in networks.state_dict().items()}
    data = save_tensors(tensors)
    content = asdict(description) | {"sha256": hashlib.sha256(data).hexdigest()}
    write_bytes(folder / TENSOR_FILE, data)
    write_bytes(folder / DESCRIPTION_FILE, (json.dumps(content, indent=2) + "\n").encode())


def locate_teacher(path: str | Path) -> Path:
    """The tensor file that a user's path means: the file itself or the folder of a run."""
    path = Path(path)
    return path / TENSOR_FILE if path.is_dir() else path


def load_teacher(path: str | Path) -> Teacher:
    """Reads and checks a teacher.

    Args:
        path: The tensor file, or the run directory that holds it.

    Raises:
        ConfigError: If a file is missing, damaged, of another format, or not what its description says.
    """
    path = locate_teacher(path)
    beside = path.with_suffix(".json")
    if not path.is_file():
        raise ConfigError(f"{path}: no such teacher file; give a finished run's directory or its {TENSOR_FILE}")
    if not beside.is_file():
        raise ConfigError(f"{path}: {beside.name} is missing beside it; a teacher is both files of a run")
    description = _read_description(beside)
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != description.sha256:
        raise ConfigError(
            f"{path}: damaged or exchanged (its sha256 is not the one in {beside.name}); "
            "copy both files again, or train the teacher again with force=true"
        )
    try:
        tensors = load_tensors(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise ConfigError(f"{path}: not a safetensors file ({error})") from error
    teacher = Teacher(path, description, tensors)
    teacher.build_networks()
    return teacher


def _read_description(path: Path) -> TeacherDescription:
    if path.stat().st_size > _MAX_DESCRIPTION_BYTES:
        raise ConfigError(f"{path}: {path.stat().st_size} bytes; not a teacher description of this project")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format_version") != FORMAT_VERSION:
        raise ConfigError(f"{path}: not a teacher description of format {FORMAT_VERSION}")
    missing = [entry.name for entry in fields(TeacherDescription) if entry.name not in content]
    if missing:
        raise ConfigError(f"{path}: the entries {', '.join(missing)} are missing")
    return TeacherDescription(**{entry.name: content[entry.name] for entry in fields(TeacherDescription)})
