"""A run's files as they go to others: without paths of this machine, and without what only showed the run there.

Where hundreds of runs go together, each is also made slim: a few kilobytes.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
from collections.abc import Mapping
from typing import Any

import yaml

from acmr.foreign import parse_mapping
from acmr.records import (
    CONFIG_FILE,
    DESCRIPTION_FILE,
    EPISODE_COLUMNS,
    EPISODES_FILE,
    EVALUATION_FILE,
    SUMMARY_FILE,
    TRANSFER_FILE,
    description_sha256,
    portable,
    portable_settings,
)

#: What is kept of a slim run, beside the networks of those that took nothing.
SLIM_RECORDS = (CONFIG_FILE, SUMMARY_FILE, EPISODES_FILE, TRANSFER_FILE)
#: Digits of a return in it.
DIGITS = 8
_HASH = "description_sha256"


def portable_file(name: str, data: bytes) -> bytes:
    """What is published of a file, of any name; made portable once more, that stays as it is.

    Args:
        name: Its name.
        data: What it holds.

    Raises:
        DamagedError: If it is one that has to be changed for that, and cannot be read.
    """
    if name not in (CONFIG_FILE, DESCRIPTION_FILE, TRANSFER_FILE, EVALUATION_FILE):
        return data
    content = parse_mapping(name, data)
    told = _told(name, content)
    if told == content:
        return data
    if name == CONFIG_FILE:
        return yaml.safe_dump(told, sort_keys=False).encode()
    return (json.dumps(told, indent=2) + "\n").encode()


def slim_file(name: str, data: bytes) -> tuple[str, bytes]:
    """Name and content of a file of a slim run: its episodes without what no measure needs, compressed.

    Args:
        name: One of ``SLIM_RECORDS``.
        data: What it holds.
    """
    if name != EPISODES_FILE:
        return name, data
    lines = [",".join(EPISODE_COLUMNS)]
    for row in csv.DictReader(io.StringIO(data.decode())):
        step, value, length = (row[column] for column in EPISODE_COLUMNS)
        lines.append(f"{step},{float(value):.{DIGITS}g},{length}")
    return f"{name}.gz", gzip.compress(("\n".join(lines) + "\n").encode(), mtime=0)


def _told(name: str, content: Mapping[str, Any]) -> dict[str, Any]:
    if name == CONFIG_FILE:
        return portable_settings(content)
    told: dict[str, Any] = portable(content)
    if name == DESCRIPTION_FILE and isinstance(settings := content.get("config"), Mapping):
        told["config"] = portable_settings(settings)
        # A wrong hash stays wrong: who loads the file is to be told that it is damaged.
        if content.get(_HASH) == description_sha256(content):
            told[_HASH] = description_sha256(told)
    return told
