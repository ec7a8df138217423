"""What a search chooses from: the words of the command line as Optuna's distributions, and back."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, QuotedString, RangeSweep
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from acmr.command import typed
from acmr.config import ConfigError, schema_defaults
from acmr.settings.compose import as_override, sources
from acmr.settings.swept import check_counts

#: Which of the words choose the seeds of every trial, and what the search is after; both are chosen by nobody else.
SEED, METRIC = "seed", "metric"
#: An interval is searched by its logarithm from this ratio of its ends on, unless a tag says otherwise.
_DECADE = 10.0
_LOG, _LINEAR = "log", "linear"
#: Digits of a number that is chosen: more say nothing, and stand in the names of the runs.
_DIGITS = 4


@dataclass(frozen=True)
class Space:
    """What is the same in all trials, and what is chosen.

    Attributes:
        fixed: Words of every run.
        choices: Distributions by the setting's key.
        seeds: Those of each trial, in the order in which they are trained.
    """

    fixed: tuple[str, ...]
    choices: dict[str, BaseDistribution]
    seeds: tuple[int, ...]

    def job(self, params: Mapping[str, Any], seed: int) -> list[str]:
        """The words of one run."""
        return [*self.fixed, *self.words(params), f"{SEED}={seed}"]

    def words(self, params: Mapping[str, Any]) -> list[str]:
        """What was chosen, as words of a command line."""
        return [f"{key}={_as_word(params[key], self.choices[key])}" for key in self.choices if key in params]

    def command(self, params: Mapping[str, Any]) -> str:
        """The command line that trains all seeds with what was chosen."""
        seeds = f"{SEED}={','.join(map(str, self.seeds))}"
        said = [*self.fixed, *self.words(params), seeds]
        return " ".join([typed(), "-m", *sources().words, *map(shlex.quote, said)])

    @property
    def of_seeds(self) -> str:
        """What the value of a trial is of."""
        said = ", ".join(map(str, self.seeds))
        return f"of seed {said}" if len(self.seeds) == 1 else f"mean of seeds {said}"

    def lines(self) -> list[str]:
        """What is searched, for people."""
        return [f"{key}: {_described(choice)}" for key, choice in self.choices.items()]

    def corners(self) -> list[dict[str, Any]]:
        """Choices at the ends: what is refused there would be refused in the middle of a search."""
        ends = {key: _ends(choice) for key, choice in self.choices.items()}
        first = {key: values[0] for key, values in ends.items()}
        return [first, *({**first, key: value} for key, values in ends.items() for value in values[1:])]


def make_space(overrides: Iterable[Override]) -> Space:
    """Sorts the words of a command line.

    Raises:
        ConfigError: If nothing is left to choose, or something cannot be chosen from.
    """
    fixed, choices = list[str](), dict[str, BaseDistribution]()
    seeds: tuple[int, ...] = (1,)
    for override in overrides:
        key = override.get_key_element()
        if key == METRIC:
            continue
        if key == SEED:
            seeds = _seeds(override)
        elif override.is_sweep_override():
            choices[key] = _distribution(key, override)
        else:
            fixed.append(str(override.input_line))
    if not choices:
        raise ConfigError(
            f"nothing to search: say from what to choose, as in {typed('tune')} 'agent.q_lr=interval(1e-4,1e-3)' "
            "agent.tau=0.005,0.01"
        )
    return Space(tuple(fixed), choices, seeds)


def _seeds(override: Override) -> tuple[int, ...]:
    given = _values(override) if override.is_sweep_override() else [override.value()]
    if not given or not all(type(seed) is int for seed in given) or len(set(given)) < len(given):
        raise ConfigError(f"{override.input_line}: different whole numbers are needed, as in seed=1,2,3")
    return tuple(given)


def _values(override: Override) -> list[Any]:
    check_counts([override])
    values = []
    for given in override.sweep_iterator():
        # As freeze='true' is typed to Hydra.
        entry = given.text if isinstance(given, QuotedString) else given
        if not isinstance(entry, str | int | float | bool | None):
            raise ConfigError(f"{override.input_line}: values to choose from are numbers and words, not {entry}")
        values.append(entry)
    return values


def _distribution(key: str, override: Override) -> BaseDistribution:
    sweep, whole = override.value(), type(schema_defaults().get(key)) is int
    if isinstance(sweep, IntervalSweep):
        return _interval(override, sweep, whole)
    if isinstance(sweep, RangeSweep):
        values = [float(value) for value in _values(override)]
        step = values[1] - values[0] if len(values) > 1 else 1.0
        if whole and len(values) > 1 and all(value.is_integer() for value in values) and step > 0:
            return IntDistribution(int(values[0]), int(values[-1]), step=int(step))
    elif not isinstance(sweep, ChoiceSweep):
        raise ConfigError(f"{override.input_line}: type an interval(LOW,HIGH), a range(LOW,HIGH) or a list")
    return CategoricalDistribution(_values(override))


def _interval(override: Override, sweep: IntervalSweep, whole: bool) -> BaseDistribution:
    low, high = float(sweep.start or 0.0), float(sweep.end or 0.0)
    if not low < high:
        raise ConfigError(f"{override.input_line}: the first number has to be the smaller one")
    tags = {str(tag) for tag in sweep.tags}
    if strange := tags - {_LOG, _LINEAR}:
        raise ConfigError(f"{override.input_line}: tag({min(strange)}, ...): must be {_LOG} or {_LINEAR}")
    log = _LOG in tags or (_LINEAR not in tags and low > 0 and high / low >= _DECADE)
    if log and low <= 0:
        raise ConfigError(f"{override.input_line}: a logarithm needs numbers above zero")
    if not whole:
        return FloatDistribution(low, high, log=log)
    if not (low.is_integer() and high.is_integer()):
        raise ConfigError(f"{override.input_line}: the setting is a whole number")
    return IntDistribution(int(low), int(high), log=log)


def _as_word(value: Any, choice: BaseDistribution) -> str:
    if isinstance(choice, FloatDistribution):
        # Rounding must not leave the interval.
        value = min(max(float(f"{value:.{_DIGITS}g}"), choice.low), choice.high)
    return as_override(value)


def _ends(choice: BaseDistribution) -> Sequence[Any]:
    if isinstance(choice, CategoricalDistribution):
        return choice.choices
    assert isinstance(choice, FloatDistribution | IntDistribution)
    return choice.low, choice.high


def _described(choice: BaseDistribution) -> str:
    if isinstance(choice, CategoricalDistribution):
        return f"one of {', '.join(map(str, choice.choices))}"
    assert isinstance(choice, FloatDistribution | IntDistribution)
    scale = ", by its logarithm" if choice.log else ""
    return f"{choice.low:g} to {choice.high:g}{scale}"
