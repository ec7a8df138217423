"""The search: asks Optuna for trials, trains their runs, tells it what they are worth, and goes on where it was."""

from __future__ import annotations

import hashlib
import json
import signal
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from hydra.core.override_parser.types import Override
from hydra.types import HydraContext
from omegaconf import DictConfig
from optuna.distributions import distribution_to_json
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState

from acmr.app.tune.page import write_page
from acmr.app.tune.space import METRIC, Space, make_space
from acmr.app.tune.trainings import Trainings
from acmr.config import NONE, STEPS, ConfigError, ExperimentConfig, is_neutral
from acmr.names import terminal
from acmr.settings.compose import CONFIG_FOLDER, compose_config, look_in, parse
from acmr.settings.run_spec import specify
from acmr.settings.sources import sources_of
from acmr.storage.hold import hold
from sweeps.launchers.base import make_adapter
from sweeps.screen.display import command_line
from sweeps.sweeper import Settings

#: Folder of all searches, in that of all runs; the files of one: Optuna's own, and what the sweeps said.
SEARCHES, STORAGE_FILE, LOG_FILE = "tune", "study.log", "trainings.log"
#: Trials that fail one after the other before the search gives up, and that end before others may be cut short.
MOST_FAILURES, UNPRUNED = 5, 5
_VALUES = "values"


@dataclass(frozen=True)
class Wanted:
    """What was typed of the search itself.

    Attributes:
        trials: How many it has at its end, those of earlier calls included.
        study: Its name; None: one that follows from the words.
        prune: Whether a trial whose first seeds are worse than the median of the others' gets no more seeds.
        sweeps: How runs are trained.
    """

    trials: int
    study: str | None
    prune: bool
    sweeps: Settings


def run_search(overrides: Sequence[Override], wanted: Wanted, config: DictConfig, context: HydraContext) -> int:
    """Searches until there are as many trials as wanted.

    Args:
        overrides: The words of the command line.
        wanted: What was typed of the search itself.
        config: Hydra's composed config.
        context: Hydra's own.

    Returns:
        The exit code: 0 if a trial came to its end, 1 if none did, 128 + the signal that stopped it.

    Raises:
        ConfigError: If the search cannot be made; nothing has been started then.
    """
    look_in(sources_of(config.hydra, CONFIG_FOLDER))
    if type(wanted.trials) is not int or wanted.trials < 1:
        raise ConfigError(f"trials={wanted.trials}: an integer of at least 1 is needed")
    space = make_space(overrides)
    run, metric = _try_out(space, overrides)
    name = wanted.study or _name(space, run, metric)
    if Path(name).name != name or name.startswith("."):
        raise ConfigError(f"study={name}: the name of a folder is needed")
    workers = make_adapter(config, context, run.threads, wanted.sweeps.workers).workers
    folder = Path(run.output_dir) / SEARCHES / name
    with hold(folder):
        search = Search(folder, space, metric, wanted, workers)
        search.trainings = Trainings(wanted.sweeps, config, context, metric, folder / LOG_FILE)
        return search.run()


class Search:
    """A search that this process holds.

    Args:
        folder: Where its files lie.
        space: What is chosen.
        metric: What it is after.
        wanted: What was typed of it.
        workers: How many runs are trained at a time.
    """

    trainings: Trainings

    def __init__(self, folder: Path, space: Space, metric: str, wanted: Wanted, workers: int) -> None:
        self._folder, self._space, self._metric, self._wanted = folder, space, metric, wanted
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._less = metric == STEPS
        self._prunes = wanted.prune and len(space.seeds) > 1
        # Of a trial that may be cut short one seed is trained at a time, and the workers take up as many trials.
        self._abreast = workers if self._prunes else max(1, workers // len(space.seeds))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            storage = JournalStorage(JournalFileBackend(str(folder / STORAGE_FILE)))
            self._study = optuna.create_study(
                storage=storage,
                study_name=folder.name,
                direction="minimize" if self._less else "maximize",
                pruner=optuna.pruners.MedianPruner(n_startup_trials=UNPRUNED),
                load_if_exists=True,
            )
            trials = self._study.get_trials(deepcopy=False)
            # Other draws than those of the process that was here before.
            seed = int(hashlib.sha256(folder.name.encode()).hexdigest()[:6], 16) + len(trials)
            self._study.sampler = optuna.samplers.TPESampler(seed=seed)
        self._check_space(trials)

    def run(self) -> int:
        """Asks, trains and tells; returns the exit code."""
        study, known = self._study, self._study.get_trials(deepcopy=False)
        under_way = [Trial(study, trial._trial_id) for trial in known if trial.state == TrialState.RUNNING]
        self._greet(len(known) - len(under_way), len(under_way))
        code, failures = 0, 0
        while code < 128 and failures < MOST_FAILURES:
            while len(under_way) < self._abreast and len(study.get_trials(deepcopy=False)) < self._wanted.trials:
                under_way.append(study.ask(self._space.choices))
            if not under_way:
                break
            jobs = [(trial, seed) for trial in under_way for seed in self._due(trial)]
            values, code = self.trainings.train([self._space.job(trial.params, seed) for trial, seed in jobs])
            if code < 128:
                for trial in list(under_way):
                    found = {seed: value for (owner, seed), value in zip(jobs, values, strict=True) if owner is trial}
                    state = self._tell(trial, found)
                    if state is not None:
                        under_way.remove(trial)
                        failures = failures + 1 if state == TrialState.FAIL else 0
        return self._end(code, failures)

    def _due(self, trial: Trial) -> list[int]:
        done = trial.user_attrs.get(_VALUES, {})
        left = [seed for seed in self._space.seeds if str(seed) not in done]
        return left[:1] if self._prunes else left

    def _tell(self, trial: Trial, found: dict[int, float | None]) -> TrialState | None:
        """Tells what runs of a trial are worth; returns how it ended, None if it goes on."""
        told = {str(seed): value for seed, value in found.items() if value is not None}
        values = {**trial.user_attrs.get(_VALUES, {}), **told}
        trial.set_user_attr(_VALUES, values)
        words = " ".join(self._space.words(trial.params))
        if len(told) < len(found):
            self._study.tell(trial, state=TrialState.FAIL)
            self._say(f"trial {trial.number} failed: {words}; why: {self._folder / LOG_FILE}")
            return TrialState.FAIL
        mean = sum(values.values()) / len(values)
        trial.report(mean, len(values))
        seeds = "  ".join(f"seed {seed}: {value:,.6g}" for seed, value in told.items())
        said = f"trial {trial.number}: {words}  {seeds}  mean {mean:,.6g}"
        if len(values) == len(self._space.seeds):
            self._study.tell(trial, mean)
            self._say(f"{said}  ({self._best()})")
            return TrialState.COMPLETE
        if trial.should_prune():
            self._study.tell(trial, state=TrialState.PRUNED)
            self._say(f"{said}  (worse than the median: no more seeds)")
            return TrialState.PRUNED
        self._say(said)
        return None

    def _best(self) -> str:
        best = self._study.best_trial
        ended = len([trial for trial in self._study.get_trials(deepcopy=False) if trial.state.is_finished()])
        return f"best {best.value:,.6g}, of trial {best.number}; {ended} of {self._wanted.trials} ended"

    def _greet(self, ended: int, under_way: int) -> None:
        for line in self._space.lines():
            self._say(line)
        self._say(f"{'least' if self._less else 'greatest'} {self._metric}, {self._space.of_seeds}; {self._folder}")
        if ended or under_way:
            self._say(f"going on: {ended} trials have ended, {under_way} were under way")

    def _end(self, code: int, failures: int) -> int:
        complete = self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        if complete:
            page = write_page(self._folder, self._study, self._space, self._metric)
            self._say(f"best: {self._space.command(self._study.best_params)}")
            self._say(f"written: {page}")
        if code >= 128:
            self._say(f"stopped by {signal.Signals(code - 128).name}; to go on: {command_line()}")
            return code
        if failures >= MOST_FAILURES:
            self._say(f"error: the last {failures} trials failed; why: {self._folder / LOG_FILE}")
        return 0 if complete and failures < MOST_FAILURES else 1

    def _say(self, line: str) -> None:
        print(terminal(line), flush=True)

    def _check_space(self, trials: Sequence[optuna.trial.FrozenTrial]) -> None:
        """A study that was named is of one search only."""
        ours = self._space.choices
        if any(trial.distributions != ours for trial in trials if trial.distributions):
            raise ConfigError(f"study={self._folder.name}: is of another search; give this one another name")


def _try_out(space: Space, overrides: Sequence[Override]) -> tuple[ExperimentConfig, str]:
    """The settings of a run, and what it is asked for; refuses what cannot be run, before anything is begun."""
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


def _name(space: Space, config: ExperimentConfig, metric: str) -> str:
    """Follows from what the search does, so that the same command finds it again."""
    fixed = sorted(word for word in space.fixed if not is_neutral(word.partition("=")[0]) or word.startswith("profile"))
    choices: dict[str, Any] = {key: distribution_to_json(choice) for key, choice in space.choices.items()}
    content = json.dumps([fixed, choices, space.seeds, metric], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    return "-".join([config.env.name, config.transfer.name, *(key.split(".")[-1] for key in space.choices), digest])
