"""Files that may be somebody else's: the one reader of what a run, a teacher or a folder of results holds.

Whatever lies there costs one line at most: only regular files are read, no link is followed out of its folder, nothing
is waited for, no more is read than such a file can have, and what comes back is plain data of few levels.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from acmr.records import (
    DESCRIPTION_FILE,
    EPISODE_FILES,
    EVALUATION_FILE,
    METRICS_FILE,
    TENSOR_FILE,
    DamagedError,
)
from acmr.text import message

#: Most bytes of settings, summaries and notices; of descriptions; of tables, unpacked; of networks.
SETTINGS, DESCRIPTIONS, TABLES, NETWORKS = 1 << 20, 4 << 20, 1 << 28, 1 << 30
_MOST = {
    **dict.fromkeys((DESCRIPTION_FILE, EVALUATION_FILE), DESCRIPTIONS),
    **dict.fromkeys((*EPISODE_FILES, METRICS_FILE, f"{METRICS_FILE}.gz"), TABLES),
    TENSOR_FILE: NETWORKS,
}
#: Levels of settings within settings, and bits of a number that can be printed.
_DEEPEST, _LONGEST = 30, 4096
_PIECE = 1 << 20
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def most_of(name: str) -> int:
    """Bytes that a file of this name has at most."""
    return _MOST.get(name, SETTINGS)


def is_there(path: Path) -> bool:
    """Whether a path has anything, a link that leads nowhere included."""
    try:
        return os.path.lexists(path)
    except (OSError, ValueError):
        return False


def is_file(path: Path) -> bool:
    """Whether a path leads to a regular file, as far as one may see: in a folder that is locked there is none."""
    return os.path.isfile(path)


def real_path(path: Path) -> Path:
    """Where a path leads, as far as one may see: a link that cannot be read leads to itself."""
    try:
        return Path(os.path.realpath(path))
    except OSError:
        return path.absolute()


@contextmanager
def opened(path: Path, title: str = "", links: bool = True) -> Iterator[tuple[BinaryIO, int]]:
    """Opens a regular file to read it; its size in bytes comes with it.

    Args:
        path: The file.
        title: What it is called in messages; by default its path.
        links: Whether it may be a link to another file of its folder.

    Raises:
        DamagedError: If it is missing, unreadable, no regular file, or a link that leaves its folder.
    """
    title = title or str(path)
    try:
        place = _followed(path, title) if links else path
        # Before it is opened: that alone does something to some devices.
        _check_regular(os.lstat(place), title)
        descriptor = os.open(place, _READ)
    except OSError as error:
        raise DamagedError(f"{title}: {error.strerror or error}") from error
    except ValueError as error:
        raise DamagedError(f"{title}: no name of a file") from error
    with open(descriptor, "rb") as stream:
        status = os.fstat(descriptor)
        _check_regular(status, title)
        try:
            yield stream, status.st_size
        except OSError as error:
            raise DamagedError(f"{title}: {error.strerror or error}") from error


def read_bytes(path: Path, most: int | None = None, title: str = "") -> bytes:
    """What a file holds, as :func:`opened` reads it.

    Args:
        path: The file.
        most: Bytes that it may have; by default those of a file of its name.
        title: What it is called in messages; by default its path.

    Raises:
        DamagedError: As :func:`opened`, or if it is larger.
    """
    title, most = title or str(path), most_of(path.name) if most is None else most
    with opened(path, title) as (stream, size):
        if size > most:
            raise DamagedError(f"{title}: {size} bytes, at most {most} expected")
        # What it grows by meanwhile is left for the next time.
        return stream.read(size)


def unpack(data: bytes, title: str, most: int = TABLES) -> bytes:
    """What a file packed by gzip holds.

    Raises:
        DamagedError: If it is damaged, or holds more than ``most`` bytes, however small it is itself.
    """
    parts, left = [], most
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            # Piece by piece: asked for all at once, it takes several times the memory.
            while left >= 0 and (part := packed.read(_PIECE)):
                parts.append(part)
                left -= len(part)
    except (EOFError, zlib.error, OSError) as error:
        raise DamagedError(f"{title}: cannot be decompressed ({error})") from None
    if left < 0:
        raise DamagedError(f"{title}: holds more than the {most} bytes that are expected at most")
    return b"".join(parts)


def read_mapping(path: Path, title: str = "", most: int | None = None) -> dict[str, Any]:
    """The contents of a YAML or JSON file, as its name ends.

    Raises:
        DamagedError: As :func:`read_bytes`, or if it holds anything but a mapping of plain data.
    """
    title = title or str(path)
    return parse_mapping(path.name, read_bytes(path, most, title), title)


def parse_mapping(name: str, data: bytes, title: str = "") -> dict[str, Any]:
    """The contents of a YAML or JSON file that has been read.

    Args:
        name: Its name.
        data: What it holds.
        title: What it is called in messages; by default its name.

    Raises:
        DamagedError: If it holds anything but a mapping of plain data.
    """
    title = title or name
    try:
        # Some editors begin a file with a mark of its encoding.
        text = data.decode("utf-8-sig")
        value = json.loads(text, object_pairs_hook=_object) if name.endswith(".json") else _yaml(title, text)
    except (ValueError, yaml.YAMLError, RecursionError, OverflowError) as error:
        raise DamagedError(f"{title}: cannot be read ({_reason(error)})") from None
    if not isinstance(value, dict):
        raise DamagedError(f"{title}: holds no settings")
    _check(title, value)
    return value


def _check_regular(status: os.stat_result, title: str) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise DamagedError(f"{title}: no regular file")


def _followed(path: Path, title: str) -> Path:
    if not stat.S_ISLNK(os.lstat(path).st_mode):
        return path
    folder, target = os.path.realpath(path.parent), os.path.realpath(path)
    if os.path.commonpath([folder, target]) != folder:
        raise DamagedError(f"{title}: a link that leaves its folder")
    return Path(target)


def _check(title: str, value: Any, depth: int = 0) -> None:
    """Sees that contents can be walked through and printed."""
    _check_depth(title, depth)
    if isinstance(value, int) and value.bit_length() > _LONGEST:
        raise DamagedError(f"{title}: holds a number of more than {_LONGEST} bits")
    if not isinstance(value, dict | list | str | int | float | date | None):
        raise DamagedError(f"{title}: holds more than texts, numbers, lists and mappings")
    for entry in (*value, *value.values()) if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check(title, entry, depth + 1)


def _yaml(title: str, text: str) -> Any:
    depth = 0
    # Looked through first: thousands of levels end the process where they are loaded.
    for event in yaml.parse(text, _LOADER):
        # No run writes aliases; in a foreign file they can hold a mapping within itself, or a billion of them.
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("aliases")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        _check_depth(title, depth)
    loader = _LOADER(text)
    try:
        node = loader.get_single_node()
        _check_keys(node)
        return None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


def _check_keys(node: yaml.Node | None) -> None:
    """Refuses two values of one key: which of them a reader takes is its own affair."""
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise ValueError(f"line {key.start_mark.line + 1}: {key.value} is there twice")
                seen.add(key.value)
            _check_keys(value)
    elif isinstance(node, yaml.SequenceNode):
        for entry in node.value:
            _check_keys(entry)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, in which each key has one value."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{key} is there twice")
        found[key] = value
    return found


def _reason(error: Exception) -> str:
    """Why, and where, in a few visible words."""
    if isinstance(error, UnicodeDecodeError):
        return f"not UTF-8 at byte {error.start}"
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"line {error.problem_mark.line + 1}: {message(ValueError(error.problem))}"
    return message(error)


def _check_depth(title: str, depth: int) -> None:
    if depth > _DEEPEST:
        raise DamagedError(f"{title}: holds settings within settings within settings, more than {_DEEPEST} deep")
