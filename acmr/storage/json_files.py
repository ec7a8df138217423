"""JSON files that whoever reads them sees whole: results, which last, and notices, which need not."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acmr.foreign import read_mapping
from acmr.records import DamagedError
from acmr.storage.durable import write_bytes
from acmr.storage.hold import check_hold


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a result, which survives a crash from then on.

    Raises:
        WriteError: If the disk does not take it; the old content is untouched then.
    """
    write_bytes(path, (json.dumps(content, indent=2) + "\n").encode())


def replace_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a notice for other processes; it may be lost with the machine, since waiting for the disk takes too long.

    Raises:
        OSError: If the disk does not take it; the old content is untouched then.
        LostError: If it lies in the directory of a run that this process no longer holds.
    """
    check_hold(path)
    # Several processes may write the same file.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    with open(os.open(temporary, flags, 0o644), "w", encoding="utf-8") as stream:
        stream.write(json.dumps(content) + "\n")
    os.replace(temporary, path)


def read_json(path: Path) -> dict[str, Any] | None:
    """What a file says that others write; None if it is not there, not readable or no object."""
    try:
        return read_mapping(path)
    except DamagedError:
        return None
