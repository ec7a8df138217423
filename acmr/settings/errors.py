"""Turns Hydra's errors into one line each: what was given, what is allowed, what to type instead.

Hydra tells its errors apart by their texts only, so this goes by texts, too; tests/test_config.py has one of each.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from difflib import get_close_matches
from shlex import quote

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from acmr.command import typed
from acmr.config import ConfigError, ExperimentConfig
from acmr.names import terminal
from acmr.settings.compose import groups, launchers, options, setting_keys, sources, unknown_key
from acmr.settings.files import place_of_key, place_of_text, wrong_kind
from acmr.settings.validate import A_WRAPPER, WRAPPERS
from acmr.text import flatten, message, without_userinfo

#: Settings whose entries are free; Hydra adds to them with a plus sign only.
FREE_KEYS = ("env.kwargs", "agent.options", "transfer.options", "tracking.options")
#: What a wrong command line or a wrong file of ``conf/`` raises.
USER_ERRORS = (ConfigError, HydraException, OmegaConfBaseException, YAMLError)


def explain(error: BaseException) -> str:
    """One line for the user.

    Args:
        error: One of :data:`USER_ERRORS`.
    """
    return without_userinfo(terminal(_explained(error)))


def _explained(error: BaseException) -> str:
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _unknown_option(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not of the form key=value; quote values with special characters: 'key=\"value\"'"
    if isinstance(error, YAMLError):
        return f"not readable as YAML: {message(error)}"
    text = str(error)
    if isinstance(error, ConfigCompositionException):
        if match := re.match(r"In '([^']+)': \w+ raised while composing config:\n(.*?)(?:\n *full_key: (.*)|$)", text):
            return _wrong_file(match[1], match[2], match[3] or "")
        if match := re.match(r"In '([^']+)': Could not override '([^'@]+)", text):
            return _wrong_choice(match[1], match[2])
        if match := re.match(r"(?:Ambiguous value for argument|Sweep parameters) '([^']+)'", text):
            return f"{match[1]}: several values are several runs; add -m, as in {typed()} -m {quote(match[1])}"
        if match := re.match(r"(?:Could not override|Key) '([^']+)'", text):
            key = match[1].split("@")[0]
            if key in FREE_KEYS:
                return f"{key}: entries are added one by one; type +{key}.NAME=VALUE"
            if key.startswith(tuple(f"{free}." for free in FREE_KEYS)):
                return f"{key}: there is no such entry yet; type +{key}=VALUE to add it"
            return unknown_key(key)
        if match := re.match(r"Could not append to config. An item is already at '([^']+)'", text):
            return f"+{match[1]}: this setting is there already; type {match[1]}=VALUE"
        if match := re.match(r"Error merging override (.*)", text):
            return _wrong_type(match[1], error)
    if not text.strip() and error.__cause__ is not None:
        # Hydra says nothing of what it found in a value.
        return _explained(error.__cause__)
    if text.startswith("Error in call to target") and error.__cause__ is not None:
        # A sweeper or a launcher that is not ours; Hydra's own line says which class it is of, not what is wrong.
        key = text.rpartition("full_key: ")[2].strip() if "full_key: " in text else "hydra"
        return f"{key}: {_explained(error.__cause__)}"
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return _wrong_value(str(error.full_key), text)
    return text.strip().splitlines()[0] if text.strip() else type(error).__name__


def check_booleans(overrides: Sequence[str]) -> None:
    """Refuses ``force=2`` and the like, which would pass as true.

    Raises:
        ConfigError: Naming the setting and what to type.
    """
    flat = flatten(asdict(ExperimentConfig()))
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if isinstance(flat.get(key), bool) and key not in groups() and not override.is_sweep_override():
            value = override.value()
            if not isinstance(value, bool) and str(value).lower() not in ("true", "false"):
                raise ConfigError(f"{key}={value}: must be true or false")


def _unknown_option(error: MissingConfigException) -> str:
    group, _, option = str(error.missing_cfg_file).removeprefix("/").rpartition("/")
    if not group:
        return f"{option}: no such config group; there are {', '.join(groups())}"
    # Hydra lists none where it is a file that names what does not exist.
    allowed = launchers() if group == "hydra/launcher" else sorted(error.options or options(group))
    near = get_close_matches(option, allowed, n=1)
    hint = f"; did you mean {group}={near[0]}?" if near else ""
    by = re.match(r"In '([^']+)': Could not (?:load|find)", str(error))
    ours = by is not None and by[1] != sources().name and not by[1].startswith("hydra/")
    place, file = sources().file(by[1]) if by and ours else ("", None)
    before, behind = f"{place}: " if place else "", place_of_text(file, option)
    if not allowed:
        near = get_close_matches(group, groups(), n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{before}{group}={option}: there is no group {group}, only {', '.join(groups())}{hint}{behind}"
    return f"{before}{group}={option}: must be one of {', '.join(allowed)}{hint}{behind}"


def _wrong_file(file: str, reason: str, key: str) -> str:
    """One line on a settings file that does not fit the settings' types."""
    place, path = sources().file(file)
    if re.match(r"Key '.*' (is )?not in", reason):
        return f"{place}: {unknown_key(key)}{place_of_key(path, key)}"
    if not re.search(r"Value '.*' of type", reason):
        # Of a value in the place of a group, or the other way round, OmegaConf does not say where.
        known = asdict(ExperimentConfig())
        inside = "" if file.startswith(("experiment/", "profile/", "matrix/")) else file.rpartition("/")[0]
        if what := wrong_kind(path, known, inside):
            return f"{place}: {what}"
    return f"{place}: {f'{key}: ' if key else ''}{reason}{place_of_key(path, key)}"


def _wrong_choice(file: str, group: str) -> str:
    """One line on a settings file that overrides a choice which is not made before it."""
    place, path = sources().file(file)
    behind = place_of_text(path, group)
    if group not in groups():
        near = get_close_matches(group, groups(), n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{place}: override {group}: there is no group {group}, only {', '.join(groups())}{hint}{behind}"
    return f"{place}: override {group}: only experiments, profiles and matrices choose anew; write - NAME{behind}"


def _wrong_value(key: str, reason: str) -> str:
    """One line on a value that cannot be worked out, and the file that it stands in, if that can be found."""
    line = reason.strip().splitlines()[0]
    group = key.partition(".")[0]
    for option in options(group) if group in groups() else []:
        place, path = sources().file(f"{group}/{option}")
        missing = re.search(r"Interpolation key '([^']+)'", line)
        if missing and (behind := place_of_text(path, f"${{{missing[1]}}}")):
            return f"{place}: {key}: {line}{behind}"
    return f"{key}: {line}"


def _wrong_type(override: str, error: BaseException) -> str:
    key, _, value = override.lstrip("+").partition("=")
    cause = str(error.__cause__ or "").strip().splitlines()
    if key == WRAPPERS:
        return f"{key}={value}: a list of wrappers is needed, each with its name and its arguments, as in {A_WRAPPER}"
    reason = cause[0] if cause else "is of another type"
    hint = ""
    if key in setting_keys() and re.fullmatch(r"[0-9.]+e[0-9]+|[0-9]+\.0*", value) and float(value).is_integer():
        hint = f"; type {key}={int(float(value))}"
    return f"{key}={value}: {reason}{hint}"
