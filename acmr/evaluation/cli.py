"""The command line of :mod:`acmr.evaluation`.

``python -m acmr.evaluation RUN_DIR [--episodes N] [--video FILE.mp4 [--seconds S]]`` and
``python -m acmr.evaluation still ENVIRONMENT --out FILE.png``.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from acmr.command import add_own_modules, typed
from acmr.config import IMPUTATIONS, MEAN, ConfigError
from acmr.evaluation.camera import without_gl
from acmr.evaluation.evaluate import evaluate, still
from acmr.evaluation.video import FILM_SUFFIXES
from acmr.names import terminal
from acmr.records import EVALUATION_FILE, MOST_SEED
from acmr.settings.command_line import use_folder

#: Of one side of a picture, and of a film.
_MOST_PIXELS, _MOST_SECONDS = 8192, 1e6


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code: 2 for what cannot be done, with one line that says why."""
    given = _parse(list(sys.argv[1:] if arguments is None else arguments))
    torch.set_num_threads(1)
    try:
        add_own_modules()
        use_folder(given.config_dir)
        with without_gl():
            importlib.import_module("acmr.envs")
        given.action(given)
    except ConfigError as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    return 0


def _parse(arguments: list[str]) -> argparse.Namespace:
    if arguments[:1] == ["still"]:
        parser = argparse.ArgumentParser(prog=f"{typed('evaluate')} still", description=still.__doc__)
        parser.add_argument("environment", help="an environment of conf/env, or any Gymnasium id")
        parser.add_argument("--out", type=Path, required=True, metavar="FILE.png")
        _add_common(parser)
        parser.set_defaults(action=still)
        return parser.parse_args(arguments[1:])
    parser = argparse.ArgumentParser(
        prog=typed("evaluate"),
        description="Evaluates the policy of a finished run.",
        epilog=f"{typed('evaluate')} still ENVIRONMENT --out FILE.png draws a robot.",
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="as in runs/quick/ant-none/seed_1")
    parser.add_argument("--episodes", type=_positive, default=10, help="default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next ones count up")
    parser.add_argument(
        "--env",
        type=_names,
        metavar="ENV[,ENV...]",
        help="play in other bodies, before any learning: what fits of the policy by the names of sensors and actuators",
    )
    parser.add_argument(
        "--impute", choices=IMPUTATIONS, default=MEAN, help="what is gone in another body counts as; default: mean"
    )
    parser.add_argument(
        "--trust", action="store_true", help="run the code that the run's own files name: only where you know them"
    )
    parser.add_argument("--stochastic", action="store_true", help="sample actions, as in training")
    parser.add_argument(
        "--video", type=_film, metavar="FILE.mp4", help="film the first episode; or .gif (0.2 s a frame without a GPU)"
    )
    parser.add_argument(
        "--seconds", type=_seconds, metavar="S", help="of the film: S seconds of simulated time, episode after episode"
    )
    _add_common(parser)
    parser.add_argument("--out", type=Path, metavar="FILE.json", help=f"default: RUN_DIR/{EVALUATION_FILE}")
    parser.set_defaults(action=evaluate)
    given = parser.parse_args(arguments)
    if given.seed < 0:
        parser.error(f"--seed {given.seed}: an integer of at least 0 is needed")
    if given.seed + given.episodes - 1 > MOST_SEED:
        parser.error(f"--seed {given.seed} --episodes {given.episodes}: seeds of at most {MOST_SEED} are needed")
    if given.env is None and given.impute != MEAN:
        parser.error(f"--impute {given.impute}: nothing is gone in the policy's own body; type --env ENV as well")
    for option in ("video", "out"):
        if given.env is not None and len(given.env) > 1 and getattr(given, option) is not None:
            parser.error(f"--env {','.join(given.env)}: one file cannot hold several bodies; leave --{option} out")
    if given.seconds is not None and given.video is None:
        parser.error(f"--seconds {given.seconds:g}: there is no film; type --video FILE.mp4 as well")
    return given


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config-dir", metavar="FOLDER", help="settings files of your own, as for training")
    for name in ("--width", "--height"):
        parser.add_argument(name, type=_pixels, default=480, metavar="PIXELS", help="of the picture; default: 480")


def _names(text: str) -> list[str]:
    names = text.split(",")
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text}: environments are needed, as in armless_humanoid,humanoid")
    return list(dict.fromkeys(names))


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: an integer of at least 1 is needed")
    return int(text)


def _pixels(text: str) -> int:
    value = _positive(text)
    if value > _MOST_PIXELS:
        raise argparse.ArgumentTypeError(f"{text}: at most {_MOST_PIXELS} pixels can be drawn")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= _MOST_SECONDS:
        raise argparse.ArgumentTypeError(
            f"{text}: a number of seconds above 0 is needed, and at most {_MOST_SECONDS:g}"
        )
    return value


def _film(text: str) -> Path:
    if not text.endswith(FILM_SUFFIXES):
        raise argparse.ArgumentTypeError(f"{text}: the name must end in {' or '.join(FILM_SUFFIXES)}")
    return Path(text)
