"""Completion of the command ``acmr`` with Tab: subcommands, Hydra's groups and settings, options of subcommands.

argcomplete brings the function for the shell and asks this program, as it is started by that function, what fits.
"""

from __future__ import annotations

import argparse
import io
import os
import runpy
import sys
from contextlib import redirect_stdout
from typing import Any

from acmr.command import PROGRAM, SUBCOMMANDS
from acmr.config import ConfigError

#: Set by the shell's function; says at which word the command begins, counted from 1.
ASKED = "_ARGCOMPLETE"
#: Subcommands whose words are Hydra's; and what ``acmr tune`` takes beside them.
_OF_HYDRA, _TUNE = ("train", "tune"), ("trials=", "study=", "prune=")
_SHELLS = ("bash", "zsh", "fish")


def shell_code(action: str) -> str:
    """What a shell evaluates for ``acmr -sc ACTION``, as in ``eval "$(acmr -sc install=bash)"``.

    Raises:
        ConfigError: If there is no such action, or argcomplete is not installed.
    """
    what, _, shell = action.partition("=")
    if what not in ("install", "uninstall") or shell not in _SHELLS:
        allowed = ", ".join(f"install={each}" for each in _SHELLS)
        raise ConfigError(f"-sc {action}: must be one of {allowed}, or uninstall=bash")
    if what == "uninstall":
        return f"{'compdef -d' if shell == 'zsh' else 'complete -e -c' if shell == 'fish' else 'complete -r'} {PROGRAM}"
    return str(_argcomplete().shellcode([PROGRAM], shell=shell))


def complete() -> int:
    """Answers the shell's function; ends the process where an answer was given."""
    words = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))].split(" ")
    typed = [word for word in words[1:-1] if word]
    if typed and typed[0] in SUBCOMMANDS and typed[0] not in _OF_HYDRA:
        _complete_subcommand(typed[0])
    else:
        _complete_settings(typed)
    return 0


def _complete_subcommand(name: str) -> None:
    """Completes with the parser that the subcommand makes of itself, at the point where it would parse its words."""
    argcomplete: Any = _argcomplete()

    def answer(parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        argcomplete.autocomplete(parser)
        # Whatever the answer is, the subcommand itself must not begin.
        os._exit(1)

    argparse.ArgumentParser.parse_args = answer  # type: ignore[method-assign, assignment]
    os.environ[ASKED] = "2"
    sys.argv[1:] = ["--help"]
    runpy.run_module(SUBCOMMANDS[name], run_name="__main__", alter_sys=True)


def _complete_settings(typed: list[str]) -> None:
    parser = argparse.ArgumentParser(PROGRAM)
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-cd", "--config-dir")
    parser.add_argument("--cfg", choices=("job", "hydra", "all"))
    if not typed:
        parser.add_argument("--version", action="store_true")

    def answer(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
        subcommand = typed[0] if typed and typed[0] in _OF_HYDRA else ""
        settings = [word for word in parsed_args.words or [] if word != subcommand]
        more = [] if typed else [f"{name} " for name in SUBCOMMANDS]
        more += _TUNE if subcommand == "tune" else ()
        found = [word.strip() for word in more if word.startswith(prefix)]
        return found + _settings(settings, prefix, parsed_args.config_dir)

    words: Any = parser.add_argument("words", nargs="*")
    words.completer = answer
    _argcomplete().autocomplete(parser, always_complete_options=False, default_completer=None)


def _settings(words: list[str], prefix: str, config_dir: str | None) -> list[str]:
    """What Hydra would complete, asked as its own script for bash asks."""
    found = _asked_of_hydra(words, prefix, config_dir)
    if len(found) == 1 and found[0].endswith(".") and found != [prefix]:
        # The shell would put a space behind the only answer; this one is not whole.
        return _settings(words, found[0], config_dir)
    return found


def _asked_of_hydra(words: list[str], prefix: str, config_dir: str | None) -> list[str]:
    from acmr.app.training import main as train

    place = ["--config-dir", config_dir] if config_dir else []
    before, sys.argv[1:] = sys.argv[1:], [*place, "-sc", "query=bash"]
    os.environ["COMP_LINE"] = " ".join([PROGRAM, *words, prefix])
    said = io.StringIO()
    try:
        with redirect_stdout(said):
            train()
    finally:
        sys.argv[1:] = before
    return said.getvalue().split()


def _argcomplete() -> Any:
    try:
        import argcomplete
    except ModuleNotFoundError as error:
        raise ConfigError("argcomplete is not installed; type pip install argcomplete") from error
    return argcomplete
