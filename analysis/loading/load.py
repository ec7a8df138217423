"""Run directories -> one tidy frame of episodes and one of runs.

Nothing that lies in the runs folder vanishes: what cannot be used is listed with its state and the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acmr.cells import CELLS, Cell, planned_cells
from acmr.command import typed
from acmr.names import distinct, terminal
from acmr.records import ENDED
from acmr.run_folders import run_folders
from analysis.loading.identify import PAIRS
from analysis.loading.read_run import DAMAGED, DUPLICATE, FOREIGN, SUPERSEDED, FoundRun, no_episodes, read_run

#: States of runs that have come to their end, and so enter the comparisons. A run that diverged will never reach the
#: threshold: leaving it out would favor settings that break.
COUNTED = (*ENDED, FOREIGN)


class InputError(ValueError):
    """Input that cannot be analyzed. Its message is one line for the user."""


@dataclass(frozen=True)
class RunSet:
    """All that was found below one folder.

    Attributes:
        root: The runs folder.
        runs: One row a run, indexed by its path below the root in visible letters: ``directory`` (that path as the
            file system has it), ``group, cell, seed, profile, env, transfer, freeze``
            (see :class:`~analysis.loading.identify.Identity`), ``state`` and ``reason``, ``doubts`` (what
            is not known of a run that counts, as a file was changed or is missing), ``counted`` (enters
            comparisons), ``episodes`` (number), ``last_step`` (end of the last episode), ``horizon`` (step
            up to which the run is known not to have reached the threshold, if it has not), ``cut`` (ends at
            its own threshold, as ``stop=threshold`` has it, before its last step), ``apart`` (shares no
            random numbers with other runs of its seed, as ``seeding=independent`` has it), ``stop_after``
            (step at which a run that is cut ends at the latest), ``total_timesteps``, ``learning_starts``,
            ``acts_from`` (step from which the agent chooses its actions), ``threshold``, ``consecutive``,
            ``wall_seconds``, ``steps_per_second``.
        episodes: One row an episode: ``run, group, seed`` and the columns of ``episodes.csv``; steps ascend within a
            run.
        configs: The settings of each run that has them.
        summaries: The summary of each run that has one.
    """

    root: Path
    runs: pd.DataFrame
    episodes: pd.DataFrame
    configs: dict[str, dict[str, Any]] = field(default_factory=dict)
    summaries: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def groups(self) -> list[str]:
        """Names of the groups that there are: the cells first."""
        found = set(self.runs["group"])
        return [cell for cell in CELLS if cell in found] + sorted(found - CELLS.keys())

    @property
    def cells(self) -> list[Cell]:
        """The cells that the folder should have."""
        return planned_cells(self.runs["group"])

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the source and the target environment."""
        for config in self.configs.values():
            pair = config.get("pair")
            if isinstance(pair, dict) and {"source", "target"} <= set(pair):
                # Both go into a command line.
                source, target = (terminal(str(pair[role]))[:100] for role in ("source", "target"))
                return source, target
        for pair in PAIRS:
            if set(pair) & set(self.runs["env"].dropna()):
                return pair
        return PAIRS[0]


def load(root: Path) -> RunSet:
    """Reads every run below a folder.

    Args:
        root: Usually ``runs/<profile>``; any layout whose runs end in ``<name>/seed_<n>`` is found.

    Raises:
        InputError: If there is no such folder, or it holds runs of more than one profile.
    """
    if not root.is_dir():
        what = "is no folder" if root.exists() else "there is no such folder"
        raise InputError(f"{root}: {what}; give one with runs, as in runs/paper ({typed()} matrix=paper makes it)")
    found = _named([read_run(root, folder) for folder in run_folders(root)])
    runs = _runs_frame([run.row for run in found.values()])
    _one_profile(root, runs)
    _mark_duplicates(runs)
    return RunSet(
        root=root,
        runs=runs,
        episodes=_episodes_frame(runs, {name: run.episodes for name, run in found.items()}),
        configs={name: run.config for name, run in found.items() if run.config},
        summaries={name: run.summary for name, run in found.items() if run.summary},
    )


def _named(runs: list[FoundRun]) -> dict[str, FoundRun]:
    """The runs by names of visible letters; names with bytes that are no text pandas would take for one another."""
    names, groups = (distinct(run.row[key] for run in runs) for key in ("run", "group"))
    rows = [
        run.row | {"run": names[run.row["run"]], "group": groups[run.row["group"]], "directory": run.row["run"]}
        for run in runs
    ]
    return {row["run"]: replace(run, row=row) for run, row in zip(runs, rows, strict=True)}


_RUN_COLUMNS = (
    *("run", "directory", "group", "cell", "seed", "profile", "env", "transfer", "freeze", "state", "reason", "doubts"),
    *("episodes", "last_step", "horizon", "cut", "apart"),
    *("total_timesteps", "stop_after", "learning_starts", "acts_from", "threshold", "consecutive"),
    *("wall_seconds", "steps_per_second", "steps_in_summary"),
)
_FLOATS = _RUN_COLUMNS[_RUN_COLUMNS.index("total_timesteps") :]


def _runs_frame(rows: list[dict[str, Any]]) -> pd.DataFrame:
    frame = pd.DataFrame(rows, columns=list(_RUN_COLUMNS))
    frame = frame.astype({**dict.fromkeys(_FLOATS, "float64"), "seed": "Int64", "cut": "bool", "apart": "bool"})
    frame = frame.astype(dict.fromkeys(("episodes", "last_step", "horizon"), "int64"))
    position = {cell: index for index, cell in enumerate(CELLS)}
    frame["order"] = [position.get(group, len(position)) for group in frame["group"]]
    frame = frame.sort_values(["order", "group", "seed", "run"], kind="stable").drop(columns="order")
    frame["counted"] = frame["state"].isin(COUNTED)
    return frame.set_index("run")


def _one_profile(root: Path, runs: pd.DataFrame) -> None:
    profiles = sorted(set(runs.loc[runs["state"] != DAMAGED, "profile"].dropna()))
    if len(profiles) > 1:
        raise InputError(
            f"{root}: holds runs of the profiles {', '.join(profiles)}, which are no one experiment; "
            f"give one of them, as in {root / profiles[0]}"
        )


def _mark_duplicates(runs: pd.DataFrame) -> None:
    """Of several directories that claim one group and seed, only one may count.

    A finished one does, of those one that other runs of its seed can be paired with, of those the full one, of cut ones
    the one that was watched longest, else the first.
    """
    for _, same in runs[runs["state"] != DAMAGED].groupby(["group", "seed"]):
        if len(same) > 1:
            watched = same["horizon"].where(same["cut"], 0)
            limit = same["stop_after"].fillna(np.inf)
            ranks = same.assign(shared=~same["apart"], full=~same["cut"], watched=watched, limit=limit)
            by = ["counted", "shared", "full", "watched", "limit"]
            kept = ranks.sort_values(by, ascending=False, kind="stable").index[0]
            others = same[same.index != kept]
            alike = others["apart"] == runs.loc[kept, "apart"]
            # Both are the same run as far as the cut one goes: nothing is lost by leaving that out.
            superseded = others["counted"] & others["cut"] & alike
            what = "longer" if runs.loc[kept, "cut"] else "full"
            reasons = np.where(superseded, f"{kept} is the {what} run of the same", f"{kept} is the same")
            hints = np.where(alike, "", "; seeding=independent needs seeds, or an output_dir, of its own")
            runs.loc[others.index, "state"] = np.where(superseded, SUPERSEDED, DUPLICATE)
            runs.loc[others.index, "reason"] = [
                f"{reason} group and seed{hint}" for reason, hint in zip(reasons, hints, strict=True)
            ]
            runs.loc[others.index, "counted"] = False


def _episodes_frame(runs: pd.DataFrame, frames: dict[str, pd.DataFrame]) -> pd.DataFrame:
    order = list(runs.index)
    lengths = [len(frames[name]) for name in order]
    filled = [frames[name] for name in order if len(frames[name])] or [no_episodes()]
    table = pd.concat(filled, ignore_index=True)
    repeat = np.repeat(np.arange(len(order)), lengths)
    table.insert(0, "run", pd.CategoricalIndex(pd.Categorical.from_codes(repeat, categories=pd.Index(order))))
    table.insert(1, "group", runs["group"].to_numpy()[repeat] if len(order) else [])
    table.insert(2, "seed", runs["seed"].array[repeat] if len(order) else [])
    return table
