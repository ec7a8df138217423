"""From a set of runs to all numbers of the analysis, before anything is written."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property

import pandas as pd

from acmr.cells import REFERENCE
from acmr.records import SUMMARY_FILE
from analysis.loading.load import InputError, RunSet
from analysis.loading.missing import Missing, missing_runs, planned_runs, planned_seeds, profile_of
from analysis.loading.read_run import DAMAGED, SUPERSEDED
from analysis.statistics.comparisons import check_reference, compare_cells, compare_groups
from analysis.statistics.early_ends import settle
from analysis.statistics.metrics import measure
from analysis.statistics.study.study import Study, study
from analysis.statistics.summaries import cell_table

#: The paper's threshold and count (section 4.2), for runs that do not say theirs.
PAPER_THRESHOLD, PAPER_CONSECUTIVE = 4900.0, 5
#: What is said where two runs that should be the same are not.
DIFFERS = "their steps to threshold differ"


@dataclass(frozen=True)
class Analysis:
    """All numbers, before anything is written.

    Attributes:
        data: The runs.
        measured: The runs with their metrics.
        cells: Steps to threshold by group.
        table3: The paper's comparisons.
        others: The comparisons of groups that are no cells.
        missing: Runs of the matrix that are not there.
        margin: Steps that count as no difference, for equivalence; None: a share of a full run.
    """

    data: RunSet
    threshold: float
    consecutive: int
    reference: str
    measured: pd.DataFrame
    cells: pd.DataFrame
    table3: pd.DataFrame
    others: pd.DataFrame
    missing: list[Missing]
    margin: float | None = None

    @property
    def planned(self) -> int:
        """Seeds that a cell of the paper is planned to have."""
        return len(planned_seeds(self.data.runs))

    @property
    def planned_runs(self) -> int:
        """Runs that there should be: every cell with every seed."""
        return planned_runs(self.data)

    @property
    def notices(self) -> list[str]:
        """What a reader has to know first: biased groups, runs that contradict each other, what is not known."""
        odd = self.measured[self.measured["reason"].str.contains(DIFFERS, regex=False)]
        contradictions = [f"{name} ({run['state']}): {run['reason']}" for name, run in odd.iterrows()]
        return [*dict.fromkeys(filter(None, self.measured["bias"])), *contradictions, *self.doubts]

    @property
    def doubts(self) -> list[str]:
        """What is not known of runs that count, since a file of theirs was changed, cut off or is missing."""
        told = self.measured[self.measured["counted"] & (self.measured["doubts"] != "")]
        return [f"not all is known of {name}: {run['doubts']}" for name, run in told.iterrows()]

    @cached_property
    def study(self) -> Study:
        """What stands beyond table 3; it takes seconds, and not everybody who analyzes asks for it."""
        asked = (self.threshold, self.consecutive, self.reference, self.margin)
        return study(self.data, self.measured, *asked)

    @property
    def comparisons(self) -> pd.DataFrame:
        """Rows of table 3 and of the other groups."""
        return pd.concat([self.table3, self.others], ignore_index=True) if len(self.others) else self.table3


def analyze(
    data: RunSet,
    threshold: float | None = None,
    consecutive: int | None = None,
    reference: str = REFERENCE,
    margin: float | None = None,
) -> Analysis:
    """All numbers of a set of runs.

    Args:
        data: The runs.
        threshold: Return to reach; None: the runs' own.
        consecutive: Episodes in a row; None: the runs' own.
        reference: Group in A0's place.
        margin: Steps that count as no difference, for equivalence; None: a share of a full run.

    Raises:
        InputError: If the runs differ in their thresholds and none is given, or the reference is not there.
    """
    check_reference(reference, data.groups)
    limit = threshold if threshold is not None else _common(data, "threshold", PAPER_THRESHOLD)
    count = consecutive if consecutive is not None else int(_common(data, "consecutive", PAPER_CONSECUTIVE))
    seeds = planned_seeds(data.runs)
    measured = settle(measure(data, limit, count), seeds, profile_of(data))
    planned = len(seeds)
    told = threshold is None and consecutive is None
    return Analysis(
        data=data,
        threshold=limit,
        consecutive=count,
        reference=reference,
        measured=_check_superseded(_check_summaries(measured) if told else measured),
        cells=cell_table(measured, data.groups),
        table3=compare_cells(measured, reference, planned),
        others=compare_groups(measured, reference, planned),
        missing=missing_runs(data),
        margin=margin,
    )


def _common(data: RunSet, name: str, default: float) -> float:
    values = sorted(set(data.runs.loc[data.runs["state"] != DAMAGED, name].dropna()))
    if len(values) > 1:
        said = ", ".join(f"{value:g}" for value in values)
        raise InputError(f"{data.root}: the runs' own {name} differs ({said}); give one, as in --{name} {values[0]:g}")
    return float(values[0]) if values else default


def _check_summaries(measured: pd.DataFrame) -> pd.DataFrame:
    """Says so where a run's summary tells other steps to threshold than its episodes do."""
    told = measured["steps_in_summary"]
    odd = told.notna() & (told != measured["steps_to_threshold"])
    for name in measured.index[odd]:
        note = f"{SUMMARY_FILE} says {told[name]:,.0f} steps to threshold, its episodes say otherwise"
        _add_reason(measured, name, note)
    return measured


def _check_superseded(measured: pd.DataFrame) -> pd.DataFrame:
    """Says so where a run that stopped at its threshold tells other steps to it than the run that counts in its place.

    Both are the same run as far as both go; where they are not, one was made by another program or machine.
    """
    for name, run in measured[measured["state"] == SUPERSEDED].iterrows():
        same = measured[(measured["group"] == run["group"]) & (measured["seed"] == run["seed"]) & measured["counted"]]
        for kept, other in same.iterrows():
            watched = min(run["horizon"], other["horizon"])
            times = [_time_within(row, watched) for row in (run, other)]
            if times[0] != times[1]:
                _add_reason(measured, name, f"{DIFFERS}: {_steps(run)} here, {_steps(other)} in {kept}")
    return measured


def _time_within(run: pd.Series, steps: float) -> float | None:
    """Steps to threshold as far as they lie within these steps."""
    return None if run["censored"] or run["time"] > steps else float(run["time"])


def _steps(run: pd.Series) -> str:
    return f"{'not reached by ' if run['censored'] else ''}{run['time']:,.0f}"


def _add_reason(measured: pd.DataFrame, name: Hashable, note: str) -> None:
    row = measured.index == name
    measured.loc[row, "reason"] = [f"{reason}; {note}" if reason else note for reason in measured.loc[row, "reason"]]
