"""The teacher file: a run's final networks as data, never as code.

``teacher.safetensors`` holds the tensors, ``teacher.json`` says what they are. Nothing is unpickled, so a file from
somebody else can be wrong but cannot run anything.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from acmr.agent.architecture import TANH
from acmr.agent.networks import Networks
from acmr.config import ConfigError
from acmr.foreign import NETWORKS, is_there, read_bytes
from acmr.records import DESCRIPTION_FILE, TENSOR_FILE, DamagedError, description_sha256
from acmr.stateful import State
from acmr.storage.durable import write_bytes
from acmr.storage.json_files import write_json
from acmr.storage.state_data import from_json
from acmr.transfer.description import FULL, HALF, TeacherDescription, read_description


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

    def wrapper_states(self) -> State:
        """What the wrappers around its environment remembered at the end, by their names; empty if none did."""
        return {} if self.description.wrappers is None else from_json(self.description.wrappers)

    def log_alpha(self) -> float:
        """Log of its temperature, for a student that begins with it (``transfer.copy_log_alpha``).

        Raises:
            ConfigError: If it was imported, and its temperature is not known.
        """
        if self.description.log_alpha is None:
            raise ConfigError(
                f"transfer.copy_log_alpha=true: {self.path} was imported without its temperature; type "
                "transfer.copy_log_alpha=false, or import it again with --alpha (docs/exchange.md)"
            )
        return self.description.log_alpha


def save_teacher(folder: Path, networks: Networks, description: TeacherDescription) -> None:
    """Writes both files of a teacher, each whole or not at all."""
    tensors = {name: tensor.detach().cpu().float().contiguous() for name, tensor in networks.state_dict().items()}
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
    if description.statistics is None:
        del content["statistics"]
    if description.log_std == TANH:
        del content["log_std"]
    if not description.imported:
        del content["imported"]
    if description.wrappers is None:
        del content["wrappers"]
    content["description_sha256"] = description_sha256(content)
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
    if path.is_symlink() and not given.is_dir():
        # Typed by the user, so that it may lead anywhere; beside it is what lies beside the file itself.
        path = path.resolve()
    beside = path.with_suffix(".json")
    if given.is_dir() and not is_there(path):
        raise ConfigError(
            f"{given}: no {TENSOR_FILE} in it; a run writes it at its end, and not every published run has it"
        )
    if not is_there(path):
        raise ConfigError(f"{path}: no such teacher file; give a finished run's directory or its {TENSOR_FILE}")
    if not is_there(beside):
        raise ConfigError(f"{path}: {beside.name} is missing beside it; a teacher is both files of a run")
    description = read_description(beside)
    try:
        data = read_bytes(path, NETWORKS)
    except DamagedError as error:
        raise ConfigError(f"{error}; not the networks of a teacher of this project") from error
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
    broken = [name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())]
    if broken:
        raise ConfigError(
            f"{path}: {broken[0]} holds numbers that are not finite; give another teacher, or train it anew"
        )
    return Teacher(path, description, {name: tensor.float() for name, tensor in tensors.items()})
