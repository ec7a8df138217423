"""Hydra's errors in one line each: what was given, what is allowed, what to type instead."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from acmr.config import ConfigError, ExperimentConfig, flatten
from acmr.settings.compose import as_override, groups, launchers, setting_keys, unknown_key

#: Settings whose entries are free; Hydra adds to them with a plus sign only.
FREE_KEYS = ("env.kwargs", "transfer.options")
#: Settings that are paths. Names of runs hold equal signs, which Hydra's grammar wants quoted.
PATH_KEYS = ("transfer.teacher", "output_dir", "tracking.dir")
USER_ERRORS = (ConfigError, HydraException, OmegaConfBaseException)


def explain(error: BaseException) -> str:
    """One line for the user.

    Args:
        error: One of :data:`USER_ERRORS`.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _unknown_option(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not of the form key=value; quote values with special characters: 'key=\"value\"'"
    text = str(error)
    if isinstance(error, ConfigCompositionException):
        if match := re.match(r"(?:Could not override|Could not append.*|Key) '([^']+)'", text):
            key = match[1].split("@")[0]
            if key in FREE_KEYS:
                return f"{key}: entries are added one by one; type +{key}.NAME=VALUE"
            return unknown_key(key)
        if match := re.match(r"Error merging override (.*)", text):
            return _wrong_type(match[1], error)
    return text.strip().splitlines()[0] if text.strip() else type(error).__name__


def quote_paths(arguments: Sequence[str]) -> list[str]:
    """The command line with every path quoted as Hydra's grammar needs it."""
    quoted = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key.lstrip("+") in PATH_KEYS and "=" in value and not value.startswith(("'", '"')):
            argument = f"{key}={as_override(value)}"
        quoted.append(argument)
    return quoted


def check_booleans(overrides: Sequence[str]) -> None:
    """Refuses ``freeze=2`` and the like, which would pass as true.

    Raises:
        ConfigError: Naming the setting and what to type.
    """
    from dataclasses import asdict

    flat = flatten(asdict(ExperimentConfig()))
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if isinstance(flat.get(key), bool) and not override.is_sweep_override():
            value = override.value()
            if not isinstance(value, bool) and str(value).lower() not in ("true", "false"):
                raise ConfigError(f"{key}={value}: must be true or false")


def _unknown_option(error: MissingConfigException) -> str:
    group, _, option = str(error.missing_cfg_file).removeprefix("/").rpartition("/")
    options = launchers() if group == "hydra/launcher" else sorted(error.options or [])
    if not group:
        return f"{option}: no such config group; there are {', '.join(groups())}"
    near = get_close_matches(option, options, n=1)
    hint = f"; did you mean {group}={near[0]}?" if near else ""
    return f"{group}={option}: must be one of {', '.join(options)}{hint}"


def _wrong_type(override: str, error: BaseException) -> str:
    key, _, value = override.lstrip("+").partition("=")
    cause = str(error.__cause__ or "").strip().splitlines()
    reason = cause[0] if cause else "is of another type"
    hint = ""
    if key in setting_keys() and re.fullmatch(r"[0-9.]+e[0-9]+|[0-9]+\.0*", value) and float(value).is_integer():
        hint = f"; type {key}={int(float(value))}"
    return f"{key}={value}: {reason}{hint}"
