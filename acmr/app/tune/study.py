"""What a search is before its first trial: its settings tried out, its name, and Optuna's study in its file."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import optuna
from hydra.core.override_parser.types import Override
from optuna.distributions import distribution_to_json
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.study import StudyDirection

from acmr.app.tune.space import METRIC, Space
from acmr.config import NONE, STEPS, ConfigError, ExperimentConfig, is_neutral
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import specify

#: Optuna's own file; and trials that end before others may be cut short.
STORAGE_FILE, UNPRUNED = "study.log", 5


def open_study(folder: Path, direction: str) -> optuna.Study:
    """Optuna's study in its file, made if it is not there.

    Args:
        folder: The search's own.
        direction: ``minimize`` or ``maximize``.
    """
    # Absolute, or Optuna's link to it would lead nowhere, and it would wait for ever for a lock that was left behind.
    path = (folder / STORAGE_FILE).absolute()
    lock = JournalFileSymlinkLock(str(path))
    # Whoever left a lock or half a line was killed: this process holds the folder.
    with suppress(RuntimeError):
        lock.release()
    _cut_half_line(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(path), lock)),
            study_name=folder.name,
            direction=StudyDirection[direction.upper()],
            pruner=optuna.pruners.MedianPruner(n_startup_trials=UNPRUNED),
            load_if_exists=True,
        )
        # Other draws than those of the process that was here before.
        count = len(study.get_trials(deepcopy=False))
        seed = int(hashlib.sha256(folder.name.encode()).hexdigest()[:6], 16) + count
        study.sampler = optuna.samplers.TPESampler(seed=seed)
    return study


def _cut_half_line(path: Path) -> None:
    # Optuna passes over one at the end, but not over what it would become with the next line behind it.
    with suppress(FileNotFoundError):
        content = path.read_bytes()
        if content and not content.endswith(b"\n"):
            os.truncate(path, content.rfind(b"\n") + 1)


def try_out(space: Space, overrides: Sequence[Override]) -> tuple[ExperimentConfig, str]:
    """The settings of a run, and what it is asked for.

    Raises:
        ConfigError: If a trial could not be run; nothing has been begun then.
    """
    if neutral := [key for key in space.choices if is_neutral(key)]:
        raise ConfigError(f"{neutral[0]}: changes no result; give it one value")
    asked = [str(override.value()) for override in overrides if override.get_key_element() == METRIC]
    metric = asked[-1] if asked else STEPS
    if metric == NONE:
        raise ConfigError(f"{METRIC}={NONE}: a search is after something; type metric={STEPS}, or leave it out")
    configs = []
    for params in space.corners():
        job = space.job(params, space.seeds[0])
        configs.append(parse(compose_config([*job, f"{METRIC}={metric}"])))
        specify(configs[-1])
    return configs[0], metric


def name_of(space: Space, config: ExperimentConfig, metric: str) -> str:
    """The name of a search, which follows from what it does, so that the same command finds it again."""
    fixed = sorted(word for word in space.fixed if not is_neutral(word.partition("=")[0]) or word.startswith("profile"))
    choices: dict[str, Any] = {key: distribution_to_json(choice) for key, choice in space.choices.items()}
    content = json.dumps([fixed, choices, space.seeds, metric], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    return "-".join([config.env.name, config.transfer.name, *(key.split(".")[-1] for key in space.choices), digest])
