"""What a run's settings and summary say, as far as it can be relied on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acmr.foreign import is_file
from acmr.records import CONFIG_FILE, EPISODES_FILE, FILES_ENTRY, METRICS_FILE, STATUS_FILE, SUMMARY_FILE, DamagedError
from acmr.run_folders import changes
from acmr.text import flatten
from analysis.loading.values import check_numbers, read_mapping

#: Parts that every ``config.yaml`` of a run has, in their order there; what is cut off lacks the last of them.
_PARTS = ("env", "agent", "transfer")
#: Entries that a summary of this project's has from the first version on, and others' have not.
_OWN_ENTRIES = {"run", "profile"}
#: What a run's settings and its summary both say, and so must agree on.
_SAID_TWICE = {
    **{key: key for key in ("seed", "freeze", "profile", "total_timesteps", "threshold", "consecutive")},
    **{key: key for key in ("stop", "stop_after", "seeding")},
    "env": "env.name",
    "transfer": "transfer.name",
}


@dataclass
class RunFiles:
    """The settings and the summary of one run.

    Attributes:
        config: The settings; empty if there are none, or none to rely on.
        summary: The summary, the same.
        own: Whether it is a run of this project's.
        begun: Whether there is a file that a run of this project has from its beginning.
        problems: Why the run cannot be used; then its directory alone tells what it is.
        doubts: What is not known of a run that can be used.
        left_out: Entries that make no sense.
    """

    config: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    own: bool = False
    begun: bool = False
    problems: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def read_files(directory: Path) -> RunFiles:
    """Reads the settings and the summary of a run, and sees whether they are what the run left."""
    found = RunFiles(begun=any(is_file(directory / name) for name in (CONFIG_FILE, STATUS_FILE)))
    said = _read(directory / SUMMARY_FILE, found.problems)
    found.own = found.begun or FILES_ENTRY in said or said.keys() >= _OWN_ENTRIES
    changed = changes(directory, said)
    found.problems += [changed[name] for name in (SUMMARY_FILE, EPISODES_FILE) if name in changed]
    if SUMMARY_FILE in changed:
        return found
    if METRICS_FILE in changed:
        found.doubts.append(f"{changed[METRICS_FILE]}: its speed is not shown")
    if CONFIG_FILE in changed:
        found.doubts.append(changed[CONFIG_FILE])
    else:
        found.config = _settings(directory, found)
    found.summary = _checked(SUMMARY_FILE, said, found)
    contradictions = [*_contradictions(found.config, found.summary)]
    if contradictions:
        found.problems += contradictions
        found.config, found.summary = {}, {}
    return found


def _settings(directory: Path, found: RunFiles) -> dict[str, Any]:
    config = _checked(CONFIG_FILE, _read(directory / CONFIG_FILE, found.problems), found)
    lacking = [part for part in _PARTS if not isinstance(config.get(part), Mapping)]
    if "freeze" in config and lacking:
        found.doubts.append(f"{CONFIG_FILE} is cut off, it has no {lacking[0]}: what stands in it is not used")
        return {}
    return config


def _read(path: Path, problems: list[str]) -> dict[str, Any]:
    try:
        return read_mapping(path)
    except DamagedError as error:
        problems.append(str(error))
        return {}


def _checked(name: str, content: dict[str, Any], found: RunFiles) -> dict[str, Any]:
    try:
        kept, left_out = check_numbers(name, content)
    except DamagedError as error:
        found.problems.append(str(error))
        return {}
    found.left_out += left_out
    return kept


def _contradictions(config: Mapping[str, Any], summary: Mapping[str, Any]) -> list[str]:
    """What the settings and the summary do not agree on: nobody knows which of them was changed."""
    settings = flatten(config)
    return [
        f"{SUMMARY_FILE} says {_said(key, summary[key])}, {CONFIG_FILE} {_said(key, settings[other])}"
        for key, other in _SAID_TWICE.items()
        if key in summary and other in settings and summary[key] != settings[other]
    ]


def _said(key: str, value: Any) -> str:
    return f"{key} {str(value)[:40]}"
