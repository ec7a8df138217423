"""A day's schedule of generators of which some are gone: the others produce in their place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from grid2op.Chronics import GridStateFromFile


def schedule_without(gone: Sequence[str]) -> type[GridStateFromFile]:
    """grid2op's reader of a day's files, which moves what the gone generators produce to the others.

    Args:
        gone: Names; those of storage units, which no schedule has, change nothing.
    """

    class Schedule(GridStateFromFile):
        prod_p: np.ndarray

        def initialize(self, loads: Any, generators: Any, *others: Any, **named: Any) -> None:
            super().initialize(loads, generators, *others, **named)
            self.prod_p = moved(self.prod_p, np.isin(generators, list(gone)))

    return Schedule


def moved(power: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """The schedule with what the gone generators produce shared among the others in proportion to their own.

    Wind and sun are no exception, which is a simplification: in the grids of this project their part is small.

    Args:
        power: In MW, (steps, generators).
        gone: (generators,).

    Returns:
        In MW, (steps, generators), with the same sum at each step where at least one of the others produces.
    """
    kept = np.where(gone, 0, power)
    total, left = power.sum(axis=1, keepdims=True), kept.sum(axis=1, keepdims=True)
    return np.asarray(kept * total / np.maximum(left, 1e-6), power.dtype)
