"""What a run's settings and summary say, as far as it can be computed with: one odd run shall not end the analysis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acmr import foreign
from acmr.foreign import is_there
from acmr.records import MOST_CONSECUTIVE, MOST_RETURN, DamagedError

#: Whole numbers from here on are no longer exact as floats, and those of the seeds no longer numbers of 64 bits.
MOST_STEPS, MOST_SEED = 2**53, 2**63 - 1
#: Least and most of what a run cannot be used without, and whether it is whole.
_NEEDED = {
    "seed": (0, MOST_SEED, True),
    **dict.fromkeys(("total_timesteps", "global_step", "stop_after", "episodes"), (0, MOST_STEPS, True)),
    "consecutive": (1, MOST_CONSECUTIVE, True),
    "threshold": (-MOST_RETURN, MOST_RETURN, False),
}
#: The same of what can be left out.
_SHOWN = {
    "steps_to_threshold": (0, MOST_STEPS, True),
    **dict.fromkeys(("wall_seconds", "steps_per_second"), (0, 1e12, False)),
}


def read_mapping(path: Path) -> dict[str, Any]:
    """Contents of a YAML or JSON file; empty if there is no such file.

    Raises:
        DamagedError: If it cannot be read, or holds no settings.
    """
    return foreign.read_mapping(path, path.name) if is_there(path) else {}


def check_numbers(name: str, content: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The contents of a file without the numbers that make no sense and need not be there, and what is left out.

    Raises:
        DamagedError: If a number makes no sense without which the run cannot be used.
    """
    agent = content.get("agent")
    starts = agent.get("learning_starts") if isinstance(agent, Mapping) else None
    for key, value, limits in (
        *((key, content.get(key), limits) for key, limits in _NEEDED.items()),
        ("agent.learning_starts", starts, (0, MOST_STEPS, True)),
    ):
        if problem := _problem(key, value, *limits):
            raise DamagedError(f"{name}: {problem}")
    odd = {key: problem for key, limits in _SHOWN.items() if (problem := _problem(key, content.get(key), *limits))}
    kept = {key: value for key, value in content.items() if key not in odd}
    return kept, [f"{name}: {problem}, and is left out" for problem in odd.values()]


def number(value: Any) -> float | None:
    """A number as a float; None for anything else."""
    return float(value) if _is_number(value) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _problem(key: str, value: Any, least: float, most: float, whole: bool) -> str:
    # What is no number at all counts as not said. NaN is in no range.
    if not _is_number(value) or (least <= value <= most and not (whole and value != math.floor(value))):
        return ""
    return f"{key} is {_short(value)}, not a {'whole ' if whole else ''}number from {least:g} to {most:g}"


def _short(value: float) -> str:
    text = str(value)
    return text if len(text) <= 24 else f"{text[:12]}… ({len(text)} characters)"
