"""Derives from the settings which run they mean: its name, directory, cell, teacher and command line."""

from __future__ import annotations

import re
import shlex
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acmr.cells import SOURCE, TARGET, cell_of, digest, run_name, without_kind
from acmr.command import typed
from acmr.config import (
    HORIZON,
    TEACHER_CHOICE,
    TEACHER_KEYS,
    ConfigError,
    ExperimentConfig,
    SACConfig,
    is_neutral,
    plain_settings,
)
from acmr.foreign import DESCRIPTIONS, read_mapping
from acmr.records import DESCRIPTION_FILE, DamagedError
from acmr.settings.compose import as_override, baseline, compose_config, env_overrides, parse, sources
from acmr.text import flatten

#: Settings that a run's name spells out in its own way.
_NAMED_KEYS = ("seed", "freeze", "agent.name", "transfer.name", *TEACHER_CHOICE, "env.name")
_SHA256 = re.compile(r"[0-9a-f]{64}")
#: What stands in a method's file only.
_RULES = "transfer.rules."


@dataclass(frozen=True)
class RunSpec:
    """One run: its settings and what follows from them.

    Attributes:
        config: All settings.
        changes: Those that change the result and differ from the profile's own.
        name: Directory name, ``<env>-<transfer>[-frozen][-<key>=<value>...]``.
        cell: The cell (:mod:`acmr.cells`) that the run belongs to, or is the beginning of, if there is one.
        kin: The name of all runs like this one, wherever they stop and however they use their seeds.
    """

    config: ExperimentConfig
    changes: dict[str, Any]
    name: str
    cell: str | None
    kin: str

    @property
    def directory(self) -> Path:
        """Where the run lies."""
        return Path(self.config.output_dir) / self.config.profile / self.name / f"seed_{self.config.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings as plain data."""
        return plain_settings(self.config)

    @property
    def command(self) -> str:
        """The shortest command line that makes this run."""
        return " ".join([typed(), *sources().words, *map(in_shell, _short_overrides(self))])

    @property
    def sweep_command(self) -> str:
        """The command line that makes this run after the teacher that it needs."""
        return " ".join([typed(), "-m", *sources().words, *map(in_shell, _short_overrides(self))])


def specify(config: ExperimentConfig) -> RunSpec:
    """Finds out which run the settings mean."""
    changes = _changes(config)
    shown = dict(changes)
    if config.agent.name != SACConfig().name:
        shown["agent"] = config.agent.name
    if config.transfer.teacher is not None:
        shown["transfer.teacher"] = _teacher_mark(config.transfer.teacher)
    kind = (config.transfer.name, config.freeze, shown)
    role = {config.pair.source: SOURCE, config.pair.target: TARGET}.get(config.env.name)
    kin = run_name(config.env.name, config.transfer.name, config.freeze, without_kind(shown))
    return RunSpec(config, changes, run_name(config.env.name, *kind), cell_of(role, *kind), kin)


def teacher_spec(config: ExperimentConfig) -> RunSpec:
    """The run that teaches a student: its source environment, profile, length, network sizes, and seed or its turn.

    It takes all its steps even where its student stops, or its profile lets runs stop, at the threshold: what a student
    learns from must not depend on when its teacher happened to be good.
    """
    turns = config.transfer.teacher_seeds
    seed = config.seed if turns is None else (config.seed - 1) % turns + 1
    overrides = [*env_overrides(config.env.source), f"profile={config.profile}", f"seed={seed}"]
    flat = flatten(asdict(config))
    overrides += [f"{key}={as_override(flat[key])}" for key in TEACHER_KEYS]
    overrides += [f"stop={HORIZON}", "stop_after=null", f"output_dir={as_override(config.output_dir)}"]
    try:
        return specify(parse(compose_config(overrides)))
    except ConfigError as error:
        raise ConfigError(f"env.source={config.env.source}: no such teacher environment ({error})") from error


def _changes(config: ExperimentConfig) -> dict[str, Any]:
    base = baseline(config.profile, config.env.name, config.env.id, config.agent.name, config.transfer.name)
    now = flatten(asdict(config))
    changed = {}
    for key in sorted(set(base) | set(now)):
        if is_neutral(key) or key in _NAMED_KEYS or base.get(key) == now.get(key):
            continue
        if key.startswith(_RULES):
            # As transfer.name=hidden would have it: the method without its rules.
            raise ConfigError(
                f"{key}={now.get(key)}: no setting, but what conf/transfer/{config.transfer.name}.yaml says of the "
                f"method; type transfer={config.transfer.name}"
            )
        changed[key] = now.get(key)
    return changed


def _short_overrides(spec: RunSpec) -> list[str]:
    config = spec.config
    default = parse(compose_config([f"profile={config.profile}"]))
    said = [f"profile={config.profile}"] if config.profile != "paper" else []
    if config.env.name != default.env.name:
        said += env_overrides(config.env.name, config.env.id)
    if config.agent.name != default.agent.name:
        said.append(f"agent={config.agent.name}")
    if config.transfer.name != default.transfer.name:
        said.append(f"transfer={config.transfer.name}")
    if config.freeze:
        said.append("freeze=true")
    said += [f"{key}={as_override(value)}" for key, value in spec.changes.items()]
    if config.transfer.teacher is not None:
        said.append(f"transfer.teacher={as_override(config.transfer.teacher)}")
    if config.transfer.teacher_seeds is not None:
        said.append(f"transfer.teacher_seeds={config.transfer.teacher_seeds}")
    said.append(f"seed={config.seed}")
    if config.output_dir != default.output_dir:
        said.append(f"output_dir={as_override(config.output_dir)}")
    return said


def in_shell(word: str) -> str:
    """A word of the command line as it is typed: in quotes if it holds braces, which a shell would take apart."""
    return shlex.quote(word) if "{" in word else word


def _teacher_mark(path: str) -> str:
    given = Path(path)
    given = given.resolve() if given.is_symlink() else given
    beside = given / DESCRIPTION_FILE if given.is_dir() else given.with_suffix(".json")
    with suppress(DamagedError):
        said = read_mapping(beside, most=DESCRIPTIONS).get("sha256")
        # It becomes a part of the run's name, and so of a path.
        if isinstance(said, str) and _SHA256.fullmatch(said):
            return said[:8]
    # Loading the teacher will say what is wrong with it; until then its path identifies it.
    return digest(path)
