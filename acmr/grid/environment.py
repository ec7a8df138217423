"""The power grid as an environment: what its operator sees, commands and earns."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import grid2op
import gymnasium as gym
import numpy as np
from grid2op.Action import PlayableAction
from grid2op.Parameters import Parameters
from grid2op.Reward import CloseToOverflowReward, CombinedScaledReward, EconomicReward
from gymnasium.spaces import Box
from lightsim2grid import LightSimBackend

from acmr.grid.controls import controls
from acmr.grid.schedule import schedule_without
from acmr.grid.sensors import sensors


class PowerGridEnv(gym.Env[np.ndarray, np.ndarray]):
    """One of grid2op's grids over a day, drawn from those that come with it.

    A step is five minutes. Each generator that can be dispatched is ordered to so many MW above or below its schedule,
    where it goes as fast as it can; each renewable one gets the share of its rated power that it may not exceed, each
    storage unit its power in MW (positive charges it). A line that stays overloaded is switched off by its protection,
    which loads others: a blackout ends the episode.

    The reward is the mean of two of grid2op's, each from 0 to 1, and 0 where a command was impossible or the grid went
    black: ``EconomicReward``, the cost of generation that was avoided, as a share of the cost of all generators at
    their rated power; and ``CloseToOverflowReward``, 1 less a fifth for each line within 5% (large ones: 2.5%) of its
    limit. So a day's return grows with each step that the grid stays up, with cheap energy in place of dear, and with
    lines that have something in hand.

    Attributes:
        observation_names: ``gen_p/gen_1_0``, ``rho/0_1_0``, ...: grid2op's attribute, then its name for the component.
        action_names: ``redispatch/gen_1_0``, ``curtail/gen_5_2``, ``storage/storage_5_0``.
    """

    def __init__(self, grid: str = "educ_case14_storage", decommissioned: Sequence[str] = ()) -> None:
        """Loads the grid.

        Args:
            grid: One that comes with grid2op.
            decommissioned: Names of generators and storage units that are gone: they have neither sensors nor commands,
                and the other generators produce in the place of such a one.

        Raises:
            ValueError: If there is no such grid or component, or if nothing would be left to command.
        """
        if isinstance(decommissioned, str):
            raise ValueError(f"decommissioned={decommissioned}: a list is needed: [{decommissioned}]")
        self._simulation = _load(grid, decommissioned)
        known = [*self._simulation.name_gen, *self._simulation.name_storage]
        for name in decommissioned:
            if name not in known:
                given = f"decommissioned=[{','.join(map(str, decommissioned))}]"
                raise ValueError(f"{given}: this grid has no {name}; it has {', '.join(known)}")
        self._controls = controls(self._simulation, decommissioned)
        self._sensors = sensors(self._simulation, decommissioned)
        self.action_names = self._controls.names
        self.observation_names = self._sensors.names
        self.action_space = Box(self._controls.low, self._controls.high, dtype=np.float32)
        self.observation_space = Box(-np.inf, np.inf, (len(self.observation_names),), np.float32)
        self._days = len(self._simulation.chronics_handler.subpaths)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins a day.

        Args:
            seed: Of the days that are drawn from now on.
            options: ``{"day": 3}`` begins that one.
        """
        super().reset(seed=seed)
        # Both are drawn anew for each episode, so that the generator's state says all that outlives a reset.
        day, noise = int(self.np_random.integers(self._days)), int(self.np_random.integers(2**31 - 1))
        day = (options or {}).get("day", day)
        self._last = self._simulation.reset(seed=noise, options={"time serie id": day})
        return self._sensors.read(self._last), {"day": day}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Five minutes of the grid.

        Args:
            action: As ``action_names`` says, (commands,).
        """
        command = self._controls.command(self._simulation.action_space(), np.asarray(action), self._last)
        self._last, reward, done, info = self._simulation.step(command)
        # The grid goes on after a day, so its end is a limit in time and not the task's; a blackout is the task's.
        black = done and bool(info["exception"])
        return self._sensors.read(self._last), float(reward), black, done and not black, {}

    def close(self) -> None:
        """Ends the simulation."""
        self._simulation.close()


def _load(grid: str, decommissioned: Sequence[str]) -> Any:
    known = grid2op.list_available_test_env()
    if grid not in known:
        raise ValueError(f"grid={grid}: grid2op brings no such grid; it brings {', '.join(known)}")
    parameters = Parameters()
    # A command to curtail or to store that the other units cannot make up for is done in part; else it ends the day.
    parameters.LIMIT_INFEASIBLE_CURTAILMENT_STORAGE_ACTION = True
    with warnings.catch_warnings():
        # It warns that its bundled grids are meant for tests: they are small ones, which is what is wanted here.
        warnings.simplefilter("ignore")
        simulation = grid2op.make(
            grid,
            test=True,
            backend=LightSimBackend(),
            action_class=PlayableAction,
            reward_class=CombinedScaledReward,
            param=parameters,
            data_feeding_kwargs={"gridvalueClass": schedule_without(decommissioned)},
        )
    reward = simulation.get_reward_instance()
    reward.addReward("economy", EconomicReward(), 1.0)
    reward.addReward("margin", CloseToOverflowReward(), 1.0)
    reward.set_range(0.0, 1.0)
    reward.initialize(simulation)
    return simulation
