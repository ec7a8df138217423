"""The tables of ``docs/howto-grid.md``; ``python -m docs.grid`` writes them from committed files.

``python -m docs.grid --play`` also plays the policies that learn nothing, which needs the extra ``grid``.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np

from acmr.cells import CELLS
from acmr.records import EVALUATION_FILE, SUMMARY_FILE
from analysis.loading.load import load
from docs.markdown import number, steps, table

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "howto-grid.md"
PUBLISHED = ROOT / "results" / "grid"
#: What doing nothing and acting at random earn, a row for each day.
UNTAUGHT = ROOT / "docs" / "pilots" / "grid_untaught.csv"
#: The episodes of an evaluation begin with these, so days and noise are the same for all policies.
SEEDS = range(20)
GRIDS = ("grid14", "grid14_reduced")
DAY = 288


def play() -> None:
    """Plays twenty days of each grid with two policies that learn nothing, and writes what they earn."""
    from acmr.envs import make_env
    from acmr.settings.compose import environment_config

    rows = []
    for grid in GRIDS:
        env = make_env(environment_config(grid))
        low, high = env.action_space.low, env.action_space.high
        rng = np.random.default_rng(0)
        still = np.array([name.startswith("curtail") for name in env.unwrapped.action_names], np.float32)
        policies: dict[str, Callable[[], np.ndarray]] = {
            "nothing": lambda still=still: still,
            "random": lambda low=low, high=high, rng=rng: rng.uniform(low, high).astype(np.float32),
        }
        for policy, act in policies.items():
            for seed in SEEDS:
                env.reset(seed=seed)
                earned, length, over = 0.0, 0, False
                while not over:
                    _, reward, black, late, _ = env.step(act())
                    earned, length, over = earned + reward, length + 1, black or late
                rows.append([grid, policy, seed, f"{earned:.4f}", length])
    with UNTAUGHT.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([["grid", "policy", "seed", "return", "steps"], *rows])


def tables() -> dict[str, str]:
    """Each table in Markdown, by its name on the page."""
    return {"grid policies": _policies(), "grid cells": _cells()}


def filled() -> str:
    """The page with its tables as they are now."""
    page = PAGE.read_text(encoding="utf-8")
    for name, text in tables().items():
        between = f"<!-- {name} -->\n{text}\n<!-- /{name} -->"
        place = rf"<!-- {name} -->\n.*?<!-- /{name} -->"
        page = re.sub(place, lambda _, between=between: between, page, flags=re.DOTALL)
    return page


def _policies() -> str:
    """What is earned in a day, and how many days end without a blackout."""
    played: dict[tuple[str, str], list[tuple[float, int]]] = defaultdict(list)
    with UNTAUGHT.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            played[row["grid"], row["policy"]].append((float(row["return"]), int(row["steps"])))
    rows = []
    for grid, cells in zip(GRIDS, (("H0",), ("A0", "N1")), strict=True):
        for policy in ("nothing", "random"):
            days = played[grid, policy]
            rows.append([grid, {"nothing": "do nothing", "random": "at random"}[policy], *_earned(days)])
        for cell in cells:
            for seed, days in evaluated(cell):
                rows.append([grid, f"{cell}, seed {seed}, learned", *_earned(days)])
    return table(["grid", "policy", "mean return of 20 days", "days without a blackout"], rows)


def _earned(days: list[tuple[float, int]]) -> list[str]:
    return [number(mean(earned for earned, _ in days), 1), f"{sum(length == DAY for _, length in days)} of {len(days)}"]


def evaluated(cell: str) -> Iterable[tuple[int, list[tuple[float, int]]]]:
    """The evaluations of a cell's published runs, by seed."""
    for seed, folder in _runs()[cell]:
        found = json.loads((folder / EVALUATION_FILE).read_text(encoding="utf-8"))
        yield seed, [(episode["episodic_return"], episode["episode_length"]) for episode in found["each"]]


def _cells() -> str:
    """Each cell's steps to threshold, and what it earned at the end of training."""
    rows = []
    for cell, runs in _runs().items():
        told = [json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8")) for _, folder in runs]
        met = [run["steps_to_threshold"] for run in told if run["steps_to_threshold"]]
        final = [run["final_return"] for run in told]
        spread = f" ± {number(stdev(final), 1)}" if len(final) > 1 else ""
        rows.append(
            [
                cell,
                ", ".join(str(seed) for seed, _ in runs),
                f"{len(met)} of {len(runs)}",
                ", ".join(steps(value) for value in met) or "–",
                f"{number(mean(final), 1)}{spread}",
            ]
        )
    return table(["cell", "seeds", "reached", "steps to threshold", "return, last 10 episodes"], rows)


def _runs() -> dict[str, list[tuple[int, Path]]]:
    """The published runs by cell, each with its seed."""
    found = load(PUBLISHED).runs
    cells: dict[str, Any] = {cell: [] for cell in CELLS if cell in set(found["cell"])}
    for name, run in found.sort_values("seed").iterrows():
        cells[run["cell"]].append((int(run["seed"]), PUBLISHED / str(name)))
    return cells


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--play", action="store_true", help="play the policies that learn nothing again")
    if parser.parse_args().play:
        play()
    PAGE.write_text(filled(), encoding="utf-8")
