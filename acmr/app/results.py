"""``acmr.results``: all runs below a folder as tidy tables."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pandas as pd

from analysis.loading.load import load


class Results(NamedTuple):
    """All runs below a folder.

    Attributes:
        runs: One row a run, indexed by its path below the folder: ``group``, ``cell``, ``seed``, ``env``, ``transfer``,
            ``freeze``, ``state`` and ``reason``, ``counted``, ``episodes``, ``threshold`` and more
            (:class:`analysis.loading.load.RunSet`).
        episodes: One row an episode, of all runs: ``run``, ``group``, ``seed`` and the columns of ``episodes.csv``.
    """

    runs: pd.DataFrame
    episodes: pd.DataFrame


def results(path: str | Path) -> Results:
    """Reads every run below a folder, as the analysis does; nothing that is there is left out without a reason.

    Args:
        path: Usually ``runs/<profile>``.

    Raises:
        InputError: A ValueError: if there is no such folder, or it holds runs of more than one profile.
    """
    found = load(Path(path))
    return Results(found.runs, found.episodes)
