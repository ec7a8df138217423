"""The teacher file: a run's final networks as data, never as code.

``teacher.safetensors`` holds the tensors, ``teacher.json`` says what they are. Nothing is unpickled, so a file from
somebody else can be wrong but cannot run anything.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import ACTIVATIONS, ConfigError
from acmr.records import DESCRIPTION_FILE, TENSOR_FILE
from acmr.storage.durable import write_bytes
from acmr.storage.json_files import write_json

FORMAT_VERSION = 1
#: What numbers a tensor file may hold: those of a run, and those of one that is published in half the bytes.
FULL, HALF = "float32", "float16"
#: Entries of a description that are written only where they say something.
_OPTIONAL = ("precision", "full_sha256")
#: Files larger than this, and layers wider, are none of ours.
_MAX_DESCRIPTION_BYTES, _MAX_TENSOR_BYTES, _MAX_WIDTH = 4 << 20, 1 << 30, 1 << 20


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
        description_sha256: Of all other entries of this description.
        precision: Of the numbers in the tensor file.
        full_sha256: Of the tensor file in full precision that this one was rounded from; empty for a full one.
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
    description_sha256: str = ""
    precision: str = FULL
    full_sha256: str = ""

    @property
    def dims(self) -> Dimensions:
        """Sizes of the environment it learned in."""
        return Dimensions(len(self.observation_names), len(self.action_names))

    @property
    def architecture(self) -> Architecture:
        """The structure of its networks."""
        return Architecture(
            self.dims,
            tuple(self.hidden_sizes),
            tuple(self.action_low),
            tuple(self.action_high),
            Dimensions(*self.core) if self.core else None,
            self.adapter_activation,
        )


@dataclass(frozen=True)
class Teacher:
    """A loaded teacher: its file, its description, its tensors (float32) by ``<layer>.weight`` and ``<layer>.bias``."""

    path: Path
    description: TeacherDescription
    tensors: dict[str, Tensor]

    def build_networks(self) -> Networks:
        """The teacher's own networks, as they were when its training ended."""
        networks = Networks(self.description.architecture, torch.Generator().manual_seed(0))
        networks.load_state_dict(self.tensors)
        return networks


def save_teacher(folder: Path, networks: Networks, description: TeacherDescription) -> None:
    """Writes both files of a teacher, each whole or not at all."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in networks.state_dict().items()}
    _write(folder, tensors, description)


def save_halved(folder: Path, teacher: Teacher) -> None:
    """Writes both files of a teacher with its numbers rounded to half precision, for half the bytes.

    Raises:
        ConfigError: If a number is too large for that.
    """
    tensors = {name: tensor.half() for name, tensor in teacher.tensors.items()}
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise ConfigError(f"{teacher.path}: holds numbers that half precision does not; keep it in full")
    full = teacher.description.full_sha256 or teacher.description.sha256
    _write(folder, tensors, replace(teacher.description, precision=HALF, full_sha256=full))


def _write(folder: Path, tensors: dict[str, Tensor], description: TeacherDescription) -> None:
    data = save_tensors(tensors)
    content = asdict(description) | {"sha256": hashlib.sha256(data).hexdigest()}
    if description.precision == FULL:
        del content["precision"], content["full_sha256"]
    content["description_sha256"] = _description_sha256(content)
    # The description last: it names the hash of the tensors, so a kill in between leaves a pair that is refused.
    write_bytes(folder / TENSOR_FILE, data)
    write_json(folder / DESCRIPTION_FILE, content)


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
    given, path = Path(path), locate_teacher(path)
    beside = path.with_suffix(".json")
    if given.is_dir() and not path.exists():
        raise ConfigError(
            f"{given}: no {TENSOR_FILE} in it; a run writes it at its end, and not every published run has it"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: no such teacher file; give a finished run's directory or its {TENSOR_FILE}")
    if not beside.is_file():
        raise ConfigError(f"{path}: {beside.name} is missing beside it; a teacher is both files of a run")
    description = _read_description(beside)
    if path.stat().st_size > _MAX_TENSOR_BYTES:
        raise ConfigError(f"{path}: {path.stat().st_size} bytes; not the networks of a teacher of this project")
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
    # Compared as shapes, before anything of the size that the description claims is made.
    if {name: tuple(tensor.shape) for name, tensor in tensors.items()} != description.architecture.tensors:
        raise ConfigError(
            f"{path}: the tensors do not fit the layers that {DESCRIPTION_FILE} describes; "
            "the two files are not of one run"
        )
    if {str(tensor.dtype) for tensor in tensors.values()} != {f"torch.{description.precision}"}:
        raise ConfigError(f"{path}: not of the precision that {DESCRIPTION_FILE} says ({description.precision})")
    return Teacher(path, description, {name: tensor.float() for name, tensor in tensors.items()})


def _read_description(path: Path) -> TeacherDescription:
    if path.stat().st_size > _MAX_DESCRIPTION_BYTES:
        raise ConfigError(f"{path}: {path.stat().st_size} bytes; not a teacher description of this project")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format_version") != FORMAT_VERSION:
        raise ConfigError(f"{path}: not a teacher description of format {FORMAT_VERSION}")
    names = [entry.name for entry in fields(TeacherDescription) if entry.name not in (*_OPTIONAL, "description_sha256")]
    missing = [name for name in names if name not in content]
    if missing:
        raise ConfigError(f"{path}: the entries {', '.join(missing)} are missing")
    if unknown := content.keys() - {*names, *_OPTIONAL, "description_sha256"}:
        raise ConfigError(f"{path}: damaged (it has the unknown entries {', '.join(sorted(unknown))}); copy it again")
    if content.get("description_sha256", _description_sha256(content)) != _description_sha256(content):
        raise ConfigError(f"{path}: damaged (its entries do not have the sha256 that stands in it); copy it again")
    description = TeacherDescription(**{name: content[name] for name in (*names, *_OPTIONAL) if name in content})
    wrong = _wrong_entries(description)
    if wrong:
        raise ConfigError(f"{path}: the entries {', '.join(wrong)} are not what a teacher description holds")
    return description


def _description_sha256(content: dict[str, Any]) -> str:
    rest = {name: value for name, value in content.items() if name != "description_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _wrong_entries(about: TeacherDescription) -> list[str]:
    """Names of the entries whose values could not have been written by :func:`save_teacher`."""

    def list_of(value: object, kind: type, least: int = 1) -> bool:
        return isinstance(value, list) and len(value) >= least and all(type(entry) is kind for entry in value)

    def widths(value: object) -> bool:
        return list_of(value, int) and isinstance(value, list) and all(0 < entry <= _MAX_WIDTH for entry in value)

    def bounds(value: object) -> bool:
        fits = list_of(value, float) and isinstance(value, list) and len(value) == len(about.action_names)
        return fits and isinstance(value, list) and all(math.isfinite(entry) for entry in value)

    texts = ("environment", "environment_id", "model_hash", "profile", "sha256", "full_sha256")
    good = {
        "observation_names": list_of(about.observation_names, str),
        "action_names": list_of(about.action_names, str),
        "action_low": bounds(about.action_low),
        "action_high": bounds(about.action_high),
        "hidden_sizes": widths(about.hidden_sizes),
        "core": about.core is None or (widths(about.core) and len(about.core) == 2),
        "log_alpha": isinstance(about.log_alpha, int | float) and math.isfinite(about.log_alpha),
        "seed": type(about.seed) is int,
        "global_step": type(about.global_step) is int,
        "final_return": about.final_return is None or isinstance(about.final_return, int | float),
        "adapter_activation": about.adapter_activation in ACTIVATIONS,
        "config": isinstance(about.config, dict),
        "precision": about.precision in (FULL, HALF),
        **{name: isinstance(getattr(about, name), str) for name in texts},
    }
    return [name for name, is_good in good.items() if not is_good]
