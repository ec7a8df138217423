"""The command line: ``python -m analysis RUNS --out OUT``."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from acmr.cells import REFERENCE
from acmr.command import command, typed
from acmr.names import terminal
from analysis import FORMATS


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, terminal(f"analysis: {message} ({typed('analyze')} --help)") + "\n")


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the analysis.

    Args:
        arguments: Command line; None: the process's.

    Returns:
        Exit code: 0 if there are results (of however many runs), 1 if there was no run to analyze, 2 for bad input.
    """
    options = _parser().parse_args(arguments)
    # Only now, so that --help and typing errors need not wait for pandas and scipy.
    from analysis.loading.load import InputError
    from analysis.pipeline import run

    try:
        return run(options)
    except InputError as error:
        print(terminal(f"analysis: {error}"), file=sys.stderr)
    except OSError as error:
        print(terminal(f"analysis: {error.filename or options.out}: {error.strerror or error}"), file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog=typed("analyze"),
        description="Makes the paper's tables and figures, and a report, from run directories.",
        epilog=f"example: {typed('analyze')} runs/paper --out results/paper",
    )
    parser.add_argument("runs", type=Path, metavar="RUNS", help="folder of the runs, as in runs/paper")
    parser.add_argument(
        "--out", type=Path, metavar="OUT", help="folder for the results (default: results/<name of RUNS>)"
    )
    parser.add_argument(
        "--threshold", type=_finite, metavar="RETURN", help="return to reach (default: the runs' own, else 4900)"
    )
    parser.add_argument(
        "--consecutive", type=_count, metavar="N", help="episodes in a row (default: the runs' own, else 5)"
    )
    parser.add_argument(
        "--reference",
        default=REFERENCE,
        metavar="CELL",
        help=f"cell or group that the others are compared with (default: {REFERENCE})",
    )
    parser.add_argument(
        "--margin",
        type=_count,
        metavar="STEPS",
        help="difference that counts as none in the tests for equivalence (default: a twentieth of a full run)",
    )
    parser.add_argument(
        "--format", type=_formats, metavar="LIST", default=FORMATS, help="file formats of the figures: pdf,png,svg"
    )
    parser.add_argument(
        "--window",
        type=_count,
        metavar="N",
        help="episodes of the rolling average (default: the paper's 50; fewer for short runs)",
    )
    parser.add_argument("--no-stills", action="store_true", help="leave out figures 2 and 3, which need a GL library")
    parser.add_argument(
        "--if-changed", action="store_true", help="write nothing if runs and options are as the last time"
    )
    parser.add_argument("--summary", action="store_true", help="only print the steps to threshold; write nothing")
    return parser


def _finite(text: str) -> float:
    value = float(text) if _is_float(text) else math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: a finite return is needed, as in 4900")
    return value


def _is_float(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: a whole number of at least 1 is needed")
    return int(text)


def _formats(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if not names or any(name not in FORMATS for name in names):
        raise argparse.ArgumentTypeError(f"{text!r}: one or more of {','.join(FORMATS)} are needed")
    return names
