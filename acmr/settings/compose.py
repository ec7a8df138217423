"""Composes settings from ``conf/`` and a command line with Hydra, and types and validates them.

The border to Hydra: what leaves here are plain dataclasses.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, fields, is_dataclass
from difflib import get_close_matches
from functools import lru_cache, reduce
from pathlib import Path
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue

from acmr.command import typed
from acmr.config import ConfigError, EnvConfig, ExperimentConfig, TransferRules, schema_defaults
from acmr.settings.files import read_files_with_care
from acmr.settings.sources import SWEEPS, Sources
from acmr.settings.validate import validate
from acmr.settings.variables import refuse_variables
from acmr.text import flatten, holds_userinfo

_PACKAGE = Path(__file__).resolve().parents[1]
#: The project's settings files: within the package where it is installed, beside it in a checkout.
CONFIG_FOLDER = next(filter(Path.is_dir, (_PACKAGE / "conf", _PACKAGE.parent / "conf")), _PACKAGE / "conf")
#: Settings that are paths.
PATH_KEYS = ("transfer.teacher", "output_dir", "tracking.dir")
#: What stands for no choice of ``freeze`` in ``conf/config.yaml``.
_UNSAID = "unsaid"
_BOOLEAN = re.compile(r"(?<!['\"\w])(?:true|false)(?!['\"\w])", re.IGNORECASE)
_given: Sources | None = None


def look_in(sources: Sources) -> None:
    """Composes settings of the files in these places from now on."""
    global _given
    _given = sources


def sources() -> Sources:
    """Where settings files are: as the command line says, else in ``conf`` and ``sweeps``."""
    return _given or Sources((f"file://{CONFIG_FOLDER}", SWEEPS))


def register_schema() -> None:
    """Tells Hydra the types of all settings, and how to read their files."""
    read_files_with_care()
    ConfigStore.instance().store(name="schema", node=ExperimentConfig)


def parse(cfg: DictConfig) -> ExperimentConfig:
    """Types and validates a composed config.

    Raises:
        ConfigError: If a value is missing, unknown or not allowed.
    """
    try:
        _refuse_unknown(cfg)
        refuse_variables(cfg, PATH_KEYS)
        config = OmegaConf.to_object(cfg)
    except (MissingMandatoryValue, InterpolationToMissingValueError) as error:
        # The one knows its own place; the other says the place that it leads to.
        own = isinstance(error, MissingMandatoryValue) and error.full_key
        key = own or str(error).strip().splitlines()[0].rpartition(": ")[2]
        example = " (for example env.id=Hopper-v5)" if key == "env.id" else ""
        raise ConfigError(f"{key} has no value: type {key}=VALUE{example}") from error
    if not isinstance(config, ExperimentConfig):
        raise ConfigError(
            f"{sources().name}.yaml: the first of its defaults must be schema, as in conf/ of the project"
        )
    _expand_paths(config)
    validate(config)
    return config


def _expand_paths(config: ExperimentConfig) -> None:
    for key in PATH_KEYS:
        *groups, leaf = key.split(".")
        part = reduce(getattr, groups, config)
        if (value := getattr(part, leaf)) is None:
            continue
        if not value.strip():
            raise ConfigError(f"{key}=: a path is needed, as in {key}={'runs' if key == 'output_dir' else 'FOLDER'}")
        # Each would become a folder of that name, in which nobody looks for runs. One with a password in it is refused
        # below, in a line that does not repeat it.
        if "://" in value and not holds_userinfo(value):
            raise ConfigError(f"{key}={value}: is an address; type a folder of this machine, as in {key}=FOLDER")
        if re.match(r"\$[\w({]", value):
            raise ConfigError(
                f"{key}={value}: is not looked up here; let the shell do it, without single quotes around it, "
                f"or type ./{value} for a folder of that name"
            )
        # A shell does so at the beginning of a word only, not behind an equal sign.
        path = os.path.expanduser(value)
        if path.startswith("~"):
            raise ConfigError(f"{key}={value}: there is no such user; type ./{value} for a folder of that name")
        setattr(part, leaf, path)


def compose_config(overrides: Sequence[str]) -> DictConfig:
    """Composes ``conf/`` with overrides, within a running Hydra application or outside one.

    Files are read once for each choice of groups; values are set on a copy, as Hydra itself does it.
    """
    # Hydra reads and merges all files anew for every composition, 0.1 s of processor time. A sweep composes every run
    # several times (settings, baseline, teacher, command line), and nearly always from the same few choices of groups.
    parsed = OverridesParser.create().parse_overrides([quote_choice(override) for override in overrides])
    for entry in parsed:
        if _chooses(entry) and not entry.is_sweep_override() and isinstance(entry.value(), int | float | None):
            raise ConfigError(f"{entry.input_line}: must be one of {', '.join(options(entry.key_or_group))}")
    cfg = deepcopy(_composed(tuple(str(entry.input_line) for entry in parsed if _chooses(entry)), sources()))
    # Private, read in hydra-core 1.3.8: there is no public way to set values on a config that is composed already.
    # tests/test_hydra.py fails where it is gone, tests/test_settings_files.py where it makes other configs than Hydra.
    ConfigLoaderImpl._apply_overrides_to_config([entry for entry in parsed if not _chooses(entry)], cfg)
    return cfg


def quote_choice(override: str) -> str:
    """``freeze='true'`` for ``freeze=true``: of a group Hydra takes names only, and reads a bare true as none."""
    key, equal, value = override.partition("=")
    if _BOOLEAN.search(value) and key in groups() and {"true", "false"} <= set(options(key)):
        return f"{key}{equal}{_BOOLEAN.sub(lambda match: repr(match[0].lower()), value)}"
    return override


def check_choices(choices: Mapping[str, object]) -> None:
    """Refuses a choice of ``freeze`` that is not there.

    Hydra passes over it: the group is optional, so that experiments may say ``freeze: true`` where nothing is chosen.

    Args:
        choices: Of all groups, as Hydra has them.

    Raises:
        ConfigError: Naming the options.
    """
    chosen, allowed = choices.get("freeze", _UNSAID), options("freeze")
    if chosen not in (_UNSAID, *allowed):
        raise ConfigError(f"freeze={chosen}: must be one of {', '.join(allowed)}")


def _chooses(override: Override) -> bool:
    """Whether an override decides which files are read; ``env.id=X`` does not, ``env=ant`` does."""
    if override.is_sweep_override() or override.is_hydra_override():
        return True
    return override.key_or_group in groups() and not isinstance(override.value(), dict)


@lru_cache(maxsize=256)
def _composed(choices: tuple[str, ...], places: Sources) -> DictConfig:
    # The places are part of the key: a training of a sweep reads the copies that the sweep made (sweeps/job.py).
    register_schema()
    cfg, chosen = places.compose(list(choices))
    check_choices(chosen)
    return cfg


def _refuse_unknown(node: DictConfig, prefix: str = "") -> None:
    # A key added with "+" passes Hydra's own check, and would be dropped in silence.
    typed = OmegaConf.get_type(node)
    allowed = {known.name for known in fields(typed)} if is_dataclass(typed) else {str(key) for key in node}
    for entry in node:
        key = str(entry)
        if key not in allowed:
            raise ConfigError(unknown_key(f"{prefix}{key}"))
        if not OmegaConf.is_missing(node, key) and isinstance(node[key], DictConfig):
            _refuse_unknown(node[key], f"{prefix}{key}.")


def setting_keys() -> list[str]:
    """Every setting there is, as ``group.key``."""
    return sorted(schema_defaults())


def unknown_key(key: str) -> str:
    """One line on a key that does not exist, with what was probably meant."""
    keys = [*setting_keys(), *(f"transfer.rules.{rule.name}" for rule in fields(TransferRules))]
    leaf = key.split(".")[-1]
    near = [known for known in keys if known.split(".")[-1] == leaf]
    near = near or get_close_matches(key, dict.fromkeys([*keys, *groups()]), n=3, cutoff=0.6)
    near = near or [known for known in keys if get_close_matches(leaf, [known.split(".")[-1]], cutoff=0.75)][:3]
    section = key.rpartition(".")[0]
    beside = [known for known in keys if section and known.rpartition(".")[0] == section]
    others = f"there are {', '.join(beside)}" if beside else f"{typed()} --help lists all of them"
    hint = f"did you mean {' or '.join(near)}?" if near else others
    return f"{key}: no such setting; {hint}"


def groups() -> list[str]:
    """The config groups, such as ``env`` and ``transfer``."""
    return sources().groups()


def options(group: str) -> list[str]:
    """What may be chosen of a config group: the names of its files."""
    return sources().options(group)


def launchers() -> list[str]:
    """What ``hydra/launcher`` may be; Hydra has more, but those cannot run a sweep of teachers and students."""
    return options("hydra/launcher")


def baseline(profile: str, env: str, env_id: str, agent: str, transfer: str) -> dict[str, Any]:
    """The settings, flat, that a profile has for these choices where nothing else is said.

    With the rules of the method.
    """
    return _baseline(profile, env, env_id, agent, transfer, sources())


@lru_cache(maxsize=256)
def _baseline(profile: str, env: str, env_id: str, agent: str, transfer: str, places: Sources) -> dict[str, Any]:
    overrides = [f"profile={profile}", f"agent={agent}", f"transfer={transfer}", *env_overrides(env, env_id)]
    return flatten(asdict(parse(compose_config(overrides))))


def env_overrides(name: str, env_id: str | None = None) -> list[str]:
    """What to type for an environment: its name in the group ``env``, or a Gymnasium id."""
    if name in options("env") and name != "gym":
        return [f"env={name}"]
    return ["env=gym", f"env.id={as_override(env_id or name)}"]


def as_override(value: object) -> str:
    """A value in Hydra's grammar, quoted where it has to be."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ",".join(as_override(entry) for entry in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{as_override(key)}:{as_override(entry)}" for key, entry in value.items()) + "}"
    text = str(value)
    if re.fullmatch(r"[A-Za-z_./-][A-Za-z0-9_./+-]*", text):
        return text
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def environment_config(name: str) -> EnvConfig:
    """The settings of an environment by its name in ``conf/env`` or its Gymnasium id."""
    return parse(compose_config(env_overrides(name))).env
