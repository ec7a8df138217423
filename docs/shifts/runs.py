"""The runs of the benchmark of structural shifts, one row a run, with what ``docs/shifts.md`` tells of each."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acmr.cells import CELLS, run_name
from acmr.records import steps_to_threshold
from analysis.loading.load import RunSet, load
from analysis.statistics.metrics import asymptotic_return
from analysis.statistics.study.aggregates import LEAST_RUNS

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = ROOT / "results" / "shifts"
#: The methods, by the cells that they are in other profiles, in the order of the tables; the first is the baseline.
METHODS = {
    "A0": "from nothing",
    "A2": "hidden layers, frozen",
    "A3": "expanded",
    "N0": "by name",
    "N1": "by name, best start",
}
BASELINE = next(iter(METHODS))
#: The pairs in the order of the tables; each is called as the environment of its students.
PAIRS = (
    *("ant_leg_lost", "ant_leg_added", "walker2d_foot_lost", "walker2d_foot_added"),
    *("halfcheetah_motor_failed", "halfcheetah_motor_added", "hopper_sensors_failed", "hopper_sensors_added"),
    *("humanoid_arm_lost", "humanoid_arm_added"),
)
#: Seeds that every method of every pair is to have; others are pilots, on which something was chosen.
PLANNED = range(1, 11)
#: Part of the budget whose episodes tell the return at a tenth of it.
EARLY = (0.05, 0.1)
#: Beside the runs: what each policy returns before any learning (:mod:`docs.shifts.play`).
ZERO_SHOT = "zero_shot.csv"
COLUMNS = ["pair", "method", "seed", "steps", "reached", "zero_shot", "early", "final", "threshold", "budget", "run"]


@dataclass(frozen=True)
class Benchmark:
    """All runs of the benchmark that there are.

    Attributes:
        data: The runs as they lie in their folder.
        runs: ``COLUMNS``, a row for each run that counts and each pair that it belongs to (a baseline may be that of
            two). ``steps``: to the threshold, or the budget where it was not met; ``zero_shot``: mean return before any
            learning; ``early``: mean return of the episodes that end in the part ``EARLY`` of the budget; ``final``: of
            those in its last tenth.
    """

    data: RunSet
    runs: pd.DataFrame

    @property
    def pairs(self) -> list[str]:
        """Pairs of which there are students."""
        there = set(self.runs.loc[self.runs["method"] != BASELINE, "pair"])
        return [pair for pair in PAIRS if pair in there]

    @property
    def whole(self) -> list[str]:
        """Pairs of which every method has runs enough."""
        return [pair for pair in self.pairs if min(len(self.of(pair, method)) for method in METHODS) >= LEAST_RUNS]

    def of(self, pair: str, method: str) -> pd.DataFrame:
        """The runs of one method in one pair, by their seeds."""
        own = self.runs[(self.runs["pair"] == pair) & (self.runs["method"] == method)]
        return own.sort_values("seed")


def read(root: Path) -> Benchmark:
    """Reads the runs below a folder, as ``results/shifts``, that are planned."""
    data = load(root)
    counted = data.runs[data.runs["counted"] & data.runs["seed"].isin(PLANNED)]
    episodes = {str(name): frame for name, frame in data.episodes.groupby("run", observed=True)}
    played = _played(root / ZERO_SHOT)
    bodies = {str(run["env"]): _body(data.configs[str(name)]) for name, run in counted.iterrows()}
    rows = []
    for pair in PAIRS:
        # A baseline that was trained under the pair's own name goes before the same run of another name.
        alike = [pair, *(name for name, body in bodies.items() if name != pair and body == bodies.get(pair))]
        for method in METHODS:
            taken: set[int] = set()
            for environment in alike if method == BASELINE else [pair]:
                own = counted[(counted["group"] == _group(environment, method)) & ~counted["seed"].isin(taken)]
                rows += [_row(pair, method, str(name), run, episodes, played) for name, run in own.iterrows()]
                taken |= set(own["seed"])
    return Benchmark(data, pd.DataFrame(rows, columns=COLUMNS))


def early_return(steps: np.ndarray, returns: np.ndarray, budget: float) -> float:
    """Mean return of the episodes that end in the part ``EARLY`` of the budget; NaN without any."""
    within = (steps > EARLY[0] * budget) & (steps <= EARLY[1] * budget)
    return float(returns[within].mean()) if within.any() else float("nan")


def _row(
    pair: str,
    method: str,
    name: str,
    run: pd.Series,
    episodes: Mapping[str, pd.DataFrame],
    played: Mapping[tuple[str, str, int], float],
) -> list[Any]:
    own, budget = episodes[name], float(run["total_timesteps"])
    steps, returns = own["global_step"].to_numpy(), own["episodic_return"].to_numpy()
    met = steps_to_threshold(steps.tolist(), returns.tolist(), run["threshold"], int(run["consecutive"]))
    return [
        *(pair, method, int(run["seed"]), budget if met is None else float(met.last), met is not None),
        played.get((pair, method, int(run["seed"])), float("nan")),
        *(early_return(steps, returns, budget), asymptotic_return(steps, returns)),
        *(run["threshold"], budget, name),
    ]


def _group(environment: str, method: str) -> str:
    cell = CELLS[method]
    return run_name(environment, cell.transfer, cell.freeze, cell.changes)


def _body(config: Mapping[str, Any]) -> dict[str, Any]:
    """What an environment is, whatever it is called and whoever teaches in it."""
    return {key: value for key, value in config["env"].items() if key not in ("name", "source")}


def _played(path: Path) -> dict[tuple[str, str, int], float]:
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {(row["pair"], row["method"], int(row["seed"])): float(row["mean_return"]) for row in rows}
