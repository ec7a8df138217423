"""Whether the numbers of an ``evaluation.json`` belong together: tables are made of what is published of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

#: The numbers in it that follow from its episodes, and how.
_OF_EACH: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "mean_return": ("episodic_return", np.mean),
    "std_return": ("episodic_return", np.std),
    "min_return": ("episodic_return", np.min),
    "max_return": ("episodic_return", np.max),
    "mean_length": ("episode_length", np.mean),
    "fall_rate": ("terminated", np.mean),
}
_VELOCITY = "mean_forward_velocity"


def adds_up(content: Mapping[str, Any]) -> bool:
    """Whether the numbers of an evaluation are those of the episodes that it lists: a changed digit is found.

    Args:
        content: What the file holds.
    """
    try:
        each = content["each"]
        seeds = [content["seed"] + number for number in range(content["episodes"])]
        if [episode["seed"] for episode in each] != seeds:
            return False
        numbers = {name: np.array([float(episode[of]) for episode in each]) for name, (of, _) in _OF_EACH.items()}
        pairs = [(content[name], made(numbers[name])) for name, (_, made) in _OF_EACH.items()]
        if velocities := [episode[_VELOCITY] for episode in each if episode[_VELOCITY] is not None]:
            pairs.append((content[_VELOCITY], np.mean(velocities)))
        # Sums of the same numbers differ in their last digits between machines.
        return all(bool(np.isclose(said, made, rtol=1e-12, atol=1e-12)) for said, made in pairs)
    except (LookupError, TypeError, ValueError, OverflowError):
        return False
