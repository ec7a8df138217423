"""The search: asks Optuna for trials, trains their runs, tells it what they are worth, and goes on where it was."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import optuna
from hydra.core.override_parser.types import Override
from hydra.types import HydraContext
from omegaconf import DictConfig
from optuna.trial import FrozenTrial, Trial, TrialState

from acmr.app.tune.curve import TENTHS, first_judged, step_of
from acmr.app.tune.page import CUT, VALUES, write_page
from acmr.app.tune.space import Space, make_space
from acmr.app.tune.study import name_of, open_study, try_out
from acmr.app.tune.trainings import Training, Trainings
from acmr.config import STEPS, ConfigError
from acmr.names import terminal
from acmr.settings.compose import CONFIG_FOLDER, look_in
from acmr.settings.sources import sources_of
from acmr.storage.hold import hold
from sweeps.launchers.base import make_adapter
from sweeps.screen.display import command_line
from sweeps.sweeper import Settings

#: Folder of all searches, in that of all runs; the file of one with what its sweeps said.
SEARCHES, LOG_FILE = "tune", "trainings.log"
#: Trials that fail one after the other before the search gives up.
MOST_FAILURES = 5


@dataclass(frozen=True)
class Wanted:
    """What was typed of the search itself.

    Attributes:
        trials: How many it has at its end, those of earlier calls included.
        study: Its name; None: one that follows from the words.
        prune: Whether a trial is cut short that is worse than the median of the others at the same point: a tenth of a
            run's length, or the end of a seed.
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
    run, metric = try_out(space, overrides)
    name = wanted.study or name_of(space, run, metric)
    if Path(name).name != name or name.startswith("."):
        raise ConfigError(f"study={name}: the name of a folder is needed")
    workers = make_adapter(config, context, run.threads, wanted.sweeps.workers).workers
    folder = Path(run.output_dir) / SEARCHES / name
    with hold(folder):
        search = Search(folder, space, metric, wanted, workers)
        search.trainings = Trainings(wanted.sweeps, config, context, metric, folder / LOG_FILE)
        return search.run()


@dataclass
class _Candidate:
    """A trial under way, with those of its runs that are, by seed."""

    trial: Trial
    trainings: dict[int, Training] = field(default_factory=dict)
    #: Whether this process has asked already if it is to be cut short.
    asked: bool = False
    #: What the run that was looked at last is worth at its latest tenth.
    height: float = 0.0


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
        # While a sweep is on, what is printed goes into its log.
        self._out = sys.stdout
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._less = metric == STEPS
        # Of a trial that may be cut short one seed is trained at a time, and the workers take up as many trials.
        self._abreast = workers if wanted.prune else max(1, workers // len(space.seeds))
        self._study = open_study(folder, "minimize" if self._less else "maximize")
        self._under_way: list[_Candidate] = []
        self._failures = 0
        self._check_space(self._trials())

    def run(self) -> int:
        """Asks, trains and tells; returns the exit code."""
        known = [trial for trial in self._trials() if trial.state != TrialState.WAITING]
        begun = [trial for trial in known if trial.state == TrialState.RUNNING]
        self._under_way = [_Candidate(Trial(self._study, trial._trial_id)) for trial in begun]
        self._greet(len(known) - len(begun), len(begun))
        return self._end(self.trainings.run(self.look))

    def look(self) -> bool:
        """Tells of the runs what is new, cuts short, and begins what is next; returns whether anything is under way."""
        for candidate in list(self._under_way):
            if (state := self._follow(candidate)) is not None:
                self._under_way.remove(candidate)
                self._failures = self._failures + 1 if state == TrialState.FAIL else 0
        if self._failures >= MOST_FAILURES:
            # The others stay under way, for the time when what is wrong has been mended.
            for candidate in self._under_way:
                self._stop(candidate)
            return False
        # Somebody may have put trials into the study's queue by means of Optuna's; they are asked for first.
        asked = [trial for trial in self._trials() if trial.state != TrialState.WAITING]
        room = min(self._abreast - len(self._under_way), self._wanted.trials - len(asked))
        for _ in range(room):
            self._under_way.append(_Candidate(self._study.ask(self._space.choices)))
        for candidate in self._under_way:
            for seed in self._due(candidate):
                candidate.trainings[seed] = self.trainings.begin(self._space.job(candidate.trial.params, seed))
        return bool(self._under_way)

    def _trials(self) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False)

    def _due(self, candidate: _Candidate) -> list[int]:
        done = candidate.trial.user_attrs.get(VALUES, {})
        left = [seed for seed in self._space.seeds if str(seed) not in done]
        return [seed for seed in (left[:1] if self._wanted.prune else left) if seed not in candidate.trainings]

    def _follow(self, candidate: _Candidate) -> TrialState | None:
        """Looks at a trial's runs; returns how it has ended, None if it goes on."""
        trial = candidate.trial
        if (cut := trial.user_attrs.get(CUT)) is not None:
            # The process that was here before was killed between two lines of its file.
            return self._cut(candidate, cut)
        for seed, training in list(candidate.trainings.items()):
            over = self.trainings.is_over(training)
            value = self.trainings.worth(training) if over else None
            if over and value is None:
                self._study.tell(trial, state=TrialState.FAIL)
                self._stop(candidate)
                self._say(f"{self._named(trial)}  seed {seed} failed; why: {self._folder / LOG_FILE}")
                return TrialState.FAIL
            step = self._report(candidate, training, value) if self._wanted.prune else 0
            state = self._note(candidate, seed, value) if value is not None else None
            if state is not None:
                return state
            if step and trial.should_prune():
                return self._cut(candidate, self._where(candidate, seed, step, training.config.most_steps))
        return None

    def _report(self, candidate: _Candidate, training: Training, value: float | None) -> int:
        """Tells Optuna what a run is worth at each tenth of its length that it has passed, once for each.

        Args:
            candidate: Its trial.
            training: The run.
            value: What it is worth in the end, if it has ended.

        Returns:
            The environment step of the latest tenth, if that is new and one after which a run may be cut short; else 0.
        """
        trial, config = candidate.trial, training.config
        place = len(trial.user_attrs.get(VALUES, {}))
        found = self.trainings.heights(training)
        if value is not None and not self._less:
            found[TENTHS] = value
        told = self._trials()[trial.number].intermediate_values
        if place and place * TENTHS not in told:
            # Its first seeds were trained with prune=false.
            return 0
        before = place * told.get(place * TENTHS, 0.0)
        new = [tenth for tenth in found if place * TENTHS + tenth not in told]
        for tenth in new:
            # The seeds follow one another; those before count as they stood in the end.
            trial.report((before + found[tenth]) / (place + 1), place * TENTHS + tenth)
        due = bool(new) or not candidate.asked
        candidate.asked = candidate.asked or bool(found)
        latest = max(found, default=0)
        candidate.height = found.get(latest, 0.0)
        return step_of(latest, config) if due and latest >= first_judged(config) else 0

    def _note(self, candidate: _Candidate, seed: int, value: float) -> TrialState | None:
        """Notes what a run that has ended is worth; returns how the trial has ended if that was its last."""
        trial = candidate.trial
        del candidate.trainings[seed]
        values = {**trial.user_attrs.get(VALUES, {}), str(seed): value}
        trial.set_user_attr(VALUES, values)
        mean = sum(values.values()) / len(values)
        said = f"{self._named(trial)}  seed {seed}: {value:,.6g}  mean {mean:,.6g}"
        if len(values) < len(self._space.seeds):
            self._say(said)
            return None
        self._study.tell(trial, mean)
        self._say(f"{said}  ({self._best()})")
        return TrialState.COMPLETE

    def _where(self, candidate: _Candidate, seed: int, step: int, most: int) -> dict[str, float]:
        """At which point a trial is cut short, and what it is worth there: the mean of its seeds so far."""
        values = dict(candidate.trial.user_attrs.get(VALUES, {}))
        # As anywhere else, what has not met its threshold counts as the most steps that it could have taken.
        values.setdefault(str(seed), min(candidate.height, float(most)) if self._less else candidate.height)
        return {"seed": seed, "step": step, "of": most, "worth": sum(values.values()) / len(values)}

    def _cut(self, candidate: _Candidate, where: dict[str, float]) -> TrialState:
        """Cuts a trial short."""
        trial = candidate.trial
        trial.set_user_attr(CUT, where)
        self._study.tell(trial, state=TrialState.PRUNED)
        self._stop(candidate)
        place = f"seed {where['seed']}, step {where['step']:,} of {where['of']:,}"
        self._say(f"{self._named(trial)}  cut short: worse than the median at {place}")
        return TrialState.PRUNED

    def _stop(self, candidate: _Candidate) -> None:
        """Stops a trial's runs, but for those that another one needs."""
        others = [each for other in self._under_way if other is not candidate for each in other.trainings.values()]
        needed = {training.made.directory for training in others}
        for training in candidate.trainings.values():
            if training.made.directory not in needed:
                self.trainings.cut(training)

    def _named(self, trial: Trial) -> str:
        return f"trial {trial.number}: {' '.join(self._space.words(trial.params))}"

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

    def _end(self, code: int) -> int:
        complete = self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        if complete:
            page = write_page(self._folder, self._study, self._space, self._metric)
            self._say(f"best: {self._space.command(self._study.best_params)}")
            self._say(f"written: {page}")
        if code >= 128:
            self._say(f"stopped by {signal.Signals(code - 128).name}; to go on: {command_line()}")
            return code
        if self._failures >= MOST_FAILURES:
            self._say(f"error: the last {self._failures} trials failed; why: {self._folder / LOG_FILE}")
        return 0 if complete and self._failures < MOST_FAILURES else 1

    def _say(self, line: str) -> None:
        print(terminal(line), file=self._out, flush=True)

    def _check_space(self, trials: Sequence[FrozenTrial]) -> None:
        """A study that was named is of one search only."""
        ours = self._space.choices
        if any(trial.distributions != ours for trial in trials if trial.distributions):
            raise ConfigError(f"study={self._folder.name}: is of another search; give this one another name")
