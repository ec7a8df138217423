"""Which of the planned runs are not there, and the commands that make them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from shlex import quote

import pandas as pd

from acmr.cells import CELLS
from acmr.command import typed
from acmr.config import INDEPENDENT, THRESHOLD
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


def planned_seeds(runs: pd.DataFrame, cell: str | None = None) -> list[int]:
    """Seeds that a cell should have: the paper's, and all others that one of the paper's cells has been run with.

    A cell that goes beyond the paper has those that it was run with itself in the place of the latter: ten seeds of a
    method that takes minutes do not ask for ten of one that takes hours.

    Args:
        runs: All runs.
        cell: The cell; None: those of the paper.
    """
    beyond = cell is not None and not CELLS[cell].published
    own = [cell] if beyond else [row.name for row in CELLS.values() if row.published]
    seen = runs.loc[runs["cell"].isin(own) & runs["seed"].notna(), "seed"]
    return sorted({*PAPER_SEEDS, *(int(seed) for seed in seen)})


def planned_runs(data: RunSet) -> int:
    """Runs that there should be: every cell with every seed planned for it."""
    return sum(len(planned_seeds(data.runs, cell.name)) for cell in data.cells)


def missing_runs(data: RunSet) -> list[Missing]:
    """Every planned cell and seed without a run that counts, in the order of the cells."""
    runs = data.runs
    profile = profile_of(data)
    option = "" if profile == "paper" else f" {quote(f'profile={profile}')}"
    found = []
    for cell, teaches in ((cell.name, cell.teaches) for cell in data.cells):
        own = runs[runs["cell"] == cell]
        # Students need the whole of their teacher; any other cell that has no run yet ends as those of the folder do.
        alike = own if len(own) or teaches else runs[runs["cell"].notna()]
        for seed in planned_seeds(runs, cell):
            there = own[own["seed"] == seed]
            if not there["counted"].any():
                state = str(there["state"].iloc[0]) if len(there) else "missing"
                force = " force=true" if state == DAMAGED else ""
                # A run that is there goes on as it began; one that is not ends as the others of its cell do.
                stop = stop_words(there if len(there) else alike)
                line = f"{typed()} experiment={cell} seed={seed}{option}{stop}{force}"
                found.append(Missing(cell, seed, state, line))
    return found


def stop_words(runs: pd.DataFrame) -> str:
    """What is typed so that a run ends, and draws from its seed, as these do; empty for the paper's way."""
    seeding = f" seeding={INDEPENDENT}" if runs["apart"].any() else ""
    limits = runs.loc[runs["cut"], "stop_after"]
    if limits.empty:
        return seeding
    return f" stop={THRESHOLD}{'' if pd.isna(limits.max()) else f' stop_after={limits.max():.0f}'}{seeding}"


def command_for(runs: pd.DataFrame, seeds: Iterable[int], profile: str) -> str:
    """The command that makes these seeds of a cell as its runs here were made; empty for what is no cell."""
    cell = runs["cell"].iloc[0]
    if pd.isna(cell):
        return ""
    return f"{typed()} {quote(f'matrix={profile}')} experiment={cell} seed={_list(seeds)}{stop_words(runs)}"


def profile_of(data: RunSet) -> str:
    """The profile that the runs say (any text), else the folder's name as in ``runs/quick``, else the paper's."""
    said = data.runs["profile"].dropna()
    if len(said):
        return str(said.iloc[0])
    folder = data.root.resolve()
    return folder.name if folder.parent.name == "runs" else "paper"


def matrix_command(data: RunSet) -> str:
    """The one command that makes all that is missing and leaves alone what is complete."""
    words, seeds = [f"{typed()} {quote(f'matrix={profile_of(data)}')}"], planned_seeds(data.runs)
    stop, missing = stop_words(data.runs[data.runs["cell"].notna()]), missing_runs(data)
    if missing and (stop or any(run.seed not in seeds for run in missing)):
        # Only what is missing is named: what is complete may have been made with another stop_after, and further seeds
        # of one cell are none of the others'.
        cells, lacking = dict.fromkeys(run.cell for run in missing), sorted({run.seed for run in missing})
        return f"{words[0]} experiment={_list(cells)} seed={_list(lacking)}{stop}"
    if not all(cell.published for cell in data.cells):
        words.append(f"experiment={_list(cell.name for cell in data.cells)}")
    if tuple(seeds) != PAPER_SEEDS:
        words.append(f"seed={_list(seeds)}")
    return " ".join(words)


def _list(values: Iterable[object]) -> str:
    return ",".join(map(str, values))
