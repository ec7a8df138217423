"""Trains one run or many: ``python run.py experiment=A2 seed=3``, ``python run.py matrix=quick``.

``python run.py --help`` lists everything.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

# Hydra would print several lines and exit; with this it hands us the error, and the user gets one line.
os.environ["HYDRA_FULL_ERROR"] = "1"
# Training draws nothing, but mujoco cannot even be imported where this names a library that is missing.
os.environ.pop("MUJOCO_GL", None)

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from acmr.command import command
from acmr.settings.compose import parse, register_schema
from acmr.settings.errors import USER_ERRORS, check_booleans, explain, quote_paths
from acmr.settings.run_spec import RunSpec, specify

#: Words of a sweep, and where Hydra keeps them: they are no settings of a run.
SWEEP_WORDS = {word: f"hydra.sweeper.{word}" for word in ("plan", "retries", "workers")}

register_schema()


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def train(cfg: DictConfig) -> None:
    """Runs what the command line describes; sweeps.sweeper does so where that is more than one run."""

    def start() -> None:
        check_booleans(HydraConfig.get().overrides.task)
        _run(specify(parse(cfg)))

    # An error that left from here would get a line of Hydra's own before it.
    if code := _exit_code(start):
        sys.exit(code)


def _run(spec: RunSpec) -> None:
    # Here, so that a wrong setting is refused without waiting for torch and MuJoCo to load.
    from acmr.run.experiment import exit_code, run_experiment

    if code := exit_code(run_experiment(spec)):
        sys.exit(code)


def _train_job(path: str) -> None:
    from sweeps.job import adopt

    _run(adopt(Path(path)))


def _arguments(given: list[str]) -> list[str]:
    """The command line in Hydra's words."""
    arguments, several = [], False
    for argument in quote_paths(given):
        key, equal, value = argument.partition("=")
        several = several or key in SWEEP_WORDS
        arguments.append(f"{SWEEP_WORDS[key]}{equal}{value}" if key in SWEEP_WORDS else argument)
    return ["--multirun", *arguments] if several else arguments


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    if len(sys.argv) == 2 and sys.argv[1].startswith("@"):
        return _exit_code(lambda: _train_job(sys.argv[1][1:]))
    sys.argv[1:] = _arguments(sys.argv[1:])
    return _exit_code(train)


def _exit_code(run: Callable[[], None]) -> int:
    try:
        run()
    except USER_ERRORS as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return int(getattr(error, "exit_code", 2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
