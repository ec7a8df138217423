"""A run's files as they go to others: without paths of this machine, and without what only showed the run there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import yaml

from acmr.foreign import parse_mapping
from acmr.records import (
    CONFIG_FILE,
    DESCRIPTION_FILE,
    EVALUATION_FILE,
    TRANSFER_FILE,
    description_sha256,
    portable,
    portable_settings,
)

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
