"""Which runs that stop at their threshold may be used while others of their cell are under way.

Of such runs the fast ones end first. A cell of which only some have ended would look faster than it is, and a test
would be of the runs that the clock has picked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd

from analysis.loading.missing import PAPER_SEEDS, command_for
from analysis.loading.read_run import UNFINISHED
from analysis.statistics.metrics import END_MEASURES

#: State of a run that has ended and is not used before others have.
WAITING = "waiting"


def settle(runs: pd.DataFrame, planned: Iterable[int], profile: str) -> pd.DataFrame:
    """Decides for each group with runs that stopped at their threshold whether it may enter means and tests.

    It may once every seed planned for it is known: has ended, has reached the threshold, or is past the slowest run
    that has ended; such a run under way then counts as not reached by its latest step. Failing that it enters with the
    paper's seeds alone, if these are known: a set that was chosen beforehand is not chosen by speed. Failing that, too,
    it is biased. Groups of full runs only are left as they are: when those end has nothing to do with how they do.

    Args:
        runs: The runs with their metrics (:func:`analysis.statistics.metrics.measure`).
        planned: Seeds that a group is planned to have; those that it has belong to them, too.
        profile: Name of the profile, for the commands.

    Returns:
        The frame with ``counted``, ``state`` and ``reason`` changed accordingly, and ``bias``: empty, or what is
        missing of the run's group, and what to type.
    """
    runs = runs.copy()
    for group in dict.fromkeys(runs.loc[runs["counted"] & runs["cut"], "group"]):
        own = runs[runs["group"] == group]
        seeds = sorted({*planned, *(int(seed) for seed in own["seed"].dropna())})
        if set(seeds) <= set(own.loc[own["counted"], "seed"]):
            continue  # all have ended
        unknown, first = _unknown(own, seeds), own[own["seed"].isin(PAPER_SEEDS)]
        if unknown and not (first["counted"].any() and _is_whole(first)):
            runs.loc[own.index, "bias"] = _sentence(str(group), own, unknown, profile)
            continue
        if unknown:
            _set_aside(runs, own[own["counted"] & own["cut"] & ~own["seed"].isin(PAPER_SEEDS)], unknown)
            own = first
        _count_as_censored(runs, own)
    return runs


def _is_whole(first: pd.DataFrame) -> bool:
    """Whether of the paper's seeds all are known, or those that are were not picked by their speed."""
    return not _is_selected(first) or not _unknown(first, PAPER_SEEDS)


def _is_selected(runs: pd.DataFrame) -> bool:
    return bool((runs["counted"] & runs["cut"]).any())


def _unknown(runs: pd.DataFrame, seeds: Sequence[int]) -> list[int]:
    """Those of the seeds of which nothing is known that the ended runs of the group could be compared with."""
    known = runs[runs["counted"] | _is_known(runs)]
    return [seed for seed in seeds if seed not in set(known["seed"])]


def _is_known(runs: pd.DataFrame) -> pd.Series:
    """Whether a run under way has reached the threshold, or is past all runs of the group that have ended."""
    ended = runs[runs["counted"]]
    # A run that was cut ended where it reached its own threshold, which need not be the one that is asked for.
    slowest = ended["time"].where(~ended["cut"], ended["horizon"]).max()
    return (runs["state"] == UNFINISHED) & (~runs["censored"].astype(bool) | (runs["horizon"] > slowest))


def _count_as_censored(runs: pd.DataFrame, own: pd.DataFrame) -> None:
    known = own.index[_is_known(own)] if _is_selected(own) else own.index[:0]
    runs.loc[known, "counted"] = True
    runs.loc[known, list(END_MEASURES)] = float("nan")
    for name in known:
        said = "has reached" if not runs.loc[name, "censored"] else f"not reached by step {runs.loc[name, 'horizon']:,}"
        runs.loc[name, "reason"] = f"{runs.loc[name, 'reason']}; counts: {said}, and all others are known up to there"


def _set_aside(runs: pd.DataFrame, later: pd.DataFrame, unknown: list[int]) -> None:
    runs.loc[later.index, "counted"] = False
    runs.loc[later.index, "state"] = WAITING
    which = ", ".join(map(str, unknown))
    runs.loc[later.index, "reason"] = (
        f"the fast ones end first: counts once seed {which} of its group is known; until then the paper's seeds do"
    )


def _sentence(group: str, own: pd.DataFrame, unknown: list[int], profile: str) -> str:
    said = []
    for seed in unknown:
        there = own[own["seed"] == seed].to_dict("records")
        state = there[0]["state"] if there else "missing"
        step = f" at step {there[0]['horizon']:,}" if state == UNFINISHED else ""
        said.append(f"{seed} ({state}{step})")
    what = command_for(own, unknown, profile)
    words = ("seed", "has") if len(unknown) == 1 else ("seeds", "have")
    return (
        f"{group}: biased, so no test: of runs that stop at their threshold the fast ones end first, and "
        f"{words[0]} {', '.join(said)} {words[1]} not ended{f'. Type {what}' if what else ''}"
    )
