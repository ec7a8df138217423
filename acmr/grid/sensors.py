"""What an operator sees: the grid's measurements, scaled by its own ratings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_DAY = 24 * 60
#: Of a line, as a share of its limit: what goes on below is of less interest than the same difference above.
_LOADED = 0.8


@dataclass(frozen=True)
class Sensors:
    """The measurements of a grid, side by side.

    Attributes:
        names: One per measurement.
        groups: Pairs of the components a kind of measurement is taken of and how to read and scale it.
    """

    names: tuple[str, ...]
    groups: tuple[tuple[np.ndarray, Callable[[Any], np.ndarray]], ...]

    def read(self, seen: Any) -> np.ndarray:
        """The observation of an agent, (measurements,), of grid2op's."""
        values = [read(seen)[components] for components, read in self.groups]
        clock = 2 * np.pi * (60 * seen.hour_of_day + seen.minute_of_hour) / _DAY
        return np.concatenate([*values, [np.sin(clock), np.cos(clock)]]).astype(np.float32)


def sensors(grid: Any, gone: Sequence[str]) -> Sensors:
    """The measurements that a grid without some components has.

    Each is scaled by a constant of the grid: power is divided by the generator's, the storage unit's or, for a load, by
    a mean load's share of all rated power, energy by the unit's capacity; a line's current is 0 at 80% of its thermal
    limit and 1 at the limit.

    Args:
        grid: A grid2op environment.
        gone: Names of generators and storage units.
    """
    generators = np.flatnonzero(~np.isin(grid.name_gen, list(gone)))
    dispatched = np.flatnonzero(grid.gen_redispatchable & ~np.isin(grid.name_gen, list(gone)))
    renewable = np.flatnonzero(grid.gen_renewable & ~np.isin(grid.name_gen, list(gone)))
    stored = np.flatnonzero(~np.isin(grid.name_storage, list(gone)))
    lines, loads = np.arange(grid.n_line), np.arange(grid.n_load)
    load = grid.gen_pmax.sum() / grid.n_load
    charged = np.maximum(grid.storage_max_p_absorb, grid.storage_max_p_prod)
    overload = grid.parameters.NB_TIMESTEP_OVERFLOW_ALLOWED
    kinds: list[tuple[str, np.ndarray, np.ndarray, Callable[[Any], np.ndarray]]] = [
        ("gen_p", grid.name_gen, generators, lambda seen: seen.gen_p / grid.gen_pmax),
        ("target_dispatch", grid.name_gen, dispatched, lambda seen: seen.target_dispatch / grid.gen_pmax),
        ("actual_dispatch", grid.name_gen, dispatched, lambda seen: seen.actual_dispatch / grid.gen_pmax),
        ("curtailment_limit", grid.name_gen, renewable, lambda seen: seen.curtailment_limit),
        ("load_p", grid.name_load, loads, lambda seen: seen.load_p / load),
        ("load_q", grid.name_load, loads, lambda seen: seen.load_q / load),
        ("rho", grid.name_line, lines, lambda seen: (seen.rho - _LOADED) / (1 - _LOADED)),
        ("timestep_overflow", grid.name_line, lines, lambda seen: seen.timestep_overflow / overload),
        ("line_status", grid.name_line, lines, lambda seen: seen.line_status),
        ("storage_charge", grid.name_storage, stored, lambda seen: seen.storage_charge / grid.storage_Emax),
        ("storage_power", grid.name_storage, stored, lambda seen: seen.storage_power / charged),
    ]
    names = [f"{kind}/{component[index]}" for kind, component, kept, _ in kinds for index in kept]
    return Sensors((*names, "clock/sin", "clock/cos"), tuple((kept, read) for _, _, kept, read in kinds))
