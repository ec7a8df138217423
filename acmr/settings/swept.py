"""What the values that are swept have to be, checked before a sweep is planned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from math import prod

from hydra.core.override_parser.types import Override, RangeSweep
from omegaconf import DictConfig

from acmr.config import ConfigError
from acmr.settings.compose import groups, setting_keys, sources, unknown_key
from acmr.settings.errors import FREE_KEYS
from acmr.settings.files import place_of_text

#: Runs of one sweep; planning more would take hours, and a range with a zero too many would take all memory.
MOST_RUNS = 100_000


def check_swept(params: Mapping[str, object], config: DictConfig) -> None:
    """Refuses a matrix that sweeps a setting which is not there.

    Args:
        params: What its file sweeps.
        config: Hydra's composed config.

    Raises:
        ConfigError: With the file and the place in it.
    """
    for key in params:
        if key in groups() or key in setting_keys() or key.startswith(("+", "hydra.", *FREE_KEYS)):
            continue
        place, file = sources().file(f"matrix/{config.hydra.runtime.choices.get('matrix')}")
        raise ConfigError(f"{place}: hydra.sweeper.params: {unknown_key(key)}{place_of_text(file, key)}")


def check_counts(overrides: Sequence[Override]) -> None:
    """Refuses what is swept without a value, without an end, or with more runs than can be planned.

    Raises:
        ConfigError: Naming what was typed.
    """
    counts = [_count(override) for override in overrides if override.is_sweep_override()]
    if prod(counts) > MOST_RUNS:
        raise ConfigError(f"these are more than {MOST_RUNS:,} runs; sweep fewer values, as in seed=range(1,4)")


def _count(override: Override) -> int:
    """How many values are swept, as far as they can be planned."""
    given, key, value = override.input_line, override.key_or_group, override.value()
    if not override.is_discrete_sweep():
        raise ConfigError(f"{given}: has no end; sweep a list, as in {key}=1,2, or range(1,3)")
    try:
        # Of a range itself: shuffled it would be made whole first.
        values = value.range() if isinstance(value, RangeSweep) else override.sweep_string_iterator()
        count = sum(1 for _ in islice(values, MOST_RUNS + 1))
    except ValueError as error:
        raise ConfigError(f"{given}: {error}; type a step other than 0, as in {key}=range(1,4)") from error
    if not count:
        raise ConfigError(f"{given}: holds no value; type them one by one, with commas between them")
    return count
