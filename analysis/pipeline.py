"""All steps in a row: runs -> metrics -> comparisons -> tables and figures -> report."""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from acmr.records import CELLS
from analysis.comparisons import check_reference, compare_cells, compare_groups
from analysis.load import InputError, RunSet, load
from analysis.metrics import measure
from analysis.missing import Missing, matrix_command, missing_runs, planned_seeds, profile_of
from analysis.summary import left_out_lines, missing_lines, print_summary, result_lines
from analysis.tables import cell_table

#: The paper's threshold and count (section 4.2), for runs that do not say theirs.
PAPER_THRESHOLD, PAPER_CONSECUTIVE = 4900.0, 5


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

    @property
    def planned(self) -> int:
        """Seeds that a cell is planned to have."""
        return len(planned_seeds(self.data.runs))

    @property
    def planned_runs(self) -> int:
        """Runs of the whole matrix."""
        return len(CELLS) * self.planned

    @property
    def comparisons(self) -> pd.DataFrame:
        """Rows of table 3 and of the other groups."""
        return pd.concat([self.table3, self.others], ignore_index=True) if len(self.others) else self.table3


def analyze(
    data: RunSet, threshold: float | None = None, consecutive: int | None = None, reference: str = "A0"
) -> Analysis:
    """All numbers of a set of runs.

    Args:
        data: The runs.
        threshold: Return to reach; None: the runs' own.
        consecutive: Episodes in a row; None: the runs' own.
        reference: Group in A0's place.

    Raises:
        InputError: If the runs differ in their thresholds and none is given, or the reference is not there.
    """
    check_reference(reference, data.groups)
    limit = threshold if threshold is not None else _common(data, "threshold", PAPER_THRESHOLD)
    count = consecutive if consecutive is not None else int(_common(data, "consecutive", PAPER_CONSECUTIVE))
    measured = measure(data, limit, count)
    planned = len(planned_seeds(data.runs))
    return Analysis(
        data=data,
        threshold=limit,
        consecutive=count,
        reference=reference,
        measured=_check_summaries(measured, threshold is None and consecutive is None),
        cells=cell_table(measured, data.groups),
        table3=compare_cells(measured, reference, planned),
        others=compare_groups(measured, reference, planned),
        missing=missing_runs(data),
    )


def run(options: argparse.Namespace) -> int:
    """What the command line asks for; see :func:`analysis.cli.main`."""
    data = load(options.runs)
    missing, planned = missing_runs(data), len(CELLS) * len(planned_seeds(data.runs))
    lines = missing_lines(missing, planned, matrix_command(data))
    if not len(data.episodes):
        said = [f"{options.runs}: no run with episodes to analyze", *left_out_lines(data.runs), *lines]
        print("\n".join(said), file=sys.stderr)
        return 1
    analysis = analyze(data, options.threshold, options.consecutive, options.reference)
    closing = [] if options.summary else _write(analysis, options)
    title = f"Steps to threshold {analysis.threshold:g} ({analysis.consecutive} episodes in a row), {profile_of(data)}"
    print_summary(analysis.cells, analysis.comparisons, title)
    print("\n".join(["", *left_out_lines(analysis.measured), *lines, *closing]))
    return 0


def _write(analysis: Analysis, options: argparse.Namespace) -> list[str]:
    """Writes the results, unless they are there; what to say of them."""
    from analysis.fingerprint import STAMP, fingerprint, is_current

    out: Path = options.out or Path("results") / options.runs.resolve().name
    asked = {key: value for key, value in vars(options).items() if key not in ("runs", "out", "if_changed")}
    value = fingerprint(analysis.data, out, asked)
    if options.if_changed and is_current(out, value):
        return [f"results: {out}/ (nothing has changed since they were written)", f"report:  {out / 'report.html'}"]
    from analysis.results import write_results

    (out / STAMP).unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        written = write_results(analysis, out, options, Path(scratch))
    (out / STAMP).write_text(value + "\n", encoding="utf-8")
    return [*written.left_out, *result_lines(out, written.tables, written.figures)]


def _common(data: RunSet, name: str, default: float) -> float:
    values = sorted(set(data.runs[name].dropna()))
    if len(values) > 1:
        said = ", ".join(f"{value:g}" for value in values)
        raise InputError(f"{data.root}: the runs' own {name} differs ({said}); give one, as in --{name} {values[0]:g}")
    return float(values[0]) if values else default


def _check_summaries(measured: pd.DataFrame, own: bool) -> pd.DataFrame:
    """Says so where a run's summary tells other steps to threshold than its episodes do."""
    if not own:
        return measured
    told = measured["steps_in_summary"]
    odd = told.notna() & (told != measured["steps_to_threshold"])
    for name in measured.index[odd]:
        note = f"summary.json says {told[name]:,.0f} steps to threshold, its episodes say otherwise"
        reason = measured.loc[name, "reason"]
        measured.loc[name, "reason"] = f"{reason}; {note}" if reason else note
    return measured
