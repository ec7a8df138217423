"""What a cell costs with the steps of its teacher, and without."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acmr.cells import CELLS
from acmr.records import TRANSFER_FILE, DamagedError
from analysis.loading.values import number, read_mapping
from analysis.statistics.comparisons import bias, common_horizon, stopped_before
from analysis.statistics.survival import restricted_mean

_NAN = float("nan")

COLUMNS = [
    *("group", "baseline", "runs", "censored", "own_steps", "teacher_steps", "total_steps", "teacher_to_threshold"),
    *("baseline_steps", "saved_steps", "students_to_repay"),
]


def costs(root: Path, runs: pd.DataFrame, groups: Iterable[str], reference: str) -> pd.DataFrame:
    """The steps of each group up to the threshold, with its teachers' and without.

    Args:
        root: The runs folder.
        runs: The runs with their metrics, as they count.
        groups: Groups in the order of the rows.
        reference: Baseline of groups that are no cells.

    Returns:
        ``COLUMNS``, one row a group with runs: mean ``own_steps`` (restricted, where some run never reached);
        ``teacher_steps``, mean length of the runs that its teachers are the end of, 0 without one, NaN if not known;
        ``teacher_to_threshold``, the mean steps in which these cells' runs of the same seeds met the threshold, which
        a teacher that stops there would cost (it was not tried what it would teach); ``saved_steps`` less than the
        baseline without the teacher's; and how many students of one teacher make up for it, if they save anything.
    """
    used = {group: runs[(runs["group"] == group) & runs["counted"]] for group in groups}
    teachers = teacher_steps(root, runs)
    own = {group: _steps(frame) for group, frame in used.items()}
    rows = []
    for group, frame in used.items():
        if not len(frame):
            continue
        baseline = CELLS[group].baseline or "" if group in CELLS else reference
        baseline = baseline if baseline != group else ""
        taught = float(teachers[frame.index].mean(skipna=False))
        saved = own.get(baseline, _NAN) - own[group]
        row: dict[str, Any] = {"group": group, "baseline": baseline, "runs": len(frame)}
        row |= {"censored": int(frame["censored"].sum()), "own_steps": own[group], "teacher_steps": taught}
        row |= {"total_steps": own[group] + taught, "baseline_steps": own.get(baseline, _NAN), "saved_steps": saved}
        row["teacher_to_threshold"] = _teachers_threshold(runs, frame) if taught > 0 else _NAN
        row["students_to_repay"] = float(np.ceil(taught / saved)) if taught > 0 and saved > 0 else _NAN
        rows.append(row)
    return pd.DataFrame(rows, columns=COLUMNS)


def teacher_steps(root: Path, runs: pd.DataFrame) -> pd.Series:
    """Steps that each run's teacher was trained for, as the run's report of its transfer says; 0: it had none."""
    told = {name: _told(root / run["directory"], run["transfer"]) for name, run in runs.iterrows()}
    return pd.Series(told, dtype=float)


def _told(directory: Path, transfer: object) -> float:
    try:
        report = read_mapping(directory / TRANSFER_FILE)
    except DamagedError:
        return _NAN
    teacher = report.get("teacher")
    if isinstance(teacher, dict):
        steps = number(teacher.get("global_step"))
        return _NAN if steps is None else steps
    none = next(cell.transfer for cell in CELLS.values() if cell.teaches)
    return 0.0 if transfer == none or (report and teacher is None) else _NAN


def _steps(frame: pd.DataFrame) -> float:
    if not len(frame) or bias(frame) or stopped_before(frame).any():
        return _NAN
    return restricted_mean(frame["time"], ~frame["censored"].astype(bool), common_horizon(frame))


def _teachers_threshold(runs: pd.DataFrame, students: pd.DataFrame) -> float:
    teaching = [cell.name for cell in CELLS.values() if cell.teaches]
    theirs = runs[runs["group"].isin(teaching) & runs["counted"] & runs["seed"].isin(students["seed"])]
    whole = len(theirs) and set(theirs["seed"]) >= set(students["seed"]) and not theirs["censored"].any()
    return float(theirs["time"].mean()) if whole else _NAN
