"""The command line of ``run.py`` in Hydra's words."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from shlex import quote

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from acmr.command import typed
from acmr.config import ConfigError
from acmr.settings.compose import (
    CONFIG_FOLDER,
    PATH_KEYS,
    as_override,
    check_choices,
    groups,
    launchers,
    look_in,
    options,
    quote_choice,
    setting_keys,
    sources,
)
from acmr.settings.sources import SWEEPS, Sources
from acmr.settings.validate import NO_USERINFO
from acmr.text import holds_userinfo, without_userinfo

#: Words of a sweep, and where Hydra keeps them: they are no settings of a run.
SWEEP_WORDS = {word: f"hydra.sweeper.{word}" for word in ("plan", "retries", "workers")}
#: Further folders of settings files.
SEARCH_PATH = "hydra.searchpath"
#: Names that the student has for what the teacher calls otherwise.
RENAME = "transfer.rename"
#: What works something out, from a variable for instance, which an answer would repeat.
_CALL = re.compile(r"\$\{[^}]*:")
#: A variable as a shell writes it, or as OmegaConf once did.
_SHELLS = re.compile(r"\$\{(?:env:)?([A-Za-z_]\w*)[^}.]*\}")
#: Characters of one argument: Hydra's parser takes a minute over more, and time that grows faster than their number.
LONGEST_ARGUMENT = 16_384
#: What may be asked of a shell's completion.
_COMPLETION = ("install", "uninstall", "query")
#: What Hydra reads as another thing than a name.
_NO_NAME = re.compile(r"null|true|false|[-+]?[0-9.]+", re.IGNORECASE)


def hydra_arguments(given: Sequence[str]) -> list[str]:
    """The command line as Hydra is to read it.

    Raises:
        ConfigError: If there are options that Hydra does not have, or a folder is not there.
    """
    for argument in given:
        # Here, for whatever is wrong with it would be said with it.
        if holds_userinfo(argument):
            raise ConfigError(f"{without_userinfo(argument.partition('=')[0])}: {NO_USERINFO}")
        if len(argument) > LONGEST_ARGUMENT:
            key = argument.partition("=")[0][:60]
            raise ConfigError(f"{key}: {len(argument):,} characters, at most {LONGEST_ARGUMENT:,} are taken")
    chosen = _check_options(given)
    if chosen.shell_completion:
        # The words that stand there already, which Hydra composes to know what may follow.
        os.environ["COMP_LINE"] = " ".join(map(quote_choice, os.environ.get("COMP_LINE", "").split(" ")))
    searched = [place for argument in given if _is_search_path(argument) for place in _searched(argument)]
    folder = [f"file://{Path(chosen.config_dir).absolute()}"] if chosen.config_dir else []
    main = Path(chosen.config_path).absolute() if chosen.config_path else CONFIG_FOLDER
    # Until Hydra says what it has found: so that what is wrong with a file can be said with its place.
    look_in(Sources((f"file://{main}", *folder, *dict.fromkeys([*searched, SWEEPS])), chosen.config_name or "config"))
    arguments = [_in_hydras_words(_absolute(argument, chosen.config_path)) for argument in given]
    several = any(argument.partition("=")[0] in SWEEP_WORDS for argument in given)
    return ["--multirun", *arguments] if several else arguments


def use_folder(folder: str | Path | None) -> None:
    """Finds settings in a folder of the user's, too: ``--config-dir`` for programs that Hydra does not start.

    Raises:
        ConfigError: If there is no such folder.
    """
    if folder is not None:
        words = ("--config-dir", str(folder))
        hydra_arguments(words)
        # Commands that messages print have to find the same files.
        look_in(replace(sources(), words=tuple(map(quote, words))))


def _absolute(argument: str, config_path: str | None) -> str:
    """An option that names the folder that everything begins in; Hydra would look for it beside its own caller."""
    if config_path and argument in (config_path, f"--config-path={config_path}"):
        return argument.removesuffix(config_path) + str(Path(config_path).absolute())
    return argument


def _in_hydras_words(argument: str) -> str:
    key, equal, value = argument.partition("=")
    if key in SWEEP_WORDS:
        return f"{SWEEP_WORDS[key]}{equal}{value}"
    if key.lstrip("+") in PATH_KEYS:
        _refuse_shells_variable(key, value)
        return _quoted(key, value)
    if key.lstrip("+") == RENAME and value.startswith("{"):
        return _renamed(argument)
    if _is_search_path(argument):
        # Added to the places that the project needs, where Hydra would put others in their place.
        return f"{SEARCH_PATH}={as_override([*dict.fromkeys([*_searched(argument), SWEEPS])])}"
    if _CALL.search(value) and key.lstrip("+") in groups():
        raise ConfigError(f"{key}={value}: is chosen by its name; type one of {', '.join(options(key.lstrip('+')))}")
    if key.lstrip("+").startswith("hydra/") and _NO_NAME.fullmatch(value):
        known = f"one of {', '.join(launchers())}" if key.endswith("/launcher") else "a name"
        raise ConfigError(f"{key}={value}: must be {known}, or left out")
    argument = quote_choice(argument)
    value = argument.partition("=")[2]
    for chosen in value.replace("'", "").split(",") if key in groups() else []:
        if chosen.isidentifier():
            check_choices({key: chosen})
    if _NO_NAME.fullmatch(value) and key in groups():
        raise ConfigError(f"{key}={value}: must be one of {', '.join(options(key))}, or left out")
    return argument


def _quoted(key: str, value: str) -> str:
    argument = f"{key}={value}"
    if value.startswith(("'", '"')):
        return argument
    try:
        OverridesParser.create().parse_overrides([argument])
    except OverrideParseException:
        # An equal sign, as in names of runs, or a letter that is not English.
        return f"{key}={as_override(value)}"
    return argument


def _refuse_shells_variable(key: str, value: str) -> None:
    known = {setting.partition(".")[0] for setting in setting_keys()}
    for match in _SHELLS.finditer(value):
        if match[1] not in known and not match[0].startswith("${oc."):
            home = " (your home is ~, too)" if match[1] == "HOME" else ""
            raise ConfigError(
                f"{key}={value}: {match[0]} is no setting; leave the single quotes out, so that the shell looks it up, "
                f"or type ${{oc.env:{match[1]}}}{home}"
            )


def _renamed(argument: str) -> str:
    """``transfer.rename={old: new}`` as the list that the setting is, for Hydra adds no entries to a typed mapping."""
    try:
        pairs = OverridesParser.create().parse_overrides([argument])[0].value()
    except OverrideParseException as error:
        raise ConfigError(f"{argument}: names are given as in '{RENAME}={{old: new}}'") from error
    assert isinstance(pairs, dict)
    return f"{RENAME}={as_override([f'{old}:{new}' for old, new in pairs.items()])}"


def _is_search_path(argument: str) -> bool:
    return argument.partition("=")[0].lstrip("+") == SEARCH_PATH


def _searched(argument: str) -> list[str]:
    value = OverridesParser.create().parse_overrides([argument])[0].value()
    return [_place(str(place)) for place in (value if isinstance(value, list) else [value])]


def _place(place: str) -> str:
    scheme, separator, path = place.rpartition("://")
    if scheme == "pkg" and find_spec(path.replace("/", ".").partition(".")[0]) is None:
        raise ConfigError(f"{SEARCH_PATH}: {place}: there is no such package")
    if separator and scheme not in ("file", "pkg"):
        raise ConfigError(f"{SEARCH_PATH}: {place}: a folder or a package is needed, as in FOLDER or pkg://PACKAGE")
    if scheme == "pkg":
        return place
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise ConfigError(f"{SEARCH_PATH}: {path}: there is no such folder")
    # Jobs of a sweep may begin elsewhere.
    return f"file://{folder.absolute()}"


def _check_options(given: Sequence[str]) -> argparse.Namespace:
    if any(argument == "-f" or argument.startswith("--f=") for argument in given):
        # What Jupyter tells its kernel; a cell that calls run.main() finds it in sys.argv.
        raise ConfigError(
            f"{' '.join(given)}: these are the words of a notebook's kernel; type %run run.py seed=1 in a cell, "
            f"or !{typed()} seed=1"
        )
    parser = get_args_parser()
    # Else it would print its usage.
    parser.exit_on_error = False
    try:
        known, unknown = parser.parse_known_args(list(given))
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error}; {typed()} --hydra-help lists the options") from error
    if known.config_dir is not None and not Path(known.config_dir).is_dir():
        raise ConfigError(f"--config-dir {known.config_dir}: there is no such folder")
    if known.resolve and not (known.cfg or known.help):
        raise ConfigError(f"--resolve: goes with --cfg, as in {typed()} --cfg job --resolve")
    if known.shell_completion and sum(word.partition("=")[0] in _COMPLETION for word in known.overrides) != 1:
        raise ConfigError(f'--shell-completion: type eval "$({typed()} -sc install=bash)", or uninstall=bash')
    if known.experimental_rerun is not None:
        # A pickle, which may hold code; no run of ours leaves one.
        raise ConfigError("--experimental-rerun: is not offered; the same command again resumes a run")
    if unknown and not unknown[0].startswith("-"):
        raise ConfigError(f"{unknown[0]}: stands behind an option; options such as -m go before all settings")
    if unknown:
        raise ConfigError(f"{unknown[0]}: no such option; {typed()} --hydra-help lists them")
    return known
