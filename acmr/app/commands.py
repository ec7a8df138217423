"""The command ``acmr``: a subcommand, or else settings of a run or a sweep, as ``python run.py`` takes them."""

from __future__ import annotations

import os
import runpy
import sys
from difflib import get_close_matches

from acmr import __version__
from acmr.app.completion import ASKED, complete, shell_code
from acmr.command import PROGRAM, SUBCOMMANDS, command, end_at_ctrl_c
from acmr.config import ConfigError
from acmr.names import terminal


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    end_at_ctrl_c()
    if ASKED in os.environ:
        return complete()
    word, *rest = sys.argv[1:] or ["train"]
    if word in ("-sc", "--shell-completion"):
        return _print_completion(rest)
    if word == "--version":
        print(f"{PROGRAM} {__version__}")
        return 0
    if word == "train" or word.startswith("-") or "=" in word:
        # Here, so that other commands need not wait for it.
        from acmr.app.training import main as train

        sys.argv[1:] = rest if word == "train" else sys.argv[1:]
        return train()
    if word not in SUBCOMMANDS:
        near = get_close_matches(word, SUBCOMMANDS, n=1)
        hint = f"; did you mean {PROGRAM} {near[0]}?" if near else ""
        allowed = f"one of {', '.join(SUBCOMMANDS)}, or a setting such as env=ant"
        print(terminal(f"error: {PROGRAM} {word}: must be {allowed}{hint}"), file=sys.stderr)
        return 2
    sys.argv[1:] = rest
    # As python -m does it: one way into each of them, whatever it is called.
    runpy.run_module(SUBCOMMANDS[word], run_name="__main__", alter_sys=True)
    return 0


def _print_completion(actions: list[str]) -> int:
    try:
        print(shell_code(" ".join(actions)))
    except ConfigError as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    return 0
