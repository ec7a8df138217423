"""The description of a teacher, ``teacher.json``: what its networks are, where they learned, what they saw there."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from acmr.agent.architecture import LOG_STD_BOUNDS, TANH, Architecture, Dimensions
from acmr.config import ACTIVATIONS, ConfigError
from acmr.foreign import DESCRIPTIONS, read_mapping
from acmr.records import DamagedError, description_sha256
from acmr.storage.state_data import from_json

FORMAT_VERSION = 2
#: Version 1 knew no statistics.
_READABLE = (1, FORMAT_VERSION)
#: What numbers a tensor file may hold: those of a run, and those of one that is published in half the bytes.
FULL, HALF = "float32", "float16"
#: Entries of a description that are written only where they say something.
_OPTIONAL = ("precision", "full_sha256", "statistics", "log_std", "imported", "wrappers")
#: Layers wider than this are none of ours.
_MAX_WIDTH = 1 << 20


@dataclass(frozen=True)
class PolicyStatistics:
    """What a policy saw and did in its own environment; standard deviations are over the same steps as the means.

    Attributes:
        episodes: How many were played, with sampled actions.
        steps: How many they had together.
        observation_mean: Of each observation.
        observation_std: Its standard deviation.
        observation_initial: Of each observation, its mean at the start of an episode.
        action_mean: Of each action.
        action_std: Its standard deviation.
    """

    episodes: int
    steps: int
    observation_mean: list[float]
    observation_std: list[float]
    observation_initial: list[float]
    action_mean: list[float]
    action_std: list[float]


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
        log_alpha: Log of the final temperature; None where it is not known.
        seed: Seed of the run.
        profile: Profile of the run.
        global_step: Environment steps it was trained for.
        final_return: Mean return of its last episodes; None if it finished none.
        config: The settings of the run, without paths of its machine and without what only shows it.
        statistics: What its final policy saw and did; None where that was not recorded.
        sha256: Of the tensor file.
        description_sha256: Of all other entries of this description.
        precision: Of the numbers in the tensor file.
        full_sha256: Of the tensor file in full precision that this one was rounded from; empty for a full one.
        log_std: How the policy's log standard deviation is bounded, ``tanh`` or ``clamp``.
        imported: Of networks that another program trained, which program; empty for those of a run.
        wrappers: What wrappers around its environment remembered at the end, as JSON; None where none did
            (:mod:`acmr.envs.wrappers.memory`).
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
    log_alpha: float | None
    seed: int
    profile: str
    global_step: int
    final_return: float | None
    config: dict[str, Any]
    statistics: PolicyStatistics | None = None
    sha256: str = ""
    description_sha256: str = ""
    precision: str = FULL
    full_sha256: str = ""
    log_std: str = TANH
    imported: str = ""
    wrappers: dict[str, Any] | None = None

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
            self.log_std,
        )


def read_description(path: Path) -> TeacherDescription:
    """Reads and checks ``teacher.json``.

    Raises:
        ConfigError: If it is damaged, of another format, or says what no run of this project does.
    """
    try:
        content = read_mapping(path, most=DESCRIPTIONS)
    except DamagedError as error:
        raise ConfigError(f"{error}; not a teacher description of this project") from error
    if content.get("format_version") not in _READABLE:
        raise ConfigError(f"{path}: not a teacher description of format {' or '.join(map(str, _READABLE))}")
    names = [entry.name for entry in fields(TeacherDescription) if entry.name not in (*_OPTIONAL, "description_sha256")]
    missing = [name for name in names if name not in content]
    if missing:
        raise ConfigError(f"{path}: the entries {', '.join(missing)} are missing")
    if unknown := content.keys() - {*names, *_OPTIONAL, "description_sha256"}:
        raise ConfigError(f"{path}: damaged (it has the unknown entries {', '.join(sorted(unknown))}); copy it again")
    if content.get("description_sha256", description_sha256(content)) != description_sha256(content):
        raise ConfigError(f"{path}: damaged (its entries do not have the sha256 that stands in it); copy it again")
    if "statistics" in content:
        content["statistics"] = _statistics(path, content["statistics"])
    description = TeacherDescription(**{name: content[name] for name in (*names, *_OPTIONAL) if name in content})
    wrong = _wrong_entries(description)
    if wrong:
        raise ConfigError(f"{path}: the entries {', '.join(wrong)} are not what a teacher description holds")
    return description


def _statistics(path: Path, given: Any) -> PolicyStatistics:
    if not isinstance(given, dict) or given.keys() != {entry.name for entry in fields(PolicyStatistics)}:
        raise ConfigError(f"{path}: the entries statistics are not what a teacher description holds")
    return PolicyStatistics(**given)


def _wrong_entries(about: TeacherDescription) -> list[str]:
    """Names of the entries whose values could not have been written by :func:`save_teacher`."""

    def list_of(value: object, kind: type, least: int = 1) -> bool:
        return isinstance(value, list) and len(value) >= least and all(type(entry) is kind for entry in value)

    def widths(value: object) -> bool:
        return list_of(value, int) and isinstance(value, list) and all(0 < entry <= _MAX_WIDTH for entry in value)

    def bounds(value: object) -> bool:
        fits = list_of(value, float) and isinstance(value, list) and len(value) == len(about.action_names)
        return fits and isinstance(value, list) and all(math.isfinite(entry) for entry in value)

    def finite(value: object) -> bool:
        # A whole number of JSON may be one that no float holds.
        return isinstance(value, int | float) and abs(value) <= sys.float_info.max

    names = {key: list_of(getattr(about, key), str) for key in ("observation_names", "action_names")}
    if not all(names.values()):
        # All others are judged by how many there are.
        return [name for name, is_good in names.items() if not is_good]
    texts = ("environment", "environment_id", "model_hash", "profile", "sha256", "full_sha256", "imported")
    good = {
        "action_low": bounds(about.action_low),
        "action_high": bounds(about.action_high),
        "hidden_sizes": widths(about.hidden_sizes),
        "core": about.core is None or (widths(about.core) and len(about.core) == 2),
        "log_alpha": about.log_alpha is None or finite(about.log_alpha),
        "log_std": isinstance(about.log_std, str) and about.log_std in LOG_STD_BOUNDS,
        "seed": type(about.seed) is int,
        "global_step": type(about.global_step) is int,
        "final_return": about.final_return is None or finite(about.final_return),
        "adapter_activation": isinstance(about.adapter_activation, str) and about.adapter_activation in ACTIVATIONS,
        "config": isinstance(about.config, dict),
        "precision": about.precision in (FULL, HALF),
        "wrappers": about.wrappers is None or _is_state(about.wrappers),
        "statistics": about.statistics is None or _are_statistics(about.statistics, about.dims),
        **{name: isinstance(getattr(about, name), str) for name in texts},
    }
    return [name for name, is_good in good.items() if not is_good]


def _is_state(content: object) -> bool:
    try:
        from_json(content)
    except ValueError:
        return False
    return True


def _are_statistics(told: PolicyStatistics, dims: Dimensions) -> bool:
    sizes = {"observation": dims.observation, "action": dims.action}
    counts = type(told.episodes) is int and type(told.steps) is int and told.steps >= told.episodes > 0
    vectors = [(name.split("_")[0], value) for name, value in vars(told).items() if "_" in name]
    return counts and all(
        isinstance(value, list)
        and len(value) == sizes[kind]
        and all(type(number) is float and math.isfinite(number) for number in value)
        for kind, value in vectors
    )
