"""Which of the planned runs are not there, and the commands that make them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import pandas as pd

from analysis.loading.load import RunSet
from analysis.loading.read_run import DAMAGED

#: The paper's seeds (section 4.2).
PAPER_SEEDS = (1, 2, 3)


@dataclass(frozen=True)
class Missing:
    """One run of the matrix that does not count.

    Attributes:
        cell: The cell.
        seed: The seed.
        state: ``missing`` if there is nothing, else the state of what there is.
        command: What makes it, or takes it on.
    """

    cell: str
    seed: int
    state: str
    command: str


def planned_seeds(runs: pd.DataFrame) -> list[int]:
    """The paper's seeds and all others that a cell has been run with."""
    seen = runs.loc[runs["cell"].notna() & runs["seed"].notna(), "seed"]
    return sorted({*PAPER_SEEDS, *(int(seed) for seed in seen)})


def missing_runs(data: RunSet) -> list[Missing]:
    """Every planned cell and seed without a run that counts, in the order of the cells."""
    runs = data.runs
    profile = profile_of(data)
    option = "" if profile == "paper" else f" profile={profile}"
    found = []
    for cell in (cell.name for cell in data.cells):
        for seed in planned_seeds(runs):
            there = runs[(runs["cell"] == cell) & (runs["seed"] == seed)]
            if not there["counted"].any():
                state = str(there["state"].iloc[0]) if len(there) else "missing"
                force = " force=true" if state == DAMAGED else ""
                found.append(Missing(cell, seed, state, f"python run.py experiment={cell} seed={seed}{option}{force}"))
    return found


def profile_of(data: RunSet) -> str:
    """The profile that the runs say, else the folder's name as in ``runs/quick``, else the paper's."""
    said = data.runs["profile"].dropna()
    if len(said):
        return str(said.iloc[0])
    folder = data.root.resolve()
    return folder.name if folder.parent.name == "runs" else "paper"


def matrix_command(data: RunSet) -> str:
    """The one command that makes all that is missing and leaves alone what is complete."""
    words, seeds = [f"python run.py matrix={profile_of(data)}"], planned_seeds(data.runs)
    if not all(cell.published for cell in data.cells):
        words.append(f"experiment={_list(cell.name for cell in data.cells)}")
    if tuple(seeds) != PAPER_SEEDS:
        words.append(f"seed={_list(seeds)}")
    return " ".join(words)


def _list(values: Iterable[object]) -> str:
    return ",".join(map(str, values))
