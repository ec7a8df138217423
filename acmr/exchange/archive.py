"""Reads what other programs store their networks in, as files of somebody who means harm.

No object is ever unpickled: of a PyTorch file only tensors and plain data (``weights_only``), of NumPy's only numbers.
Nothing is unpacked before it is known how large it becomes.
"""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from acmr.config import ConfigError
from acmr.foreign import read_bytes
from acmr.records import DamagedError

#: Most bytes of a file, and of all that is unpacked of it: a hundred times the paper's networks.
MOST_BYTES = 1 << 28
#: Letters of a text from a file that are shown in a message.
NAMED = 80
#: Begins each entry of a zip file's table of contents, and how many there may be: some take memory by their number.
_ENTRY, _MOST_ENTRIES = b"PK\x01\x02", 10_000
_NUMPY_MAGIC = b"\x93NUMPY"


class Archive:
    """A zip file whose members are read one by one.

    Args:
        data: What it holds.
        title: What it is called in messages.

    Raises:
        ConfigError: If it is none, or would unpack to more than :data:`MOST_BYTES`.
    """

    def __init__(self, data: bytes, title: str) -> None:
        self._title = title
        try:
            if data.count(_ENTRY) > _MOST_ENTRIES:
                raise ConfigError(f"{title}: more than {_MOST_ENTRIES:,} members")
            self._file = zipfile.ZipFile(io.BytesIO(data))
        except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise error if isinstance(error, ConfigError) else ConfigError(f"{title}: no zip file ({error})") from error
        self.names = self._file.namelist()
        if len(set(self.names)) < len(self.names):
            raise ConfigError(f"{title}: damaged, two of its members have the same name")
        # As the table of contents says; no more than that is read of a member.
        if (size := sum(entry.file_size for entry in self._file.infolist())) > MOST_BYTES:
            raise ConfigError(f"{title}: {size:,} bytes when unpacked, at most {MOST_BYTES:,} expected")

    def read(self, name: str) -> bytes:
        """One member, unpacked.

        Raises:
            ConfigError: If it is missing or damaged.
        """
        if name not in self.names:
            raise ConfigError(f"{self._title}: there is no {name} in it")
        try:
            return self._file.read(name)
        except Exception as error:
            # Decompressors have errors of their own kinds, and each says that the file is damaged.
            raise ConfigError(f"{self._title}: {name} cannot be unpacked ({error})") from error


def read_archive(path: Path) -> Archive:
    """Opens a zip file.

    Raises:
        ConfigError: If it is missing, no regular file, too large, or no zip file.
    """
    return Archive(_bytes_of(path), str(path))


def read_torch(path: Path) -> Any:
    """What a file written by ``torch.save`` holds: tensors and plain data.

    Raises:
        ConfigError: As :func:`parse_torch`, or if it cannot be read.
    """
    return parse_torch(_bytes_of(path), str(path))


def parse_torch(data: bytes, title: str) -> Any:
    """What bytes written by ``torch.save`` hold, on the CPU.

    Raises:
        ConfigError: If they hold more than tensors and plain data, are damaged, or become too large.
    """
    # Sizes first; and the formats before torch 1.6, which are no zip files, say sizes that nothing can be held against.
    Archive(data, title)
    try:
        with warnings.catch_warnings():
            # What a damaged file makes torch remark on is no news beside the line that refuses it.
            warnings.simplefilter("ignore")
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:
        # Whatever a damaged or hostile file brings about: nothing of it has been run.
        said = str(error).strip().splitlines()
        raise ConfigError(
            f"{title}: holds more than tensors and plain data, or is damaged "
            f"({said[0][:200] if said else type(error).__name__})"
        ) from error


def checked_tensors(given: object, title: str) -> dict[str, Tensor]:
    """A ``state_dict`` as float32 tensors by name.

    Raises:
        ConfigError: If it is none, or holds numbers of another kind or that are not finite.
    """
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise ConfigError(f"{title}: no state_dict")
    found = {}
    for name, tensor in given.items():
        if not isinstance(tensor, Tensor) or not _is_plain(tensor):
            raise ConfigError(f"{title}: {name[:NAMED]} is no array of numbers in memory")
        found[name] = tensor.detach().float()
        if not bool(torch.isfinite(found[name]).all()):
            raise ConfigError(f"{title}: {name[:NAMED]} holds numbers that are not finite")
    return found


def _is_plain(tensor: Tensor) -> bool:
    if tensor.layout != torch.strided or tensor.device.type != "cpu" or not tensor.is_floating_point():
        return False
    # A stride of zero makes a tensor of any size from a single number.
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def read_numbers(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file, float64, by name.

    Raises:
        ConfigError: If it is damaged, or holds anything but real numbers.
    """
    archive = read_archive(path)
    return {
        name.removesuffix(".npy"): _array(archive.read(name), f"{path}: {name.removesuffix('.npy')}")
        for name in archive.names
    }


def _array(data: bytes, title: str) -> np.ndarray:
    stream = io.BytesIO(data)
    try:
        if not data.startswith(_NUMPY_MAGIC):
            raise ValueError("no array")
        read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
        shape, _, dtype = read[np.lib.format.read_magic(stream)[0]](stream)
        rest = data[stream.tell() :]
        # Of objects there are no bytes, but a pickle; and sizes are as large as somebody writes them.
        if dtype.kind not in "fiu" or math.prod(shape) * dtype.itemsize != len(rest) or len(shape) > 1:
            raise ValueError("no vector of real numbers")
        return np.frombuffer(rest, dtype).astype(np.float64).reshape(shape)
    except Exception as error:
        raise ConfigError(f"{title}: {error}") from error


def _bytes_of(path: Path) -> bytes:
    try:
        # Typed by the user: a link may lead anywhere.
        return read_bytes(path.resolve() if path.is_symlink() else path, MOST_BYTES, str(path))
    except DamagedError as error:
        raise ConfigError(str(error)) from error
