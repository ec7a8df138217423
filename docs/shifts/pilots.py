"""Pilots of the benchmark of structural shifts -> ``docs/pilots/shifts.csv``: ``python -m docs.shifts.pilots RUNS``.

A body's threshold follows from its pilots, runs from nothing with seeds that no reported run has: the median of the
returns that they had reached five times in a row by 60% of their steps, rounded down to two digits.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np

from analysis.loading.load import load

ROOT = Path(__file__).resolve().parents[2]
PILOTS = ROOT / "docs" / "pilots" / "shifts.csv"
#: Seeds of pilots, and the part of their steps by which the median of them is to be at the threshold.
SEEDS, PART = (101, 102, 103), 0.6
#: Parts of a run whose mean returns are kept.
FIFTHS = 5
COLUMNS = ["body", "seed", "level", *(f"return_{fifth}" for fifth in range(1, FIFTHS + 1)), "steps", "processor"]


def level(steps: Sequence[int], returns: Sequence[float], until: float, consecutive: int) -> float:
    """The highest threshold that so many episodes in a row had met by a step; NaN if there were fewer.

    Args:
        steps: Step at each episode's end, (episodes,), ascending.
        returns: Return of each episode, (episodes,).
        until: The step.
        consecutive: Episodes in a row.
    """
    known = np.asarray(returns, dtype=float)[np.asarray(steps) <= until]
    if len(known) < consecutive:
        return math.nan
    return float(np.lib.stride_tricks.sliding_window_view(known, consecutive).min(axis=1).max())


def threshold(levels: Sequence[float]) -> float:
    """The threshold of a body whose pilots had reached these levels: their median, rounded down to two digits."""
    middle = median(levels)
    unit = 10.0 ** (math.floor(math.log10(middle)) - 1)
    # Of a quotient such as 2.9999999999999996 the whole number is meant.
    return math.floor(round(middle / unit, 9)) * unit


def pilots() -> dict[str, list[float]]:
    """The levels of each body's committed pilots, by its name."""
    found: dict[str, list[float]] = {}
    if not PILOTS.is_file():
        return found
    with PILOTS.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            found.setdefault(row["body"], []).append(float(row["level"]))
    return found


def rows(runs: Path) -> list[list[object]]:
    """``COLUMNS`` of each pilot below a folder."""
    data = load(runs)
    episodes = {str(name): frame for name, frame in data.episodes.groupby("run", observed=True)}
    found: list[list[object]] = []
    for name, run in data.runs[data.runs["counted"]].sort_values(["env", "seed"]).iterrows():
        if run["transfer"] != "none" or run["seed"] not in SEEDS:
            continue
        own, budget = episodes[str(name)], run["total_timesteps"]
        reached = level(own["global_step"], own["episodic_return"], PART * budget, int(run["consecutive"]))
        fifth = np.ceil(own["global_step"] / budget * FIFTHS)
        means = own["episodic_return"].groupby(fifth).mean()
        machine = data.summaries[str(name)]["machine"]["processor"]
        told = [f"{means.get(part, math.nan):.1f}" for part in range(1, FIFTHS + 1)]
        found.append([run["env"], run["seed"], f"{reached:.1f}", *told, int(budget), machine])
    return found


def main() -> None:
    """Adds the pilots below a folder to the committed ones, and says which thresholds follow."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, help="folder of the pilots, as runs/shifts")
    made = {(str(row[0]), str(row[1])): [str(value) for value in row] for row in rows(parser.parse_args().runs)}
    if PILOTS.is_file():
        with PILOTS.open(encoding="utf-8") as file:
            made = {(row[0], row[1]): row for row in list(csv.reader(file))[1:]} | made
    with PILOTS.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *(made[key] for key in sorted(made))])
    for body, levels in pilots().items():
        done = len(levels) == len(SEEDS)
        print(f"{body}: " + (f"threshold: {threshold(levels):g}" if done else f"{len(levels)} of {len(SEEDS)} pilots"))


if __name__ == "__main__":
    main()
