"""Trains one run or many, as the command line says: ``python run.py``, or ``acmr`` where it is installed."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acmr.command import add_own_modules, command, end_at_ctrl_c

# All else is loaded within functions: whoever types Ctrl-C while that goes on is to get one line, too.
if TYPE_CHECKING:
    from omegaconf import DictConfig

    from acmr.settings.run_spec import RunSpec

#: Exit code of a run whose environment failed.
ENDED_BY_ENVIRONMENT = 1

# Hydra would print several lines and exit; with this it hands us the error, and the user gets one line.
os.environ["HYDRA_FULL_ERROR"] = "1"
# Training draws nothing, but mujoco cannot even be imported where this names a library that is missing.
os.environ.pop("MUJOCO_GL", None)


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    end_at_ctrl_c()
    add_own_modules()
    if len(sys.argv) == 2 and sys.argv[1].startswith("@"):
        return _exit_code(lambda: _train_job(Path(sys.argv[1][1:])))
    return _exit_code(_train_as_typed)


def _train_as_typed() -> None:
    import hydra

    from acmr.app.meanings import register_help
    from acmr.app.other_sweepers import with_their_words
    from acmr.settings.command_line import hydra_arguments
    from acmr.settings.compose import CONFIG_FOLDER, register_schema, sources

    with with_their_words(hydra_arguments(sys.argv[1:])) as arguments, sources().refusing_circles():
        sys.argv[1:] = arguments
        register_schema()
        register_help(sources())
        # The folder's own path: Hydra would look beside this file, which may have been called through a link.
        hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="config")(_train)()


def _train(cfg: DictConfig) -> float | None:
    """Runs what the command line describes; sweeps.sweeper does so where that is more than one run.

    Returns:
        What the run is worth, to Hydra and its other sweepers; None where no ``metric`` is asked for.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from acmr.settings.compose import CONFIG_FOLDER, check_choices, look_in, parse
    from acmr.settings.errors import check_booleans
    from acmr.settings.run_spec import specify
    from acmr.settings.sources import sources_of

    found: list[float | None] = []

    def start() -> None:
        # Hydra types it as what it holds; it is a DictConfig.
        hydra: Any = HydraConfig.get()
        look_in(sources_of(hydra, CONFIG_FOLDER))
        check_booleans(hydra.overrides.task)
        check_choices(hydra.runtime.choices)
        found.append(_run(specify(parse(cfg)), searched=hydra.mode == RunMode.MULTIRUN))

    # An error that left from here would get a line of Hydra's own before it.
    if code := _exit_code(start):
        sys.exit(code)
    return found[0]


def _train_job(path: Path) -> None:
    from acmr.config import ConfigError
    from sweeps.job import adopt

    try:
        _run(*adopt(path))
    except ConfigError as error:
        # Nobody watches a run of a sweep: its log keeps the way to where the code of its environment failed.
        if error.exit_code == ENDED_BY_ENVIRONMENT:
            origin: BaseException = error
            while origin.__cause__ is not None:
                origin = origin.__cause__
            traceback.print_exception(origin, chain=False)
        raise


def _run(spec: RunSpec, begun: Callable[[], None] = lambda: None, searched: bool = False) -> float | None:
    # Here, so that a wrong setting is refused without waiting for torch and MuJoCo to load.
    from acmr.config import NONE
    from acmr.run.experiment import exit_code, run_experiment

    summary, config = run_experiment(spec, begun=begun), spec.config
    value = None
    if config.metric != NONE:
        from acmr.app.metric import metric_line, metric_of

        value = metric_of(spec, summary, config.metric)
        print(metric_line(config, summary, value))
    # To a search that a run diverged is something to learn from; else it would end it.
    if (code := exit_code(summary)) and not (searched and value is not None):
        sys.exit(code)
    return value


def _exit_code(run: Callable[[], None]) -> int:
    from acmr.settings.errors import USER_ERRORS, explain

    try:
        run()
    except USER_ERRORS as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return int(getattr(error, "exit_code", 2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
