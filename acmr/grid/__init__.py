"""A power grid whose operators keep its lines from overloading, as a Gymnasium environment: ``acmr.grid:PowerGrid-v0``.

The simulation is grid2op's, its power flow lightsim2grid's; both come with the extra ``grid``.
"""

import importlib
import importlib.util
import warnings

import gymnasium as gym

for _package in ("grid2op", "lightsim2grid"):
    if importlib.util.find_spec(_package) is None:
        raise ModuleNotFoundError(f"{_package} is not installed; type pip install 'acmr[grid]'", name=_package)

with warnings.catch_warnings():
    # It advises, once, on a package that speeds up another power flow than the one used here.
    warnings.filterwarnings("ignore", "Numba cannot be loaded")
    importlib.import_module("grid2op.Backend")

# A day in steps of five minutes.
gym.register("PowerGrid-v0", "acmr.grid.environment:PowerGridEnv", max_episode_steps=288)
