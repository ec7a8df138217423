"""``acmr.train``: one run from Python, with the words of the command line."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from acmr.app.policies import Policy, load
from acmr.config import ConfigError
from acmr.records import EPISODES_FILE
from acmr.run.experiment import run_experiment
from acmr.run.stop_signals import Stopped
from acmr.settings.command_line import hydra_arguments
from acmr.settings.compose import as_override, compose_config, look_in, parse, sources
from acmr.settings.errors import USER_ERRORS, check_booleans, explain
from acmr.settings.run_spec import RunSpec, specify


@dataclass(frozen=True)
class Run:
    """A run that has come to its end.

    Attributes:
        directory: Where it lies.
        summary: What ``summary.json`` says: ``status`` (``complete`` or ``diverged``), ``steps_to_threshold``,
            ``final_return``, ``global_step`` and more.
        command: The command line that makes it.
    """

    directory: Path
    summary: dict[str, Any]
    command: str

    @property
    def episodes(self) -> pd.DataFrame:
        """A row as each episode ended: ``global_step``, ``episodic_return``, ``episode_length`` and more."""
        return pd.read_csv(self.directory / EPISODES_FILE)

    def policy(self) -> Policy:
        """Its final policy, as :func:`acmr.load` gives it."""
        return load(self.directory)


def train(
    *overrides: str, config_dir: str | Path | None = None, say: Callable[[str], None] | None = None, **settings: Any
) -> Run:
    """Trains one run, or takes it on from its checkpoint; a run that is complete is not trained again.

    A student needs its teacher, trained before. Nothing is printed; ``say=print, progress="bar"`` shows as much as the
    command. While it trains, Ctrl-C writes a checkpoint and is then raised as KeyboardInterrupt.

    Args:
        overrides: Choices and settings as on the command line, ``"env=ant"`` or ``"agent.q_lr=1e-3"``.
        config_dir: A folder of settings files of one's own, as ``--config-dir``.
        say: Takes each line that the command would print.
        settings: The same as keywords: ``profile="quick"``, ``seed=1``, ``**{"agent.hidden_sizes": [64, 64]}``.

    Raises:
        ConfigError: If the run cannot be made; in one line that says what to give instead.
    """
    words = [*overrides, *(f"{key}={as_override(value)}" for key, value in settings.items())]
    shown = "progress" in settings or any(word.startswith("progress=") for word in overrides)
    with _own_settings(config_dir), _own_threads():
        spec = _specify(words if shown else [*words, "progress=off"], config_dir)
        try:
            summary = run_experiment(spec, say or (lambda line: None))
        except Stopped as stopped:
            if stopped.code == 128 + signal.SIGINT:
                raise KeyboardInterrupt from stopped
            raise
        return Run(spec.directory, summary, spec.command)


def _specify(words: list[str], config_dir: str | Path | None) -> RunSpec:
    if options := [word for word in words if word.startswith("-")]:
        raise ConfigError(f"{options[0]}: an option of the command line; train() makes one run from its settings")
    places = [] if config_dir is None else ["--config-dir", str(config_dir)]
    try:
        arguments = hydra_arguments([*places, *words])
        if "--multirun" in arguments:
            raise ConfigError(f"{' '.join(words)}: words of a sweep; train() makes one run, the command many")
        # For the commands that messages print: they have to find the same files.
        look_in(replace(sources(), words=tuple(places)))
        chosen = arguments[len(places) :]
        cfg = compose_config(chosen)
        check_booleans(chosen)
        return specify(parse(cfg))
    except USER_ERRORS as error:
        raise ConfigError(explain(error)) from error


@contextmanager
def _own_settings(config_dir: str | Path | None) -> Iterator[None]:
    before = sources()
    try:
        yield
    finally:
        look_in(before)


@contextmanager
def _own_threads() -> Iterator[None]:
    """Lets torch compute with as many threads as before, once the run has ended: those are the run's own setting."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)
