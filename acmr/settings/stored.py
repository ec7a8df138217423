"""Settings that a file of a run holds, which may come from anybody: typed like our own, and never a choice of code.

What is read here is data. Code that it names is run only where the user has chosen that code, too: on the command line,
or in a file of ``conf/env``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from acmr.config import ConfigError, EnvConfig, ExperimentConfig
from acmr.settings.compose import environment_config, options
from acmr.settings.validate import check_environment

#: How a reference to another setting, or to a variable of the reader's, begins; no run stores one.
_REFERENCE = "${"
#: What a stored environment may ask for unasked: frames of a step, steps of an episode, any other whole number. A step
#: of a thousand million frames cannot even be interrupted.
_MOST_FRAMES, _MOST_STEPS, _MOST = 1_000, 1_000_000, 1_000_000


def stored_config(settings: object) -> ExperimentConfig:
    """Types the content of a run's ``config.yaml``, whichever version of this program wrote it.

    A setting that it lacks has the schema's default; one that the schema knows no more is left out.

    Raises:
        ConfigError: If these are no settings.
    """
    return _typed(ExperimentConfig, _known(ExperimentConfig(), _mapping(settings)))


def stored_environment(settings: object, place: object, remedy: str, trust: bool = False) -> EnvConfig:
    """The environment that a run's stored settings describe.

    Args:
        settings: All of its settings.
        place: The file that they stand in, for messages.
        remedy: What to type where that would run code of the file's choice, as ``type --trust``.
        trust: Whether the user has typed that.

    Raises:
        ConfigError: If there is none, or if it would run code, read files or take a time that the user has not chosen.
    """
    try:
        stored = _mapping(_mapping(settings).get("env"))
        # A setting that is not known did something to the environment that cannot be done any more.
        if unknown := stored.keys() - {entry.name for entry in fields(EnvConfig)}:
            raise ConfigError(f"there is no setting env.{sorted(map(str, unknown))[0]}")
        config = _typed(EnvConfig, stored)
        _check_names(config)
        check_environment(config)
    except ConfigError as error:
        raise ConfigError(f"{place}: damaged, its part env cannot be used ({error})") from error
    chosen = list(_code(config))
    if chosen and not trust and not _is_in_conf(config):
        raise ConfigError(
            f"{place}: {', '.join(chosen)} would run code or read files that this file chooses, not you; "
            f"if you trust it, {remedy}"
        )
    if (long := list(_endless(config))) and not trust and not _is_in_conf(config, limit=True):
        raise ConfigError(
            f"{place}: {', '.join(long)} would keep this machine busy for as long as this file chooses, not you; "
            f"if you trust it, {remedy}"
        )
    return config


def _check_names(config: EnvConfig) -> None:
    # OmegaConf takes lists within lists.
    for key in ("remove_bodies", "drop_sensors", "drop_actuators"):
        kinds = (str,) if key == "remove_bodies" else (str, int)
        if not all(type(name) in kinds for name in getattr(config, key)):
            raise ConfigError(f"env.{key}: no list of names")


def _code(config: EnvConfig) -> Iterator[str]:
    """What in an environment's settings may name code or a file."""
    if ":" in config.id:
        yield f"env.id={config.id}"
    # Whatever the key is called: a text may be a model file, a wrapper, a module, an environment within this one.
    yield from (f"env.kwargs.{key}" for key, value in config.kwargs.items() if not _is_number(value))
    for place, wrapper in enumerate(config.wrappers):
        if ":" in wrapper["name"]:
            yield f"env.wrappers[{place}].name={wrapper['name']}"
        texts = (key for key, value in wrapper.items() if key != "name" and not _is_number(value))
        yield from (f"env.wrappers[{place}].{key}" for key in texts)


def _is_number(value: object) -> bool:
    """Whether a value is made of numbers and truth values only."""
    if isinstance(value, dict):
        return all(map(_is_number, value.values()))
    return all(map(_is_number, value)) if isinstance(value, list) else isinstance(value, int | float | None)


def _endless(config: EnvConfig) -> Iterator[str]:
    """What in an environment's settings may make an evaluation that never ends."""
    if (config.max_episode_steps or 0) > _MOST_STEPS:
        yield f"env.max_episode_steps={config.max_episode_steps}"
    for key, value in config.kwargs.items():
        most = _MOST_FRAMES if key == "frame_skip" else _MOST
        if any(abs(number) > most for number in _whole_numbers(value)):
            yield f"env.kwargs.{key}={value}"
    # Observations that are stacked, actions that are repeated.
    for place, wrapper in enumerate(config.wrappers):
        if any(abs(number) > _MOST_FRAMES for value in wrapper.values() for number in _whole_numbers(value)):
            yield f"env.wrappers[{place}]={wrapper}"


def _whole_numbers(value: object) -> Iterator[int]:
    if isinstance(value, int):
        yield value
    for entry in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _whole_numbers(entry)


def _is_in_conf(config: EnvConfig, limit: bool = False) -> bool:
    """Whether the user's own file for this environment names the same."""
    if config.name not in options("env"):
        return False
    try:
        own = environment_config(config.name)
    except ConfigError:
        return False
    limits = (own.max_episode_steps, config.max_episode_steps) if limit else (None, None)
    theirs = (config.id, config.kwargs, config.wrappers, limits[1])
    return (own.id, own.kwargs, own.wrappers, limits[0]) == theirs


def _mapping(settings: object) -> Mapping[Any, Any]:
    if not isinstance(settings, Mapping):
        raise ConfigError("no settings")
    return settings


def _typed(schema: type[Any], settings: Mapping[Any, Any]) -> Any:
    try:
        _refuse_references(settings)
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), settings))
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).strip().splitlines()[0]) from error
    except ConfigError:
        raise
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        raise ConfigError("no settings of this project") from error


def _refuse_references(value: object) -> None:
    if isinstance(value, str) and _REFERENCE in value:
        # Worked out here, it would tell others what stands in the reader's environment.
        raise ConfigError("it refers to other settings or variables, which no run stores")
    if isinstance(value, Mapping):
        for entry in (*value, *value.values()):
            _refuse_references(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            _refuse_references(entry)


def _known(schema: Any, settings: Mapping[Any, Any]) -> dict[str, Any]:
    known = {}
    for entry in fields(schema):
        if entry.name in settings:
            value, default = settings[entry.name], getattr(schema, entry.name)
            nested = is_dataclass(default) and isinstance(value, Mapping)
            known[entry.name] = _known(default, value) if nested else value
    return known
