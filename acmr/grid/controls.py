"""What an operator commands: power of generators and storage units, within the ratings of the grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

#: Steps of ramping that a generator may be ordered away from its schedule: a quarter of an hour.
_RAMPS = 3


@dataclass(frozen=True)
class Controls:
    """The commands of a grid, side by side.

    Attributes:
        names: One per command.
        low: The least value of each, (commands,), in MW (of a dispatch, beside the schedule); for curtailments a share.
        high: The greatest.
        redispatched, curtailed, stored: Indices of the generators and storage units they are for, in this order.
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    redispatched: np.ndarray
    curtailed: np.ndarray
    stored: np.ndarray

    def command(self, empty: Any, action: np.ndarray, seen: Any) -> Any:
        """grid2op's action for an agent's.

        Args:
            empty: One that does nothing; it is filled.
            action: (commands,).
            seen: The last observation of grid2op's: what is dispatched so far.
        """
        first, second = len(self.redispatched), len(self.redispatched) + len(self.curtailed)
        if len(self.redispatched):
            empty.redispatch = self._ramped(action[:first], seen)
        if len(self.curtailed):
            limits = np.full(seen.n_gen, -1.0, np.float32)  # -1: not curtailed
            limits[self.curtailed] = action[first:second]
            empty.curtail = limits
        if len(self.stored):
            power = np.zeros(seen.n_storage, np.float32)
            power[self.stored] = action[second:]
            empty.storage_p = power
        return empty

    def _ramped(self, ordered: np.ndarray, seen: Any) -> np.ndarray:
        """The change of each generator's dispatch in this step, in MW, (generators,): towards what was ordered.

        grid2op is told changes. An agent orders levels, so that the noise of its actions does not add up.
        """
        change = np.zeros(seen.n_gen, np.float32)
        units = self.redispatched
        wanted = ordered - seen.target_dispatch[units]
        change[units] = np.clip(wanted, -seen.gen_max_ramp_down[units], seen.gen_max_ramp_up[units])
        return change


def controls(grid: Any, gone: Sequence[str]) -> Controls:
    """The commands that a grid without some components has.

    Args:
        grid: A grid2op environment.
        gone: Names of generators and storage units.

    Raises:
        ValueError: If none is left.
    """
    there = ~np.isin(grid.name_gen, list(gone))
    dispatched = np.flatnonzero(grid.gen_redispatchable & there)
    curtailed = np.flatnonzero(grid.gen_renewable & there)
    stored = np.flatnonzero(~np.isin(grid.name_storage, list(gone)))
    names = [f"redispatch/{grid.name_gen[unit]}" for unit in dispatched]
    names += [f"curtail/{grid.name_gen[unit]}" for unit in curtailed]
    names += [f"storage/{grid.name_storage[unit]}" for unit in stored]
    if not names:
        raise ValueError("decommissioned: no generator and no storage unit would be left to command; name fewer")
    low = [-_RAMPS * grid.gen_max_ramp_down[dispatched], np.zeros(len(curtailed)), -grid.storage_max_p_prod[stored]]
    high = [_RAMPS * grid.gen_max_ramp_up[dispatched], np.ones(len(curtailed)), grid.storage_max_p_absorb[stored]]
    return Controls(
        tuple(names),
        np.concatenate(low).astype(np.float32),
        np.concatenate(high).astype(np.float32),
        dispatched,
        curtailed,
        stored,
    )
